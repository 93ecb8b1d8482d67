"""The backend "mujoco": its motion against Pinocchio and DART, and the limits and parameters of its motors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from gym_mara.backends import make_backend
from gym_mara.backends.mujoco.backend import MujocoBackend
from gym_mara.backends.mujoco.model import build_model
from gym_mara.backends.servo import SimulationDivergedError
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.testing import assert_same_state, pickled, uniform_q
from gym_mara.types import Floats
from tests.helpers import robot_model, upright_arm, write

# The path from home is free of collisions.
FREE_TARGET = np.array([0.3, 0.5, -0.6, 0.4, 0.7, -0.9])
# A cart on a slope that carries a pole: a prismatic joint, friction and damping. The hinge is too weak to hold the pole.
SLIDER = """
<robot name="slider">
  <link name="rail"><collision><origin xyz="-0.5 0 -0.3"/><geometry><box size="0.2 2 0.2"/></geometry></collision></link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="0.6 0.8 0"/>
    <limit lower="-0.4" upper="0.5" effort="40" velocity="0.8"/><dynamics damping="2" friction="1.5"/></joint>
  <link name="cart"><inertial><mass value="2"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.02" ixy="0.001" ixz="0.002" iyz="0.003"/></inertial>
    <collision><geometry><sphere radius="0.05"/></geometry></collision></link>
  <joint name="hinge" type="revolute"><parent link="cart"/><child link="pole"/>
    <origin xyz="0 0.1 0" rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="3"/></joint>
  <link name="pole"><inertial><origin xyz="0 0 -0.25"/><mass value="1"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 -0.3"/><geometry><cylinder radius="0.03" length="0.4"/></geometry></collision></link>
</robot>
"""
# A foot of 1 kg that one joint presses on a table, and another moves along the table.
FOOT = """
<robot name="foot">
  <link name="table"><collision><geometry><box size="4 1 0.2"/></geometry></collision></link>
  <joint name="x" type="prismatic"><parent link="table"/><child link="carriage"/><axis xyz="1 0 0"/><origin xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="500" velocity="0.5"/></joint>
  <link name="carriage"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="z" type="prismatic"><parent link="carriage"/><child link="foot"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="0" effort="30" velocity="0.5"/></joint>
  <link name="foot"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
