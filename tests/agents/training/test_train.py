"""Training: the files of a run, and that an interrupted run is resumed with the same result."""

from __future__ import annotations

import base64
import contextlib
import errno
import json
import os
import pickle
import shutil
import time
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from filelock import FileLock
from stable_baselines3 import PPO
from stable_baselines3.common.logger import CSVOutputFormat
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gym_mara.agents.algorithms.base import Preset
from gym_mara.agents.algorithms.registry import algorithm
from gym_mara.agents.evaluation.episodes import MOST_SEED
from gym_mara.agents.evaluation.metrics import METRICS, STATISTICS, spread
from gym_mara.agents.runs.archive import read_weights
from gym_mara.agents.runs.evaluation import (
    RANDOM_EPISODES,
    episodes_to_judge,
    evaluate_run,
    make_arms,
    make_env,
)
from gym_mara.agents.runs.folder import DamagedRunError, RunFolder, read_progress
from gym_mara.agents.training import callbacks
from gym_mara.agents.training import train as train_module
from gym_mara.agents.training.train import preset_agent, preset_of, resume, train
from gym_mara.envs import MaraVectorEnv
from gym_mara.errors import GymMaraError, TrainingDivergedError
from tests.agents.conftest import EPISODE, ROLLOUT, config, silent
from tests.helpers import Cli, started


def parameters(run: RunFolder, which: str = "last") -> dict[str, torch.Tensor]:
    """The weights of a run's policy."""
    return read_weights(run.policy(which) / "model.zip")


def assert_same_training(run: RunFolder, other: RunFolder) -> None:
    """The two runs have the same weights to the bit, and the same log except for times."""
    mine, theirs = parameters(run), parameters(other)
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)
    tables = []
    for folder in (run, other):
        rows = read_progress(folder.progress_file)
        clock = ("time/fps", "time/time_elapsed")
        tables.append([{k: v for k, v in row.items() if k not in clock} for row in rows])
    assert tables[0] == tables[1]


def test_a_run_writes_all_its_files(finished_run: RunFolder) -> None:
    path = finished_run.path
    about = json.loads((path / "config.json").read_text())
    assert about["seed"] == 5
    assert about["preset"]["arguments"]["n_steps"] * about["preset"]["num_envs"] == ROLLOUT
    assert {"gym_mara", "gymnasium", "torch", "pin", "python"} <= about["versions"].keys()
    assert [int(p.name) for p in finished_run.checkpoints()] == [ROLLOUT, 2 * ROLLOUT, 3 * ROLLOUT]
    for folder in (path / "best", path / "last", *finished_run.checkpoints()):
        assert (folder / "model.zip").is_file()
        assert (folder / "policy.json").is_file()
    assert list((path / "tensorboard").glob("events*"))
    assert (path / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    rows = read_progress(finished_run.progress_file)
    assert [r["eval/position_error_mm"] > 0 for r in rows if "eval/position_error_mm" in r]
    assert {r["time/total_timesteps"] for r in rows} == {ROLLOUT, 2 * ROLLOUT, 3 * ROLLOUT}


@pytest.mark.slow
def test_the_same_seed_trains_the_same_policy(finished_run: RunFolder, tmp_path: Path) -> None:
    again = train(config(), tmp_path / "run", silent)
    assert_same_training(finished_run, again)


@pytest.mark.parametrize(
    "command",
    [
        ("train", "--steps", "1"),
        ("benchmark", "--seeds", "1", "--steps", "1"),
        ("search", "--steps", "1"),
    ],
)
def test_an_environment_of_a_real_arm_is_not_trained_on_another_backend(
    command: tuple[str, ...], tmp_path: Path, gym_mara: Cli
) -> None:
    code, _, error = gym_mara(*command, "--env", "MARAReal-v0", "--out", tmp_path / "out")
    assert (code, "no run can be trained on the backend 'ros2'" in error) == (2, True)
    assert not (tmp_path / "out").exists()


def test_random_episodes_are_judged_by_several(tmp_path: Path) -> None:
    few = config(env="MARARandomTarget-v0", steps=ROLLOUT, env_options={"max_joint_velocity": 1.57})
    run = train(few, tmp_path / "run", silent)
    assert episodes_to_judge(run.config) == RANDOM_EPISODES > 1
    (judged,) = (r for r in read_progress(run.progress_file) if "eval/reward_per_step" in r)
    seed = MOST_SEED + 1 + run.config.seed  # which no evaluation by the command has
    metrics = evaluate_run(run, episodes=RANDOM_EPISODES, seed=seed)
    assert np.ptp(metrics["position_error_mm"]) > 1.0
    for name, found in spread(metrics).items():
        if found is None:
            assert f"eval/{name}" not in judged
        else:
            np.testing.assert_allclose(judged[f"eval/{name}"], found["mean"], rtol=1e-4, atol=1e-9)


def test_equal_episodes_are_judged_by_one(finished_run: RunFolder) -> None:
    assert episodes_to_judge(finished_run.config) == 1


@pytest.mark.parametrize(("arms", "processes"), [(1, 1), (5, 1), (6, 2)])
def test_arms_have_as_many_processes_as_divide_them(arms: int, processes: int) -> None:
    made = make_arms("MARA-v0", "dart", arms, {"workers": 2})
    try:
        assert len(getattr(made.simulation.backend, "processes", [None])) == processes
    finally:
        made.close()


def test_another_seed_trains_another_policy(finished_run: RunFolder, tmp_path: Path) -> None:
    other = train(config(seed=6, steps=ROLLOUT), tmp_path / "run", silent)
    mine, theirs = parameters(finished_run), parameters(other)
    assert not all(torch.equal(mine[name], theirs[name]) for name in mine)


@pytest.mark.slow
@pytest.mark.parametrize("updates_before_the_interrupt", [1, 2])
def test_an_interrupted_run_is_resumed_with_the_same_result(
    finished_run: RunFolder, tmp_path: Path, updates_before_the_interrupt: int
) -> None:
    def interrupt(steps: int, shown: dict[str, float]) -> None:
        # This is called at the end of a rollout, so the update that follows and the steps of the rollout are lost.
        if steps > updates_before_the_interrupt * ROLLOUT:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config(), tmp_path / "run", interrupt)
    resumed = resume(tmp_path / "run", silent)
    assert_same_training(finished_run, resumed)


