"""The dynamic backend: its motion against Pinocchio, its contacts against Coal, and the limits of its motors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from gym_mara.backends import make_backend
from gym_mara.backends.dart.arm import DartArm
from gym_mara.backends.dart.backend import DartBackend
from gym_mara.backends.dart.shapes import DETECTORS
from gym_mara.backends.servo import SimulationDivergedError
from gym_mara.collision import make_checker
from gym_mara.collision.coal import CoalChecker, approach_bounds
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import COLLIDING_Q, assert_same_state, pickled, uniform_q
from gym_mara.types import Floats
from tests.helpers import robot_model, upright_arm, write

# The path from home is free of collisions.
FREE_TARGET = np.array([0.3, 0.5, -0.6, 0.4, 0.7, -0.9])
# A bar beside the second link, which turns with it, twice as far.
BAR = """
  <link name="bar">{}<collision><origin xyz="0 0 0.15"/><geometry><box size="0.02 0.02 0.2"/></geometry></collision></link>
  <joint name="bar" type="revolute"><parent link="l1"/><child link="bar"/><origin xyz="-0.1 0 0.3"/><axis xyz="0 1 0"/>
    <mimic joint="j2" multiplier="2" offset="-0.1"/></joint>"""
BAR_INERTIAL = """
  <inertial><mass value="0.2"/><inertia ixx="0.002" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>"""


def _run(backend: DartBackend, target: Floats, steps: int) -> tuple[Floats, Floats]:
    """Positions and torques (steps, J) of one arm that moves to a target."""
    positions, torques = [], []
    for _ in range(steps):
        state = backend.step(target[None])
        assert not state.collided.any()
        positions.append(state.q[0])
        assert state.torque is not None
        torques.append(state.torque[0])
    return np.array(positions), np.array(torques)


def test_its_bodies_are_where_pinocchio_has_them(mara: RobotModel) -> None:
    arm, data = DartArm(mara), mara.model.createData()
    for q in uniform_q(mara, 50, seed=1):
        arm.reset(q)
        pin.forwardKinematics(mara.model, data, q)
        for body, placement in zip(arm.bodies, data.oMi, strict=True):
            transform = body.getWorldTransform().matrix()
            np.testing.assert_allclose(transform, placement.homogeneous, rtol=0.0, atol=1e-9)


def _fall(robot: RobotModel, q: Floats, step: float, seconds: float = 1.0) -> tuple[Floats, Floats]:
    """Where an arm without motors is after a while: by DART, and by Pinocchio's ABA with the same integrator."""
    arm = DartArm(robot, step, None, servo=False)
    arm.reset(q)
    model, data = robot.model, robot.model.createData()
    position, velocity, none = q.copy(), np.zeros_like(q), np.zeros_like(q)
    for _ in range(round(seconds / step)):
        arm.world.step()
        velocity += step * pin.aba(model, data, position, velocity, none)
        position += step * velocity
    return arm.q, position


def test_it_falls_as_pinocchio_says(mara: RobotModel) -> None:
    for q in uniform_q(mara, 20, seed=3):
        mine, theirs = _fall(mara, q, 1e-3)
        np.testing.assert_allclose(mine, theirs, rtol=0.0, atol=1e-7)


def test_its_fall_converges_in_proportion_to_the_step(mara: RobotModel) -> None:
    for q in uniform_q(mara, 6, seed=4):
        exact = _fall(mara, q, 2e-5, 0.5)[1]
        error = {step: np.abs(_fall(mara, q, step, 0.5)[0] - exact).max() for step in (1e-3, 1e-4)}
        assert error[1e-4] < 0.2 * error[1e-3]
        assert error[1e-3] < 0.3  # rad


def _energies(arm: DartArm, seconds: float) -> tuple[Floats, Floats]:
    """Kinetic and total energy of an arm without motors, J."""
    kinetic, potential = [], []
    for _ in range(round(seconds / arm.physics_step)):
        arm.world.step()
        kinetic.append(arm.skeleton.computeKineticEnergy())
        potential.append(arm.skeleton.computePotentialEnergy())
    return np.array(kinetic), np.array(kinetic) + np.array(potential)