</robot>
"""
# A finger on the base and a bar on the first link, which follow the second and the third joint.
FOLLOWERS = """
  <link name="finger"/>
  <joint name="finger" type="prismatic"><parent link="base"/><child link="finger"/><axis xyz="0 0 1"/>
    <mimic joint="j3" multiplier="0.5"/></joint>
  <link name="bar"><inertial><mass value="0.2"/>
    <inertia ixx="0.002" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="bar" type="revolute"><parent link="l1"/><child link="bar"/><origin xyz="-0.1 0 0.3"/><axis xyz="0 1 0"/>
    <mimic joint="j2" multiplier="-2" offset="0.1"/></joint>"""
ENGINE_PARAMETERS = {
    "mass": (0.8, 1.2),
    "effort_limit": (0.9, 1.1),
    "joint_friction": (0.0, 0.5),
    "contact_friction": (0.5, 1.0),
}

pytestmark = pytest.mark.filterwarnings("ignore:.*below the weight of the arm")  # on purpose


@pytest.fixture
def slider(tmp_path: Path) -> RobotModel:
    return RobotModel.load(write(tmp_path / "slider.urdf", SLIDER), "pole")


@pytest.fixture(params=["mara", "slider", "ur5"])
def robot(request: pytest.FixtureRequest, slider: RobotModel) -> RobotModel:
    return slider if request.param == "slider" else robot_model(request.param)


def _run(backend: MujocoBackend, target: Floats, steps: int) -> list[SimState]:
    """The states of one arm that moves to a target."""
    return [backend.step(target[None]) for _ in range(steps)]


def _torque(state: SimState) -> Floats:
    assert state.torque is not None
    return state.torque


def _with(robot: RobotModel, control_period: float = 0.02, **parameters: float) -> MujocoBackend:
    """One arm with these parameters."""
    ranges = {name: (value, value) for name, value in parameters.items()}
    backend = MujocoBackend(robot, 1, control_period=control_period, randomisation=ranges)
    backend.begin_episodes(np.zeros(1, np.uint64), np.ones(1, np.bool_))
    return backend


def test_an_arm_without_motors_accelerates_as_pinocchio_says(robot: RobotModel) -> None:
    model, joints = build_model(robot, 0.002), robot.num_joints
    # Pinocchio's algorithm has no contact, end stops or Coulomb friction; in MuJoCo they are constraints.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT.value
    data, reference = mujoco.MjData(model), robot.model.createData()
    rng = np.random.default_rng(0)
    for q in uniform_q(robot, 20, 0):
        qd = rng.uniform(-1.0, 1.0, joints) * robot.velocity_limit
        data.qpos[:joints], data.qvel[:joints] = q, qd
        mujoco.mj_forward(model, data)
        expected = pin.aba(robot.model, reference, q, qd, -robot.model.damping * qd)
        np.testing.assert_allclose(data.qacc[:joints], expected, rtol=1e-5, atol=1e-5)


def test_an_arm_without_motors_falls_as_pinocchio_says(mara: RobotModel) -> None:
    step = 0.002
    model = build_model(mara, step)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT.value
    data, reference = mujoco.MjData(model), mara.model.createData()
    for q in uniform_q(mara, 20, seed=3):
        mujoco.mj_resetData(model, data)
        data.qpos[:6] = q
        position, velocity, none = q.copy(), np.zeros(6), np.zeros(6)
        for _ in range(200):
            mujoco.mj_step(model, data)
            velocity += step * pin.aba(mara.model, reference, position, velocity, none)
            position += step * velocity
        np.testing.assert_allclose(data.qpos[:6], position, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", ["mara", "ur5"])
def test_in_free_space_it_moves_as_dart(name: str) -> None:
    robot = robot_model(name)
    targets = robot.home + np.random.default_rng(0).uniform(-0.8, 0.8, (6, robot.num_joints))
    targets = targets.clip(robot.lower, robot.upper)
    dart, mine = make_backend("dart", robot, 6, {"workers": 1}), MujocoBackend(robot, 6)
    for _ in range(100):
        expected, state = dart.step(targets), mine.step(targets)
        assert not expected.collided.any()
        assert not state.collided.any()
        np.testing.assert_allclose(state.q, expected.q, rtol=0.0, atol=2e-3)
    np.testing.assert_allclose(_torque(state), _torque(expected), rtol=0.0, atol=0.1)


def test_with_darts_physics_step_the_paths_are_equal(mara: RobotModel) -> None:
    """The rest of the difference is that motors at their limit accelerate for whole physics steps."""
    dart = make_backend("dart", mara, 1, {})
    mine = MujocoBackend(mara, 1, physics_step=0.001)
    for _ in range(100):
        expected, state = dart.step(FREE_TARGET[None]), mine.step(FREE_TARGET[None])
        np.testing.assert_allclose(state.q, expected.q, rtol=0.0, atol=5e-5)


@pytest.mark.parametrize("target", [FREE_TARGET, *(FREE_TARGET * np.eye(6))])
def test_targets_are_reached_without_overshoot(mara: RobotModel, target: Floats) -> None:
    for state in _run(MujocoBackend(mara, 1), target, 150):
        beyond = (state.q[0] - target) * np.sign(target)
        assert (beyond <= 0.01 * np.abs(target) + 2e-5).all()
    np.testing.assert_allclose(state.q[0], target, rtol=0.0, atol=1e-4)


def test_a_pose_is_held_against_gravity(robot: RobotModel) -> None:
    backend = MujocoBackend(robot, 1)
    q = np.zeros(2) if robot.num_joints == 2 else FREE_TARGET * [1, -1, 1, 1, 1, 1]
    backend.reset(q[None])
    states = _run(backend, q, 300)
    for state in states:
        np.testing.assert_allclose(state.q[0], q, rtol=0.0, atol=1e-4)
    gravity = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q)
    friction = robot.model.friction
    away = np.abs(_torque(state)[0] - gravity)
    assert (away <= 0.01 + friction).all()


def test_motors_and_joints_stay_within_their_limits(robot: RobotModel) -> None:
    backend = MujocoBackend(robot, 4)
    efforts = []
    for targets in np.split(uniform_q(robot, 240, 0), 60):
        state = backend.step(targets)
        assert (np.abs(state.qd) <= backend.joint_velocity).all()
        assert (state.q >= robot.lower - backend.overshoot).all()
        assert (state.q <= robot.upper + backend.overshoot).all()
        efforts.append(np.abs(_torque(state)).max(axis=0))
    assert (np.max(efforts, axis=0) <= robot.effort_limit).all()
    assert (np.max(efforts, axis=0) > 0.9 * robot.effort_limit).any()


def test_in_free_space_no_joint_is_faster_than_its_limit(mara: RobotModel) -> None:
    backend = MujocoBackend(mara, 1)
    before = backend.state.q
    for target in np.repeat([0.5, -0.5, 0.3], 20):
        (state,) = _run(backend, np.full(6, target), 1)
        speed = np.abs(state.q - before) / backend.control_period  # qd is clipped to the limit
        assert (speed <= 1.001 * mara.velocity_limit).all()
        before = state.q


def test_joints_move_at_max_joint_velocity(mara: RobotModel) -> None:
    backend = MujocoBackend(mara, 1, max_joint_velocity=0.5)
    np.testing.assert_array_equal(backend.joint_velocity, 0.5)
    speeds = np.abs([state.qd[0] for state in _run(backend, FREE_TARGET, 40)])
    np.testing.assert_allclose(speeds.max(axis=0)[1:3], 0.5, atol=1e-4)
    assert (speeds <= 0.5).all()


def test_a_motor_too_weak_to_hold_its_load_lets_it_sink(slider: RobotModel) -> None:
    backend, side = MujocoBackend(slider, 1), np.array([0.0, 1.5])  # 2.5 Nm
    backend.reset(side[None])
    state = _run(backend, side, 10)[-1]
    assert state.q[0, 1] < 1.4
    np.testing.assert_allclose(_torque(state)[0, 1], slider.effort_limit[1], rtol=1e-6)


def test_a_prismatic_joint_with_friction_and_damping_reaches_its_target(slider: RobotModel) -> None:
    state = _run(MujocoBackend(slider, 1), np.array([0.4, 0.0]), 150)[-1]
    np.testing.assert_allclose(state.q[0, 0], 0.4, atol=1e-4)


def test_friction_and_damping_load_the_motor(tmp_path: Path) -> None:
    """At a constant 0.5 m/s against a friction of 1.5 N and a damping of 2 Ns/m."""
    xml = FOOT.replace(
        'velocity="0.5"/></joint>',
        'velocity="0.5"/><dynamics damping="2" friction="1.5"/></joint>',
        1,
    )
    robot = RobotModel.load(write(tmp_path / "foot.urdf", xml), "foot")
    state = _run(MujocoBackend(robot, 1), np.array([0.9, 0.0]), 30)[-1]
    np.testing.assert_allclose(_torque(state)[0, 0], 1.5 + 2.0 * 0.5, atol=1e-4)
    np.testing.assert_allclose(state.qd[0, 0], 0.5, atol=1e-5)


def test_a_joint_that_mimics_another_follows_it(tmp_path: Path) -> None:
    robot = RobotModel.load(write(tmp_path / "arm.urdf", upright_arm(FOLLOWERS)), "tool")
    backend = MujocoBackend(robot, 1)
    assert len(robot.followers) == 2
    for target in np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3)):
        for _ in range(10):
            q = backend.step(target[None]).q
            assert q.shape == (1, 3)
            expected = [each.position(q[0]) for each in robot.followers]
            np.testing.assert_allclose(backend._states[0, backend._follower_q], expected, atol=1e-3)
    assert np.abs(q).max() > 0.05


def test_an_arm_with_a_joint_that_follows_is_restored_to_the_bit(tmp_path: Path) -> None:
    robot = RobotModel.load(write(tmp_path / "arm.urdf", upright_arm(FOLLOWERS)), "tool")
    backend, other = MujocoBackend(robot, 2), MujocoBackend(robot, 2)
    targets = np.array([[0.5, 0.9, -0.4], [1.0, -0.5, 0.3]])
    backend.step(targets)
    other.restore(pickled(backend.save()))
    for _ in range(20):
        assert_same_state(other.step(targets), backend.step(targets))


def test_random_masses_change_the_torques_at_rest(mara: RobotModel) -> None:
    backend = _with(mara, mass=1.2)
    state = _run(backend, FREE_TARGET, 200)[-1]
    data = mara.model.createData()
    gravity = pin.computeGeneralizedGravity(mara.model, data, state.q[0])
    np.testing.assert_allclose(_torque(state)[0], 1.2 * gravity, rtol=0.0, atol=0.02)


def test_a_random_effort_limit_limits_the_motors(mara: RobotModel) -> None:
    backend, outstretched = (
        _with(mara, effort_limit=0.1),
        np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.0]),
    )
    backend.reset(outstretched[None])
    states = _run(backend, outstretched, 20)
    assert states[-1].q[0, 1] > 1.6
    for state in states:
        assert (np.abs(_torque(state)) <= 0.1 * mara.effort_limit).all()


@pytest.mark.parametrize("friction", [0.0, 3.0])
def test_random_joint_friction_loads_the_motors(tmp_path: Path, friction: float) -> None:
    robot = RobotModel.load(write(tmp_path / "foot.urdf", FOOT), "foot")
    backend = _with(robot, joint_friction=friction)
    torque = _torque(_run(backend, np.array([0.9, 0.0]), 30)[-1])[0]
    np.testing.assert_allclose(torque[0], friction, rtol=0.0, atol=0.01)


@pytest.mark.parametrize("friction", [0.2, 0.9])
def test_random_contact_friction_brakes_links_that_slide(tmp_path: Path, friction: float) -> None:
    robot = RobotModel.load(write(tmp_path / "foot.urdf", FOOT), "foot")
    # Every physics step is seen: a link that slides hops, and is braked only while it touches.
    backend = _with(robot, contact_friction=friction, control_period=0.002)
    states = _run(backend, np.array([-0.8, -1.0]), 2000)
    np.testing.assert_allclose(_torque(states[-1])[0, 1], -30.0, rtol=1e-3)
    states = _run(backend, np.array([0.9, -1.0]), 1000)[100:]
    np.testing.assert_allclose([state.qd[0, 0] for state in states], 0.5, rtol=0.05)
    braking = np.mean([_torque(state)[0, 0] for state in states])
    np.testing.assert_allclose(braking, friction * (30.0 + 9.81), rtol=0.02)


def test_each_arm_has_parameters_of_its_own(mara: RobotModel) -> None:
    """As an arm alone with the same seed, to the bit, although their models have other numbers of constraints."""
    ranges = {**ENGINE_PARAMETERS, "latency": (0.0, 0.05)}
    seeds, targets = np.arange(6, dtype=np.uint64), uniform_q(mara, 6, 1)
    together = MujocoBackend(mara, 6, randomisation=ranges, threads=2)
    together.begin_episodes(seeds, np.ones(6, np.bool_))
    together.reset(np.zeros((6, 6)))
    together._models[2].dof_frictionloss[:3] = 0.0
    states = [together.step(targets) for _ in range(30)]
    assert len({*states[-1].q[:, 0]}) == 6
    for arm in range(6):
        alone = MujocoBackend(mara, 1, randomisation=ranges)
        alone.begin_episodes(seeds[[arm]], np.ones(1, np.bool_))
        alone.reset(np.zeros((1, 6)))
        if arm == 2:
            alone._models[0].dof_frictionloss[:3] = 0.0
        for state in states:
            np.testing.assert_array_equal(alone.step(targets[[arm]]).q[0], state.q[arm])


def test_arms_share_a_model_unless_the_engine_is_random(mara: RobotModel) -> None:
    models = MujocoBackend(mara, 3, randomisation={"latency": (0.0, 0.01)})._models
    assert len({id(model) for model in models}) == 1
    models = MujocoBackend(mara, 3, randomisation={"mass": (0.9, 1.1)})._models
    assert len({id(model) for model in models}) == 3


def _diverge(backend: MujocoBackend, arm: int) -> None:
    """Give an arm a state from which no engine can continue."""
    backend._states[arm, backend._joint_v] = 1e200


def test_a_state_that_diverges_is_an_error_from_which_a_reset_recovers(
    mara: RobotModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    backend, untouched = (MujocoBackend(mara, 2, threads=threads) for threads in (2, 1))
    _diverge(backend, 1)
    with pytest.raises(SimulationDivergedError, match=r"arm 1 diverged 0\.020 s after its reset"):
        backend.step(np.full((2, 6), 0.2))
    for each in (backend, untouched):
        each.reset(np.zeros((2, 6)))
    expected = untouched.step(np.full((2, 6), 0.2))
    assert_same_state(backend.step(np.full((2, 6), 0.2)), expected)
    assert list(tmp_path.iterdir()) == []  # MuJoCo's log
    assert capfd.readouterr() == ("", "")


def test_an_arm_whose_state_diverges_is_reported_where_it_was_before(mara: RobotModel) -> None:
    backend = MujocoBackend(mara, 2, on_divergence="truncate")
    before = backend.step(np.full((2, 6), 0.2))
    _diverge(backend, 1)
    state = backend.step(np.full((2, 6), 0.2))
    assert state.diverged is not None
    assert state.diverged.tolist() == [False, True]
    np.testing.assert_array_equal(state.q[1], before.q[1])
    np.testing.assert_array_equal(state.qd[1], before.qd[1])
    assert (state.q[0] > before.q[0]).all()
    state = backend.step(np.full((2, 6), 0.2))
    assert state.diverged is not None
    assert not state.diverged.any()
    assert (state.q[1] > before.q[1]).all()


def test_an_arm_at_which_mujoco_stops_has_diverged(mara: RobotModel) -> None:
    """MuJoCo stops at a warning; here a follower's, a shaft's or another value that is not among the joints'."""
    backend = MujocoBackend(mara, 2, on_divergence="truncate")
    backend._warmstarts[1] = 1e200
    state = backend.step(np.full((2, 6), 0.2))
    assert state.diverged is not None
    assert state.diverged.tolist() == [False, True]
    assert all(np.isfinite(values).all() for values in (state.q, state.qd, _torque(state)))


