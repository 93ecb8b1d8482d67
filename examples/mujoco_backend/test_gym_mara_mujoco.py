"""The MuJoCo backend: the contract of every backend, and what is specific to MuJoCo."""

from __future__ import annotations

import importlib
import sys
import types
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from gym_mara_mujoco import MujocoBackend, build_model

from gym_mara.backends import make_backend
from gym_mara.collision import make_checker
from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import BackendContract, Make, uniform_q

pytestmark = pytest.mark.filterwarnings("ignore:.*below the weight of the arm")  # on purpose

# A cart that carries a pole: a prismatic joint, other shapes, friction and damping. The hinge is too weak to hold the pole.
SLIDER = """
<robot name="slider">
  <link name="rail"><collision><origin xyz="-0.5 0 -0.3"/>
    <geometry><box size="0.2 2 0.2"/></geometry></collision></link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="0.6 0.8 0"/>
    <limit lower="-0.4" upper="0.5" effort="40" velocity="0.8"/>
    <dynamics damping="2" friction="1.5"/></joint>
  <link name="cart"><inertial><mass value="2"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.02" ixy="0.001" ixz="0.002" iyz="0.003"/></inertial>
    <collision><geometry><sphere radius="0.05"/></geometry></collision></link>
  <joint name="hinge" type="revolute"><parent link="cart"/><child link="pole"/>
    <origin xyz="0 0.1 0" rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="3"/></joint>
  <link name="pole"><inertial><origin xyz="0 0 -0.25"/><mass value="1"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 -0.3"/>
      <geometry><cylinder radius="0.03" length="0.4"/></geometry></collision></link>
</robot>
"""


@pytest.fixture
def mara() -> RobotModel:
    return RobotModel.load("mara")


@pytest.fixture
def slider(tmp_path: Path) -> RobotModel:
    path = tmp_path / "slider.urdf"
    path.write_text(SLIDER)
    return RobotModel.from_urdf(path, ee_frame="pole")


@pytest.fixture(params=["mara", "slider", "ur5"])
def robot(request: pytest.FixtureRequest) -> RobotModel:
    if request.param == "ur5":
        return RobotModel.load("ur5")  # has meshes
    return request.getfixturevalue(request.param)  # type: ignore[no-any-return]


class TestContract(BackendContract):
    @pytest.fixture
    def make(self, mara: RobotModel) -> Make:
        return lambda num_envs: MujocoBackend(mara, num_envs)


def test_an_arm_without_motors_accelerates_as_pinocchio_says(robot: RobotModel) -> None:
    model = build_model(robot, 0.002)
    # Pinocchio's algorithm has no contact, joint stops or Coulomb friction; in MuJoCo they are constraints.
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data, reference = mujoco.MjData(model), robot.model.createData()
    rng = np.random.default_rng(0)
    for q in uniform_q(robot, 20, 0):
        qd = rng.uniform(-1.0, 1.0, robot.num_joints) * robot.velocity_limit
        data.qpos[:], data.qvel[:] = q, qd
        mujoco.mj_forward(model, data)
        expected = pin.aba(robot.model, reference, q, qd, -robot.model.damping * qd)
        np.testing.assert_allclose(data.qacc, expected, rtol=1e-5, atol=1e-5)


def test_a_target_is_reached_and_held_against_gravity(mara: RobotModel) -> None:
    backend = MujocoBackend(mara, 1)
    target = np.array([[0.5, -0.4, 0.6, 0.3, -0.5, 0.2]])
    for _ in range(150):
        state = backend.step(target)
        assert not state.collided.any()
        assert ((state.q - target) * np.sign(target) <= 1e-4).all(), "no overshoot"
    for _ in range(50):
        state = backend.step(target)
        np.testing.assert_allclose(state.q, target, atol=1e-4)
        np.testing.assert_allclose(state.qd, 0.0, atol=1e-4)
    gravity = pin.computeGeneralizedGravity(mara.model, mara.model.createData(), target[0])
    assert state.torque is not None
    np.testing.assert_allclose(state.torque[0], gravity, atol=0.05)


def test_a_prismatic_joint_with_friction_reaches_its_target(slider: RobotModel) -> None:
    backend = MujocoBackend(slider, 1)
    target = np.array([[0.4, 0.0]])
    for _ in range(150):
        state = backend.step(target)
    np.testing.assert_allclose(state.q[0, 0], 0.4, atol=1e-3)


def test_motors_and_joints_stay_within_their_limits(robot: RobotModel) -> None:
    backend = MujocoBackend(robot, 4)
    rng = np.random.default_rng(0)
    low, high = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    efforts = []
    for _ in range(60):
        state = backend.step(rng.uniform(low, high, (4, robot.num_joints)))
        assert (np.abs(state.qd) <= backend.joint_velocity).all()
        assert ((state.q >= robot.lower) & (state.q <= robot.upper)).all()
        assert state.torque is not None
        efforts.append(np.abs(state.torque))
    assert (np.max(efforts, axis=(0, 1)) <= robot.effort_limit).all()


