"""Random targets, and the goal environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.envs.goal import MaraGoalEnv, MaraGoalVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.inverse_kinematics import miss
from gym_mara.state import SimState
from gym_mara.tasks import Goal, Part, ReachTask, Task, Workspace, observation
from gym_mara.testing import COLLIDING_Q, COPIES
from gym_mara.types import Floats, Mask
from tests.backends.fake import FakeBackend
from tests.helpers import TARGET_Q, robot_model

RANDOM = "MARARandomTarget-v0"
ORIENT: dict[str, Any] = {"orientation": True}


def test_each_episode_has_a_new_target_within_reach() -> None:
    env = MaraEnv(RANDOM, **ORIENT)
    targets = [env.reset(seed=0)[0][-7:], *(env.reset()[0][-7:] for _ in range(4))]
    assert len({tuple(target) for target in targets}) == 5
    for target in targets:
        distance, angle = miss(robot_model("mara"), target[:3], target[3:])
        assert distance < 1e-6
        assert angle < 1e-6


def test_the_target_is_constant_in_an_episode_and_the_reward_uses_it() -> None:
    env = MaraEnv(RANDOM)
    target = env.reset(seed=1)[0][-3:]
    # A collision resets the arm, but not the target.
    for q in (TARGET_Q, COLLIDING_Q, TARGET_Q):
        observation, _, _, _, info = env.step(np.array(q, np.float32))
        np.testing.assert_array_equal(observation[-3:], target)
        assert info["position_error"] == pytest.approx(np.linalg.norm(observation[6:9]))
        assert env.observation_space.contains(observation)


def test_the_same_seed_gives_the_same_targets() -> None:
    def targets(seed: int) -> list[Any]:
        env = MaraEnv(RANDOM)
        return [env.reset(seed=seed)[0].tolist(), env.reset()[0].tolist()]

    assert targets(5) == targets(5)
    assert targets(5) != targets(6)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_vector_environment_has_the_targets_of_single_environments(mode: str) -> None:
    envs = MaraVectorEnv(3, RANDOM, max_episode_steps=2, autoreset_mode=mode)
    singles = [MaraEnv(RANDOM) for _ in range(3)]
    observation, _ = envs.reset(seed=7)
    expected = [env.reset(seed=7 + index)[0] for index, env in enumerate(singles)]
    np.testing.assert_array_equal(observation, expected)
    for _ in range(2 if mode == "SameStep" else 3):
        observation = envs.step(np.zeros((3, 6)))[0]
    expected = [env.reset()[0] for env in singles]
    np.testing.assert_array_equal(observation, expected)


@pytest.mark.parametrize("copy", COPIES)
def test_a_copy_keeps_its_target(copy: Any) -> None:
    env = MaraEnv(RANDOM)
    env.reset(seed=2)
    copied = copy(env)
    np.testing.assert_array_equal(
        copied.step(np.zeros(6, np.float32))[0], env.step(np.zeros(6, np.float32))[0]
    )
    snapshot = env.save_state()
    first = env.reset()[0]
    env.restore_state(snapshot)
    np.testing.assert_array_equal(env.reset()[0], first)


def test_a_user_defined_target_is_refused() -> None:
    with pytest.raises(GymMaraError, match="draws its targets"):
        MaraEnv(RANDOM, target_position=(0.0, 0.3, 1.0))


@pytest.mark.filterwarnings("ignore:.*action space", "ignore:.*symmetric")  # users rescale actions
@pytest.mark.parametrize("check", [check_env, sb3_check_env], ids=["gymnasium", "sb3"])
@pytest.mark.parametrize("options", [{}, ORIENT, {"reward_type": "dense"}])
def test_the_checkers_accept_the_goal_environment(check: Any, options: dict[str, Any]) -> None:
    env: Any = gymnasium.make("gym_mara/MARAGoal-v0", **options)
    check(env.unwrapped, skip_render_check=True)
    env.close()


OPTIONS: list[dict[str, Any]] = [
    {},
    {"reward_type": "dense"},
    {"reward_type": "dense", **ORIENT, "collision_penalty": True},
    {"reward_type": "sparse", **ORIENT},
]


@pytest.mark.parametrize("options", OPTIONS)
@given(data=st.data())
def test_compute_reward_gives_the_rewards_of_the_steps(
    options: dict[str, Any], data: st.DataObject
) -> None:
    env: Any = MaraGoalEnv(**options)
    env.reset(seed=data.draw(st.integers(0, 1000)))
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    steps = [env.step(rng.uniform(-2.0, 2.0, 6).astype(np.float32)) for _ in range(4)]
    achieved, desired = (
        np.array([step[0][key] for step in steps]) for key in ("achieved_goal", "desired_goal")
    )
    rewards = [step[1] for step in steps]
    infos = np.array([step[4] for step in steps], dtype=object)
    np.testing.assert_allclose(
        env.compute_reward(achieved, desired, infos), rewards, rtol=0.0, atol=1e-9
    )
    one = env.compute_reward(achieved[0], desired[0], infos[0])
    assert one == pytest.approx(rewards[0], abs=1e-9)


def test_reaching_the_goal_is_a_success() -> None:
    env: Any = MaraGoalEnv("MARAOrient-v0")
    env.reset()
    observation, reward, *_, info = env.step(np.array(TARGET_Q, np.float32))
    assert reward == 0.0
    assert info["is_success"]
    rotated = observation["desired_goal"].copy()
    rotated[3:] = (1.0, 0.0, 0.0, 0.0)
    assert env.compute_reward(observation["achieved_goal"], rotated, info) == -1.0
    _, reward, *_, info = env.step(np.zeros(6, np.float32))
    assert reward == -1.0
    assert not info["is_success"]


@pytest.mark.slow
def test_hindsight_replay_relabels_goals_as_successes() -> None:
    env = gymnasium.wrappers.RescaleAction(
        gymnasium.make("gym_mara/MARAGoal-v0", max_episode_steps=10),
        np.float32(-1),
        np.float32(1),
    )
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "copy_info_dict": True},
        learning_starts=100,
        policy_kwargs={"net_arch": [16]},
        seed=0,
        device="cpu",
    )
    model.learn(300)
    assert isinstance(model.replay_buffer, HerReplayBuffer)
    rewards = model.replay_buffer.sample(256).rewards
    assert rewards.max() == 0.0, "some relabelled goals are successes"
    assert model.replay_buffer.rewards.max() <= 0.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reward_type": "shaped"}, "unknown reward_type"),
        ({"position_tolerance": 0.0}, "position_tolerance"),
        ({"angle_tolerance": np.nan}, "angle_tolerance"),
        ({"alfa": 1.0}, "Did you mean 'alpha'"),
    ],
)
def test_invalid_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        MaraGoalEnv(**options)


def test_a_collision_penalty_without_infos_is_an_error() -> None:
    env: Any = MaraGoalEnv(reward_type="dense", collision_penalty=True)
    observation, _ = env.reset(seed=0)
    with pytest.raises(GymMaraError, match="copy_info_dict"):
        env.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})


@pytest.mark.parametrize("options", [{}, {"reward_type": "dense"}, {**ORIENT}])
def test_the_reward_of_a_step_with_noisy_sensors_is_of_the_true_pose(
    options: dict[str, Any],
) -> None:
    noise = {"sensor_noise": (0.05, 0.05)}
    env = MaraGoalVectorEnv(4, backend="mujoco", randomisation=noise, **options)
    env.reset(seed=0, options={"start_q": TARGET_Q, "target_position": _tool_at(TARGET_Q)})
    away = 0.0
    for _ in range(10):
        observation: Any
        observation, reward, _, _, info = env.step(np.tile(TARGET_Q, (4, 1)))
        near = info["position_error"] <= 0.02
        if "orientation" in options:
            near &= info["angle_error"] <= 0.1
        np.testing.assert_array_equal(info["is_success"], near)
        if "reward_type" in options:
            np.testing.assert_array_equal(reward, info["reward_distance"] - 1.0)
        else:
            np.testing.assert_array_equal(reward, near - 1.0)
        measured = observation["achieved_goal"][:, :3] - observation["desired_goal"][:, :3]
        away = max(away, float(np.linalg.norm(measured, axis=1).max()))
        assert env.observation_space.contains(observation)
    assert away > 0.02, "the sensors see some arm outside of the tolerance"
    assert info["position_error"].max() < 0.02
    env.close()


def _tool_at(q: Any) -> Floats:
    return robot_model("mara").kinematics().pose(np.array([q]))[0][0]


# The vector environment.


def _assert_same(mine: Any, theirs: Any) -> None:
    """Both are equal: dictionaries, arrays of dictionaries and of numbers. Statistics are those of the last step only."""
    if isinstance(theirs, dict):
        for key in theirs.keys() - {"statistics", "_statistics"}:
            _assert_same(mine[key], theirs[key])
    elif theirs.dtype == object:
        for one, other in zip(mine, theirs, strict=True):
            if isinstance(other, dict):
                _assert_same(one, other)
            else:
                assert one is other is None
    else:
        np.testing.assert_allclose(mine, theirs, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("options", OPTIONS)
def test_goal_environments_in_a_batch_give_the_results_of_single_ones(
    options: dict[str, Any], mode: str
) -> None:
    native: Any = gymnasium.make_vec(
        "gym_mara/MARAGoal-v0", num_envs=3, autoreset_mode=mode, max_episode_steps=4, **options
    )
    assert type(native) is MaraGoalVectorEnv
    singles: Any = gymnasium.make_vec(
        "gym_mara/MARAGoal-v0",
        num_envs=3,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode(mode)},
        max_episode_steps=4,
        **options,
    )
    assert native.observation_space == singles.observation_space
    assert native.single_observation_space == singles.single_observation_space
    _assert_same(native.reset(seed=5)[0], singles.reset(seed=5)[0])
    rng, ends = np.random.default_rng(0), 0
    for _ in range(12):
        actions = rng.uniform(-2.0, 2.0, (3, 6))
        mine, theirs = native.step(actions), singles.step(actions)
        for one, other in zip(mine, theirs, strict=True):
            _assert_same(one, other)
        assert native.observation_space.contains(mine[0])
        ended = mine[2] | mine[3]
        ends += int(ended.sum())
        if mode == "Disabled" and ended.any():
            mask = np.array([True, False, True])
            for envs in (native, singles):
                envs.reset(options={"reset_mask": ended})
            first, expected = (e.reset(options={"reset_mask": mask})[0] for e in (native, singles))
            _assert_same(first, expected)
    assert ends


def test_the_vector_environment_computes_rewards_for_other_goals() -> None:
    envs = MaraGoalVectorEnv(4, reward_type="dense")
    envs.reset(seed=0)
    observation: Any
    observation, reward, *_ = envs.step(np.zeros((4, 6)))
    again = envs.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})
    np.testing.assert_allclose(again, reward, rtol=0.0, atol=1e-12)
    success = envs.compute_reward(observation["achieved_goal"], observation["achieved_goal"], {})
    assert (success > reward).all()


@pytest.mark.parametrize("on_collision", ["terminate", "continue"])
def test_compute_terminated_is_what_a_step_returned(on_collision: str) -> None:
    env: Any = MaraGoalEnv(on_collision=on_collision)
    envs: Any = MaraGoalVectorEnv(2, on_collision=on_collision)
    env.reset(seed=0)
    envs.reset(seed=0)
    for q in (TARGET_Q, COLLIDING_Q):
        observation, _, terminated, _, info = env.step(np.array(q, np.float32))
        assert terminated == (on_collision == "terminate" and q is COLLIDING_Q)
        goals = observation["achieved_goal"], observation["desired_goal"]
        assert env.compute_terminated(*goals, info) is terminated
    observation, _, terminated, _, info = envs.step([TARGET_Q, COLLIDING_Q])
    goals = observation["achieved_goal"], observation["desired_goal"]
    np.testing.assert_array_equal(envs.compute_terminated(*goals, info), terminated)


def test_compute_terminated_of_a_task_that_terminates_itself_is_an_error() -> None:
    env: Any = MaraGoalEnv(Arriving())
    goal = env.reset(seed=0)[0]["desired_goal"]
    with pytest.raises(GymMaraError, match="read what step returns"):
        env.compute_terminated(goal, goal, {"collided": False})


PENALISED: dict[str, Any] = {"reward_type": "dense", "collision_penalty": True}


def test_the_vector_environment_computes_the_rewards_of_steps_with_collisions() -> None:
    envs = MaraGoalVectorEnv(4, on_collision="continue", **PENALISED)
    envs.reset(seed=0)
    observation: Any
    observation, reward, _, _, infos = envs.step(np.eye(4)[1][:, None] * COLLIDING_Q)
    assert infos["collided"].tolist() == [False, True, False, False]
    goals = observation["achieved_goal"], observation["desired_goal"]
    again = envs.compute_reward(*goals, infos)
    np.testing.assert_allclose(again, reward, rtol=0.0, atol=1e-12)
    one_each = [{"collided": one} for one in infos["collided"]]
    np.testing.assert_array_equal(envs.compute_reward(*goals, one_each), again)
    with pytest.raises(GymMaraError, match="the goals and the infos have the shapes"):
        envs.compute_reward(*goals, one_each[:3])
    with pytest.raises(GymMaraError, match="4 infos are more than the goals"):
        envs.compute_reward(goals[0][0], goals[1][0], infos)


@pytest.mark.parametrize("options", [{}, PENALISED])
def test_rewards_are_computed_for_one_pose_and_many_goals(options: dict[str, Any]) -> None:
    env: Any = MaraGoalEnv(**options)
    env.reset(seed=0)
    observation, _, _, _, info = env.step(np.zeros(6, np.float32))
    pose = observation["achieved_goal"]
    goals = pose + np.linspace(0.0, 0.1, 10).reshape(5, 2, 1)
    rewards = env.compute_reward(pose, goals, info)
    expected = [[env.compute_reward(pose, goal, info) for goal in row] for row in goals]
    np.testing.assert_allclose(rewards, expected, rtol=0.0, atol=1e-12)
    assert rewards[0, 0] > rewards[-1, -1]
    with pytest.raises(GymMaraError, match="the goals have the shapes"):
        env.compute_reward(np.zeros((2, 3)), np.zeros((3, 3)), info)


def test_the_statistics_are_of_the_rewards_that_the_agent_receives() -> None:
    env: Any = MaraGoalEnv()
    env.reset(seed=0)
    assert env.step(np.zeros(6, np.float32))[4]["statistics"]["ep_rew_mean"] == -1.0


class Arriving(ReachTask):
    """Ends an episode at the target."""

    def terminated(self, state: SimState, goal: Goal) -> Mask:
        return np.linalg.norm(state.ee_position - goal.position, axis=-1) < 0.01


class StillTask(Task):
    """A task that is no reach task."""

    def goal(self, robot: RobotModel, workspace: Workspace, num_envs: int) -> Goal:
        return Goal(np.zeros((num_envs, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (num_envs, 1)))

    def observation(self, robot: RobotModel, goal: Goal, joint_velocity: Floats) -> list[Part]:
        return [observation.joint_positions(robot)]

    def reward(self, state: SimState, goal: Goal) -> tuple[Floats, dict[str, Floats]]:
        return np.zeros(len(state.q)), {}


@pytest.mark.parametrize("make", [MaraGoalEnv, MaraGoalVectorEnv])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": StillTask()}, "needs a reach task"),
        ({"observation": "pixels"}, "observation must be 'state' or 'state\\+pixels'"),
    ],
)
def test_what_has_no_goals_is_refused_and_the_backend_is_closed(
    fake_backend: str,
    make: Any,
    options: dict[str, Any],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    closed: list[FakeBackend] = []
    monkeypatch.setattr(FakeBackend, "close", lambda backend: closed.append(backend))
    with pytest.raises(GymMaraError, match=message):
        make(backend=fake_backend, **options)
    assert len(closed) == 1
