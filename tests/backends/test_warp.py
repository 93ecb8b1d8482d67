"""The backend on MuJoCo Warp: against Pinocchio, Coal and MuJoCo; tensors, errors, messages.

All numbers of the engine are in single precision. The tolerances follow from it.
"""

from __future__ import annotations

import re
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import torch
import trimesh
import warp as wp

from gym_mara.backends import make_backend
from gym_mara.backends.servo import SimulationDivergedError
from gym_mara.backends.warp import WarpBackend, engine
from gym_mara.backends.warp.device import check_memory, compiling
from gym_mara.backends.warp.model import warp_model
from gym_mara.collision import make_checker
from gym_mara.errors import GymMaraError, MissingExtraError
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.testing import COLLIDING_Q, arrays_of, assert_same_state, pickled, uniform_q
from tests.helpers import WARP_DEVICE, upright_arm, write

# The path from home is free of collisions.
FREE_TARGET = np.array([0.3, 0.5, -0.6, 0.4, 0.7, -0.9])
ROUNDING = 1e-5
MODES: list[dict[str, Any]] = [
    {"physics_step": 0.004},
    {"dynamics": False},
    {"dynamics": False, "max_joint_velocity": 1.0},
]


def _warp(robot: RobotModel, num_envs: int, **settings: Any) -> WarpBackend:
    return WarpBackend(robot, num_envs, device=WARP_DEVICE, **settings)


def test_it_falls_as_pinocchio_says(mara: RobotModel) -> None:
    step, periods, q = 0.002, 15, uniform_q(mara, 10, seed=3)
    backend = _warp(mara, len(q), physics_step=step)
    # Without motors, end stops and contacts.
    backend._engine.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    backend.reset(q)
    states = [backend.step(q) for _ in range(periods)]
    data = mara.model.createData()
    for arm, start in enumerate(q):
        position, velocity, none = start.copy(), np.zeros(6), np.zeros(6)
        for _ in range(round(periods * backend.control_period / step)):
            velocity += step * pin.aba(mara.model, data, position, velocity, none)
            position += step * velocity
        np.testing.assert_allclose(states[-1].q[arm], position, rtol=0.0, atol=2e-4)


def test_arms_in_several_threads_do_not_disturb_each_other(mara: RobotModel) -> None:
    def states(_: int) -> list[SimState]:
        backend = _warp(mara, 2, dynamics=False)
        return [backend.step(q) for q in np.split(uniform_q(mara, 8, seed=1), 4)]

    with ThreadPoolExecutor(3) as threads:
        first, *others = threads.map(states, range(3))
    for other in others:
        for one, same in zip(first, other, strict=True):
            assert_same_state(one, same)


def test_links_touch_where_coal_says_but_within_a_millimetre(mara: RobotModel) -> None:
    q = uniform_q(mara, 400, seed=1)
    backend = _warp(mara, len(q), dynamics=False)
    state = backend.step(q)
    geometry, data = mara.geometry, mara.model.createData()
    result = geometry.createData()
    links = [
        tuple(sorted((mara.link_of(pair.first), mara.link_of(pair.second))))
        for pair in geometry.collisionPairs
    ]
    assert state.contacts is not None
    assert 100 < state.collided.sum() < 300
    for row, found in zip(q, state.contacts, strict=True):
        pin.computeDistances(mara.model, data, geometry, result, row)
        distances: dict[tuple[str, ...], float] = {}
        for pair, answer in zip(links, result.distanceResults, strict=True):
            distances[pair] = min(answer.min_distance, distances.get(pair, np.inf))
        touching = {contact.links for contact in found}
        assert {pair for pair, distance in distances.items() if distance < -1e-3} <= touching
        assert all(distances[pair] < 1e-3 for pair in touching)


def test_its_collisions_are_those_of_coal(mara: RobotModel) -> None:
    q = uniform_q(mara, 1000, seed=2)
    state = _warp(mara, len(q), dynamics=False).step(q)
    assert np.count_nonzero(state.collided != make_checker("coal", mara).check(q)) <= 1


