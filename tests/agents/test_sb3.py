"""The environments as a VecEnv of Stable-Baselines3."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from gymnasium.wrappers import NormalizeObservation, RescaleAction
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from gym_mara.agents.runs.evaluation import make_env
from gym_mara.agents.sb3 import MaraVecEnv, in_one_batch
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.testing import pickled
from gym_mara.types import UnitActions


def step(env: VecEnv, action: NDArray[np.float32]) -> tuple[Any, Any, Any, list[Any]]:
    """One step; Stable-Baselines3's type allows dicts of observations too."""
    return env.step(action)


def small(num_envs: int = 3, **options: Any) -> MaraVecEnv:
    """Arms with episodes of four steps."""
    return make_env("MARAOrient-v0", "pinocchio", num_envs, options, max_episode_steps=4)


def test_actions_are_scaled_to_each_joint_s_range() -> None:
    env = small()
    env.reset()
    robot = env.env.simulation.robot
    for value, limit in (
        (-1.0, robot.lower),
        (1.0, robot.upper),
        (0.0, 0.5 * (robot.lower + robot.upper)),
    ):
        observation, *_ = step(env, np.full((3, 6), value, np.float32))
        np.testing.assert_allclose(
            observation[:, :6],
            np.tile(np.clip(limit, -np.float32(np.pi), np.float32(np.pi)), (3, 1)),
        )


def test_the_info_of_a_last_step_is_complete() -> None:
    env = small()
    start: Any = env.reset()
    rewards = np.zeros(3)
    for number in range(4):
        before = rewards.copy()
        observation, reward, done, infos = step(env, np.full((3, 6), 0.1 * number, np.float32))
        rewards = before + reward
        assert done.tolist() == [number == 3] * 3
    np.testing.assert_array_equal(observation, start)
    for index, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True
        assert info["terminal_observation"].shape == observation[0].shape
        assert not np.array_equal(info["terminal_observation"], observation[index])
        assert info["episode"]["l"] == 4
        assert info["episode"]["r"] == pytest.approx(rewards[index], abs=1e-5)
        assert {"position_error", "angle_error", "num_coll", "ep_dist_min"} <= info.keys()


def test_an_episode_that_a_collision_ends_is_not_truncated() -> None:
    env = small(num_envs=1, on_collision="terminate")
    env.reset()
    _, _, done, infos = step(env, np.array([[0.0, 1.0, 0.5, 0.0, 0.0, 0.0]], np.float32))
    assert done[0]
    assert infos[0]["collided"] is True
    assert infos[0]["TimeLimit.truncated"] is False


def test_it_continues_from_a_snapshot() -> None:
    env, action = small(), np.full((3, 6), 0.2, np.float32)
    env.reset()
    step(env, action)
    snapshot = env.save_state()
    first = [step(env, action) for _ in range(4)]
    env.restore_state(snapshot)
    for expected in first:
        again = step(env, action)
        np.testing.assert_array_equal(again[0], expected[0])
        np.testing.assert_array_equal(again[2], expected[2])
    assert (
        first[2][3][0]["episode"]["r"] == again[3][0].get("episode", first[2][3][0]["episode"])["r"]
    )


def test_any_algorithm_of_stable_baselines3_trains_on_it() -> None:
    model = PPO("MlpPolicy", small(), n_steps=8, batch_size=8, device="cpu")
    model.learn(48)
    assert model.ep_info_buffer
    assert model.ep_info_buffer[0]["l"] == 4


def test_it_takes_what_make_vec_makes() -> None:
    made = gymnasium.make_vec("gym_mara/MARA-v0", num_envs=2, autoreset_mode="SameStep")
    with pytest.raises(ValueError, match="expect OpenAI Gym to be installed"):
        PPO("MlpPolicy", made, device="cpu")  # type: ignore[arg-type]
    assert isinstance(made, MaraVectorEnv)
    PPO("MlpPolicy", MaraVecEnv(made), n_steps=8, batch_size=16, device="cpu").learn(16)