@pytest.mark.filterwarnings("ignore:.*they touch in the start pose")
def test_a_weak_arm_falls_onto_its_end_stop(tmp_path: Path) -> None:
    path = tmp_path / "weak.urdf"
    path.write_text(
        SLIDER.replace('lower="-2" upper="2" effort="1"', 'lower="1" upper="2" effort="0.1"')
    )
    robot = RobotModel.from_urdf(path, ee_frame="pole")
    backend = MujocoBackend(robot, 1)
    backend.reset(np.array([[0.0, 1.8]]))
    positions = []
    for _ in range(100):
        state = backend.step(np.array([[0.0, 1.8]]))
        assert state.torque is not None
        assert (np.abs(state.torque) <= robot.effort_limit).all()
        np.testing.assert_array_equal(state.q[0], backend._arms[0].qpos)
        positions.append(state.q[0, 1])
    assert min(positions) >= 1.0 - backend.overshoot
    np.testing.assert_allclose(positions[-10:], 1.0, atol=1e-3)


def test_a_joint_moves_at_max_joint_velocity(mara: RobotModel) -> None:
    backend = MujocoBackend(mara, 1, max_joint_velocity=0.5)
    np.testing.assert_array_equal(backend.joint_velocity, 0.5)
    backend.reset(np.zeros((1, 6)))
    first = backend.step(np.full((1, 6), -0.5))
    second = backend.step(np.full((1, 6), -0.5))
    np.testing.assert_allclose((second.q - first.q) / backend.control_period, -0.5, rtol=1e-4)


def test_in_free_space_no_joint_travels_faster_than_its_limit(mara: RobotModel) -> None:
    backend = MujocoBackend(mara, 1)
    before = backend.state.q
    for target in np.repeat([0.5, -0.5, 0.3], 20):
        state = backend.step(np.full((1, 6), target))
        assert not state.collided.any()
        speed = (
            np.abs(state.q - before) / backend.control_period
        )  # not qd, which is clipped to the limit
        assert (speed <= 1.001 * mara.velocity_limit).all()
        before = state.q


def test_a_motor_too_weak_to_hold_its_load_lets_it_fall(slider: RobotModel) -> None:
    backend = MujocoBackend(slider, 1)
    side = np.array([[0.0, 1.5]])  # 2.5 Nm
    backend.reset(side)
    for _ in range(10):
        state = backend.step(side)
    assert state.q[0, 1] < 1.4
    assert state.torque is not None
    assert state.torque[0, 1] == slider.effort_limit[1]


def test_at_equal_q_it_collides_where_the_pinocchio_backend_does(
    robot: RobotModel,
) -> None:
    q = uniform_q(robot, 300, 0)
    backend, other = MujocoBackend(robot, 300), make_backend("pinocchio", robot, 300, {})
    backend.reset(q)
    other.reset(q)
    expected = other.state.collided
    assert expected.any()
    assert not expected.all()
    np.testing.assert_array_equal(backend.state.collided, expected)


def test_mujoco_has_a_contact_wherever_links_touch(robot: RobotModel) -> None:
    """`collided` relies on it."""
    model = build_model(robot, 0.002)
    data = mujoco.MjData(model)
    q = uniform_q(robot, 300, 1)
    for row in q[make_checker("coal", robot).check(q)]:
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        assert data.ncon


@pytest.mark.parametrize("scale", ["1 1 1", "-1 1.5 0.8"])
def test_convex_hulls_touch_where_coal_says(tmp_path: Path, scale: str) -> None:
    """MuJoCo takes the hull of every mesh, here of an L; Coal takes it with `convex_hulls`."""
    legs = [trimesh.creation.box(size) for size in ((0.3, 0.1, 0.1), (0.1, 0.1, 0.3))]
    legs[0].apply_translation((0.1, 0.0, 0.0))
    legs[1].apply_translation((0.0, 0.0, 0.1))
    trimesh.util.concatenate(legs).export(tmp_path / "part.stl")
    mesh = f'<geometry><mesh filename="part.stl" scale="{scale}"/></geometry></collision>'
    fixed = f'<link name="rail"><collision><origin xyz="0.3 0.5 0"/>{mesh}'
    text = SLIDER.replace('<link name="rail">', fixed)
    path = tmp_path / "slider.urdf"
    path.write_text(text.replace("</inertial>", f"</inertial><collision>{mesh}"))
    robot = RobotModel.from_urdf(path, ee_frame="pole", convex_hulls=True)
    model = build_model(robot, 0.002)
    data, q = mujoco.MjData(model), uniform_q(robot, 300, 0)
    flags = make_checker("coal", robot).check(q)
    geometry_data = robot.geometry.createData()
    assert flags.any()
    assert not flags.all()
    for row, flag in zip(q, flags, strict=True):
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        if (data.ncon > 0) != flag:
            pin.computeDistances(
                robot.model, robot.model.createData(), robot.geometry, geometry_data, row
            )
            assert abs(min(r.min_distance for r in geometry_data.distanceResults)) < 1e-3