def test_it_moves_as_mujoco_does_and_holds_the_arm_with_the_same_torques(mara: RobotModel) -> None:
    backends = _warp(mara, 1), make_backend("mujoco", mara, 1, {})
    paths = [[backend.step(FREE_TARGET[None]) for _ in range(100)] for backend in backends]
    for mine, theirs in zip(*paths, strict=True):
        np.testing.assert_allclose(mine.q, theirs.q, rtol=0.0, atol=2e-3)
    mine, theirs = paths[0][-1], paths[1][-1]
    assert mine.torque is not None
    assert theirs.torque is not None
    np.testing.assert_allclose(mine.torque, theirs.torque, rtol=0.0, atol=0.1)
    gravity = pin.computeGeneralizedGravity(mara.model, mara.model.createData(), FREE_TARGET)
    np.testing.assert_allclose(mine.torque[0], gravity, rtol=0.0, atol=0.1)


def test_without_dynamics_an_arm_needs_no_inertias_and_a_joint_that_follows_moves_along(
    tmp_path: Path,
) -> None:
    bar = """
      <link name="bar"><collision><origin xyz="0 0 0.15"/><geometry><box size="0.02 0.02 0.2"/></geometry></collision></link>
      <joint name="bar" type="revolute"><parent link="l1"/><child link="bar"/><origin xyz="-0.1 0 0.3"/>
        <axis xyz="0 1 0"/><mimic joint="j2" multiplier="2" offset="-0.1"/></joint>"""
    text = re.sub("<inertial>.*?</inertial>", "", upright_arm(bar), flags=re.DOTALL)
    robot = RobotModel.load(write(tmp_path / "arm.urdf", text), "tool")
    q = uniform_q(robot, 200, seed=0)
    state = _warp(robot, len(q), dynamics=False).step(q)
    np.testing.assert_array_equal(state.collided, make_checker("coal", robot).check(q))
    assert state.contacts is not None
    assert any("bar" in contact.links for found in state.contacts for contact in found)


RANDOM = {
    "mass": (0.7, 1.5),
    "effort_limit": (
        0.1,
        1.0,
    ),  # weaker motors drop the arm onto the table, where small differences grow
    "servo_gain": (5.0, 15.0),
    "joint_friction": (0.0, 5.0),
    "contact_friction": (0.1, 1.0),
    "latency": (0.0, 0.07),
    "sensor_noise": (0.0, 1e-3),
}


@pytest.mark.parametrize("name", RANDOM)
def test_random_parameters_act_as_in_mujoco(mara: RobotModel, name: str) -> None:
    settings: dict[str, Any] = {"randomisation": {name: RANDOM[name]}}
    seeds, every = np.arange(4, dtype=np.uint64), np.ones(4, np.bool_)
    # Where the arm slides over the table, small differences soon grow.
    steps, start, target = 15, (0.0, 1.5, 0.0, 0.0, 0.0, 0.0), FREE_TARGET
    if name == "contact_friction":
        steps, start, target = 6, (1.5, 1.9, 0.0, 0.0, 0.0, 0.0), np.array([0.5, 2.0, 0, 0, 0, 0])
    backends = _warp(mara, 4, **settings), make_backend("mujoco", mara, 4, settings)
    paths = []
    for backend in backends:
        backend.begin_episodes(seeds, every)
        backend.reset(np.tile(start, (4, 1)))
        paths.append([backend.step(np.tile(target, (4, 1))) for _ in range(steps)])
    for mine, theirs in zip(*paths, strict=True):
        assert mine.parameters is not None
        assert theirs.parameters is not None
        np.testing.assert_array_equal(mine.parameters[name], theirs.parameters[name])
        np.testing.assert_allclose(mine.q, theirs.q, rtol=0.0, atol=2e-3)
        assert mine.torque is not None
        assert theirs.torque is not None
        np.testing.assert_allclose(mine.torque, theirs.torque, rtol=0.01, atol=0.3)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"max_joint_velocity": 1.0},
        {"servo_gain": 10.0},
        {"servo_gain": 10.0, "max_joint_velocity": 1.0},
    ],
    ids=str,
)
def test_without_dynamics_it_moves_as_the_backend_pinocchio(
    mara: RobotModel, settings: dict[str, Any]
) -> None:
    mine = _warp(mara, 8, dynamics=False, **settings)
    theirs = make_backend("pinocchio", mara, 8, settings)
    # A servo makes a velocity of its gain times the way that is left.
    fast = dict.fromkeys(("qd", "ee_velocity"), ROUNDING * settings.get("servo_gain", 1.0))
    stopped = 0
    for target in uniform_q(mara, 8 * 4, seed=5, furthest=2.0).reshape(4, 8, 6):
        for backend in (mine, theirs):
            backend.reset(np.tile(mara.home, (8, 1)))
        for _ in range(100):
            state, expected = mine.step(target), theirs.step(target)
            np.testing.assert_array_equal(state.collided, expected.collided)
            for name in ("q", "qd", "ee_position", "ee_quaternion", "ee_velocity", "time"):
                actual, value = getattr(state, name), getattr(expected, name)
                atol = fast.get(name, ROUNDING)
                np.testing.assert_allclose(actual, value, rtol=0.0, atol=atol, err_msg=name)
            if settings:
                arrived = (np.abs(state.q - target) < ROUNDING).all(axis=1)
                stopped += int((state.collided & ~state.qd.any(axis=1) & ~arrived).sum())
    assert bool(stopped) == bool(settings)


