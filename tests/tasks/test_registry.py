"""Tasks by name, also those of other packages, and the page that shows how to add one."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest

from gym_mara import register_task
from gym_mara.envs import MaraGoalVectorEnv, MaraVectorEnv, make_vector_env
from gym_mara.errors import GymMaraError
from gym_mara.registration import ENVIRONMENTS, environment, environment_id, environment_names
from gym_mara.tasks import TASKS, ReachTask, named_task, task_names
from gym_mara.tasks.registry import BrokenTaskError

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "add_a_task.md"
NAME = "my_package/MARATouch-v0"


def _install(folder: Path, package: str, entry_points: str) -> None:
    """What pip leaves of a package: its metadata with the entry points."""
    metadata = folder / f"{package}-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 0.1\n")
    (metadata / "entry_points.txt").write_text(f"[gym_mara.tasks]\n{entry_points}\n")


# A package as the page describes it.


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(), re.M | re.S)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """The folder of the package of docs/add_a_task.md, installed."""
    task, init, *_ = _blocks("python")
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "touch.py").write_text(task)
    (tmp_path / "my_package" / "__init__.py").write_text(init)
    [toml] = _blocks("toml")
    [(name, value)] = re.findall(r'^"(.*)" = "(.*)"$', toml, re.M)
    assert name == NAME
    _install(tmp_path, "my_package", f"{name} = {value}")
    return tmp_path


def _python(package: Path, *arguments: str) -> str:
    path = os.pathsep.join([str(package), str(ROOT)])
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=package,
        env=os.environ | {"PYTHONPATH": path, "COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_example_of_the_page_works(package: Path) -> None:
    _, _, *examples = _blocks("python")
    _python(package, "-c", "\n".join(examples))


def test_the_command_line_knows_the_task(package: Path) -> None:
    command = ("-m", "gym_mara.cli")
    assert NAME in _python(package, *command, "list")
    (package / "rewards").mkdir()
    record = ("rewards/MARATouch-v0.csv",)
    _python(package, *command, "rewards", "--env", NAME, "--record", *record)
    assert "no value has changed" in _python(package, *command, "rewards", "--check", *record)


def test_the_name_works_without_an_import_of_the_package(package: Path) -> None:
    code = f"""
