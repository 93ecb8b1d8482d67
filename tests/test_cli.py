"""The command gym-mara, as a user calls it."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.console import Console

from gym_mara import __version__
from gym_mara.agents.algorithms.registry import ALGORITHMS
from gym_mara.agents.evaluation.metrics import METRICS
from gym_mara.agents.experiments.grid import Grid
from gym_mara.cli import common, experiments
from gym_mara.cli.app import app
from gym_mara.cli.common import keyword_arguments, whole
from gym_mara.errors import GymMaraError
from gym_mara.registration import ENVIRONMENTS, Environment, environment_id, environment_names
from gym_mara.tasks import ReachTask, registry
from tests.agents.conftest import shorten_episodes
from tests.helpers import Cli


def _commands() -> dict[str, Any]:
    """The commands by name."""
    return dict(typer.main.get_command(app).commands)  # type: ignore[attr-defined]


def test_list_shows_everything(gym_mara: Cli) -> None:
    code, out, _ = gym_mara("list")
    assert code == 0
    assert all(environment_id(name) in out for name in environment_names())
    assert "pinocchio" in out
    assert "ur5" in out
    assert "they make MARA, with 6 joints: a motor makes a joint at each of its two faces" in out
    words = out.split()  # a narrow terminal wraps the lines
    assert all(name in words for name in ALGORITHMS)
    assert all(set(entry.summary.split()) <= set(words) for entry in ALGORITHMS.values())


@pytest.mark.parametrize("command", sorted(_commands()))
def test_every_command_has_help(gym_mara: Cli, command: str) -> None:
    code, out, _ = gym_mara(command, "--help")
    assert code == 0
    assert "Usage" in out


def test_the_help_comes_from_the_registry(gym_mara: Cli) -> None:
    _, out, _ = gym_mara("train", "--help")
    assert f"Algorithm: {', '.join(ALGORITHMS)}." in out
    assert "Hyperparameters: tuned or paper or robust." in out


def test_a_setting_that_looks_like_json_must_be_json(gym_mara: Cli, tmp_path: Path) -> None:
    run = tmp_path / "run"
    code, out, error = gym_mara("train", "--set", "randomisation={'mass': (1, 2)}", "--out", run)
    assert code != 0
    assert "not JSON" in error
    assert "steps" not in out, "no progress bar"
    assert not run.exists()


@pytest.mark.slow
def test_train_then_evaluate(
    gym_mara: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 256)
    run = tmp_path / "run"
    code, out, _ = gym_mara("train", "--env", "gym_mara/MARA-v0", "--steps", "1024", "--out", run)
    assert code == 0
    assert "position error, mm" in out
    everywhere = ("--backend", "dart,mujoco,pinocchio")
    code, out, _ = gym_mara("transfer", run, *everywhere)
    assert code == 0
    assert all(word in out for word in ("mujoco", "pinocchio", "settling time", "highest torque"))
    code, out, _ = gym_mara("transfer", run, *everywhere, "--json")
    assert code == 0
    rows = json.loads(out, parse_constant=pytest.fail)  # NaN is no JSON
    assert [row["backend"] for row in rows] == ["dart", "mujoco", "pinocchio", "pinocchio"]
    assert rows[3]["settings"] == {"max_joint_velocity": 1.57}
    assert rows[1]["highest_torque"]["mean"] > 0.0
    assert rows[2]["highest_torque"] is None
    statistics = {"mean", "std", "min", "max", "p50", "p95"}
    assert rows[0]["position_error_mm"].keys() == statistics
    code, out, _ = gym_mara("evaluate", run, "--episodes", "2", "--json", "--policy", "best")
    assert code == 0
    metrics = json.loads(out, parse_constant=pytest.fail)
    assert metrics["position_error_mm"].keys() == statistics
    assert metrics["success_percent"] is None
    code, out, _ = gym_mara("evaluate", run, "--backend", "pinocchio")
    assert code == 0
    assert "10 episodes" in out
    away = ("--set", "target_position=[0.1, 0.3, 0.9]")
    _, moved, _ = gym_mara("evaluate", run, *away)
    assert moved != out
    _, compared, _ = gym_mara("transfer", run, "--backend", "pinocchio", *away)
    assert compared.split("position error, mm")[1].split()[1] in moved
    code, _, err = gym_mara("train", "--out", run)
    assert code == 2
    assert "not overwritten" in err


BASELINE = ("evaluate", "--baseline", "ik", "--env", "MARAGoal-v0")


def test_a_baseline_is_measured_like_a_policy(gym_mara: Cli) -> None:
    code, out, _ = gym_mara(*BASELINE, "--episodes", "3", "--json")
    assert code == 0
    metrics = json.loads(out, parse_constant=pytest.fail)
    assert list(metrics) == [*METRICS]
    assert metrics["success_percent"].keys() == {"mean", "std", "min", "max", "p50", "p95"}
    assert metrics["highest_torque"] is None, "this backend has no motors"
    again, other = (gym_mara(*BASELINE, "--episodes", "3", "--json", "--seed", s) for s in "01")
    assert again[1] == out
    assert other[1] != out


def test_a_table_of_metrics_has_at_most_80_columns(
    gym_mara: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(common.out, "width", 80)
    for name in ("MARAGoal-v0", "MARA-v0"):
        code, out, _ = gym_mara("evaluate", "--baseline", "ik", "--env", name, "--episodes", "3")
        assert code == 0
        assert "baseline ik, seed 0, 3 episodes" in out
        assert all(title.strip() in out for title in METRICS.values()), "no title is wrapped"
        assert "…" not in out
    assert re.search(r"episodes with a collision +0\.0 % *\n", out)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate"], "give a run folder, --policy pretrained and --env, or --baseline ik"),
        ([*BASELINE, "run"], "--baseline plays no run: leave out run"),
        ([*BASELINE, "--policy", "best"], "--baseline plays no run: leave out --policy"),
        (["evaluate", "run", "--env", "MARA-v0"], "has its own environment: leave out --env"),
        (["evaluate", "--baseline", "ki"], "unknown baseline 'ki'. Valid: ik"),
        ([*BASELINE, "--episodes", "0"], "whole number from 1 to 100,000"),
        ([*BASELINE, "--seed", "-1"], "whole number from 0 to"),
        ([*BASELINE, "--set", "colour=1"], "unknown keyword argument 'colour'"),
    ],
)
def test_wrong_arguments_of_an_evaluation_are_errors(
    gym_mara: Cli, arguments: list[str], message: str
) -> None:
    code, _, err = gym_mara(*arguments)
    assert code == 2
    assert message in err


def test_the_steps_that_were_trained_are_printed_if_they_are_more(
    gym_mara: Cli, tmp_path: Path
) -> None:
    more = "Trained 512 steps: an update needs a whole rollout"
    train = ("train", "--env", "MARAGoal-v0")  # its episodes are short
    assert more in gym_mara(*train, "--steps", "300", "--out", tmp_path / "more")[1]
    assert "Trained" not in gym_mara(*train, "--steps", "512", "--out", tmp_path / "exact")[1]


def test_an_interrupt_before_there_is_a_run_says_that_nothing_is_saved(
    gym_mara: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gym_mara.agents.training.train.train", interrupted)
    code, _, err = gym_mara("train", "--out", tmp_path / "run")
    assert (code, err) == (130, "Interrupted. Nothing was saved.\n")


def test_a_task_of_another_package_is_trained_under_its_name(
    gym_mara: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "another_package/MARASteep-v0"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(registry.TASKS, name, ReachTask(alpha=9.0))
    monkeypatch.setitem(ENVIRONMENTS, name, Environment(name, 32))
    asked = ("--env", name, "--algo", "ppo", "--steps", "512")
    assert gym_mara("train", *asked)[0] == 0
    [run] = Path("runs").iterdir()
    assert "another_package-MARASteep-v0" in run.name
    assert (run / "last/model.zip").is_file()
    assert name in gym_mara("evaluate", run)[1]
    assert gym_mara("rewards", "--env", name, "--record", "x.csv", "--states", "4")[0] == 0
    assert gym_mara("rewards", "--check", "x.csv")[0] == 0
    grid = Grid((name, "MARAGoal-v0"), ("ppo",), 1, 512)
    assert list(grid.runs()) == [
        "another_package-MARASteep-v0_ppo_0",
        "MARAGoal-v0_ppo_0",
    ]


def test_the_table_of_a_grid_ends_with_its_results(tmp_path: Path) -> None:
    view = experiments._GridView(tmp_path, Grid(("MARA-v0",), ("ppo",), 1, 512))
    view.on_message("MARA-v0_ppo_0", (512, {"eval_position_error_mm": 1.25}))
    console = Console(file=io.StringIO())
    with console.capture() as captured:
        console.print(view.table())
    assert "100%    1.25 mm" in captured.get()


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
        (["train", "--algo", "a3c"], "unknown algorithm 'a3c'"),
        (["train", "--backend", "gazebo"], "unknown backend 'gazebo'"),
        (["train", "--backend", "ros2", "--preset", "tuned"], "with gym-mara ros2 deploy RUN"),
        (["benchmark", "--backend", "ros2", "--out", "x"], "with gym-mara ros2 deploy RUN"),
        (["train", "--steps", "0.5"], "'--steps': must be a whole number"),
        (["train", "--steps", "nan"], "'--steps': must be a whole number"),
        (["train", "--steps", "1M"], "such as 300000 or 3e5, not '1M'"),
        (["train", "--set", "robot"], "write NAME=VALUE"),
        (["train", "--set", "robot=ur55"], "Did you mean 'ur5'"),
        (
            ["train", "--set", "max_joint_velocity=-1"],
            "max_joint_velocity must be finite and positive",
        ),
        (["train", "--resume", "nowhere"], "is not a run folder"),
        (["train", "--resume", "nowhere", "--steps", "5", "--algo", "ppo"], "leave out"),
        (["train", "--preset", "papers", "--out", "x"], "unknown preset 'papers'"),
        (["benchmark", "--algo", "ppo2", "--out", "x"], "unknown algorithm 'ppo2'"),
        (["benchmark", "--env", "MARA-v1", "--out", "x"], "unknown environment 'MARA-v1'"),
        (["benchmark", "--env", "MARA-v0, MARA-v0", "--out", "x"], "give each name once"),
        (["benchmark", "--algo", "ppo, trpo ,ppo", "--out", "x"], "give each name once"),
        (["benchmark", "--jobs", "0", "--out", "x"], "'--jobs': must be"),
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
    ("command", "reason"),
    [
        ("train --resume run --steps 5 --algo ppo", "leave out --algo, --steps"),
        ("train --resume run --set robot=ur5", "leave out --set"),
        ("watch run --env MARA-v0", "a run has its own environment: leave out --env"),
        ("watch --policy best", "no policy to play: leave out --policy"),
        ("watch --video film.mp4", "no policy to play: leave out --video"),
        ("watch --seconds 3", "only --video has a length: leave out --seconds"),
        ("watch run --seconds 3", "only --video has a length: leave out --seconds"),
        ("watch --targets 3", "no policy to play: leave out --targets"),
        ("watch run --targets 3", "only --video has a length: leave out --targets"),
        ("watch run --video a.gif --targets 3 --seconds 2", "leave out --seconds"),
        ("watch run --video a.gif --targets 3 --backend pinocchio,dart", "give one --backend"),
        ("watch --speed 6", "--speed of the viewer must be from 0.1 to 5, not 6"),
        ("watch --backend pinocchio,dart", "give one --backend"),
        ("watch --set width=100", "width has no effect here"),
        ("watch run --video film.mp4 --set viewer_port=1", "viewer_port has no effect here"),
        ("train --set viewer_host=0.0.0.0", "viewer_host has no effect here"),
        ("evaluate run --set camera=top", "camera has no effect here"),
        ("transfer run --set width=5", "width has no effect here"),
        ("rewards --record x.csv --set height=5", "height has no effect here"),
        ("benchmark --address host:1", "--address is for --executor ray only"),
        ("benchmark --executor ray --jobs 2", "--jobs is for --executor local only"),
        ("rewards --record a --check b", "either --record FILE or --check FILE"),
    ],
)
def test_an_option_without_effect_is_refused(
    gym_mara: Cli,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    reason: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = gym_mara(*command.split())
    assert code == 2
    assert reason in err
    assert not list(tmp_path.iterdir())


def test_options_have_the_same_names_in_every_command() -> None:
    commands = _commands()
    shared: dict[str, set[str]] = {}
    for command in commands.values():
        for parameter in command.params:
            if parameter.param_type_name == "option":
                shared.setdefault(parameter.name, set()).add(parameter.opts[0])
    shared.pop("out_folder"), shared.pop("out_file")
    for name, spellings in shared.items():
        expected = {"settings": "--set", "as_json": "--json", "start": "--from"}.get(
            name, f"--{name}"
        )
        assert spellings == {expected.replace("_", "-")}
    for name in ("--envs", "--algos", "--backends", "--policies", "--trial"):
        assert not any(name in p.opts for c in commands.values() for p in c.params)


def _numbers() -> list[tuple[str, str]]:
    """Every command with each of its options that is a number."""
    return [
        (name, parameter.opts[0])
        for name, command in _commands().items()
        for parameter in command.params
        if parameter.metavar in ("N", "X")
    ]


@pytest.mark.parametrize(("command", "option"), _numbers())
@pytest.mark.parametrize("value", ["nan", "-inf", "1e23", "9" * 5000, "-1", "1M", "", "0x10"])
def test_every_number_has_a_range(gym_mara: Cli, command: str, option: str, value: str) -> None:
    needed = [] if command in ("train", "benchmark", "search", "watch", "rewards") else ["run"]
    code, _, err = gym_mara(command, *needed, option, value)
    assert code == 2
    assert f"Invalid value for '{option}': must be a" in err
    assert " from " in err


@pytest.mark.parametrize("value", ["3e5", "300_000", "300000", "300000.0", " 300000"])
def test_a_whole_number_may_be_written_in_several_ways(value: str) -> None:
    assert whole(1, 10**6)(value) == 300_000


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ("kappa=NaN", "not a finite number"),
        ("kappa=-Infinity", "not a finite number"),
        ("kappa=1e999", "not a finite number"),
        ("kappa=" + "9" * 5000, "not a finite number"),
        ("target_position=" + "[" * 100_000, "nested too deeply"),
        ("self=1", "write NAME=VALUE"),
        ("=1", "write NAME=VALUE"),
        ("robt=ur5", "Did you mean 'robot'"),
        ("backand=dart", "Did you mean 'backend'"),
        ("task=MARA-v0", "give --env"),
        ("autoreset_mode=Disabled", "the commands set it"),
    ],
)
def test_a_wrong_setting_is_an_error(
    gym_mara: Cli, tmp_path: Path, setting: str, reason: str
) -> None:
    code, out, err = gym_mara("train", "--set", setting, "--out", tmp_path / "run")
    assert code == 2
    assert reason in err
    assert out == ""
    assert not (tmp_path / "run").exists()


def test_a_keyword_is_given_once(gym_mara: Cli) -> None:
    code, _, err = gym_mara("train", "--set", "kappa=1", "--set", "kappa=2")
    assert code == 2
    assert "kappa is given twice" in err


@pytest.mark.parametrize("command", sorted(_commands()))
def test_help_names_the_extra_that_a_command_needs(gym_mara: Cli, command: str) -> None:
    _, out, _ = gym_mara(command, "--help")
    assert ("Needs the extra" in out) == (command not in ("list", "rewards"))


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


def test_an_error_is_one_line_without_control_characters(
    gym_mara: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    hostile = "evil\x1b[2J\x07\nsecond\u202eline" + 10**6 * "x"

    def fail(*_: object, **__: object) -> None:
        raise GymMaraError(hostile)

    monkeypatch.setattr("gym_mara.cli.app.app", fail)
    code, _, err = gym_mara("list")
    assert code == 2
    assert err.startswith(r"error: evil\x1b[2J\x07 second\u202elinexxx")
    assert err.count("\n") == 1
    assert len(err) < 3000


def test_an_interrupt_while_the_arguments_are_read_ends_the_command(
    gym_mara: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gym_mara.cli.app._Commands.parse_args", interrupt)
    code, _, err = gym_mara("list")
    assert code == 130
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("True", True),
        ("true", True),
        ("False", False),
        ("None", None),
        ("null", None),
        ("ur5", "ur5"),
    ],
)
def test_set_takes_the_words_of_python_and_of_json(text: str, value: object) -> None:
    assert keyword_arguments([f"guide={text}"]) == {"guide": value}


def test_the_version_is_printed(gym_mara: Cli) -> None:
    assert gym_mara("--version")[:2] == (0, f"{__version__}\n")


def test_a_hyperparameter_is_no_keyword_argument_of_the_environment(
    gym_mara: Cli, tmp_path: Path
) -> None:
    train = ("train", "--steps", "1", "--out", tmp_path / "run", "--set")
    code, _, error = gym_mara(*train, "learning_rate=0.1")
    assert (code, "Hyperparameters are presets: give --preset" in error) == (2, True)
    code, printed, error = gym_mara(*train, "gamma=-1")
    assert (code, "gamma is a constant of the reward here" in printed) == (2, True)
