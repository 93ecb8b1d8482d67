"""The simulation: the state in an outcome, and switches of the backend in an episode."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError
from gym_mara.testing import COLLIDING_Q

TARGETS = np.array([[0.3, -0.2, 0.4, 0.1, 0.2, -0.1]])


def test_the_outcome_has_the_rewarded_state_even_after_a_reset_by_a_collision() -> None:
    env = MaraEnv("MARACollision-v0")
    env.reset()
    env.step(np.array(COLLIDING_Q, np.float32))
    outcome, goal = env.simulation.outcome, env.simulation.goal
    assert outcome is not None
    assert outcome.state.collided.all()
    distance = np.linalg.norm(outcome.state.ee_position - goal.position, axis=1)
    np.testing.assert_allclose(outcome.info["position_error"], distance, rtol=0.0, atol=1e-12)
    assert not env.simulation.backend.state.collided.any(), "the collision reset the arm"


@pytest.mark.parametrize(
    ("old", "new"), [("pinocchio", "dart"), ("dart", "mujoco"), ("mujoco", "pinocchio")]
)
def test_a_switch_of_the_backend_keeps_the_joints_and_the_goal(old: str, new: str) -> None:
    env = MaraEnv(backend=old, control_period=0.02)
    env.reset(seed=0)
    simulation = env.simulation
    for _ in range(20):
        simulation.step(TARGETS)
    q, goal = simulation.backend.state.q, simulation.goal
    simulation.switch_backend(new)
    assert simulation.backend_name == new
    state = simulation.backend.state
    np.testing.assert_allclose(state.q, q, rtol=0.0, atol=1e-12)
    assert not state.qd.any()
    assert simulation.goal is goal
    assert (state.torque is None) == (new == "pinocchio")
    for _ in range(100):
        outcome = simulation.step(TARGETS)
    np.testing.assert_allclose(outcome.state.q, TARGETS, atol=1e-3)
    env.close()


def test_a_failed_switch_keeps_the_old_backend() -> None:
    env = MaraEnv()
    env.reset()
    with pytest.raises(GymMaraError, match="unknown backend 'gazebo'"):
        env.simulation.switch_backend("gazebo")
    env.simulation.step(TARGETS)
    assert env.simulation.backend_name == "pinocchio"


def test_switching_back_restores_the_settings_of_the_old_backend() -> None:
    env = MaraEnv(max_joint_velocity=0.5, path_resolution=0.01)
    env.reset()
    env.simulation.switch_backend("dart")
    np.testing.assert_array_equal(env.simulation.backend.joint_velocity, 0.5)
    env.simulation.switch_backend("pinocchio")
    assert env.simulation.backend.path_resolution == 0.01  # type: ignore[attr-defined]


def test_a_switch_to_a_random_backend_needs_a_reset_first() -> None:
    env = MaraEnv(backend="dart", randomisation={"mass": (0.5, 1.5)})
    with pytest.raises(ResetNeeded, match="before you switch the backend"):
        env.simulation.switch_backend("dart")
