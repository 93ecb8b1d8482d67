"""A policy with a memory is trained, resumed and played like the others, and its memory ends with the episode."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from gym_mara.agents.algorithms.base import Preset
from gym_mara.agents.export.run import export
from gym_mara.agents.runs import Policy, load_policy
from gym_mara.agents.runs.evaluation import Player, evaluate_run, make_arms
from gym_mara.agents.runs.folder import DamagedRunError, RunConfig, RunFolder
from gym_mara.agents.runs.snapshot import decode, encode
from gym_mara.agents.training.checkpoint import STATE_FILE
from gym_mara.agents.training.train import resume, train
from gym_mara.errors import GymMaraError
from gym_mara.registration import ENVIRONMENTS, Environment
from gym_mara.tasks import TASKS, ReachTask
from tests.agents.conftest import silent
from tests.agents.training.test_train import assert_same_training

SHORT, LENGTH = "MARAShort-v0", 30
ROLLOUT = 4 * 20
"""Steps between two updates; a checkpoint after the first one is in the middle of the episodes."""
PRESET = Preset(
    num_envs=4,
    policy="lstm",
    arguments={
        "n_steps": 20,
        "batch_size": 40,
        "n_epochs": 2,
        "learning_rate": 1e-2,
        "policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 16, "log_std_init": -1.0},
    },
)
CONFIG = RunConfig(
    env=SHORT,
    algo="ppo-lstm",
    backend="pinocchio",
    steps=3 * ROLLOUT,
    seed=3,
    checkpoint_every=ROLLOUT,
    env_options={"max_joint_velocity": 1.57},
)


@pytest.fixture(scope="module", autouse=True)
def _short_episodes() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TASKS, SHORT, ReachTask())
        patch.setitem(ENVIRONMENTS, SHORT, Environment(SHORT, LENGTH))
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return train(CONFIG, tmp_path_factory.mktemp("lstm") / "run", silent, preset=PRESET)


@pytest.fixture(scope="module")
def policy(finished: RunFolder) -> Policy:
    return load_policy(finished)


@pytest.fixture
def interrupted(tmp_path: Path) -> Path:
    """A run that ended after its first checkpoint."""

    def stop(steps: int, shown: dict[str, float]) -> None:
        if steps > ROLLOUT:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(CONFIG, tmp_path / "run", stop, preset=PRESET)
    return tmp_path / "run"


def observations(count: int) -> Any:
    """Observations of one arm in a row (T, 1, O)."""
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 1, 12))


def test_an_interrupted_run_is_resumed_with_the_same_result(
    finished: RunFolder, interrupted: Path
) -> None:
    assert_same_training(finished, resume(interrupted, silent))


@pytest.mark.parametrize("wrong", [np.full((1, 4, 16), np.nan), np.zeros((1, 3, 16)), None])
def test_a_damaged_memory_is_found(interrupted: Path, wrong: Any) -> None:
    file = RunFolder.open(interrupted).checkpoints()[-1] / STATE_FILE
    state = decode(file.read_bytes())
    state["memory"][0][0] = wrong if wrong is None else wrong.astype(np.float32)
    file.write_bytes(encode(state))
    with pytest.raises(DamagedRunError, match=r"memory.*resume from the one before"):
        resume(interrupted, silent)


def test_the_memory_changes_the_actions_until_an_episode_begins(policy: Policy) -> None:
    first, second = observations(2)
    _, state = policy.predict(first)
    remembering, _ = policy.predict(second, state)
    forgetting, _ = policy.predict(second, state, np.array([True]))
    fresh, _ = policy.predict(second)
    assert np.abs(remembering - fresh).max() > 1e-4
    np.testing.assert_array_equal(forgetting, fresh)


def test_evaluations_play_it_as_stable_baselines3_does(finished: RunFolder, policy: Any) -> None:
    env = gymnasium.make(
        "gym_mara/MARA-v0",
        max_episode_steps=LENGTH,
        max_joint_velocity=1.57,
        disable_env_checker=True,
    )
    mean, _ = evaluate_policy(policy, Monitor(env), 2)
    expected = float(np.mean(mean))
    played = evaluate_run(finished, episodes=1)
    np.testing.assert_allclose(played["return"], expected, rtol=1e-6)
    with Player(finished, "pinocchio", finished.config.env_options) as player:
        total = sum(float(player.step().reward[0]) for _ in range(LENGTH))
    assert total == pytest.approx(expected, rel=1e-6)
    without, observation = 0.0, env.reset(seed=0)[0]
    for _ in range(LENGTH):
        observation, reward, *_ = env.step(policy.predict(observation)[0])
        without += float(reward)
    assert abs(without - expected) > 1e-4


def test_an_arm_forgets_when_its_own_episode_ends(policy: Policy) -> None:
    """One arm collides, which terminates its episode; the other one goes on."""
    arms = make_arms(
        "MARA-v0", "pinocchio", 2, {"on_collision": "terminate"}, max_episode_steps=None
    )
    act, state = policy.begin(arms.simulation), None
    observation, _ = arms.reset(seed=0)
    ended = np.ones(2, np.bool_)
    ends = 0
    for step in range(6):
        expected, state = policy.predict(observation, state, ended)
        np.testing.assert_array_equal(act(observation), expected)
        actions = np.zeros((2, 6), np.float32)
        actions[0, 1] = 2.3 if step == 2 else 0.0  # into the table
        observation, _, terminated, truncated, _ = arms.step(actions)
        ended = terminated | truncated
        ends += int(ended[0])
        assert not ended[1]
    assert ends == 1
    arms.close()


@pytest.mark.parametrize(
    ("state", "starts", "message"),
    [
        ((np.zeros((1, 2, 16)),) * 2, None, r"state must be what predict returned.*\(1, 1, 16\)"),
        ((np.full((1, 1, 16), np.nan),) * 2, None, "state must be"),
        ("yesterday", None, "state must be"),
        (None, np.zeros(3, np.bool_), r"episode_start must have the shape \(1,\)"),
    ],
)
def test_a_wrong_memory_is_refused(policy: Policy, state: Any, starts: Any, message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        policy.predict(observations(1)[0], state, starts)


def test_an_export_is_refused(finished: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(GymMaraError, match="cannot export a recurrent policy"):
        export(finished, tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def test_a_goal_environment_trains_it_too(tmp_path: Path) -> None:
    config = RunConfig("MARAGoal-v0", "ppo-lstm", "pinocchio", ROLLOUT, 0, ROLLOUT)
    run = train(config, tmp_path / "run", silent, preset=PRESET)
    assert len(evaluate_run(run, episodes=2)["return"]) == 2
