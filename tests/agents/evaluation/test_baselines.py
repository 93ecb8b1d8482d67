"""The baseline of inverse kinematics: it moves straight, at the limits, in every environment with a pose to reach."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from gym_mara.agents.evaluation.baselines import StraightMove, evaluate_baseline
from gym_mara.agents.evaluation.episodes import episode_seeds
from gym_mara.agents.evaluation.metrics import measure, settling_time
from gym_mara.agents.evaluation.rollout import Trajectory, roll_out
from gym_mara.agents.runs.evaluation import make_arms
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.inverse_kinematics import solve_ik
from gym_mara.state import SimState
from gym_mara.tasks import Goal, ReachTask, registry
from gym_mara.types import Floats
from tests.agents.conftest import shorten_episodes

TRAVELLING = {"max_joint_velocity": 1.0}
ARMS, STEPS = 3, 200


def moved(env: str, backend: str, options: dict[str, Any], steps: int = STEPS) -> Trajectory:
    """The straight moves of some arms."""
    arms = make_arms(env, backend, ARMS, options, max_episode_steps=None)
    with contextlib.closing(arms):
        return roll_out(arms, StraightMove, episode_seeds(0, 0, ARMS), steps)


@pytest.mark.parametrize("env", ["MARARandomTarget-v0", "MARAOrient-v0"])
@pytest.mark.parametrize("options", [{}, TRAVELLING])
def test_it_reaches_the_target_on_a_straight_line_at_the_velocity_limits(
    env: str, options: dict[str, float]
) -> None:
    played = moved(env, "pinocchio", options)
    assert played.position_error[-1].max() < 1e-6
    if env == "MARAOrient-v0":
        assert played.angle_error[-1].max() < 1e-6
    limit = options.get("max_joint_velocity", 1.57)
    path = np.concatenate([played.start[None], played.q])
    way = path[-1] - path[0]
    for arm in range(ARMS):
        farthest = np.abs(way[arm]).argmax()
        share = (path[:, arm, farthest] - path[0, arm, farthest]) / way[arm, farthest]
        np.testing.assert_allclose(path[:, arm], path[0, arm] + share[:, None] * way[arm])
        speed = np.abs(np.diff(path[:, arm, farthest])) / played.period
        moving = share[1:] < 1.0 - 1e-9
        np.testing.assert_allclose(speed[moving], limit)


def test_it_settles_in_the_least_time_where_joints_travel() -> None:
    ratio = measure(moved("MARARandomTarget-v0", "pinocchio", TRAVELLING))["settling_ratio"]
    assert (ratio > 1.0 - 1e-9).all()
    assert (ratio < 1.02).all(), "the last of its periods may be only partly used"


@pytest.mark.parametrize("backend", ["dart", "mujoco"])
def test_servos_with_mass_move_at_their_limits_too(backend: str) -> None:
    measured = measure(moved("MARARandomTarget-v0", backend, {}))
    assert measured["position_error_mm"].max() < 0.1
    assert (measured["settling_ratio"] < 1.5).all()


def test_it_takes_a_solution_near_the_start(mara: RobotModel) -> None:
    generator = np.random.default_rng(0)
    for _ in range(5):
        start = generator.uniform(-1.5, 1.5, 6)
        position, quaternion = mara.kinematics().pose(start[None] + 0.05)
        q = solve_ik(mara, position[0], quaternion[0], start)
        np.testing.assert_allclose(q, start + 0.05, atol=1e-6)


@pytest.mark.parametrize("backend", ["pinocchio", "dart"])
@pytest.mark.parametrize("reference", ["position", "target"])
def test_relative_actions_make_the_same_move(backend: str, reference: str) -> None:
    options = {"max_joint_velocity": 1.0}
    relative = {**options, "action": "relative", "action_from": reference}
    absolute = moved("MARARandomTarget-v0", backend, options)
    played = moved("MARARandomTarget-v0", backend, relative)
    assert played.position_error[-1].max() < 1e-4
    slack = 1e-9 if reference == "position" else 0.3  # a target that runs ahead starts slowly
    np.testing.assert_allclose(settling_time(played), settling_time(absolute), rtol=0.0, atol=slack)


@pytest.mark.parametrize("scale", [0.005, [0.005, 0.01, 0.002, 0.005, 0.005, 0.005]])
def test_shorter_steps_make_a_slower_straight_move(scale: Any) -> None:
    options = {**TRAVELLING, "action": "relative", "action_scale": scale}
    played = moved("MARARandomTarget-v0", "pinocchio", options, 1000)
    assert played.position_error[-1].max() < 1e-6
    way = played.q[-1] - played.start
    share = (played.q - played.start) / np.where(np.abs(way) > 1e-3, way, np.nan)
    assert np.nanmax(np.nanmax(share, axis=2) - np.nanmin(share, axis=2)) < 1e-6


def test_a_twist_of_the_tool_is_no_joint_move() -> None:
    with pytest.raises(GymMaraError, match="has no cartesian actions: give action=relative"):
        moved("MARARandomTarget-v0", "pinocchio", {"action": "cartesian"})


@dataclass(frozen=True)
class StandStill(ReachTask):
    """A task without a pose to reach."""

    def reward(self, state: SimState, goal: Goal) -> tuple[Floats, dict[str, Floats]]:
        return -np.abs(state.qd).sum(axis=1), {}


def test_a_task_without_a_pose_has_no_baseline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.TASKS, "Still-v0", StandStill())
    with pytest.raises(GymMaraError, match=r"a task with a pose to reach.*StandStill has no"):
        evaluate_baseline("ik", "Still-v0", backend="pinocchio", episodes=1)


@dataclass(frozen=True)
class Smooth(ReachTask):
    """A task that judges actions, too."""

    def reward(self, state: SimState, goal: Goal) -> tuple[Floats, dict[str, Floats]]:
        reward, terms = super().reward(state, goal)
        assert state.action is not None
        assert state.last_action is not None
        return reward - np.square(state.action - state.last_action).sum(axis=1), terms


def test_a_task_that_judges_actions_has_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.TASKS, "Smooth-v0", Smooth())
    assert moved("Smooth-v0", "pinocchio", {}).position_error[-1].max() < 1e-6


def test_it_succeeds_at_almost_any_target() -> None:
    options = {"max_joint_velocity": 1.57, "servo_gain": 20.0}
    played = evaluate_baseline(
        "ik", "MARAPose-v0", backend="pinocchio", episodes=20, options=options
    )
    assert played["success_percent"].mean() >= 80.0


def test_with_a_guide_it_moves_to_the_nearest_known_configuration() -> None:
    ways = {}
    for guide in (False, True):
        options: dict[str, Any] = {"max_joint_velocity": 1.57, "guide": guide}
        played = moved("MARAPose-v0", "pinocchio", options)
        ways[guide] = np.abs(played.q[-1] - played.start).max(axis=1)
        assert played.position_error[-1].max() < 2e-3
    assert (ways[True] <= ways[False] + 0.01).all()


def test_an_unknown_baseline_is_an_error() -> None:
    with pytest.raises(GymMaraError, match="unknown baseline 'ikk'"):
        evaluate_baseline("ikk", "MARA-v0", backend="pinocchio")


def test_it_plays_the_episodes_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_episodes(monkeypatch, 3)
    played = evaluate_baseline("ik", "MARARandomTarget-v0", backend="pinocchio", episodes=4)
    np.testing.assert_allclose(played["return"], 3.0 * played["reward_per_step"])
    assert len(set(played["return"])) == 4