def test_a_swinging_arm_keeps_its_energy(mara: RobotModel) -> None:
    arm = DartArm(mara, 1e-3, None, servo=False)
    arm.reset(np.array([0.3, 2.6, 0.3, 0.2, 0.3, 0.0]))  # nearly hanging
    kinetic, total = _energies(arm, 10.0)
    assert np.abs(total - total[0]).max() < 0.05 * kinetic.max()


def test_the_energy_of_a_falling_arm_drifts_in_proportion_to_the_step(mara: RobotModel) -> None:
    drifts = []
    for step in (1e-3, 1e-4):
        arm = DartArm(mara, step, None, servo=False)
        arm.reset(np.array([0.5, 1.0, 0.5, 0.3, -0.5, 0.0]))
        kinetic, total = _energies(arm, 1.0)
        drifts.append(np.abs(total - total[0]).max() / kinetic.max())
    assert drifts[0] < 0.1
    assert drifts[1] < 0.15 * drifts[0]


@pytest.mark.parametrize("target", [FREE_TARGET, *(FREE_TARGET * np.eye(6))])
def test_targets_are_reached_without_overshoot(mara: RobotModel, target: Floats) -> None:
    backend = DartBackend(mara, 1)
    positions, _ = _run(backend, target, 150)
    assert np.abs(positions[-1] - target).max() < 1e-4
    beyond = (positions - target) * np.sign(target)
    assert (beyond <= 0.01 * np.abs(target) + 1e-6).all()


def test_a_pose_is_held_against_gravity(mara: RobotModel) -> None:
    backend = DartBackend(mara, 1)
    backend.reset(FREE_TARGET[None])
    positions, torques = _run(backend, FREE_TARGET, 500)
    assert np.abs(positions - FREE_TARGET).max() < 1e-4
    data = mara.model.createData()
    gravity = pin.computeGeneralizedGravity(mara.model, data, FREE_TARGET)
    np.testing.assert_allclose(torques[-1], gravity, rtol=0.0, atol=1e-2)


def test_motors_are_no_stronger_than_their_limits(mara: RobotModel) -> None:
    backend = DartBackend(mara, 1)
    _, torques = _run(backend, FREE_TARGET, 50)
    assert (np.abs(torques) <= mara.effort_limit * 1.01).all()


def test_a_motor_too_weak_to_hold_the_arm_lets_it_sink(mara: RobotModel) -> None:
    backend = DartBackend(mara, 1, randomisation={"effort_limit": (0.1, 0.1)})
    outstretched = np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.0])
    backend.begin_episodes(np.zeros(1, np.uint64), np.ones(1, np.bool_))
    backend.reset(outstretched[None])
    for _ in range(20):
        state = backend.step(outstretched[None])
    assert state.q[0, 1] > 1.6


def test_joints_move_at_max_joint_velocity(mara: RobotModel) -> None:
    backend = DartBackend(mara, 1, max_joint_velocity=0.5)
    speeds = np.abs([backend.step(FREE_TARGET[None]).qd[0] for _ in range(40)])
    np.testing.assert_allclose(speeds.max(axis=0)[1:3], 0.5, atol=1e-6)
    assert (speeds <= 0.5 + 1e-9).all()


def test_in_free_space_it_ends_where_the_kinematic_backend_does(mara: RobotModel) -> None:
    dynamic = DartBackend(mara, 1)
    kinematic = make_backend("pinocchio", mara, 1, {"max_joint_velocity": 1.57})
    apart = []
    for _ in range(150):
        states = [b.step(FREE_TARGET[None]) for b in (dynamic, kinematic)]
        apart.append(np.abs(states[0].q - states[1].q).max())
    # The servo slows down over limit / gain = 0.157 rad; the kinematic joint does not.
    assert 0.01 < max(apart) < 0.157
    assert apart[-1] < 1e-5
    np.testing.assert_allclose(states[0].ee_position, states[1].ee_position, atol=1e-5)


