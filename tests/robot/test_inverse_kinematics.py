"""Inverse kinematics: poses within reach are reached, others are missed by as little as possible."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from gym_mara.collision import make_checker
from gym_mara.robot import RobotModel
from gym_mara.robot.catalog import robot_names
from gym_mara.robot.inverse_kinematics import _PoseError, miss, solve_ik
from gym_mara.rotations import angle_between
from gym_mara.testing import uniform_q
from tests.helpers import MODULAR_ARMS, Floats, joint_xml, robot_model, urdf_xml, write


def _rail(folder: Path) -> RobotModel:
    """An arm on a rail longer than one turn, with a second sliding joint and a continuous one."""
    joints = [
        joint_xml(0, "prismatic", "0 1 0", limit=_limit(0.0, 6.0)),
        joint_xml(1, "revolute", "1 2 -0.5"),
        joint_xml(2, "continuous", "0 -1 0"),
        joint_xml(3, "prismatic", "1 0 1"),
        joint_xml(4),
        joint_xml(5, axis="1 0 0"),
    ]
    return RobotModel.load(write(folder / "rail.urdf", urdf_xml(*joints)), "link6")


def _limit(lower: float, upper: float) -> str:
    return f'<limit lower="{lower}" upper="{upper}" effort="10" velocity="2"/>'


def _assert_all_reached(
    robot: RobotModel, q: Floats, metres: float = 1e-6, radians: float = 1e-6
) -> None:
    """The end effector's poses at q (N, J) are reached within the limits."""
    kinematics = robot.kinematics()
    positions, quaternions = kinematics.pose(q)
    found = np.array([solve_ik(robot, *pose) for pose in zip(positions, quaternions, strict=True)])
    assert (robot.lower <= found).all()
    assert (found <= robot.upper).all()
    reached_positions, reached_quaternions = kinematics.pose(found)
    distance = np.linalg.norm(reached_positions - positions, axis=1)
    # The arc cosine of angle_between rounds to 1e-8 rad.
    angle = angle_between(reached_quaternions, quaternions)
    assert np.flatnonzero((distance > metres) | (angle > radians)).tolist() == []


@pytest.mark.parametrize("name", ["mara", "3 joints", "7 joints", "rail", "ur5"])
def test_every_pose_that_the_arm_can_take_is_reached(tmp_path: Path, name: str) -> None:
    robot = (
        _rail(tmp_path)
        if name == "rail"
        else robot_model(name)
        if name in robot_names()
        else RobotModel.from_modules(MODULAR_ARMS[int(name[0])])
    )
    low, high = robot.lower, robot.upper
    _assert_all_reached(robot, np.random.default_rng(5).uniform(low, high, (500, len(low))))


def test_an_arm_of_five_joints_never_seems_out_of_reach() -> None:
    """Its branches of configurations come so close to each other that a few poses are missed by up to 0.2 mm."""
    robot = RobotModel.from_modules(MODULAR_ARMS[5])
    q = np.random.default_rng(5).uniform(robot.lower, robot.upper, (100, 5))
    _assert_all_reached(robot, q, 1e-3, 1e-2)


@pytest.mark.parametrize("name", ["mara", "panda"])
def test_an_orientation_is_reached_at_any_position(name: str) -> None:
    robot = robot_model(name)
    for quaternion in robot.kinematics().pose(uniform_q(robot, 50, 1))[1]:
        (turned,) = robot.kinematics().pose(solve_ik(robot, None, quaternion)[None])[1]
        assert angle_between(turned, quaternion) < 1e-6
    distance, angle = miss(robot, None, quaternion)
    assert distance == 0.0
    assert angle < 1e-6


def test_joints_without_limits_are_solved_for() -> None:
    robot = robot_model("panda")
    endless = np.full(robot.num_joints, np.inf)
    _assert_all_reached(
        dataclasses.replace(robot, lower=-endless, upper=endless), uniform_q(robot, 20, 0)
    )