def test_another_programs_handler_of_warnings_stays(mara: RobotModel) -> None:
    def handler(message: str) -> None:
        raise AssertionError(message)

    mujoco.set_mju_user_warning(handler)
    try:
        backend = MujocoBackend(mara, 2, on_divergence="truncate")
        _diverge(backend, 1)
        backend.step(np.full((2, 6), 0.2))
        assert mujoco.get_mju_user_warning() is handler
    finally:
        mujoco.set_mju_user_warning(None)


@pytest.mark.parametrize(
    "settings",
    [
        {"physics_step": 0.003},
        {"physics_step": 0.0},
        {"physics_step": -0.001},
        {"physics_step": 0.04},
        {"servo_gain": 0.0},
        {"servo_gain": np.nan},
        {"max_joint_velocity": -1.0},
        {"on_divergence": "ignore"},
        {"threads": 0},
        {"threads": -1},
        {"threads": 1.5},
        {"threads": True},
        {"threads": 100_000},
        {"threads": "all"},
        {"randomisation": {"mass": (1.2, 0.8)}},
        {"randomisation": {"mass": (0.0, 1.0)}},
        {"randomisation": {"latency": (-0.01, 0.0)}},
        {"randomisation": [1.0]},
        {"randomisation": {"colour": (0.0, 1.0)}},
    ],
    ids=str,
)
def test_bad_settings_are_refused(mara: RobotModel, settings: dict[str, Any]) -> None:
    with pytest.raises(GymMaraError, match=str(next(iter(settings)))):
        MujocoBackend(mara, 1, **settings)


@pytest.mark.parametrize(
    ("count", "settings"),
    [(2**16 + 1, {}), (2**15, {"control_period": 1.0, "physics_step": 1e-4})],
    ids=str,
)
def test_more_arms_than_memory_are_refused(
    mara: RobotModel, count: int, settings: dict[str, Any]
) -> None:
    with pytest.raises(GymMaraError, match="num_envs must be at most"):
        make_backend("mujoco", mara, count, settings)


def test_a_snapshot_of_other_arms_is_refused(mara: RobotModel) -> None:
    with pytest.raises(GymMaraError, match="of the snapshot does not fit"):
        MujocoBackend(mara, 2).restore(MujocoBackend(mara, 3).save())


def test_a_robot_without_inertia_is_refused(tmp_path: Path) -> None:
    path = write(
        tmp_path / "massless.urdf", SLIDER.replace('<mass value="1"/>', '<mass value="0"/>')
    )
    with pytest.raises(GymMaraError, match="link pole: no mass"):
        MujocoBackend(RobotModel.load(path, "pole"), 1)