def _numbers(state: SimState) -> SimState:
    """A state of tensors as one of NumPy's arrays."""
    values = {name: getattr(state, name) for name in vars(state)}
    for name, value in values.items():
        if isinstance(value, torch.Tensor):
            assert value.device.type == WARP_DEVICE.split(":")[0]
            assert value.dtype in (torch.float32, torch.bool)
            values[name] = value.cpu().numpy()
    return SimState(**values)


@pytest.mark.parametrize("settings", MODES, ids=str)
def test_tensors_have_the_values_of_arrays(mara: RobotModel, settings: dict[str, Any]) -> None:
    numbers, tensors = (_warp(mara, 3, arrays=a, **settings) for a in ("numpy", "torch"))
    assert (numbers.device, tensors.device) == (None, WARP_DEVICE)
    start = np.array([COLLIDING_Q, mara.home, mara.home])
    mask = np.array([True, False, True])
    for backend in (numbers, tensors):
        backend.reset(backend.asarray(np.tile(mara.home, (3, 1))))
        backend.step(backend.asarray(uniform_q(mara, 3, seed=1)))
        backend.reset(backend.asarray(start), backend.asarray(mask))
    targets = uniform_q(mara, 3 * 10, seed=4).reshape(10, 3, 6)
    states = [(numbers.state, tensors.state)]
    states += [(numbers.step(t), tensors.step(tensors.asarray(t))) for t in targets]
    collided = 0
    for expected, state in states:
        assert state.contacts is None
        actual = arrays_of(_numbers(state))
        assert actual.keys() == arrays_of(expected).keys()
        collided += int(expected.collided.sum())
        for name, value in arrays_of(expected).items():
            # NumPy's pose is computed in double precision from the same q.
            same = name in ("q", "qd", "torque") or value.dtype == np.bool_
            atol = 0.0 if same else ROUNDING
            np.testing.assert_allclose(actual[name], value, rtol=0.0, atol=atol, err_msg=name)
    assert collided


def test_states_of_tensors_do_not_change_later(mara: RobotModel) -> None:
    backend = _warp(mara, 2, arrays="torch", dynamics=False)
    target = backend.asarray(np.array([FREE_TARGET, COLLIDING_Q]))
    state = backend.step(target)
    kept = {name: value.clone() for name, value in vars(state).items() if value is not None}
    target.fill_(0.0)
    assert torch.equal(vars(backend.state)["q"], kept["q"])
    backend.step(target)
    backend.reset(target, backend.asarray(np.array([True, False])))
    for name, value in kept.items():
        assert torch.equal(getattr(state, name), value), name


def test_a_copy_of_a_backend_of_tensors_continues_identically(mara: RobotModel) -> None:
    backend = _warp(mara, 2, arrays="torch", physics_step=0.004)
    target = backend.asarray(np.array([FREE_TARGET, COLLIDING_Q]))
    backend.step(target)
    other = pickled(backend)
    for _ in range(3):
        expected, state = backend.step(target), other.step(target)
        assert_same_state(_numbers(state), _numbers(expected))


