"""Off-policy algorithms are trained, resumed and played like the others; on goal environments with hindsight replay."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer

from gym_mara.agents.algorithms.base import Preset
from gym_mara.agents.runs import load_policy
from gym_mara.agents.runs.config import DamagedRunError, RunConfig
from gym_mara.agents.runs.evaluation import evaluate_run, make_env
from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.agents.runs.policy import base_env, save_policy
from gym_mara.agents.training.checkpoint import Progress, restore_state, state_files
from gym_mara.agents.training.replay import REPLAY_FILE
from gym_mara.agents.training.train import new_agent, new_model, resume, train
from gym_mara.errors import GymMaraError, TrainingDivergedError
from gym_mara.registration import ENVIRONMENTS, Environment
from gym_mara.tasks import TASKS, ReachTask
from tests.agents.conftest import silent
from tests.agents.training.test_train import assert_same_training

ALGORITHMS = ["sac", "tqc"]
SHORT = "MARAShort-v0"
ARMS, STEPS, EVERY = 4, 600, 200
REACHED = Progress(best=1.5, elapsed=2.5)


def small(algo: str, **changes: Any) -> Preset:
    """A preset that learns from step 104 on, and whose replay buffer is full before the last checkpoint."""
    arguments: dict[str, Any] = {
        "learning_starts": 100,
        "buffer_size": 500,
        "batch_size": 16,
        "gradient_steps": 1,
        "policy_kwargs": {"net_arch": [8]},
    }
    return Preset(num_envs=ARMS, policy=algo, arguments={**arguments, **changes})


def config(algo: str, **changes: Any) -> RunConfig:
    values: dict[str, Any] = {
        "env": SHORT,
        "algo": algo,
        "backend": "pinocchio",
        "steps": STEPS,
        "seed": 3,
        "checkpoint_every": EVERY,
    }
    return RunConfig(**{**values, **changes})


GOAL: dict[str, Any] = {"env": "MARAGoal-v0"}


@pytest.fixture(scope="module", autouse=True)
def _short_episodes() -> Iterator[None]:
    """An environment whose episodes have 30 steps, so that evaluations take little time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TASKS, SHORT, ReachTask(orientation=True, collision_penalty=True))
        patch.setitem(ENVIRONMENTS, SHORT, Environment(SHORT, 30))
        yield


@pytest.fixture(scope="module", params=ALGORITHMS)
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    algo = request.param
    path = tmp_path_factory.mktemp("off_policy") / "run"
    return train(config(algo), path, silent, preset=small(algo))


@pytest.fixture(scope="module")
def goal_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    path = tmp_path_factory.mktemp("goal") / "run"
    return train(config("sac", **GOAL), path, silent, preset=small("sac"))


def interrupted(run: RunFolder, path: Path, steps: int) -> Path:
    """A training of the same run that ended early."""

    class Stop(Exception):  # noqa: N818
        pass

    def stop(reached: int, shown: dict[str, float]) -> None:
        if reached > steps:
            raise Stop

    preset = run.config.made_preset()
    with pytest.raises(Stop):
        train(replace(run.config, preset={}), path, stop, preset=preset)
    return path


def test_a_run_has_the_files_and_the_table_of_any_other(finished: RunFolder) -> None:
    assert [int(p.name) for p in finished.checkpoints()] == [EVERY, 2 * EVERY, STEPS]
    assert finished.has_policy("last")
    assert finished.has_policy("best")
    assert (finished.path / "learning_curve.png").is_file()
    rows = read_progress(finished.progress_file)
    assert [r["time/total_timesteps"] for r in rows] == [EVERY, 2 * EVERY, STEPS]
    assert all({"rollout/reward_per_step", "eval/reward_per_step"} <= r.keys() for r in rows)
    assert "train/ent_coef" in rows[-1]


def test_a_long_training_has_rows_between_its_checkpoints(tmp_path: Path) -> None:
    asked = config("sac", steps=5000, checkpoint_every=3000)
    preset = small("sac", learning_starts=5000)
    rows = read_progress(train(asked, tmp_path / "run", silent, preset=preset).progress_file)
    assert [r["time/total_timesteps"] for r in rows] == [2000, 3000, 5000, 5000]
    rewards = [r["rollout/reward_per_step"] for r in rows if "rollout/reward_per_step" in r]
    assert len(rewards) == 3, "each step counts once"


def test_the_policy_acts_alike_in_every_way(finished: RunFolder) -> None:
    policy = load_policy(finished)
    observation, _ = gymnasium.make("gym_mara/MARACollisionOrient-v0").reset(seed=0)
    targets, _ = policy.predict(observation)
    expected = np.pi * policy._network.predict(observation, deterministic=True)[0]
    np.testing.assert_allclose(targets, expected, rtol=1e-6)
    assert np.isfinite(evaluate_run(finished, episodes=2)["return"]).all()