def test_a_joint_that_cannot_move_stays_where_it_is() -> None:
    robot = robot_model("mara")
    lower, upper = robot.lower.copy(), robot.upper.copy()
    lower[[0, 3]] = upper[[0, 3]] = [0.5, -0.2]
    home = np.clip(robot.home, lower, upper)
    robot = dataclasses.replace(robot, lower=lower, upper=upper, home=home)
    _assert_all_reached(robot, np.random.default_rng(0).uniform(lower, upper, (20, 6)))


def test_an_arm_that_cannot_move_at_all_is_at_home() -> None:
    robot = robot_model("mara")
    robot = dataclasses.replace(robot, lower=robot.home, upper=robot.home)
    np.testing.assert_array_equal(solve_ik(robot, np.ones(3), None), robot.home)


def test_limits_beyond_one_turn_are_kept(tmp_path: Path) -> None:
    joints = joint_xml(0, limit=_limit(4.0, 6.0)), joint_xml(1), joint_xml(2, axis="1 0 0")
    robot = RobotModel.load(write(tmp_path / "far.urdf", urdf_xml(*joints)), "link3")
    _assert_all_reached(robot, np.random.default_rng(0).uniform(robot.lower, robot.upper, (20, 3)))


@pytest.mark.parametrize("name", ["mara", "panda"])
def test_a_reachable_pose_is_not_missed(name: str) -> None:
    robot = robot_model(name)
    position, quaternion = (rows[0] for rows in robot.kinematics().pose(uniform_q(robot, 1, 0)))
    assert miss(robot, position, quaternion) == pytest.approx((0.0, 0.0), abs=1e-6)
    distance, angle = miss(robot, position, None)
    assert distance < 1e-6
    assert angle == 0.0


def test_the_jacobian_is_the_derivative_of_the_residuals() -> None:
    robot = robot_model("panda")
    q, other = uniform_q(robot, 2, 1)
    position, quaternion = (rows[0] for rows in robot.kinematics().pose(other[None]))
    error = _PoseError(robot, position, quaternion)
    steps = 1e-6 * np.eye(robot.num_joints)
    columns = [(error(q + step) - error(q - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(error.jacobian(q), np.transpose(columns), rtol=0.0, atol=1e-7)


@pytest.mark.parametrize(
    "point", [(0.0, 0.0, 2.5), (0.0, 1.4, 0.8), (-2.0, 1.0, 0.5), (2.0, 0.0, 1.0), (5.0, 0.0, 1.0)]
)
def test_a_point_out_of_reach_is_missed_by_the_least_distance_that_is_possible(
    point: tuple[float, float, float],
) -> None:
    mara = robot_model("mara")
    distance, angle = miss(mara, np.array(point), None)
    positions = mara.kinematics().pose(uniform_q(mara, 50_000, 1))[0]
    nearest = np.linalg.norm(positions - point, axis=1).min()
    assert angle == 0.0
    assert nearest - 0.1 < distance <= nearest


def test_a_pose_within_reach_in_position_only_is_missed_in_angle() -> None:
    mara = robot_model("mara")
    (highest,), (quaternion,) = mara.kinematics().pose(np.zeros((1, 6)))
    upside_down = np.array([0.0, 1.0, 0.0, 0.0])
    assert miss(mara, highest, None)[0] < 1e-6
    assert miss(mara, highest, quaternion) == pytest.approx((0.0, 0.0), abs=1e-6)
    distance, angle = miss(mara, highest, upside_down)
    assert distance > 1e-3 or angle > 1e-2


def test_the_target_of_mara_is_reached_without_collision() -> None:
    mara = robot_model("mara")
    q = solve_ik(
        mara, np.array([-0.40028, 0.095615, 0.72466]), np.array([0.0, 0.5**0.5, 0.5**0.5, 0.0])
    )
    assert not make_checker("coal", mara).check(q[None]).any()
    assert q[3] == pytest.approx(0.0, abs=1e-2)
