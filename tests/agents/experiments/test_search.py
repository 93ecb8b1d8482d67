"""The search for hyperparameters: it can be resumed, and it never uses the seeds of reported results."""

from __future__ import annotations

import inspect
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock

from gym_mara.agents.algorithms.base import LogRange
from gym_mara.agents.algorithms.registry import ALGORITHMS, algorithm
from gym_mara.agents.experiments import search as module
from gym_mara.agents.experiments.search import (
    FIRST_SEED,
    Search,
    best_trial,
    finished_trials,
    open_study,
    run_search,
    run_trials,
    space_around,
    values_of,
    with_values,
)
from gym_mara.agents.runs.evaluation import make_env
from gym_mara.agents.training.train import new_agent, preset_of, train
from gym_mara.errors import GymMaraError, TrainingDivergedError
from tests.helpers import files_of_at_most

SMALL = Search(env="MARA-v0", algo="acktr", steps=512, trials=2, seeds=1)


def ignore(*arguments: Any) -> None:
    """Messages go nowhere."""


@pytest.mark.slow
def test_a_search_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = []

    def remember(config: Any, *arguments: Any, **keywords: Any) -> Any:
        seeds.append(config.seed)
        return train(config, *arguments, **keywords)

    monkeypatch.setattr(module, "train", remember)
    run_trials(SMALL, tmp_path / "study", ignore)
    study = open_study(SMALL, tmp_path / "study")
    assert finished_trials(study) == 2
    more = Search(**{**vars(SMALL), "trials": 3})
    run_trials(more, tmp_path / "study", ignore)
    assert finished_trials(open_study(more, tmp_path / "study")) == 3
    assert len(set(seeds)) == 3
    assert min(seeds) >= FIRST_SEED


@pytest.mark.slow
def test_a_killed_trial_is_repeated(tmp_path: Path) -> None:
    study = open_study(SMALL, tmp_path)
    acktr = algorithm("acktr")
    space = acktr.search_space
    first = values_of(acktr.preset("tuned", teleports=True), space)
    study.ask()  # its result never arrives
    killed = study.ask()
    killed.suggest_float("learning_rate", *space.arguments["learning_rate"], log=True)
    assert run_search(SMALL, tmp_path, 1, ignore) == {}
    trials = open_study(SMALL, tmp_path).get_trials()
    assert not any(trial.state.name == "RUNNING" for trial in trials)
    assert finished_trials(study) == 2
    ended = [trial.params for trial in trials if trial.state.name == "COMPLETE"]
    assert ended[0] == first
    assert ended[1]["learning_rate"] == killed.params["learning_rate"]


def test_a_trial_that_diverges_does_not_end_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverge(*arguments: Any, **keywords: Any) -> None:
        raise TrainingDivergedError("the gradient is not finite")

    monkeypatch.setattr(module, "train", diverge)
    run_trials(SMALL, tmp_path, ignore)
    study = open_study(SMALL, tmp_path)
    assert finished_trials(study) == 2
    assert best_trial(study) is None


def test_an_error_that_every_trial_would_meet_ends_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: Any, **keywords: Any) -> None:
        raise GymMaraError("no space left on device")

    monkeypatch.setattr(module, "train", full)
    with pytest.raises(GymMaraError, match="no space left"):
        run_trials(SMALL, tmp_path, ignore)
    assert finished_trials(open_study(SMALL, tmp_path)) == 0