@pytest.mark.parametrize(
    ("arrays", "foreign"), [("numpy", torch.zeros(1, 6)), ("torch", np.zeros((1, 6)))], ids=str
)
def test_arrays_of_another_library_are_refused(mara: RobotModel, arrays: str, foreign: Any) -> None:
    backend = _warp(mara, 1, arrays=arrays, dynamics=False)
    q = backend.asarray(FREE_TARGET[None])
    before = backend.step(q)
    expected = f"arrays='{arrays}' the backend 'warp' takes .*{arrays}"
    with pytest.raises(GymMaraError, match=f"(?i)q_target is a .*{expected}"):
        backend.step(foreign)
    with pytest.raises(GymMaraError, match=f"(?i)q is a .*{expected}"):
        backend.reset(foreign)
    with pytest.raises(GymMaraError, match=f"(?i)mask is a .*{expected}"):
        backend.reset(q, foreign[0] > 0.0)
    assert (backend.state.q == before.q).all()


def test_tensors_of_another_device_are_refused(mara: RobotModel) -> None:
    backend = _warp(mara, 1, arrays="torch", dynamics=False)
    with pytest.raises(
        GymMaraError, match=rf"q_target is a torch.Tensor on meta.* on {WARP_DEVICE}"
    ):
        backend.step(torch.zeros(1, 6, device="meta"))  # type: ignore[arg-type]


def _too_fast(backend: WarpBackend) -> SimState:
    """Give the second arm a velocity at which its state has diverged; returns the state before."""
    snapshot = backend.save()
    snapshot["qd"][1] = 1e7
    backend.restore(snapshot)
    return backend.state


def test_an_arm_whose_state_diverges_is_reported_where_it_was_before(mara: RobotModel) -> None:
    backend = _warp(mara, 2, on_divergence="truncate")
    target = np.full((2, 6), 0.2)
    backend.step(target)
    before = _too_fast(backend)
    state = backend.step(target)
    assert before.diverged is not None
    assert state.diverged is not None
    assert state.torque is not None
    assert before.diverged.tolist() == [False, False]
    assert state.diverged.tolist() == [False, True]
    np.testing.assert_array_equal(state.q[1], before.q[1])
    assert not state.torque[1].any()
    assert (state.q[0] > before.q[0]).all()
    backend.reset(np.zeros((2, 6)), state.diverged)
    state = backend.step(target)
    assert state.diverged is not None
    assert not state.diverged.any()
    np.testing.assert_array_less(0.0, state.q[1])


def test_a_state_that_diverges_is_an_error_from_which_a_reset_recovers(mara: RobotModel) -> None:
    backend, untouched = _warp(mara, 2), _warp(mara, 2)
    target = np.full((2, 6), 0.2)
    _too_fast(backend)
    with pytest.raises(SimulationDivergedError, match=r"arm 1 diverged 0\.020 s after its reset"):
        backend.step(target)
    assert backend.state.diverged is None
    for each in (backend, untouched):
        each.reset(np.zeros((2, 6)))
    assert_same_state(backend.step(target), untouched.step(target))


def test_contacts_without_room_for_their_forces_are_warned_of_once(mara: RobotModel) -> None:
    backend = _warp(mara, 2, max_contacts=2, physics_step=0.004)
    q = np.array([mara.home, COLLIDING_Q])
    backend.reset(q)
    with pytest.warns(UserWarning, match="arm 1 had more than max_contacts=2 points of contact"):
        backend.step(q)
    assert backend.step(q).collided.tolist() == [False, True]


def test_contacts_that_were_not_seen_are_an_error(
    mara: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "_SPARE_CONTACTS", 0)
    backend = _warp(mara, 2, max_contacts=1, dynamics=False)
    q = np.array([COLLIDING_Q, COLLIDING_Q])
    with pytest.raises(
        GymMaraError, match=r"max_contacts=1 .*not seen: give a larger max_contacts"
    ):
        backend.step(q)
    backend.reset(np.zeros((2, 6)))
    assert not backend.state.collided.any()