def test_the_table_stops_the_arm(mara: RobotModel) -> None:
    backend = MujocoBackend(mara, 1)
    target = np.array([[0.0, 2.0, 0.0, 0.0, 0.0, 0.0]])
    assert make_checker("coal", mara).check(target)
    backend.reset(np.zeros((1, 6)))
    states = [backend.step(target) for _ in range(200)]
    assert any(state.collided[0] for state in states)
    assert np.abs(states[-1].q - target).max() > 0.1
    np.testing.assert_allclose(states[-1].qd, 0.0, atol=1e-3)
    assert states[-1].contacts is not None
    (contacts,) = states[-1].contacts
    assert any("table" in contact.links for contact in contacts)
    assert all(0.0 <= contact.depth < 0.02 for contact in contacts)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"control_period": 0.0}, "control_period"),
        ({"physics_step": -1.0}, "physics_step"),
        ({"physics_step": 0.003}, "must divide"),
        ({"physics_step": 0.1}, "must divide"),
        ({"servo_gain": np.nan}, "servo_gain"),
        ({"max_joint_velocity": 0.0}, "max_joint_velocity"),
        ({"on_divergence": "ignore"}, "on_divergence"),
        ({"gain": 3.0}, "unknown keyword argument 'gain'"),
    ],
)
def test_a_bad_setting_is_an_error(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        MaraEnv("MARA-v0", backend="mujoco", **settings)


def test_a_snapshot_of_other_arms_is_refused(mara: RobotModel) -> None:
    with pytest.raises(GymMaraError, match="of the snapshot does not fit"):
        MujocoBackend(mara, 2).restore(MujocoBackend(mara, 3).save())


def test_a_state_that_diverges_is_an_error_or_ends_the_episode(
    mara: RobotModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log into the working directory
    backend = MujocoBackend(mara, 2)
    snapshot = backend.save()
    snapshot["states"][1] = 1e200
    backend.restore(snapshot)
    with pytest.raises(GymMaraError, match="arm 1 diverged"):
        backend.step(np.zeros((2, 6)))
    backend = MujocoBackend(mara, 2, on_divergence="truncate")
    backend.restore(snapshot)
    state = backend.step(np.full((2, 6), 0.2))
    assert state.diverged is not None
    assert state.diverged.tolist() == [False, True]
    np.testing.assert_array_equal(state.q[1], snapshot["q"][1])
    assert (backend.step(np.full((2, 6), 0.2)).q > 0.0).all()


def test_a_robot_without_inertia_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "massless.urdf"
    path.write_text(SLIDER.replace('<mass value="1"/>', '<mass value="0"/>'))
    with pytest.raises(GymMaraError, match="link pole: no mass"):
        MujocoBackend(RobotModel.from_urdf(path, ee_frame="pole"), 1)


@pytest.mark.parametrize("installed", [None, types.SimpleNamespace(__version__="3.1.6")])
def test_an_absent_or_old_mujoco_is_named(monkeypatch: pytest.MonkeyPatch, installed: Any) -> None:
    monkeypatch.delitem(sys.modules, "gym_mara_mujoco")
    monkeypatch.setitem(sys.modules, "mujoco", installed)
    with pytest.raises(GymMaraError, match=r"needs MuJoCo 3\.3 or newer"):
        importlib.import_module("gym_mara_mujoco")


def test_arms_in_worker_processes_move_as_in_one(mara: RobotModel) -> None:
    alone = MujocoBackend(mara, 4)
    spread = make_backend("mujoco", mara, 4, {"workers": 2})
    try:
        q, targets = uniform_q(mara, 4, 0), uniform_q(mara, 4, 1)
        for backend in (alone, spread):
            backend.reset(q)
        for _ in range(3):
            np.testing.assert_array_equal(spread.step(targets).q, alone.step(targets).q)
    finally:
        spread.close()


def test_a_joint_that_mimics_another_follows_it(tmp_path: Path) -> None:
    bar = """
      <joint name="bar" type="revolute"><parent link="rail"/><child link="bar"/><axis xyz="0 1 0"/>
        <mimic joint="hinge" multiplier="-2" offset="0.1"/></joint>
      <link name="bar"/>"""
    (tmp_path / "slider.urdf").write_text(SLIDER.replace("</robot>", f"{bar}</robot>"))
    robot = RobotModel.from_urdf(tmp_path / "slider.urdf", ee_frame="pole")
    backend = MujocoBackend(robot, 1)
    for target in np.random.default_rng(0).uniform(-0.4, 0.4, (20, 2)):
        for _ in range(10):
            state = backend.step(target[None])
            assert state.q.shape == (1, 2)
            bar_q = backend._arms[0].qpos[2]
            np.testing.assert_allclose(bar_q, -2.0 * state.q[0, 1] + 0.1, atol=1e-2)
    assert abs(state.q[0, 1]) > 0.01