import sys, gym_mara
from gym_mara.envs import MaraEnv, make_vector_env
assert "my_package" not in sys.modules
assert make_vector_env("my_package:{NAME}", 2).max_episode_steps == 512
assert MaraEnv("{NAME}", tolerance=0.5).simulation.task.tolerance == 0.5
"""
    _python(package, "-c", code)


# The registry.


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("no_such_module:Task", "ModuleNotFoundError: .*no_such_module"),
        ("tests.tasks.test_registry:no_such_task", "AttributeError: .*no_such_task"),
        ("tests.tasks.test_registry:NAME", "not a Task, a subclass of it, or a function"),
        ("tests.tasks.test_registry:needs_an_argument", "TypeError: .*missing 1 required"),
    ],
)
def test_a_broken_task_of_another_package_is_named_and_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str, reason: str
) -> None:
    _install(tmp_path, "broken_package", f"broken/MARA-v0 = {value}")
    monkeypatch.syspath_prepend(tmp_path)
    assert "broken/MARA-v0" in task_names()
    assert "broken/MARA-v0" in environment_names()
    with pytest.raises(BrokenTaskError, match=f"'broken/MARA-v0' of broken_package .*{reason}"):
        named_task("broken/MARA-v0")
    assert named_task("MARA-v0") == ReachTask()


def needs_an_argument(argument: int) -> ReachTask:
    """A function that is no entry point of a task."""
    raise AssertionError


def steep() -> ReachTask:
    """A function that returns a task."""
    return ReachTask(alpha=9.0)


STEEP = ReachTask(alpha=9.0)


class SteepTask(ReachTask):
    """A task whose defaults are used."""


@pytest.mark.parametrize("value", ["steep", "STEEP", "SteepTask"])
def test_an_entry_point_is_a_task_a_class_or_a_function(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    _install(tmp_path, "steep_package", f"MARASteep-v0 = tests.tasks.test_registry:{value}")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("gym_mara.tasks.registry.TASKS", dict(TASKS))
    assert isinstance(named_task("MARASteep-v0"), ReachTask)
    assert environment("MARASteep-v0").task == "MARASteep-v0"


def test_an_unknown_task_is_named_with_the_known_ones() -> None:
    with pytest.raises(GymMaraError, match=r"unknown task 'MARO-v0'.*Did you mean 'MARA-v0'"):
        named_task("MARO-v0")
    with pytest.raises(GymMaraError, match=r"unknown environment 'MARAGaol-v0'.*MARAGoal-v0"):
        environment("MARAGaol-v0")


@pytest.mark.parametrize("task", [ReachTask, "MARA-v0", 3])
def test_only_a_task_can_be_registered(task: Any) -> None:
    with pytest.raises(GymMaraError, match="task must be a Task"):
        register_task("other/MARA-v0", task)


def test_a_name_can_only_have_one_task() -> None:
    with pytest.raises(GymMaraError, match="another task has the name 'MARA-v0'"):
        register_task("MARA-v0", ReachTask(alpha=9.0))


@pytest.fixture
def registered() -> Iterator[None]:
    """What a test registers is forgotten after it."""
    registries: list[dict[str, Any]] = [TASKS, ENVIRONMENTS, gymnasium.registry]
    kept = [dict(each) for each in registries]
    yield
    for registry, before in zip(registries, kept, strict=True):
        registry.clear()
        registry.update(before)


@pytest.mark.usefixtures("registered")
def test_a_cell_that_defines_and_registers_a_task_can_run_again() -> None:
    def cell(kappa: float) -> None:
        class Own(ReachTask):
            """A notebook's task."""

        register_task("notebook/Own-v0", Own(kappa=kappa))

    cell(0.02)
    with pytest.warns(UserWarning, match="Overriding environment notebook/Own-v0"):
        cell(0.03)
    task = make_vector_env("notebook/Own-v0", 1).simulation.task
    assert MaraVectorEnv(1, task).max_episode_steps == task.episode_steps
    assert isinstance(task, ReachTask)
    assert task.kappa == 0.03
    with pytest.raises(GymMaraError, match="another task has the name 'notebook/Own-v0'"):
        register_task("notebook/Own-v0", ReachTask())


@pytest.mark.usefixtures("registered")
def test_a_name_can_be_registered_with_the_namespace_of_this_package() -> None:
    register_task("gym_mara/Own-v0", ReachTask(kappa=0.03))
    assert gymnasium.spec("gym_mara/Own-v0")
    for name in ("Own-v0", "gym_mara/Own-v0"):
        assert make_vector_env(name, 1).simulation.task == ReachTask(kappa=0.03)
    with pytest.raises(GymMaraError, match="another task has the name 'MARA-v0'"):
        register_task("gym_mara/MARA-v0", ReachTask(alpha=9.0))


# The environments by name.


@pytest.mark.parametrize("form", ["{}", "gym_mara/{}", "gym_mara:gym_mara/{}"])
@pytest.mark.parametrize("name", [n for n in environment_names() if n != "MARAReal-v0"])
def test_a_vector_environment_is_made_by_its_name(name: str, form: str) -> None:
    envs = make_vector_env(form.format(name), 2)
    assert type(envs) is (MaraGoalVectorEnv if name == "MARAGoal-v0" else MaraVectorEnv)
    own = gymnasium.spec(environment_id(name)).max_episode_steps
    assert envs.max_episode_steps == own
    made = {"task": environment(name).task, **environment(name).keywords}
    assert type(envs)(1, **made).max_episode_steps == own
    assert make_vector_env(name, 2, max_episode_steps=None).max_episode_steps is None
    assert environment_id(name) == f"gym_mara/{name}"