@pytest.mark.parametrize("steps", [EVERY, 2 * EVERY])
def test_an_interrupted_run_is_resumed_with_the_same_result(
    finished: RunFolder, tmp_path: Path, steps: int
) -> None:
    path = interrupted(finished, tmp_path / "run", steps)
    assert_same_training(finished, resume(path, silent))


def test_hindsight_replay_is_resumed_with_the_same_result(
    goal_run: RunFolder, tmp_path: Path
) -> None:
    path = interrupted(goal_run, tmp_path / "run", 2 * EVERY)
    assert_same_training(goal_run, resume(path, silent))


def test_only_the_last_checkpoint_of_an_unfinished_run_has_a_replay_buffer(
    finished: RunFolder, tmp_path: Path
) -> None:
    path = interrupted(finished, tmp_path / "run", 2 * EVERY)
    checkpoints = RunFolder.open(path).checkpoints()
    assert [(each / REPLAY_FILE).exists() for each in checkpoints] == [False, True]
    assert not list(finished.path.rglob(REPLAY_FILE))


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("env", [SHORT, "MARAGoal-v0"])
@pytest.mark.parametrize("steps", [80, 400, 800])
def test_a_restored_training_has_the_same_state(
    tmp_path: Path, algo: str, env: str, steps: int
) -> None:
    asked = config(algo, env=env, preset=asdict(small(algo)))
    model = new_model(asked)
    model.learn(steps)
    files = state_files(model, REACHED)
    save_policy(tmp_path / "checkpoint", model, files)
    other = new_model(replace(asked, seed=9))
    assert restore_state(other, tmp_path / "checkpoint") == REACHED
    assert _contents(state_files(other, REACHED)) == _contents(files)
    for each in (model, other):
        base_env(each).close()


def _contents(files: dict[str, Any]) -> dict[str, bytes]:
    return {name: b"".join(bytes(piece) for piece in pieces) for name, pieces in files.items()}


def _flip(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "cut": lambda content: content[:-1],
    "longer": lambda content: content + b"\0",
    "a bit": _flip,
}