def test_a_bad_trial_is_pruned_whatever_the_length_of_its_rollouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Evaluations are compared by their number, not by their steps."""
    search = Search(**{**vars(SMALL), "trials": 12, "steps": 10_000})
    played: list[int] = []

    def pretend(config: Any, folder: Path, report: Any, *, preset: Any) -> str:
        rollout = 7 * len(played) + 100  # no two alike
        played.append(0)
        reward = 9.0 if len(played) < 12 else -1.0
        for number in range(1, 11):
            shown = {"eval_reward_per_step": reward, "evaluations": number}
            report(number * 1000 // rollout * rollout, shown)
            report(number * 1000 // rollout * rollout + 1, shown)  # the same evaluation again
            played[-1] = number
        return ""

    monkeypatch.setattr(module, "train", pretend)
    evaluated = {"reward_per_step": np.array([9.0])}
    monkeypatch.setattr(module, "evaluate_run", lambda *_, **__: evaluated)
    run_trials(search, tmp_path, ignore)
    assert played[:11] == [10] * 11
    assert played[11] == 2, "it is compared from the third evaluation on"


@pytest.mark.parametrize(("env", "episodes"), [("MARA-v0", 1), ("MARAReach-v0", 100)])
def test_a_trial_is_judged_by_many_episodes_where_they_are_random(
    env: str, episodes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played: list[int] = []

    def evaluate(run: Any, *, episodes: int) -> dict[str, Any]:
        played.append(episodes)
        return {"reward_per_step": np.ones(episodes)}

    monkeypatch.setattr(module, "train", lambda *_, **__: None)
    monkeypatch.setattr(module, "evaluate_run", evaluate)
    run_trials(replace(SMALL, env=env, trials=1), tmp_path, ignore)
    assert played == [episodes]


@pytest.mark.slow
def test_a_search_may_be_short(tmp_path: Path) -> None:
    short = Search(**{**vars(SMALL), "steps": 5, "trials": 1})
    run_trials(short, tmp_path, ignore)
    assert best_trial(open_study(short, tmp_path)) is not None


def test_only_one_command_at_a_time_searches_in_a_folder(tmp_path: Path) -> None:
    open_study(SMALL, tmp_path)
    with FileLock(tmp_path / ".lock"), pytest.raises(GymMaraError, match="another process"):
        run_search(SMALL, tmp_path, 1, ignore)


@pytest.mark.slow
def test_several_processes_search_together(tmp_path: Path) -> None:
    open_study(SMALL, tmp_path)
    assert run_search(SMALL, tmp_path, 2, ignore) == {}
    assert finished_trials(open_study(SMALL, tmp_path)) >= 2


def test_the_folder_of_another_search_is_refused(tmp_path: Path) -> None:
    open_study(SMALL, tmp_path)
    with pytest.raises(GymMaraError, match="another search"):
        open_study(Search(**{**vars(SMALL), "algo": "ppo"}), tmp_path)
    with pytest.raises(GymMaraError, match="unknown algorithm"):
        open_study(Search(**{**vars(SMALL), "algo": "ppo2"}), tmp_path / "other")


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(GymMaraError, match="holds files but no search: choose another --out"):
        open_study(SMALL, tmp_path)
    with pytest.raises(GymMaraError, match="is a file: choose another --out"):
        open_study(SMALL, tmp_path / "config.json")
    assert [entry.name for entry in tmp_path.iterdir()] == ["config.json"]


@pytest.mark.parametrize("env", ["MARA-v0", "MARAReach-v0"])
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_search_starts_with_the_preset_of_the_environment(
    algo: str, env: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []

    def remember(config: Any, *arguments: Any, preset: Any) -> None:
        tried.append(preset)
        raise TrainingDivergedError("enough")

    monkeypatch.setattr(module, "train", remember)
    search = Search(env=env, algo=algo, steps=512, trials=2, seeds=1)
    run_trials(search, tmp_path, ignore)
    first, second = tried
    space, preset = algorithm(algo).search_space, preset_of(search.config(FIRST_SEED))
    assert values_of(first, space).items() >= values_of(preset, space).items()
    defaults = inspect.signature(algorithm(algo).load_class()).parameters
    for name in space.arguments.keys() - preset.arguments.keys():
        assert first.arguments[name] == defaults[name].default
    assert second != first


@pytest.mark.parametrize("env", ["MARA-v0", "MARAReach-v0"])
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_the_algorithm_accepts_the_values_of_its_search_space(algo: str, env: str) -> None:
    start = preset_of(Search(env, algo, 1, 1, 1).config(FIRST_SEED))
    space = space_around(start, algo)
    chosen = {
        name: values.high if isinstance(values, LogRange) else values[-1]
        for name, values in {**space.arguments, **space.policy_kwargs}.items()
    }
    preset = replace(with_values(start, space, chosen), num_envs=4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a batch that is larger than a rollout of so few arms
        model = new_agent(algo, preset, make_env(env, "pinocchio", 4, {}), seed=0)
    assert isinstance(model, algorithm(algo).load_class())
    first = next(iter(space.arguments))
    assert getattr(model, first) == chosen[first]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"env": "MARA v0"}, "unknown environment"),
        ({"algo": "ppo2"}, "unknown algorithm"),
        ({"steps": 10**400}, "steps must be"),
        ({"trials": 0}, "trials must be"),
        ({"trials": 10**9}, "trials must be at most 100,000"),
        ({"seeds": 10**9}, "seeds must be at most 1,000"),
    ],
)
def test_a_wrong_search_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        open_study(Search(**{**vars(SMALL), **change}), tmp_path / "search")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "log",
    [
        b"garbage\n",
        b"\x00\xff\n",
        b"[" * 100_000 + b"\n",
        b"{}\n",
        b"[1]\n",
        b'{"op_code": 0, "worker_id": "a"}\n',
        b'{"op_code": 99, "worker_id": "a"}\n',
    ],
)
def test_a_damaged_log_is_named(tmp_path: Path, log: bytes) -> None:
    (tmp_path / "study.log").write_bytes(log)
    with pytest.raises(GymMaraError, match=r"study.log' is damaged .* choose another --out"):
        open_study(SMALL, tmp_path)


def test_a_pipe_or_an_endless_log_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "pipe").mkdir()
    (tmp_path / "endless").mkdir()
    os.mkfifo(tmp_path / "pipe" / "study.log")
    (tmp_path / "endless" / "study.log").symlink_to("/dev/zero")
    for name in ("pipe", "endless"):
        with pytest.raises(GymMaraError, match=r"study.log.*not a plain file"):
            open_study(SMALL, tmp_path / name)


def test_a_log_that_is_a_link_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / "search").mkdir()
    (tmp_path / "search" / "study.log").symlink_to(tmp_path / "outside")
    with pytest.raises(GymMaraError, match="symbolic link"):
        open_study(SMALL, tmp_path / "search")
    assert not (tmp_path / "outside").exists()


def test_a_line_that_was_cut_off_does_not_end_the_search(tmp_path: Path) -> None:
    open_study(SMALL, tmp_path)
    with (tmp_path / "study.log").open("ab") as stream:
        stream.write(b'{"op_code": 5, "wor')
    open_study(SMALL, tmp_path).ask()
    assert len(open_study(SMALL, tmp_path).get_trials()) == 1, "the trial that was enqueued"


def test_a_full_disk_is_an_error_that_names_the_log(tmp_path: Path) -> None:
    open_study(SMALL, tmp_path)
    size = (tmp_path / "study.log").stat().st_size
    message = r"cannot write .*study.log.*File too large"
    with files_of_at_most(size + 10), pytest.raises(GymMaraError, match=message):
        open_study(SMALL, tmp_path)
    assert open_study(SMALL, tmp_path).user_attrs["search"]["env"] == "MARA-v0"