def test_without_a_gpu_the_error_names_the_cpu(
    mara: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wp, "get_cuda_devices", list)
    for device in (None, "cuda", "cuda:0"):
        with pytest.raises(GymMaraError, match=r"no GPU of NVIDIA .*device='cpu'.* for tests"):
            WarpBackend(mara, 1, device=device)


@pytest.mark.parametrize(
    "settings",
    [
        {"device": "gpu"},
        {"arrays": "jax"},
        {"dynamics": 1},
        {"max_contacts": 0},
        {"physics_step": 0.003},
        {"servo_gain": 0.0},
        {"max_joint_velocity": -1.0},
        {"on_divergence": "ignore"},
        {"randomisation": {"mass": (1.2, 0.8)}},
        {"randomisation": {"latency": (0.0, 0.1)}, "dynamics": False},
    ],
    ids=str,
)
def test_bad_settings_are_refused(mara: RobotModel, settings: dict[str, Any]) -> None:
    with pytest.raises(GymMaraError, match=next(iter(settings))):
        WarpBackend(mara, 1, **{"device": WARP_DEVICE} | settings)


def test_too_little_memory_is_an_error_that_names_how_many_arms_fit() -> None:
    gpu = SimpleNamespace(is_cuda=True, free_memory=2_500_000, alias="cuda:0")
    check_memory(gpu, 25, 100_000)
    with pytest.raises(GymMaraError, match=r"26 arms need .* on cuda:0: at most 25 arms fit"):
        check_memory(gpu, 26, 100_000)


def test_the_memory_of_an_arm_is_known(mara: RobotModel) -> None:
    assert 20e3 < _warp(mara, 1, dynamics=False).bytes_per_arm < 500e3


@pytest.mark.parametrize("library", ["warp", "mujoco_warp", "torch"])
def test_a_library_that_is_missing_is_named_with_its_extra(
    mara: RobotModel, monkeypatch: pytest.MonkeyPatch, library: str
) -> None:
    for module in ("device", "engine", "kernels", "paths"):
        monkeypatch.delitem(sys.modules, f"gym_mara.backends.warp.{module}")
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingExtraError, match=r"'warp' needs .*pip install 'gym_mara\[warp\]'"):
        _warp(mara, 1, arrays="torch")


def test_a_mesh_that_is_not_convex_is_refused_with_its_link(tmp_path: Path) -> None:
    parts = [trimesh.creation.box((0.3, 0.1, 0.1)), trimesh.creation.box((0.1, 0.3, 0.1))]
    trimesh.util.concatenate(parts).export(tmp_path / "cross.stl")
    parts[0].export(tmp_path / "box.stl")
    for name in ("box", "cross"):
        write(tmp_path / f"{name}.urdf", MESHES.format(name))
    warp_model(RobotModel.from_urdf(tmp_path / "box.urdf", ee_frame="arm"), 0.002)
    with pytest.raises(GymMaraError, match=r"mesh of link arm of .* not convex.*convex_hulls=True"):
        warp_model(RobotModel.from_urdf(tmp_path / "cross.urdf", ee_frame="arm"), 0.002)
    hulls = RobotModel.from_urdf(tmp_path / "cross.urdf", ee_frame="arm", convex_hulls=True)
    warp_model(hulls, 0.002)


MESHES = """
<robot name="{0}">
  <link name="base"/>
  <joint name="joint" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="10" velocity="1"/></joint>
  <link name="arm"><inertial><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="{0}.stl"/></geometry></collision></link>
</robot>
"""


def test_only_a_compilation_is_told_and_only_once(capsys: pytest.CaptureFixture[str]) -> None:
    with compiling():
        _log("Module a 12 load on device 'cpu' took 1.00 ms  (cached)")
    assert capsys.readouterr() == ("", "")
    with compiling():
        _log("Module b 34 load on device 'cpu' took 90.00 ms  (compiled)")
        _log("Module c 56 load on device 'cpu' took 90.00 ms  (compiled)")
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "compiling Warp's kernels" in err


def _log(message: str) -> None:
    wp.get_logger().info(message)