def test_an_environment_of_tensors_is_refused() -> None:
    env = MaraVectorEnv(1, autoreset_mode="SameStep")
    env.simulation.backend.arrays = "torch"
    with pytest.raises(GymMaraError, match="take NumPy's arrays: leave out arrays='torch'"):
        MaraVecEnv(env)


def test_another_autoreset_mode_is_refused() -> None:
    with pytest.raises(GymMaraError, match="SameStep"):
        MaraVecEnv(MaraVectorEnv(2))


GENTLE = "gym_mara/MARACollision-v0"


@pytest.mark.parametrize("env_id", ["gym_mara/MARA-v0", "gym_mara/MARARandomTarget-v0"])
@pytest.mark.parametrize("options", [{}, {"on_collision": "terminate"}])
def test_a_batch_gives_the_same_results_as_single_environments(
    env_id: str, options: dict[str, Any]
) -> None:
    def arms() -> VecEnv:
        return make_vec_env(
            env_id,
            5,
            seed=7,
            env_kwargs={"max_episode_steps": 4, **options},
            wrapper_class=rescaled,
        )

    single, batch = arms(), in_one_batch(arms())
    assert isinstance(batch.unwrapped, MaraVecEnv)
    assert batch.action_space == single.action_space
    np.testing.assert_array_equal(batch.reset(), single.reset())
    rng, ends = np.random.default_rng(0), 0
    for _ in range(13):
        action = rng.uniform(-0.5, 1.5, (5, 6)).astype(np.float32)
        mine, theirs = step(batch, action), step(single, action)
        for one, other in zip(mine[:3], theirs[:3], strict=True):
            np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-6)
        for info, expected in zip(mine[3], theirs[3], strict=True):
            if "terminal_observation" in expected:
                ends += 1
                for key in ("terminal_observation", "position_error", "TimeLimit.truncated"):
                    np.testing.assert_allclose(info[key], expected[key], rtol=0.0, atol=1e-6)
                for key in ("r", "l"):
                    assert info["episode"][key] == pytest.approx(expected["episode"][key], abs=1e-5)
    assert ends >= 15


def rescaled(env: Any) -> RescaleAction[Any, Any, Any]:
    """An environment with actions in [-0.5, 1.5]."""
    return RescaleAction(env, np.float32(-0.5), np.float32(1.5))


def test_the_batch_writes_the_monitor_s_file(tmp_path: Path) -> None:
    arms = make_vec_env(
        "gym_mara/MARA-v0", 2, monitor_dir=str(tmp_path), env_kwargs={"max_episode_steps": 4}
    )
    batch = in_one_batch(arms)
    batch.reset()
    for _ in range(9):
        batch.step(np.zeros((2, 6), np.float32))
    batch.close()
    lines = (tmp_path / "0.monitor.csv").read_text().splitlines()
    assert lines[1] == "r,l,t"
    assert [line.split(",")[1] for line in lines[2:]] == ["4"] * 4


