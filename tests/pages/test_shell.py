"""The shell blocks of the pages.

Every `gym-mara …` goes through the command's own parser: names of commands and options, values, and keyword arguments of `--set`. In a
slow test most are also run, in the order of the page, with few steps and episodes. Of other programs' lines it is checked that the
targets, extras, files and options that they name are there.
"""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer.core

from gym_mara.agents.algorithms.registry import ALGORITHMS
from gym_mara.agents.export.run import export
from gym_mara.agents.runs.folder import RunConfig
from gym_mara.agents.training.train import train
from gym_mara.backends import backend_names, backend_settings
from gym_mara.cli.common import keyword_arguments
from gym_mara.envs import task_keywords
from gym_mara.envs.actions import ActionSettings
from gym_mara.envs.sensors import SensorSettings
from gym_mara.registration import ENVIRONMENTS, Environment
from gym_mara.rendering import RenderSettings
from gym_mara.robot.options import ROBOT_KEYWORDS
from gym_mara.tasks import TASKS
from tests.agents.conftest import shorten_episodes
from tests.helpers import Cli
from tests.pages.blocks import PAGES, ROOT, Block, blocks

SHORT = {
    "train": {"--steps": "300"},
    "evaluate": {"--episodes": "2"},
    "transfer": {"--episodes": "1"},
    "watch": {"--seconds": "0.2"},
}
"""The options of each command with which it is run here."""
NOT_RUN = {
    "benchmark": "many trainings: tests/agents/experiments runs small grids",
    "identify": "it needs a bag of a moving arm: tests/identification makes one",
    "plot": "it needs a grid of runs: tests/agents/experiments makes one",
    "report": "it takes half a minute: tests/agents/inspection writes one",
    "ros2": "it needs an arm: tests/ros2 has one in another process",
    "search": "many trainings: tests/agents/experiments runs a small search",
}
"""Commands that are only parsed, and why."""


KEYWORDS = {
    *ROBOT_KEYWORDS,
    *(name for env in ENVIRONMENTS for name in task_keywords(env)),
    *(name for backend in backend_names() for name in backend_settings(backend)),
    *(f.name for form in (ActionSettings, SensorSettings, RenderSettings) for f in fields(form)),
}
"""The keyword arguments of all environments on all backends."""


def shell(page: str) -> list[Block]:
    """The shell blocks of a page."""
    return [block for block in blocks(page) if block.commands]


def gym_mara_lines(page: str, *, all_of_them: bool = True) -> list[list[str]]:
    """The arguments of every `gym-mara` on a page; without those in blocks that are only parsed, unless all are asked for."""
    chosen = [block for block in shell(page) if all_of_them or not block.parsed_only]
    return [words[1:] for block in chosen for words in block.commands if words[0] == "gym-mara"]


def is_run(arguments: list[str]) -> bool:
    """Whether a command is run here; `watch` without a film does not end, and only an interrupted run is resumed."""
    command, *others = arguments
    endless = command == "watch" and "--video" not in others
    return command not in NOT_RUN and not endless and "--resume" not in others