@pytest.mark.parametrize("detector", DETECTORS)
def test_contacts_are_those_that_coal_finds(mara: RobotModel, detector: str) -> None:
    arm, coal = DartArm(mara, detector=detector), make_checker("coal", mara)
    poses = uniform_q(mara, 10_000 if detector == "fcl" else 500, seed=8)
    found = []
    for q in poses:
        arm.reset(q)
        found.append(bool(arm.contacts()))
    differs = poses[np.array(found) != coal.check(poses)]
    data, geometry_data = mara.model.createData(), mara.geometry.createData()
    for q in differs:
        pin.computeDistances(mara.model, data, mara.geometry, geometry_data, q)
        assert abs(min(r.min_distance for r in geometry_data.distanceResults)) < 1e-3
    assert len(differs) < 0.01 * len(poses)


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_another_robot_has_contacts_where_coal_finds_them(name: str) -> None:
    robot = robot_model(name)
    arm, coal = DartArm(robot), make_checker("coal", robot)
    poses = uniform_q(robot, 60, seed=4)
    flags = []
    for q in poses:
        arm.reset(q)
        flags.append(bool(arm.contacts()))
    np.testing.assert_array_equal(flags, coal.check(poses))


def test_another_robot_falls_as_pinocchio_says() -> None:
    robot = robot_model("ur5")  # without damping, as MARA: DART integrates damping implicitly
    mine, theirs = _fall(robot, uniform_q(robot, 1, seed=4)[0], 1e-3, 0.5)
    np.testing.assert_allclose(mine, theirs, rtol=0.0, atol=1e-7)


def test_contacts_name_the_links_and_their_depth(mara: RobotModel) -> None:
    backend = DartBackend(mara, 1)
    backend.reset(np.array([COLLIDING_Q]))
    assert backend.state.contacts is not None
    (contacts,) = backend.state.contacts
    assert contacts
    for contact in contacts:
        assert "table" in contact.links
        assert 0.0 <= contact.depth < 0.5


def test_no_contact_is_missed_where_collision_detection_is_skipped(mara: RobotModel) -> None:
    """Against an arm that detects contacts at every physics step."""
    rng = np.random.default_rng(5)
    careful, quick = DartArm(mara), DartArm(mara)
    careful.may_touch = lambda: True  # type: ignore[method-assign]
    touched = 0
    for q in uniform_q(mara, 60, seed=6):
        careful.reset(q)
        quick.reset(q)
        for velocity in rng.uniform(-1.57, 1.57, (3, 6)):
            commands = np.tile(velocity, (20, 1))
            expected = careful.run(commands)
            assert quick.run(commands) == expected
            touched += bool(expected)
    assert 20 < touched < 160


def test_links_approach_no_more_than_the_bounds_say(mara: RobotModel) -> None:
    rng = np.random.default_rng(2)
    data, geometry_data = mara.model.createData(), mara.geometry.createData()

    def distances(q: Floats) -> Floats:
        pin.computeDistances(mara.model, data, mara.geometry, geometry_data, q)
        return np.array([r.min_distance for r in geometry_data.distanceResults])

    for q in uniform_q(mara, 20, seed=2):
        displacement = rng.uniform(0.0, 0.3, 6)
        moved = q + rng.choice([-1.0, 1.0], 6) * displacement
        nearer = distances(q) - distances(moved)
        assert (nearer <= approach_bounds(mara, displacement) + 1e-6).all()


@pytest.mark.parametrize(
    "settings",
    [
        {"physics_step": 0.003},
        {"physics_step": 0.0},
        {"physics_step": -0.001},
        {"physics_step": 0.04},
        {"servo_gain": 0.0},
        {"max_joint_velocity": -1.0},
        {"detector": "none"},
        {"on_divergence": "ignore"},
        {"randomisation": {"mass": (1.2, 0.8)}},
        {"randomisation": {"mass": (0.0, 1.0)}},
        {"randomisation": {"latency": (-0.01, 0.0)}},
        {"randomisation": {"mass": 1.0}},
        {"randomisation": [1.0]},
        {"randomisation": {"colour": (0.0, 1.0)}},
    ],
    ids=str,
)
def test_bad_settings_are_refused(mara: RobotModel, settings: dict[str, Any]) -> None:
    with pytest.raises(GymMaraError, match=str(next(iter(settings)))):
        DartBackend(mara, 1, **settings)


