"""Episodes with a drawn start: each begins there, alone and in a batch, and returns there after a collision."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from gym_mara.collision import make_checker
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.robot import RobotModel
from gym_mara.testing import COLLIDING_Q, pickled
from gym_mara.types import Floats

TASKS = ("MARAReach-v0", "MARAPose-v0")


@pytest.mark.parametrize("task", TASKS)
def test_gymnasiums_checker_accepts_it_without_a_warning(
    task: str, recwarn: pytest.WarningsRecorder
) -> None:
    check_env(gymnasium.make(f"gym_mara/{task}").unwrapped, skip_render_check=True)
    assert [str(warning.message) for warning in recwarn] == []


def test_episodes_begin_at_different_free_configurations_at_rest(mara: RobotModel) -> None:
    envs = MaraVectorEnv(50, "MARAReach-v0")
    envs.reset(seed=0)
    state = envs.simulation.backend.state
    assert not make_checker("coal", mara).check(state.q).any()
    assert not state.collided.any()
    assert len(np.unique(state.q, axis=0)) == 50
    assert (state.qd == 0.0).all()


@pytest.mark.parametrize("task", TASKS)
def test_an_arm_of_a_batch_has_the_episodes_of_the_environment_with_its_seed(task: str) -> None:
    count = 3
    options: dict[str, Any] = {"max_episode_steps": 4}
    envs = MaraVectorEnv(count, task, autoreset_mode="SameStep", **options)
    singles = [gymnasium.make(f"gym_mara/{task}", **options) for _ in range(count)]
    together, _ = envs.reset(seed=5)
    rng = np.random.default_rng(0)
    alone = [env.reset(seed=5 + arm)[0] for arm, env in enumerate(singles)]
    starts = []
    for _ in range(10):
        np.testing.assert_allclose(together, np.array(alone), rtol=0.0, atol=1e-9)
        actions = rng.uniform(-1.0, 1.0, (count, 6)).astype(np.float32)
        together, rewards, *_ = envs.step(actions)
        for arm, env in enumerate(singles):
            alone[arm], reward, terminated, truncated, _ = env.step(actions[arm])
            assert rewards[arm] == pytest.approx(reward, abs=1e-9)
            if terminated or truncated:
                alone[arm], _ = env.reset()
                starts.append(alone[arm][:6])
    assert len(np.unique(starts, axis=0)) == len(starts) >= 2 * count, "each draws a new start"


def test_after_a_collision_the_arm_returns_to_the_start_of_its_episode() -> None:
    env = MaraEnv("MARAReach-v0", on_collision="reset", max_joint_velocity=3.0, action="absolute")
    collisions, farthest = 0, np.full(6, np.pi, np.float32)
    for seed in range(20):
        start = env.reset(seed=seed)[0][:6].copy()
        for _ in range(60):
            *_, info = env.step(farthest)
            if info["collided"]:
                collisions += 1
                np.testing.assert_array_equal(env.simulation.backend.state.q[0], start)
    assert collisions > 0


@pytest.mark.parametrize("start", ["random", "home"])
def test_a_snapshot_keeps_the_start(start: str) -> None:
    env = MaraEnv("MARAPose-v0", on_collision="reset", start=start)
    first = env.reset(seed=1)[0][:6].copy()
    snapshot = env.save_state()
    env.reset(seed=2)
    env.restore_state(snapshot)
    np.testing.assert_array_equal(env.simulation.episodes.start[0], first)
    results: list[Any] = []
    for each in (env, pickled(env)):
        each.action_space.seed(0)
        results.append([each.step(each.action_space.sample())[1] for _ in range(20)])
    assert results[0] == results[1]


def test_near_the_target_a_step_is_a_part_of_a_step() -> None:
    env = MaraEnv("MARAPose-v0", slow_within=0.5, max_joint_velocity=3.0)
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        for _ in range(10):
            pace = float(env.simulation.observation.split(observation)["pace"][0])
            q = env.simulation.backend.state.q[0].copy()
            observation, _, terminated, _, _ = env.step(np.full(6, -0.5, np.float32))
            np.testing.assert_allclose(env.simulation.actions.action[0], -0.5 * pace)
            np.testing.assert_allclose(observation[-6:], -0.5 * pace)
            if terminated:
                break
            moved = env.simulation.backend.state.q[0] - q
            expected = np.maximum(
                -0.5 * pace * env.simulation.actions.steps, env.simulation.robot.lower - q
            )
            np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_the_pace_of_an_arm_that_collided_does_not_depend_on_resets_of_others() -> None:
    one, two = (
        MaraVectorEnv(
            count,
            "MARAReach-v0",
            autoreset_mode="Disabled",
            on_collision="reset",
            slow_within=1.0,
            start_q=np.zeros(6),
            max_joint_velocity=1.57,
        )
        for count in (1, 2)
    )
    one.reset(seed=3)
    two.reset(seed=3)
    alone = one.simulation
    for _ in range(200):
        way = COLLIDING_Q - alone.backend.state.q
        action = np.clip(way / alone.actions.steps, -1.0, 1.0)
        info = one.step(action)[4]
        observation = two.step(np.vstack([action, np.zeros((1, 6))]))[0]
        if info["collided"][0]:
            break
    assert not alone.backend.state.q.any(), "the collision has put the arm back"
    two.reset(options={"reset_mask": np.array([False, True])})
    pace = alone.observation.split(observation[:1])["pace"]
    for envs in (one, two):
        np.testing.assert_allclose(envs.simulation.actions.pace[:1], pace, rtol=0.0, atol=1e-12)
    expected, reward, *_ = one.step(-np.ones((1, 6)))
    mine, rewards, *_ = two.step(-np.ones((2, 6)))
    np.testing.assert_allclose(mine[:1], expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(rewards[:1], reward, rtol=0.0, atol=1e-12)


def test_the_guide_leads_to_the_target_and_follows_it() -> None:
    envs = MaraVectorEnv(
        20,
        "MARAPose-v0",
        guide=True,
        max_joint_velocity=1.57,
        on_collision="continue",
        max_episode_steps=None,
    )
    envs.reset(seed=0)
    simulation = envs.simulation

    def follow() -> Floats:
        for _ in range(150):
            ways = simulation.goal.ways(simulation.backend.state.q) / simulation.actions.steps
            longest = np.abs(ways).max(axis=1, keepdims=True)
            *_, info = envs.step((ways / np.maximum(longest, 1.0)).astype(np.float32))
        return np.asarray(info["position_error"])

    assert follow().max() < 5e-3
    # Another target for all of them, as in the viewer.
    position, quaternion = simulation.robot.kinematics().pose(np.full((1, 6), 0.4))
    simulation.set_goal(position[0], quaternion[0])
    away = simulation.backend.state.ee_position - position
    assert np.linalg.norm(away, axis=1).min() > 0.05
    assert follow().max() < 5e-3


@pytest.mark.parametrize("robot", ["mara", "ur5"])
def test_the_guides_straight_way_is_free_from_where_the_arm_is(robot: str) -> None:
    envs = MaraVectorEnv(40, "MARAPose-v0", robot=robot, guide=True)
    envs.reset(seed=0)
    simulation = envs.simulation
    checker = make_checker("coal", simulation.robot)

    def blocked() -> int:
        q = simulation.backend.state.q
        steps = np.linspace(0.0, 1.0, 100)[:, None]
        ways = zip(q, simulation.goal.ways(q), strict=True)
        return sum(bool(checker.check(each + steps * way).any()) for each, way in ways)

    # Between two checks an arm may graze itself.
    assert blocked() <= 1
    home = simulation.robot.home[None]
    position, quaternion = simulation.robot.kinematics().pose(home + 0.3)
    simulation.set_goal(position[0], quaternion[0])  # as in the viewer, far from the starts
    assert blocked() <= 2


def test_with_a_guide_a_snapshot_and_a_copy_go_on_alike() -> None:
    env = MaraEnv("MARAPose-v0", guide=True)
    env.reset(seed=1)
    snapshot = env.save_state()
    env.reset(seed=2)
    env.restore_state(snapshot)
    results: list[Any] = []
    for each in (env, pickled(env)):
        each.action_space.seed(0)
        results.append([each.step(each.action_space.sample())[1] for _ in range(5)])
    assert results[0] == results[1]


@pytest.mark.parametrize("action", ["absolute", "relative", "cartesian"])
@pytest.mark.parametrize("task", [*TASKS, "MARA-v0", "MARARandomTarget-v0"])
def test_every_task_runs_with_every_action_mode(mara: RobotModel, task: str, action: str) -> None:
    env = MaraEnv(task, action=action)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(20):
        chosen = env.action_space.sample()
        observation, reward, terminated, _, _ = env.step(chosen)
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward)
        if task in TASKS:
            if action == "absolute":
                chosen = chosen.clip(mara.lower, mara.upper)
            # Steps shrink near the target; these are far from it.
            np.testing.assert_allclose(observation[-len(chosen) :], chosen, atol=1e-6)
        if terminated:
            observation, _ = env.reset()
            if task in TASKS:
                assert (observation[-len(chosen) :] == 0.0).all()
