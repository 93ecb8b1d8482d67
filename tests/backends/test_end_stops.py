"""The end stops of joints on backends with dynamics, and what is observed there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.backends.base import Backend
from gym_mara.backends.dart.backend import DartBackend
from gym_mara.backends.mujoco.backend import MujocoBackend
from gym_mara.backends.servo import ServoBackend
from gym_mara.envs import MaraEnv, MaraGoalEnv
from gym_mara.robot import RobotModel
from gym_mara.testing import assert_same_state
from gym_mara.types import Floats
from tests.helpers import joint_xml, urdf_xml, write

pytestmark = pytest.mark.filterwarnings("ignore:.*below the weight of the arm")  # on purpose


@pytest.fixture
def weak(tmp_path: Path) -> RobotModel:
    """An arm whose motors are too weak to hold it: it falls onto the lower stop of its first joint."""
    limit = '<limit lower="-0.4" upper="0.5" effort="10" velocity="2"/>'
    xml = urdf_xml(*(joint_xml(number, axis="0 1 0", limit=limit) for number in range(2)))
    return RobotModel.load(write(tmp_path / "weak.urdf", xml), "link2", effort_limit=0.5)


@pytest.fixture(params=[DartBackend, MujocoBackend])
def kind(request: pytest.FixtureRequest) -> Any:
    """A class of backends."""
    return request.param


@pytest.fixture(params=["dart", "mujoco"])
def name(request: pytest.FixtureRequest) -> str:
    """The name of a backend."""
    return str(request.param)


def _q(backend: Backend) -> Floats:
    """The joint positions of the engine's first arm (J,)."""
    if isinstance(backend, DartBackend):
        return backend.arms[0].q
    assert isinstance(backend, MujocoBackend)
    return backend._states[0, backend._joint_q]


def _fallen(kind: Any, robot: RobotModel) -> ServoBackend:
    backend: ServoBackend = kind(robot, 1)
    for _ in range(100):
        backend.step(robot.home[None])
    return backend


def test_a_weak_arm_hangs_at_its_end_stop(kind: Any, weak: RobotModel) -> None:
    backend = kind(weak, 1)
    for _ in range(100):
        state = backend.step(weak.home[None])
        assert np.isfinite(state.qd).all()
        assert (state.q >= weak.lower - 0.01).all()
        assert (state.q <= weak.upper + 0.01).all()
        assert state.torque is not None
        assert (np.abs(state.torque) <= weak.effort_limit).all()
        np.testing.assert_array_equal(state.q[0], _q(backend))
    stop = weak.upper[0] if state.q[0, 0] > 0.0 else weak.lower[0]
    np.testing.assert_allclose(state.q[0, 0], stop, atol=1e-6)
    assert state.torque is not None
    # The motor pulls back as hard as it can, and the stop carries the rest.
    np.testing.assert_allclose(state.torque[0, 0], np.copysign(0.5, -stop), rtol=1e-6)


def test_from_a_snapshot_at_an_end_stop_it_continues_identically(
    kind: Any, weak: RobotModel
) -> None:
    backend = _fallen(kind, weak)
    snapshot, target = backend.save(), weak.upper[None]
    first = [backend.step(target) for _ in range(5)]
    for _ in range(2):
        backend.restore(snapshot)
        for state in first:
            assert_same_state(backend.step(target), state)


@pytest.mark.parametrize("make", [MaraEnv, MaraGoalEnv])
def test_the_true_positions_are_observed_and_in_the_space(
    weak: RobotModel, make: Any, name: str
) -> None:
    env = make(robot=weak, backend=name, on_collision="continue")
    env.reset(seed=0)
    for _ in range(100):
        observation, *_ = env.step(np.zeros(2, np.float32))
        assert env.observation_space.contains(observation)
        flat = observation if make is MaraEnv else observation["observation"]
        np.testing.assert_array_equal(flat[:2], _q(env.simulation.backend))


def test_only_backends_with_dynamics_have_wider_bounds(weak: RobotModel, name: str) -> None:
    kinematic: Any = MaraEnv(robot=weak).observation_space
    dynamic: Any = MaraEnv(robot=weak, backend=name).observation_space
    np.testing.assert_array_equal(kinematic.low[:2], weak.lower)
    np.testing.assert_array_equal(kinematic.high[:2], weak.upper)
    np.testing.assert_array_equal(dynamic.low[:2], weak.lower - 0.01)
    np.testing.assert_array_equal(dynamic.high[:2], weak.upper + 0.01)
    np.testing.assert_array_equal(dynamic.low[2:], kinematic.low[2:])


def test_an_observation_stays_in_its_space_after_a_switch_of_the_backend(
    weak: RobotModel, name: str
) -> None:
    env = MaraEnv(robot=weak, on_collision="continue")
    env.reset(seed=0)
    env.simulation.switch_backend(name)
    for _ in range(100):
        observation, *_ = env.step(np.zeros(2, np.float32))
        assert env.observation_space.contains(observation)