def test_environments_that_cannot_be_batched_are_returned_unchanged() -> None:
    watched = make_vec_env("gym_mara/MARA-v0", 1, env_kwargs={"render_mode": "human"})
    assert in_one_batch(watched) is watched
    batch = small()
    assert in_one_batch(batch) is batch


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            [lambda: gymnasium.make("gym_mara/MARA-v0"), lambda: gymnasium.make(GENTLE)],
            r"a batch needs equal environments.*not <.*MARA-v0.*MARACollision-v0",
        ),
        ([lambda: gymnasium.make("Pendulum-v1")], "a batch needs equal environments.*PendulumEnv"),
        ([lambda: gymnasium.make("gym_mara/MARAGoal-v0")], "a batch needs equal environments"),
        ([MaraEnv], "a batch needs equal environments"),
        (
            [lambda: NormalizeObservation(gymnasium.make("gym_mara/MARA-v0"))],
            "cannot keep the wrapper NormalizeObservation.*allowed are Monitor, OrderEnforcing, Pass",
        ),
    ],
)
def test_environments_that_do_not_form_a_batch_are_an_error(make: list[Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        in_one_batch(DummyVecEnv(make))


# The interface of VecEnv.


def plain(num_envs: int = 3, **options: Any) -> MaraVecEnv:
    """Arms that take joint targets, with episodes of four steps."""
    return MaraVecEnv(
        MaraVectorEnv(
            num_envs, "MARAOrient-v0", autoreset_mode="SameStep", max_episode_steps=4, **options
        )
    )


def test_by_default_actions_are_joint_targets() -> None:
    env = plain()
    assert env.action_space == env.env.single_action_space
    env.reset()
    single = MaraEnv("MARAOrient-v0")
    single.reset()
    targets = np.linspace(-0.2, 0.2, 6).astype(np.float32)
    observation, *_ = step(env, np.tile(targets, (3, 1)))
    np.testing.assert_array_equal(observation[1], single.step(targets)[0])


@pytest.mark.parametrize(
    "space",
    [
        Box(-1.0, 1.0, (5,)),
        Box(-np.inf, np.inf, (6,)),
        Box(1.0, 1.0, (6,)),
        Discrete(3),
    ],
)
def test_an_action_space_that_cannot_be_scaled_is_refused(space: Any) -> None:
    arms = MaraVectorEnv(1, autoreset_mode="SameStep")
    with pytest.raises(GymMaraError, match=r"a bounded Box of shape \(6,\)"):
        MaraVecEnv(arms, space)


def test_actions_in_1_1_are_refused_in_another_scaled_space() -> None:
    env = MaraVecEnv(MaraVectorEnv(1, autoreset_mode="SameStep"), Box(-0.5, 1.5, (6,), np.float32))
    env.reset()
    with pytest.raises(GymMaraError, match=r"in \[-1, 1\], and those of this environment"):
        env.step(np.zeros((1, 6), np.float32).view(UnitActions))


@pytest.mark.parametrize("indices", [None, [0, 1, 2], range(3), np.arange(3), (2, 1, 0)])
def test_methods_and_attributes_of_all_arms(indices: Any) -> None:
    env = plain()
    assert len(env.env_method("save_state", indices=indices)) == 3
    env.set_attr("max_episode_steps", 7, indices)
    assert env.get_attr("max_episode_steps", indices) == [7, 7, 7]
    assert env.env_is_wrapped(object, indices) == [False] * 3


@pytest.mark.parametrize("indices", [0, np.int64(2), [0, 1], range(1), []])
def test_some_arms_cannot_be_changed_alone(indices: Any) -> None:
    env = plain()
    with pytest.raises(GymMaraError, match=r"cannot call 'reset'.*one batch"):
        env.env_method("reset", indices=indices)
    with pytest.raises(GymMaraError, match=r"cannot set the attribute.*one batch"):
        env.set_attr("max_episode_steps", 7, indices)
    assert env.get_attr("max_episode_steps") == [4, 4, 4]
    assert env.get_attr("max_episode_steps", indices) == [4] * np.size(indices)


@pytest.mark.parametrize("indices", [3, -1, [0, 3], "0", 0.0, [True, False, True], [[0]]])
def test_indices_that_are_no_arms_are_an_error(indices: Any) -> None:
    env = plain()
    with pytest.raises(GymMaraError, match="whole numbers from 0 to 2"):
        env.get_attr("max_episode_steps", indices)
    with pytest.raises(GymMaraError, match="whole numbers from 0 to 2"):
        env.env_is_wrapped(Monitor, indices)


def test_spaces_are_those_of_one_arm() -> None:
    env = small()
    assert env.get_attr("observation_space", 0) == [env.observation_space]
    assert env.get_attr("action_space", 0) == [env.action_space]
    assert env.has_attr("max_episode_steps")
    assert not env.has_attr("colour")


def test_options_of_a_reset_are_refused_as_by_a_single_environment() -> None:
    env = small()
    env.set_options({"colour": "red"})
    with pytest.raises(GymMaraError, match="'colour'"):
        env.reset()
    env.set_options({})
    env.reset()


def test_each_arm_has_its_own_picture() -> None:
    env = plain(2, render_mode="rgb_array", width=64, height=48)
    env.reset()
    (picture,) = env.env_method("render", indices=1)
    assert picture.shape == (48, 64, 3)
    tiled = env.render()
    assert tiled is not None
    assert tiled.size == 2 * picture.size
    env.close()


def test_seeds_repeat_random_targets() -> None:
    env = make_env("MARARandomTarget-v0", "pinocchio", 2, {}, max_episode_steps=4)
    env.seed(3)
    first = env.reset()
    env.seed(3)
    np.testing.assert_array_equal(env.reset(), first)
    assert not np.array_equal(env.reset(), first)


def test_a_copy_by_pickle_continues_alike() -> None:
    env = small()
    env.reset()
    copied, action = pickled(env), np.full((3, 6), 0.1, np.float32)
    np.testing.assert_array_equal(step(copied, action)[0], step(env, action)[0])


# The helpers of Stable-Baselines3.


def agent(env: VecEnv) -> PPO:
    """A small agent."""
    return PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")


def test_evaluate_policy_gives_the_returns_of_single_environments() -> None:
    kwargs = {"max_episode_steps": 4, "on_collision": "terminate"}
    singles = make_vec_env("gym_mara/MARA-v0", 2, env_kwargs=kwargs, wrapper_class=rescaled)
    batch = in_one_batch(
        make_vec_env("gym_mara/MARA-v0", 2, env_kwargs=kwargs, wrapper_class=rescaled)
    )
    model = agent(singles)
    (returns, lengths), (others, other_lengths) = (
        evaluate_policy(model, env, 4, return_episode_rewards=True) for env in (singles, batch)
    )
    np.testing.assert_allclose(returns, others, rtol=1e-5)  # type: ignore[arg-type]
    assert lengths == other_lengths


def test_callbacks_and_wrappers_of_stable_baselines3(tmp_path: Path) -> None:
    # A warning, such as that of a missing Monitor, is an error in these tests.
    assert evaluate_policy(agent(small()), small(), 3)[0] != 0.0
    env = VecNormalize(VecCheckNan(VecFrameStack(small(), 2), raise_exception=True))
    evaluation = VecNormalize(VecCheckNan(VecFrameStack(small(2), 2)), training=False)
    evaluating = EvalCallback(
        evaluation, eval_freq=8, n_eval_episodes=2, log_path=str(tmp_path), verbose=0
    )
    saving = CheckpointCallback(8, str(tmp_path), save_vecnormalize=True)
    model = agent(env).learn(48, callback=[evaluating, saving])
    assert evaluating.evaluations_length == [[4, 4], [4, 4]]
    assert len(list(tmp_path.glob("*steps.zip"))) == 2
    assert model.ep_info_buffer
    env.close()


def test_vec_monitor_counts_as_the_batch_does() -> None:
    with pytest.warns(UserWarning, match="already wrapped"):
        monitored = VecMonitor(small())
    monitored.reset()
    for _ in range(4):
        infos = step(monitored, np.zeros((3, 6), np.float32))[3]
    own = small()
    own.reset()
    for _ in range(4):
        expected = step(own, np.zeros((3, 6), np.float32))[3]
    assert infos[0]["episode"]["l"] == expected[0]["episode"]["l"]
    assert infos[0]["episode"]["r"] == pytest.approx(expected[0]["episode"]["r"], abs=1e-5)