@pytest.mark.slow
def test_a_killed_run_is_resumed_from_its_last_checkpoint(tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = ["-m", "gym_mara.cli", "train", "--out", str(run), "--steps", "1e7"]
    with started(*command, "--checkpoint-every", str(ROLLOUT)) as process:
        deadline = time.monotonic() + 120
        while not (run / "checkpoints" / str(2 * ROLLOUT)).is_dir():
            assert process.poll() is None, "the training ended early"
            assert time.monotonic() < deadline
            time.sleep(0.02)
    reached = int(RunFolder.open(run).checkpoints()[-1].name)
    text = (run / "config.json").read_text()
    (run / "config.json").write_text(text.replace("10000000", str(reached + ROLLOUT)))
    seen: list[int] = []
    resumed = resume(run, lambda steps, shown: seen.append(steps))
    assert seen[0] == reached
    assert resumed.has_policy("last")


@pytest.mark.slow
def test_a_run_interrupted_before_its_first_checkpoint_starts_again(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    def interrupt(steps: int, shown: dict[str, float]) -> None:
        if steps:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config(), tmp_path / "run", interrupt)
    assert_same_training(finished_run, resume(tmp_path / "run", silent))


def test_a_run_interrupted_after_its_last_checkpoint_is_finished(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    shutil.copytree(finished_run.path, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "last")
    (tmp_path / "run" / "learning_curve.png").unlink()
    resumed = resume(tmp_path / "run", silent)
    assert_same_policy(finished_run, resumed)
    assert (resumed.path / "learning_curve.png").is_file()


@pytest.mark.slow
def test_the_learning_curve_is_drawn_before_a_run_counts_as_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(run: RunFolder) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(callbacks, "plot_learning_curve", kill)
        with pytest.raises(KeyboardInterrupt):
            train(config(), tmp_path / "run", silent)
    resumed = resume(tmp_path / "run", silent)
    assert (resumed.path / "learning_curve.png").is_file()


def assert_same_policy(run: RunFolder, other: RunFolder) -> None:
    """The two runs have the same last policy."""
    mine, theirs = parameters(run), parameters(other)
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)


def test_a_finished_run_is_not_resumed(finished_run: RunFolder) -> None:
    with pytest.raises(GymMaraError, match="has finished"):
        resume(finished_run.path, silent)


def test_an_existing_folder_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(GymMaraError, match="not overwritten"):
        train(config(), tmp_path, silent)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algo": "pop"}, "unknown algorithm 'pop'. Did you mean 'ppo'"),
        ({"env": "MARA-v9"}, "unknown environment 'MARA-v9'.*MARACollision-v0"),
        ({"backend": "gazebo"}, "unknown backend 'gazebo'.*pinocchio"),
        ({"backend": "ros2"}, r"dart, mujoco, .*ros2 deploy.*MARAReal-v0.*docs/ros2\.md"),
        ({"steps": 0}, "steps must be at least 1"),
        ({"checkpoint_every": 0}, "checkpoint_every must be at least 1"),
        ({"env_options": {"colour": "red"}}, "unknown keyword argument 'colour'"),
        ({"seed": -1}, "seed must be a whole number from 0"),
        ({"seed": 2**32}, "seed must be a whole number from 0"),
    ],
)
def test_a_wrong_configuration_leaves_no_folder(
    tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        train(config(**changes), tmp_path / "run", silent)
    assert not (tmp_path / "run").exists()


def test_an_evaluation_has_each_metric_of_each_episode(finished_run: RunFolder) -> None:
    metrics = evaluate_run(finished_run, episodes=3)
    assert list(metrics) == [*METRICS]
    assert all(values.shape == (3,) for values in metrics.values())
    # Start pose and policy are the same in every episode, so the results are the same up to rounding.
    for name, values in metrics.items():
        np.testing.assert_allclose(values, values[0], rtol=1e-5, err_msg=name)
    np.testing.assert_allclose(metrics["return"], EPISODE * metrics["reward_per_step"], rtol=1e-9)
    summary = spread(metrics)
    assert tuple(summary["return"] or ()) == STATISTICS


@pytest.mark.slow
def test_an_evaluation_uses_the_environment_of_the_training(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    options = {"max_joint_velocity": 1.0, "start_q": [0.1] * 6}
    run = train(config(steps=ROLLOUT, env_options=options), tmp_path / "run", silent)
    assert RunFolder.open(run.path).config.env_options == options
    assert (
        evaluate_run(run, episodes=1)["return"] != evaluate_run(finished_run, episodes=1)["return"]
    )


def copy_of(run: RunFolder, path: Path) -> RunFolder:
    """A copy of a run, which a test may damage."""
    shutil.copytree(run.path, path)
    return RunFolder.open(path)


@pytest.mark.parametrize("file", ["model.zip", "policy.json"])
@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "a bit"])
def test_a_damaged_policy_is_an_error(
    finished_run: RunFolder, tmp_path: Path, file: str, damage: str
) -> None:
    run = copy_of(finished_run, tmp_path / "run")
    victim = run.path / "last" / file
    content = victim.read_bytes()
    victim.unlink()
    gone = damage == "missing" and file == "model.zip"
    if damage in ("empty", "cut"):
        victim.write_bytes(content[: 0 if damage == "empty" else len(content) // 2])
    elif damage == "a bit":
        middle = len(content) // 2
        flipped = bytes([content[middle] ^ 128])
        victim.write_bytes(content[:middle] + flipped + content[middle + 1 :])
    with pytest.raises(GymMaraError, match="has no 'last'" if gone else "damaged"):
        evaluate_run(run)


# The flipped bits claim another compression, encryption, and a later version of the format.
@pytest.mark.parametrize(("place", "bit"), [(10, 64), (8, 1), (6, 128)])
def test_a_policy_with_a_flipped_bit_in_the_directory_of_its_archive_is_an_error(
    finished_run: RunFolder, tmp_path: Path, place: int, bit: int
) -> None:
    run = copy_of(finished_run, tmp_path / "run")
    file = run.path / "last" / "model.zip"
    with zipfile.ZipFile(file) as archive:
        directory = archive.start_dir
    content = bytearray(file.read_bytes())
    content[directory + place] ^= bit
    file.write_bytes(content)
    with pytest.raises(DamagedRunError, match="damaged"):
        evaluate_run(run, episodes=1)


def test_an_evaluation_runs_no_code_from_the_policy_s_file(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    run = copy_of(finished_run, tmp_path / "run")
    trap = tmp_path / "trap"
    file = run.path / "last" / "model.zip"
    with zipfile.ZipFile(file) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    about = json.loads(parts["data"])
    pickled = base64.b64encode(pickle.dumps(Trap(trap))).decode()
    about["clip_range"] = {":type:": "", ":serialized:": pickled}
    parts["data"] = json.dumps(about).encode()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    evaluate_run(run, episodes=1)
    assert not trap.exists()
    PPO.load(file)
    assert trap.exists(), "loading it with Stable-Baselines3 runs the code"


class Trap:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return _make_file, (self.path,)


def _make_file(path: Path) -> float:
    path.touch()
    return 0.2


def test_a_policy_of_another_environment_is_refused(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    run = copy_of(finished_run, tmp_path / "run")
    file = run.path / "config.json"
    file.write_text(file.read_text().replace("MARACollisionOrient-v0", "MARA-v0"))
    with pytest.raises(GymMaraError, match="does not fit the environment"):
        evaluate_run(RunFolder.open(run.path))


def test_a_preset_with_an_unknown_policy_is_refused() -> None:
    with pytest.raises(GymMaraError, match=r"unknown policy 'mpl'\. Did you mean 'mlp'"):
        Preset(num_envs=1, policy="mpl")


def test_only_one_process_at_a_time_trains_a_run(
    finished_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = copy_of(finished_run, tmp_path / "run")
    shutil.rmtree(run.path / "last")
    shutil.rmtree(run.checkpoints()[-1])
    table = run.progress_file.read_bytes()
    with monkeypatch.context() as patch, FileLock(run.path / ".lock"):
        patch.delattr(
            train_module, "restore_state"
        )  # the checkpoint must not be read while the other process may write it
        with pytest.raises(GymMaraError, match="another process"):
            resume(run.path, silent)
    assert run.progress_file.read_bytes() == table
    assert resume(run.path, silent).has_policy("last")


@pytest.mark.slow
def test_a_run_in_training_is_not_resumed(tmp_path: Path) -> None:
    refused: list[int] = []

    def resume_meanwhile(steps: int, shown: dict[str, float]) -> None:
        with pytest.raises(GymMaraError, match="another process"):
            resume(tmp_path / "run", silent)
        refused.append(steps)

    train(config(), tmp_path / "run", resume_meanwhile)
    assert refused == [ROLLOUT * n for n in range(4)]


def test_a_resumed_tensorboard_log_has_every_step_once(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    run = copy_of(finished_run, tmp_path / "run")
    shutil.rmtree(run.path / "last")
    shutil.rmtree(run.checkpoints()[-1])
    resume(run.path, silent)
    log = EventAccumulator(str(run.path / "tensorboard"))
    log.Reload()
    steps = [event.step for event in log.Scalars("rollout/reward_per_step")]
    assert steps == [ROLLOUT * (n + 1) for n in range(3)]


# In turn: the parameters are NaN; the standard deviation overflows; a matrix of the policy cannot be factorised; the step of
# K-FAC is not finite.
@pytest.mark.parametrize(
    ("algo", "preset_name", "wild"),
    [
        ("ppo", "tuned", {"learning_rate": 1e30}),
        ("ppo", "paper", {"learning_rate": 1e10}),
        ("trpo", "tuned", {"target_kl": 1e5}),
        ("acktr", "tuned", {"learning_rate": 1e30}),
    ],
)
def test_a_diverging_training_is_an_error(
    tmp_path: Path, algo: str, preset_name: str, wild: dict[str, float]
) -> None:
    preset = algorithm(algo).preset(preset_name, teleports=True)
    preset = replace(preset, arguments={**preset.arguments, **wild})
    asked = config(algo=algo, steps=6000, checkpoint_every=6000)
    with pytest.raises(TrainingDivergedError, match="finite"):
        train(asked, tmp_path / "run", silent, preset=preset)


def test_another_failure_is_not_taken_for_divergence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any) -> None:
        raise ValueError("something else")

    monkeypatch.setattr(callbacks, "save_policy", fail)
    with pytest.raises(ValueError, match="something else") as caught:
        train(config(), tmp_path / "run", silent)
    assert not isinstance(caught.value, TrainingDivergedError)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_a_failed_training_closes_its_environments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    opened: list[MaraVectorEnv] = []
    closed: list[MaraVectorEnv] = []
    open_, close = MaraVectorEnv.__init__, MaraVectorEnv.close

    def note_opening(env: MaraVectorEnv, *arguments: Any, **options: Any) -> None:
        opened.append(env)
        open_(env, *arguments, **options)

    def note_closing(env: MaraVectorEnv) -> None:
        closed.append(env)
        close(env)

    def interrupt(steps: int, shown: dict[str, float]) -> None:
        if steps:
            raise error

    monkeypatch.setattr(MaraVectorEnv, "__init__", note_opening)
    monkeypatch.setattr(MaraVectorEnv, "close", note_closing)
    with pytest.raises(error):
        train(config(), tmp_path / "run", interrupt)
    # To find out whether joints teleport and whether episodes are random, to train, and to evaluate.
    assert len(opened) == 4
    assert {id(env) for env in opened} == {id(env) for env in closed}


def test_an_unfinished_run_has_no_last_policy(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    run = RunFolder(tmp_path / "run", config())
    with pytest.raises(GymMaraError, match="has no 'last' policy"):
        evaluate_run(run)


def test_a_full_disk_ends_a_training_with_one_line_and_the_run_can_be_resumed(
    finished_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = copy_of(finished_run, tmp_path / "run")
    shutil.rmtree(run.path / "last")
    shutil.rmtree(run.checkpoints()[-1])
    kept = run.checkpoints()

    def full(self: object, values: object, *arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(CSVOutputFormat, "write", full)
        with pytest.raises(GymMaraError, match=r"cannot write to .*No space left.*--resume"):
            resume(run.path, silent)
    with monkeypatch.context() as patch:
        patch.setattr(PPO, "save", full)
        with pytest.raises(GymMaraError, match=r"cannot write .*No space left"):
            resume(run.path, silent)
    assert run.checkpoints() == kept
    assert not list(run.path.glob("checkpoints/.*"))
    assert_same_training(finished_run, resume(run.path, silent))


def test_a_run_in_a_read_only_folder_is_not_resumed(
    finished_run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(FileLock, "_acquire", refuse)
    with pytest.raises(GymMaraError, match=r"cannot lock .*Read-only"):
        resume(finished_run.path, silent)


def test_another_failure_of_the_system_is_not_taken_for_a_full_disk(tmp_path: Path) -> None:
    def fail(steps: int, shown: dict[str, float]) -> None:
        raise BrokenPipeError(errno.EPIPE, "a worker died")

    with pytest.raises(BrokenPipeError):
        train(config(), tmp_path / "run", fail)


def test_a_table_that_is_no_plain_file_is_not_written(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    run = copy_of(finished_run, tmp_path / "run")
    shutil.rmtree(run.path / "last")
    shutil.rmtree(run.checkpoints()[-1])
    run.progress_file.unlink()
    os.mkfifo(run.progress_file)
    with pytest.raises(GymMaraError, match=r"progress.csv.*not a plain file"):
        resume(run.path, silent)


def test_evaluations_have_at_most_as_many_workers_as_arms() -> None:
    asked = config(env="MARA-v0", backend="dart", env_options={"workers": 2})
    assert preset_of(asked).num_envs == 16
    with contextlib.closing(make_env("MARA-v0", "dart", 1, asked.env_options)) as env:
        assert env.num_envs == 1
    with pytest.raises(GymMaraError, match="workers"):
        make_env("MARA-v0", "dart", 1, {"workers": "two"})


def test_an_agent_of_a_preset_for_a_script_trains_as_a_run(
    finished_run: RunFolder,
) -> None:
    asked = finished_run.config
    model = preset_agent(asked.env, asked.algo, seed=asked.seed)
    model.learn(asked.steps)
    mine, theirs = model.policy.state_dict(), parameters(finished_run)
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)
    with pytest.raises(GymMaraError, match="unknown keyword argument 'colour'"):
        preset_agent(colour="red")
