"""Parts of an observation that need the arm's geometry: each is what a search or an independent formula finds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import torch

from gym_mara import rotations
from gym_mara.arrays import host
from gym_mara.robot import RobotModel
from gym_mara.robot.clearance import Clearance
from gym_mara.state import SimState
from gym_mara.tasks import Goal
from gym_mara.tasks.arm_parts import DAMPING, STEP_TIME, ArmParts
from gym_mara.testing import pickled, uniform_q
from gym_mara.types import Floats
from tests.helpers import robot_model, write

SLOW = 0.02
"""The error within which actions slow down, m."""

# A carriage on a rail with two more joints, one of them along a slanted axis.
SLIDER = """
<robot name="slider">
  <link name="rail"><collision><geometry><box size="2 0.1 0.1"/></geometry></collision></link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><origin xyz="0 0 0.1"/><axis xyz="1 0 0"/>
    <limit lower="-0.6" upper="0.7" effort="300" velocity="0.8"/></joint>
  <link name="cart"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
  <joint name="shoulder" type="revolute"><parent link="cart"/><child link="upper"/><origin xyz="0 0 0.1"/><axis xyz="0 0.6 0.8"/>
    <limit lower="-2" upper="2" effort="60" velocity="1.5"/></joint>
  <link name="upper"><collision><origin xyz="0 0 0.3"/><geometry><cylinder radius="0.03" length="0.3"/></geometry></collision></link>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.1 0 0.5"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="30" velocity="2"/></joint>
  <link name="lower"/>
</robot>
"""

# Links of 0.7 m, whose spheres overlap by more than those of thin arms can.
THICK = """
<robot name="thick">
  <link name="base"><collision><geometry><box size="3 3 0.1"/></geometry></collision></link>
  <joint name="lift" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.8"/><axis xyz="0 1 0"/>
    <limit lower="-2.2" upper="2.2" effort="20" velocity="1.5"/></joint>
  <link name="upper"><collision><origin xyz="0 0 0.9"/><geometry><box size="0.7 0.7 1.2"/></geometry></collision></link>
  <joint name="bend" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 1.6"/><axis xyz="0 1 0"/>
    <limit lower="-2.8" upper="2.8" effort="10" velocity="2"/></joint>
  <link name="fore"><collision><origin xyz="0 0 0.9"/><geometry><box size="0.7 0.7 1.2"/></geometry></collision></link>
  <joint name="tip" type="fixed"><parent link="fore"/><child link="tool"/><origin xyz="0 0 1.6"/></joint>
  <link name="tool"/>