@pytest.mark.parametrize("page", [page for page in PAGES if gym_mara_lines(page)])
def test_the_command_understands_every_line(
    page: str, gym_mara: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[Any] = []
    monkeypatch.setattr(
        typer.core.TyperCommand, "invoke", lambda _, context: parsed.append(context)
    )
    if page in PREPARED:
        PREPARED[page](monkeypatch)
    for arguments in gym_mara_lines(page):
        code, _, errors = gym_mara(*arguments)
        assert code == 0, f"gym-mara {' '.join(arguments)}: {errors}"
        settings = keyword_arguments(
            parsed[-1].params.get("settings") or [], pictures=True, viewer=True
        )
        assert settings.keys() <= KEYWORDS, arguments


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # such as that warp is left out, where no GPU is
@pytest.mark.parametrize(
    "page", [p for p in PAGES if any(map(is_run, gym_mara_lines(p, all_of_them=False)))]
)
def test_the_commands_of_a_page_run_one_after_the_other(
    page: str, trained: Path, tmp_path: Path, gym_mara: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 50)
    shutil.copytree(trained, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    if page in PREPARED:
        PREPARED[page](monkeypatch)
    for block in shell(page):
        for program, *arguments in [] if block.parsed_only else block.commands:
            if program == "mkdir":
                Path(arguments[-1]).mkdir(parents=True)
            if program != "gym-mara" or not is_run(arguments):
                continue
            code, _, errors = gym_mara(*shortened(arguments))
            assert code == 0, f"gym-mara {' '.join(arguments)}: {errors}"


def shortened(arguments: list[str]) -> list[str]:
    """The arguments of a command, with those of SHORT; what it writes was not there before."""
    short = list(arguments)
    options = SHORT.get(arguments[0], {})
    if arguments[0] == "watch":
        short += ["--set", "width=64", "--set", "height=48"]
    if "--targets" in short:
        options = {"--targets": "1"}  # such a film has no other length
    for option, value in options.items():
        if option in short:
            short[short.index(option) + 1] = value
        else:
            short += [option, value]
    if "--out" in short:
        shutil.rmtree(short[short.index("--out") + 1], ignore_errors=True)
    if arguments[0] == "export":
        Path(arguments[2]).unlink(missing_ok=True)
    return short


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the runs, the exported policy and the arms that pages speak of."""
    folder = tmp_path_factory.mktemp("pages")
    with pytest.MonkeyPatch.context() as patch:
        shorten_episodes(patch, 50)
        for name, env in (("first", "MARA-v0"), ("reach", "MARAReach-v0")):
            config = RunConfig(env=env, algo="ppo", backend="pinocchio", steps=300, seed=0)
            run = train(config, folder / "runs" / name, lambda *_: None)
    export(run, folder / "policy.onnx")
    for name in ("arm", "my_arm"):
        for kind in ("urdf", "srdf"):
            shutil.copy(ROOT / "robots" / "mara" / f"mara.{kind}", folder / f"{name}.{kind}")
    return folder


@pytest.mark.parametrize("page", [page for page in PAGES if shell(page)])
def test_what_other_programs_are_given_is_there(page: str) -> None:
    for block in shell(page):
        for program, *arguments in block.commands:
            CHECKS[program](arguments)


def _make(arguments: list[str]) -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    assert {*arguments} <= {*targets}


def _pip(arguments: list[str]) -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    known = re.findall(r"^(\w+) = \[", text.partition("[project.optional-dependencies]")[2], re.M)
    for extras in re.findall(r"\.\[(.*?)\]", " ".join(arguments)):
        assert {*extras.split(",")} <= {*known}


def _python(arguments: list[str]) -> None:
    if arguments[0] == "-m":
        assert find_spec(arguments[1])
        return
    script = (ROOT / arguments[0]).read_text(encoding="utf-8")
    options = {word for word in arguments[1:] if word.startswith("--")}
    assert "sys.argv" in script or all(f'"{option}"' in script for option in options)


def _pytest(arguments: list[str]) -> None:
    assert all((ROOT / path).exists() for path in arguments)


def _not_ours(arguments: list[str]) -> None:
    """A program that is not of this project: that the shell can read the line is all that is checked."""


CHECKS: dict[str, Callable[[list[str]], None]] = {
    "gym-mara": _not_ours,  # the tests above
    "make": _make,
    "pip": _pip,
    "pytest": _pytest,
    "python": _python,
    **dict.fromkeys(("mkdir", "export", "ray", "ros2", ".venv/bin/pre-commit"), _not_ours),
}
"""How the arguments of each program are checked."""


def _touch(monkeypatch: pytest.MonkeyPatch) -> None:
    """The task of the page, as if its package were installed."""
    name, module = "my_package/MARATouch-v0", ModuleType("touch")
    monkeypatch.setitem(sys.modules, "touch", module)  # dataclasses look there
    exec(blocks("docs/add_a_task.md")[0].text, vars(module))
    monkeypatch.setitem(TASKS, name, module.TouchTask())
    monkeypatch.setitem(ENVIRONMENTS, name, Environment(name, 512))


def _a2c(monkeypatch: pytest.MonkeyPatch) -> None:
    """The algorithm of the page."""
    script: dict[str, Any] = {}
    exec(blocks("docs/add_an_algorithm.md")[0].text, script)
    monkeypatch.setitem(ALGORITHMS, "a2c", script["ALGORITHM"])


PREPARED: dict[str, Callable[[pytest.MonkeyPatch], None]] = {
    "docs/add_a_task.md": _touch,
    "docs/add_an_algorithm.md": _a2c,
}
"""What a page adds to the names that the command knows."""
