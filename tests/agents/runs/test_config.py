"""The configuration of a run: what it may hold, when it is made and when it is read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gym_mara.agents.runs.config import DamagedRunError, RunConfig
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.errors import GymMaraError
from tests.agents.conftest import config

FORBIDDEN: list[tuple[dict[str, Any], str]] = [
    ({"viewer_host": "0.0.0.0"}, "'viewer_host' cannot be an option of a run"),
    ({"viewer_port": 80}, "'viewer_port' cannot be an option of a run"),
    ({"render_mode": "human"}, "'render_mode' cannot be an option of a run"),
    ({"width": 10}, "'width' cannot be an option of a run"),
    ({"num_envs": 3}, "the preset sets the number of arms"),
    ({"max_episode_steps": 3}, "'max_episode_steps' cannot be"),
    ({"autoreset_mode": "Disabled"}, "needs 'SameStep'"),
    ({"task": "MARA-v0"}, "it is the run's env"),
    ({"backend": "dart"}, "the run names it itself"),
    ({"self": 1}, "'self' cannot be"),
    ({"start_q": [float("nan")] * 6}, "finite numbers.*it has nan"),
    ({"start_q": 10**400}, "finite numbers"),
    ({"a": [[[[[[[[[1]]]]]]]]]}, "env_options.*lists and dicts"),
]


@pytest.mark.parametrize(("options", "message"), FORBIDDEN)
def test_options_that_no_run_may_have_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        config(env_options=options)


@pytest.mark.parametrize(("options", "message"), FORBIDDEN)
def test_options_that_no_run_may_have_are_refused_when_a_run_is_read(
    finished_run: RunFolder, tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(DamagedRunError, match=message):
        changed(finished_run, tmp_path, env_options=options)


def test_options_that_are_no_json_are_refused() -> None:
    with pytest.raises(GymMaraError, match="so that a run can store it"):
        config(env_options={"start_q": object()})
    with pytest.raises(GymMaraError, match="keys must be texts"):
        config(env_options={"randomisation": {1: 2}})


def changed(run: RunFolder, path: Path, **changes: Any) -> RunConfig:
    """Read a run's configuration after a change."""
    values = json.loads((run.path / "config.json").read_text())
    for key, value in changes.items():
        target = values
        *parents, last = key.split("__")
        for parent in parents:
            target = target[parent]
        target[last] = value
    (path / "config.json").write_text(json.dumps(values))
    return RunFolder.open(path).config


@pytest.mark.parametrize(
    "changes",
    [
        {"steps": "many"},
        {"steps": 0},
        {"steps": 10**13},
        {"steps": 10**400},
        {"seed": 1.5},
        {"seed": -1},
        {"seed": 2**32},
        {"checkpoint_every": True},
        {"env": None},
        {"env_options": []},
        {"colour": "red"},
        {"versions": None},
        {"env_options": {"robot": "folder/arm.urdf"}},
        {"start": "runs/first"},
        {"start": {"run": "runs/first", "policy": "last"}},
        {"start": {"run": "runs/first", "policy": "last", "steps": -1}},
        {"start": {"run": "runs/first", "policy": "last", "steps": 1, "colour": "red"}},
        {"preset": {}},
        {"preset": []},
        {"preset__colour": "red"},
        {"preset__num_envs": "many"},
        {"preset__num_envs": 0},
        {"preset__num_envs": 10**19},
        {"preset__policy": "mpl"},
        {"preset__normalise_reward": 1},
        {"preset__arguments__n_steps": 2**20},
        {"preset__arguments__n_steps": "2"},
        {"preset__arguments__n_steps": -1},
        {"preset__arguments__gamma": "0.9"},
        {"preset__arguments__gamma": float("nan")},
        {"preset__arguments__n_epochs": 10**400},
        {"preset__arguments__tensorboard_log": "/tmp/here"},
        {"preset__arguments__learning_rate": [[0.0]]},
        {"preset__arguments__learning_rate": [[0.0, "x"]]},
        {"preset__arguments__policy_kwargs": []},
        {"preset__arguments__policy_kwargs__net_arch": [64] * 100_000},
        {"preset__arguments__policy_kwargs__net_arch": [10**9]},
        {"preset__arguments__policy_kwargs__net_arch": [-1]},
        {"preset__arguments__policy_kwargs__net_arch": {"qf": [1]}},
        {"preset__arguments__policy_kwargs__net_arch": 64},
        {"preset__arguments__policy_kwargs__log_std_init": "x"},
        {"preset__arguments__policy_kwargs__optimizer_class": "os.system"},
        {"preset__arguments__policy_kwargs__activation_fn": "Linear"},
        {"preset__arguments__policy_kwargs__activation_fn": ["ReLU"]},
        {"preset__arguments__policy_kwargs__features_extractor_class": "x"},
    ],
)
def test_a_wrong_value_in_a_configuration_is_an_error(
    finished_run: RunFolder, tmp_path: Path, changes: dict[str, Any]
) -> None:
    with pytest.raises(DamagedRunError, match="is damaged"):
        changed(finished_run, tmp_path, **changes)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", "3", '{"env": "MARA-v0", "versions": {}}', '{"a":' * 100_000, "\x00"],
)
def test_a_damaged_configuration_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(DamagedRunError, match="damaged"):
        RunFolder.open(tmp_path)


def test_the_path_of_a_robot_is_made_absolute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert config(env_options={"robot": "a/arm.urdf"}).env_options["robot"] == str(
        tmp_path / "a" / "arm.urdf"
    )
    assert config(env_options={"robot": "ur5"}).env_options["robot"] == "ur5"


def test_a_folder_without_a_run_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DamagedRunError, match="not a run folder"):
        RunFolder.open(tmp_path)