@pytest.fixture(scope="module")
def unfinished(goal_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with hindsight replay that was interrupted; tests must not change it."""
    return interrupted(goal_run, tmp_path_factory.mktemp("unfinished") / "run", 2 * EVERY)


@pytest.mark.parametrize("damage", ["missing", "a folder", *DAMAGE])
def test_a_damaged_replay_buffer_is_an_error(unfinished: Path, tmp_path: Path, damage: str) -> None:
    shutil.copytree(unfinished, tmp_path / "run")
    file = RunFolder.open(tmp_path / "run").checkpoints()[-1] / REPLAY_FILE
    content = file.read_bytes()
    file.unlink()
    if damage == "a folder":
        file.mkdir()
    elif damage != "missing":
        file.write_bytes(DAMAGE[damage](content))
    reason = "only the last checkpoint" if damage == "missing" else r"replay\.bin"
    with pytest.raises(DamagedRunError, match=rf"checkpoint .*{reason}"):
        resume(tmp_path / "run", silent)


@pytest.mark.parametrize(
    ("number", "name"),
    [(np.nan, "rewards"), (np.inf, "actions"), (-1, "ep_start"), (10**6, "ep_length")],
)
def test_a_replay_buffer_with_a_wrong_number_is_an_error(
    tmp_path: Path, name: str, number: float
) -> None:
    asked = config("sac", **GOAL, preset=asdict(small("sac")))
    model: Any = new_model(asked)
    model.learn(300)
    getattr(model.replay_buffer, name)[0, 0] = number
    save_policy(tmp_path / "checkpoint", model, state_files(model, REACHED))
    with pytest.raises(DamagedRunError, match="not finite or out of range"):
        restore_state(new_model(asked), tmp_path / "checkpoint")


# A penalty for collisions is no function of the goals; a sparse reward has none.
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, HerReplayBuffer),
        ({"reward_type": "dense"}, HerReplayBuffer),
        ({"collision_penalty": True}, HerReplayBuffer),
        ({"reward_type": "dense", "collision_penalty": True}, DictReplayBuffer),
    ],
)
def test_a_goal_environment_has_hindsight_replay_where_its_reward_can_be_computed_again(
    options: dict[str, Any], expected: type
) -> None:
    env = make_env("MARAGoal-v0", "pinocchio", ARMS, options)
    model: Any = new_agent("sac", small("sac"), env, seed=0)
    assert type(model.replay_buffer) is expected
    model.learn(260)  # some updates after the first episodes
    assert model._n_updates > 0
    env.close()


def test_hindsight_replay_begins_after_the_first_episodes() -> None:
    env = make_env("MARAGoal-v0", "pinocchio", ARMS, {})
    model: Any = new_agent("sac", small("sac", learning_starts=1), env, seed=0)
    assert model.learning_starts == 50 * ARMS
    model = new_agent("sac", small("sac", learning_starts=1000), env, seed=0)
    assert model.learning_starts == 1000
    env.close()


def test_the_rewards_of_hindsight_replay_are_those_of_the_environment() -> None:
    env: Any = make_env("MARAGoal-v0", "pinocchio", ARMS, {"position_tolerance": 0.3})
    model: Any = new_agent("sac", small("sac"), env, seed=0)
    model.learn(400)
    buffer = model.replay_buffer
    rows = np.repeat(np.arange(buffer.pos), ARMS)
    arms = np.tile(np.arange(ARMS), buffer.pos)
    kept = buffer.ep_length[rows, arms] > 0
    again = env.env.compute_reward(
        buffer.next_observations["achieved_goal"][rows, arms],
        buffer.next_observations["desired_goal"][rows, arms],
        [{}] * len(rows),
    )
    np.testing.assert_array_equal(again[kept], buffer.rewards[rows, arms][kept])
    ends = buffer.dones[: buffer.pos].nonzero()
    # The last observation of an episode is that of its end, and not the first one of the next episode.
    np.testing.assert_array_equal(
        buffer.next_observations["desired_goal"][ends], buffer.observations["desired_goal"][ends]
    )
    assert buffer.timeouts[ends].all()
    env.close()


def test_a_preset_may_normalise_observations(tmp_path: Path) -> None:
    preset = replace(small("sac"), normalise_observation=True, normalise_reward=True)
    run = train(config("sac", steps=EVERY), tmp_path / "run", silent, preset=preset)
    (evaluated,) = (
        r["eval/return"] for r in read_progress(run.progress_file) if "eval/return" in r
    )
    assert evaluate_run(run, episodes=1)["return"][0] == pytest.approx(evaluated, rel=1e-6)


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_observations_that_are_dictionaries_are_not_normalised(algo: str, tmp_path: Path) -> None:
    preset = small("sac") if algo == "sac" else Preset(num_envs=ARMS, arguments={"n_steps": 16})
    normalising = replace(preset, normalise_observation=True)
    with pytest.raises(GymMaraError, match="arrays, not dictionaries"):
        train(config(algo, **GOAL), tmp_path / "run", silent, preset=normalising)
    assert not (tmp_path / "run").exists()


def test_a_diverging_training_is_an_error(tmp_path: Path) -> None:
    wild = small("sac", learning_rate=1e30)
    with pytest.raises(TrainingDivergedError, match="finite"):
        train(config("sac"), tmp_path / "run", silent, preset=wild)


def test_nothing_in_a_policy_is_unpickled(
    finished: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.serialization, "_legacy_load", lambda *_, **__: pytest.fail("read"))
    monkeypatch.setattr(SAC, "load", lambda *_, **__: pytest.fail("unpickled"))
    monkeypatch.setattr("pickle.loads", lambda *_, **__: pytest.fail("unpickled"))
    load_policy(finished).predict(np.zeros(16))


@pytest.mark.parametrize("value", ["auto", "auto_0.1", "auto_2", 0.1])
def test_the_entropy_coefficient_may_be_learnt(value: str | float) -> None:
    env = make_env(SHORT, "pinocchio", ARMS, {})
    model: Any = new_agent("sac", small("sac", ent_coef=value), env, seed=0)
    assert (model.log_ent_coef is None) == isinstance(value, float)
    env.close()


@pytest.mark.parametrize(
    "changes",
    [
        {"ent_coef": "auto_0"},
        {"ent_coef": "auto_-1"},
        {"ent_coef": "auto_1e400"},
        {"ent_coef": "x"},
        {"gamma": "auto"},
        {"buffer_size": 10**9},
        {"buffer_size": "many"},
        {"policy_kwargs": {"n_critics": 10**6}},
        {"policy_kwargs": {"n_quantiles": 0}},
        {"policy_kwargs": {"n_critics": 2.0}},
        {"policy_kwargs": {"net_arch": {"vf": [8]}}},
    ],
)
def test_a_wrong_argument_of_a_preset_is_an_error(changes: dict[str, Any]) -> None:
    with pytest.raises(GymMaraError):
        small("sac", **changes)
