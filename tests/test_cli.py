"""The command gym-mara, as a user calls it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gym_mara import cli
from gym_mara.agents.algorithms.registry import ALGORITHMS
from gym_mara.tasks import TASKS


class Cli:
    """Runs the command in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys = monkeypatch, capsys

    def __call__(self, *arguments: object) -> tuple[int, str, str]:
        """The exit code, the output and the error output."""
        self._monkeypatch.setattr(sys, "argv", ["gym-mara", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        printed = self._capsys.readouterr()
        code = exit_.value.code
        return code if isinstance(code, int) else int(bool(code)), printed.out, printed.err


@pytest.fixture
def gym_mara(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Cli:
    """The command."""
    monkeypatch.setenv("COLUMNS", "200")
    return Cli(monkeypatch, capsys)


def test_list_shows_everything(gym_mara: Cli) -> None:
    code, out, _ = gym_mara("list")
    assert code == 0
    assert all(f"gym_mara/{task}" in out for task in TASKS)
    assert "pinocchio" in out
    assert "ur5" in out
    words = out.split()  # a narrow terminal wraps the lines
    assert all(name in words for name in ALGORITHMS)
    assert all(set(entry.summary.split()) <= set(words) for entry in ALGORITHMS.values())


@pytest.mark.parametrize(
    "command",
    [
        "train",
        "evaluate",
        "transfer",
        "watch",
        "report",
        "benchmark",
        "plot",
        "search",
        "rewards",
        "list",
    ],
)
def test_every_command_has_help(gym_mara: Cli, command: str) -> None:
    code, out, _ = gym_mara(command, "--help")
    assert code == 0
    assert "Usage" in out


def test_the_help_comes_from_the_registry(gym_mara: Cli) -> None:
    _, out, _ = gym_mara("train", "--help")
    assert f"Algorithm: {', '.join(ALGORITHMS)}." in out
    assert "Hyperparameters: tuned or paper." in out


def test_a_setting_that_looks_like_json_must_be_json(gym_mara: Cli, tmp_path: Path) -> None:
    run = tmp_path / "run"
    code, out, error = gym_mara("train", "--set", "randomisation={'mass': (1, 2)}", "--out", run)
    assert code != 0
    assert "not JSON" in error
    assert "steps" not in out, "no progress bar"
    assert not run.exists()


def test_train_then_evaluate(gym_mara: Cli, tmp_path: Path) -> None:
    run = tmp_path / "run"
    code, out, _ = gym_mara("train", "--env", "gym_mara/MARA-v0", "--steps", "4096", "--out", run)
    assert code == 0
    assert "position error, mm" in out
    code, out, _ = gym_mara("transfer", run)
    assert code == 0
    assert all(word in out for word in ("dart", "pinocchio", "settling time", "highest torque"))
    code, out, _ = gym_mara("evaluate", run, "--episodes", "2", "--json", "--policy", "best")
    assert code == 0
    metrics = json.loads(out)
    assert list(metrics) == [
        "position_error_mm",
        "angle_deg",
        "reward_per_step",
        "return",
        "collisions",
    ]
    assert all(values.keys() == {"mean", "std", "min", "max"} for values in metrics.values())
    code, out, _ = gym_mara("evaluate", run, "--backend", "pinocchio")
    assert code == 0
    assert "10 episode(s)" in out
    code, _, err = gym_mara("train", "--out", run)
    assert code == 2
    assert "not overwritten" in err


def test_rewards_are_recorded_and_checked(gym_mara: Cli, tmp_path: Path) -> None:
    file = tmp_path / "rewards.csv"
    code, _, _ = gym_mara("rewards", "--record", file, "--env", "MARAOrient-v0", "--states", "8")
    assert code == 0
    assert gym_mara("rewards", "--check", file)[0] == 0
    lines = file.read_text().splitlines()
    cells = lines[3].split(",")
    cells[-1] = repr(float(cells[-1]) + 0.5)
    file.write_text("\n".join([*lines[:3], ",".join(cells), *lines[4:]]))
    code, out, _ = gym_mara("rewards", "--check", file)
    assert code == 1
    assert "state 1: reward was" in out
    assert "(moved by -0.5)" in out
    assert "state 0" not in out


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["--check", "rewards.csv", "--set", "kappa=0.05"], "--set"),
        (["--check", "rewards.csv", "--env", "MARA-v0"], "--env"),
        (["--check", "rewards.csv", "--states", "8"], "--states"),
        (["--record", "rewards.csv", "--tolerance", "1e-6"], "--tolerance"),
    ],
)
def test_an_option_of_rewards_without_effect_is_an_error(
    gym_mara: Cli, arguments: list[str], option: str
) -> None:
    code, _, err = gym_mara("rewards", *arguments)
    assert code == 2
    assert f"leave out {option}" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--env", "MARA-v1"], "Did you mean 'MARA-v0'"),
        (["train", "--algo", "sac"], "unknown algorithm 'sac'"),
        (["train", "--backend", "gazebo"], "unknown backend 'gazebo'"),
        (["train", "--steps", "0.5"], "--steps must be a whole number"),
        (["train", "--steps", "nan"], "--steps must be a whole number"),
        (["train", "--set", "robot"], "write NAME=VALUE"),
        (["train", "--set", "robot=ur55"], "Did you mean 'ur5'"),
        (
            ["train", "--set", "max_joint_velocity=-1"],
            "max_joint_velocity must be finite and positive",
        ),
        (["train", "--resume", "nowhere"], "is not a run folder"),
        (["train", "--resume", "nowhere", "--steps", "5", "--algo", "ppo"], "leave out"),
        (["train", "--preset", "papers", "--out", "x"], "unknown preset 'papers'"),
        (["benchmark", "--algos", "ppo2", "--out", "x"], "unknown algorithm 'ppo2'"),
        (["benchmark", "--envs", "MARA-v1", "--out", "x"], "unknown environment 'MARA-v1'"),
        (["benchmark", "--envs", "MARA-v0, MARA-v0", "--out", "x"], "give each name once"),
        (["benchmark", "--algos", "ppo, trpo ,ppo", "--out", "x"], "give each name once"),
        (["benchmark", "--jobs", "0", "--out", "x"], "--jobs must be"),
        (["plot", "nowhere"], "holds no grid"),
        (["search", "--algo", "ppo2", "--out", "x"], "unknown algorithm 'ppo2'"),
        (["evaluate", "nowhere"], "is not a run folder"),
        (["rewards"], "either --record FILE or --check FILE"),
        (["rewards", "--check", "nowhere.csv"], "cannot read"),
        (["rewards", "--record", "no/such/folder/x.csv"], "cannot write"),
    ],
)
def test_wrong_input_is_an_error_in_one_line(
    gym_mara: Cli,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = gym_mara(*arguments)
    assert code == 2
    assert message in err
    assert "Traceback" not in err
    assert not list(tmp_path.iterdir())


def test_training_without_torch_names_the_extra(tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text("raise ModuleNotFoundError('no torch', name='torch')")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    for arguments in (["train"], ["evaluate", "run"]):
        result = subprocess.run(
            [sys.executable, "-m", "gym_mara.cli", *arguments],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
        assert result.returncode == 2
        assert "gym_mara[train]" in result.stderr
        assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("setting", "instead"),
    [("backend=dart", "give --backend"), ("num_envs=4", "the preset sets the number of arms")],
)
def test_what_a_command_sets_itself_is_no_keyword(
    gym_mara: Cli, tmp_path: Path, setting: str, instead: str
) -> None:
    code, _, err = gym_mara("train", "--set", setting, "--out", str(tmp_path / "run"))
    assert code == 2
    assert instead in err
    assert not (tmp_path / "run").exists()