def _diverge(backend: DartBackend, index: int) -> None:
    """Give an arm a state from which no engine can continue."""
    arm = backend.arms[index]
    arm.set_state(arm.q, np.full(6, 1e200))


def test_a_state_that_diverges_is_an_error_from_which_a_reset_recovers(mara: RobotModel) -> None:
    backend, untouched = DartBackend(mara, 2), DartBackend(mara, 2)
    _diverge(backend, 1)
    with pytest.raises(SimulationDivergedError, match=r"arm 1 diverged 0\.020 s after its reset"):
        backend.step(np.full((2, 6), 0.2))
    assert backend.state.diverged is None
    for each in (backend, untouched):
        each.reset(np.zeros((2, 6)))
    expected = untouched.step(np.full((2, 6), 0.2))
    assert_same_state(backend.step(np.full((2, 6), 0.2)), expected)


def test_an_arm_whose_state_diverges_is_reported_where_it_was_before(mara: RobotModel) -> None:
    backend = DartBackend(mara, 2, on_divergence="truncate")
    before = backend.step(np.full((2, 6), 0.2))
    assert before.diverged is not None
    assert not before.diverged.any()
    _diverge(backend, 1)
    state = backend.step(np.full((2, 6), 0.2))
    assert state.diverged is not None
    assert state.diverged.tolist() == [False, True]
    np.testing.assert_array_equal(state.q[1], before.q[1])
    np.testing.assert_array_equal(state.qd[1], before.qd[1])
    assert (state.q[0] > before.q[0]).all()
    snapshot = pickled(backend.save())
    backend.reset(np.zeros((2, 6)), state.diverged)
    assert backend.state.diverged is not None
    assert not backend.state.diverged.any()
    state = backend.step(np.full((2, 6), 0.2))
    assert state.diverged is not None
    assert not state.diverged.any()
    np.testing.assert_array_less(0.0, state.q[1])
    backend.restore(snapshot)
    assert backend.state.diverged is not None
    assert backend.state.diverged.tolist() == [False, True]


@pytest.mark.parametrize("inertial", ["", BAR_INERTIAL])
def test_a_joint_that_mimics_another_follows_it_into_contacts(
    tmp_path: Path, inertial: str
) -> None:
    robot = RobotModel.load(write(tmp_path / "arm.urdf", upright_arm(BAR.format(inertial))), "tool")
    data, checker = robot.model.createData(), make_checker("coal", robot)
    backend, collisions = DartBackend(robot, 1), 0
    for target in np.random.default_rng(0).uniform(-1.5, 1.5, (30, 3)):
        backend.reset(np.zeros((1, 3)))
        for _ in range(15):
            state = backend.step(target[None])
            if state.collided[0]:
                collisions += 1
                assert CoalChecker(robot, np.full(3, 0.1)).check(state.q)[0]
                break
            assert not checker.check(state.q)[0]
            pin.forwardKinematics(robot.model, data, state.q[0])
            for body, placement in zip(backend.arms[0].bodies, data.oMi, strict=True):
                transform = body.getWorldTransform().matrix()
                np.testing.assert_allclose(transform, placement.homogeneous, rtol=0.0, atol=1e-9)
    assert 5 < collisions < 25


def test_an_arm_with_a_joint_that_follows_is_restored_to_the_bit(tmp_path: Path) -> None:
    text = upright_arm(BAR.format(BAR_INERTIAL))
    robot = RobotModel.load(write(tmp_path / "arm.urdf", text), "tool")
    backend, target = DartBackend(robot, 2), np.array([[0.5, 0.9, -0.4], [1.0, -0.5, 0.3]])
    backend.step(target)
    snapshot = pickled(backend.save())
    expected = [backend.step(target) for _ in range(20)]
    other = DartBackend(robot, 2)
    other.restore(snapshot)
    for state in expected:
        assert_same_state(other.step(target), state)