</robot>
"""
URDFS = {"slider": (SLIDER, "lower"), "thick": (THICK, "tool")}


@pytest.fixture(scope="module", params=["mara", "panda", *URDFS])
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    if request.param not in URDFS:
        return robot_model(request.param)
    urdf, tool = URDFS[request.param]
    path = write(tmp_path_factory.mktemp(request.param) / "robot.urdf", urdf)
    return RobotModel.from_urdf(path, ee_frame=tool)


def _state(robot: RobotModel, q: Floats) -> SimState:
    position, quaternion = robot.kinematics().pose(q)
    count = len(q)
    return SimState(
        q, 0 * q, position, quaternion, np.zeros((count, 3)), np.zeros(count, bool), np.zeros(count)
    )


def _least_distance(mara: RobotModel, q: Floats) -> Floats:
    return Clearance(mara)(mara.kinematics().joint_frames(q))[0].min(axis=1)


def _scene(robot: RobotModel, count: int = 30) -> tuple[SimState, Goal]:
    """Random states, and goals that are the poses of other random configurations."""
    goal = Goal(*robot.kinematics().pose(uniform_q(robot, count, seed=1)))
    return _state(robot, uniform_q(robot, count, seed=2)), goal


def _parts(robot: RobotModel, orientation: bool = True) -> ArmParts:
    return ArmParts(robot, robot.velocity_limit, orientation, 0.2, SLOW)


def test_no_other_angle_of_a_joint_brings_the_tool_nearer(robot: RobotModel) -> None:
    state, goal = _scene(robot)
    ways = _parts(robot).joint_ways(state, goal)
    kinematics = robot.kinematics()
    for joint in range(robot.num_joints):
        slides = bool(kinematics.prismatic[joint])
        tried = np.linspace(-2, 2, 401) if slides else np.linspace(-np.pi, np.pi, 721)
        q = np.repeat(state.q[:, None], len(tried), axis=1)
        q[..., joint] += tried
        position, _ = kinematics.pose(q.reshape(-1, robot.num_joints))
        away = np.linalg.norm(position.reshape(*q.shape[:2], 3) - goal.position[:, None], axis=2)
        for arm, best in enumerate(away.argmin(axis=1)):
            if np.ptp(away[arm]) < 0.1:
                continue  # the joint hardly changes the distance
            off = abs(np.angle(np.exp(1j * (ways[arm, joint] - tried[best]))))
            # It fades a little with short levers.
            assert off < 0.02 + 0.2 * abs(tried[best]), (joint, arm)
            assert np.sign(ways[arm, joint]) == np.sign(tried[best]) or off < 0.02


def test_no_other_angle_of_a_joint_aligns_the_tool_better(robot: RobotModel) -> None:
    state, goal = _scene(robot)
    turns = _parts(robot).joint_turns(state, goal)
    kinematics = robot.kinematics()
    for joint in range(robot.num_joints):
        if kinematics.prismatic[joint]:
            assert not turns[:, joint].any()
            continue
        tried = np.linspace(-np.pi, np.pi, 721)
        q = np.repeat(state.q[:, None], len(tried), axis=1)
        q[..., joint] += tried
        _, quaternion = kinematics.pose(q.reshape(-1, robot.num_joints))
        angle = rotations.angle_between(
            quaternion.reshape(*q.shape[:2], 4), goal.quaternion[:, None]
        )
        for arm, best in enumerate(angle.argmin(axis=1)):
            if np.ptp(angle[arm]) > 0.3:
                off = abs(np.angle(np.exp(1j * (turns[arm, joint] - tried[best]))))
                assert off < 0.02 + 0.1 * abs(tried[best]), (joint, arm)


@pytest.mark.parametrize("orientation", [False, True])
def test_joint_steps_are_the_damped_least_squares_of_pinocchios_jacobian(
    robot: RobotModel, orientation: bool
) -> None:
    state, goal = _scene(robot)
    steps = _parts(robot, orientation).joint_steps(state, goal)
    model, data = robot.model, robot.model.createData()
    for arm, q in enumerate(state.q):
        jacobian = pin.computeFrameJacobian(
            model, data, q, robot.ee_frame_id, pin.LOCAL_WORLD_ALIGNED
        )[:, : robot.num_joints]
        w, x, y, z = goal.quaternion[arm]
        here = data.oMf[robot.ee_frame_id]
        turn = pin.log3(pin.Quaternion(w, x, y, z).matrix() @ here.rotation.T)
        error = np.concatenate([goal.position[arm] - here.translation, 0.2 * turn])
        jacobian[3:] *= 0.2
        rows = 6 if orientation else 3
        own = jacobian[:rows]
        step = own.T @ np.linalg.solve(own @ own.T + DAMPING**2 * np.eye(rows), error[:rows])
        far = step / (np.abs(step).max() + 0.3)
        step /= STEP_TIME * robot.velocity_limit
        near = step / max(1.0, np.abs(step).max())
        np.testing.assert_allclose(steps[arm], [*near, *far], atol=1e-6)


def test_joint_steps_do_not_push_against_a_limit(robot: RobotModel) -> None:
    state, goal = _scene(robot)
    count = robot.num_joints
    free = _parts(robot).joint_steps(state, goal)[:, :count]
    joint = np.abs(free).argmax(axis=1)
    rows = np.arange(len(free))
    q = state.q.copy()
    limits = np.where(free[rows, joint] > 0.0, robot.upper[joint], robot.lower[joint])
    q[rows, joint] = limits
    pushed = _parts(robot).joint_steps(_state(robot, q), goal)[:, :count]
    outward = pushed[rows, joint] * np.sign(limits - 0.5 * (robot.lower + robot.upper)[joint])
    assert (outward <= 0.0).all()
    assert np.abs(pushed).max(axis=1).min() > 0.0


def test_the_pace_is_the_error_relative_to_the_distance_of_slowing_down(robot: RobotModel) -> None:
    there = _state(robot, uniform_q(robot, 30, seed=1))
    for away, angle, expected in ((0.3, 0.0, 1.0), (0.005, 0.0, 0.25), (0.003, 0.01, 0.25)):
        turn = np.array([[np.cos(angle / 2.0), 0.0, np.sin(angle / 2.0), 0.0]])
        goal = Goal(
            there.ee_position + np.array([0.0, away, 0.0]),
            rotations.multiply(turn, there.ee_quaternion),
        )
        pace = _parts(robot).pace(there, goal)
        np.testing.assert_allclose(pace, np.full((30, 1), expected), atol=1e-6)


def test_all_parts_stay_in_their_bounds_at_the_target_and_everywhere(robot: RobotModel) -> None:
    state, goal = _scene(robot)
    there = _state(robot, uniform_q(robot, 30, seed=1))
    for part in _parts(robot).parts():
        for at in (state, there):
            values = part.values(at, goal)
            assert values.shape == (30, len(part.low))
            assert np.isfinite(values).all(), part.name
            assert (values >= part.low).all(), part.name
            assert (values <= part.high).all(), part.name


def test_clearance_and_repulsion_tell_near_from_far() -> None:
    mara = robot_model("mara")
    q = np.zeros((40, 6))
    q[:, 1] = np.linspace(0.0, 1.9, 40)  # towards the table
    state, goal = _state(mara, q), Goal(*mara.kinematics().pose(q))
    parts = _parts(mara)
    least = _least_distance(mara, q)
    order = np.argsort(least)
    near = parts.clearance(state, goal)[order]
    assert (np.diff(near[:, :6].min(axis=1)) >= 0.0).all()
    assert (np.diff(near[:, 6:].max(axis=1)) <= 0.0).all()
    strength = np.abs(parts.joint_repulsions(state, goal)[:, 6:]).max(axis=1)
    assert strength[order[0]] > 2.0 * strength[order[-1]]


def test_tensors_give_the_numbers_of_arrays_and_a_copy_the_same(robot: RobotModel) -> None:
    state, goal = _scene(robot)
    names = ("q", "qd", "ee_position", "ee_quaternion", "ee_velocity", "collided", "time")
    values: dict[str, Any] = {name: torch.tensor(getattr(state, name)) for name in names}
    tensors = SimState(**values)
    target = Goal(torch.tensor(goal.position), torch.tensor(goal.quaternion))  # type: ignore[arg-type]
    parts = _parts(robot)
    for part, again in zip(parts.parts(), pickled(parts).parts(), strict=True):
        expected = part.values(state, goal)
        np.testing.assert_array_equal(again.values(state, goal), expected)
        np.testing.assert_allclose(host(part.values(tensors, target)), expected, atol=1e-11)
