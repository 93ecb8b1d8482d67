"""The pretrained policies that the package has, and the commands that play them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from gym_mara import pretrained
from gym_mara.deploy import OnnxPolicy
from gym_mara.envs import make_vector_env
from gym_mara.errors import GymMaraError
from gym_mara.pretrained import pretrained_file, pretrained_names
from gym_mara.registration import ENVIRONMENTS
from gym_mara.viewer import exported
from tests.deploy.models import solving
from tests.helpers import Cli

LARGEST = 1_000_000
"""The largest size of all pretrained policies together, bytes."""


def test_every_policy_of_the_package_acts_in_its_environment() -> None:
    for name in pretrained_names():
        assert name in ENVIRONMENTS
        policy = OnnxPolicy(pretrained_file(name))
        assert policy.about.env == name
        arms = make_vector_env(name, 2, **policy.keywords(backend="pinocchio"))
        policy.check(arms)
        observation, _ = arms.reset(seed=0)
        for _ in range(20):
            observation, *_ = arms.step(policy.predict(observation)[0])
        assert np.isfinite(observation).all()
        arms.close()


def test_the_policies_of_the_package_are_small() -> None:
    sizes = [pretrained_file(name).stat().st_size for name in pretrained_names()]
    assert sum(sizes) < LARGEST


@pytest.fixture
def two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the policies of two environments, in place of that of the package."""
    for name in ("MARAReach-v0", "MARAPose-v0"):
        solving(tmp_path / f"{name}.onnx", name, start="home")
    monkeypatch.setattr(pretrained, "_FOLDER", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "name", ["MARAReach-v0", "gym_mara/MARAReach-v0", "gym_mara:gym_mara/MARAReach-v0"]
)
def test_a_policy_is_found_by_the_name_of_its_environment(two: Path, name: str) -> None:
    assert pretrained_names() == ["MARAPose-v0", "MARAReach-v0"]
    assert pretrained_file(name) == two / "MARAReach-v0.onnx"


@pytest.mark.parametrize("name", ["MARA-v0", "other/MARAReach-v0", "../MARAReach-v0", ""])
def test_without_a_policy_the_error_lists_the_environments_that_have_one(
    two: Path, name: str
) -> None:
    with pytest.raises(GymMaraError, match="that have one: MARAPose-v0, MARAReach-v0"):
        pretrained_file(name)


# The command watch.


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, dict[str, Any]]]:
    """The environments, backends and keyword arguments of the viewers that would have been opened."""
    opened: list[tuple[str, str, dict[str, Any]]] = []
    monkeypatch.setattr(
        exported,
        "watch",
        lambda env, backend, keywords, *_, **__: opened.append((env, backend, keywords)),
    )
    return opened


def test_the_pretrained_policy_of_an_environment_is_watched(
    two: Path, watched: list[Any], gym_mara: Cli
) -> None:
    chosen = ("--policy", "pretrained", "--env", "MARAPose-v0")
    assert gym_mara("watch", *chosen)[0] == 0
    assert gym_mara("watch", *chosen, "--backend", "mujoco", "--set", "start=random")[0] == 0
    (env, backend, keywords), (_, other, changed) = watched
    assert (env, backend, other) == ("MARAPose-v0", "pinocchio", "mujoco")
    assert (keywords["start"], keywords["on_collision"]) == ("home", "continue")
    assert changed["start"] == "random"


def test_an_exported_policy_is_watched_in_its_own_environment_or_another(
    two: Path, watched: list[Any], gym_mara: Cli
) -> None:
    file = two / "MARAReach-v0.onnx"
    assert gym_mara("watch", "--policy", file)[0] == 0
    assert gym_mara("watch", "--policy", file, "--env", "MARAReach-v0", "--speed", "2")[0] == 0
    assert [env for env, *_ in watched] == ["MARAReach-v0"] * 2
    code, _, error = gym_mara("watch", "--policy", file, "--env", "MARAPose-v0")
    assert code == 2
    assert "the policy of MARAReach-v0 does not fit the environment: it observes" in error


@pytest.mark.parametrize(
    "way", ["--seconds 0.1", "--targets 1", "--seconds 0.1 --backend pinocchio,mujoco"]
)
def test_a_pretrained_policy_is_filmed(two: Path, gym_mara: Cli, way: str) -> None:
    small = "--set", "width=64", "--set", "height=48"
    chosen = "--policy", "pretrained", "--env", "MARAPose-v0", *way.split(), *small
    code, out, error = gym_mara("watch", *chosen, "--video", two / "film.gif")
    assert (code, error) == (0, "")
    assert out.splitlines()[-1] == str(two / "film.gif")
    wide = 128 if "mujoco" in way else 64
    assert iio.improps(two / "film.gif").shape[1:3] == (48, wide)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--env", "MARA-v0", "--video", "film.gif"], "does not fit the environment: it observes"),
        (["--video", "film.avi"], "unknown format of a video '.avi'"),
        (["--video", "policy.gif"], "exists and is not overwritten"),
    ],
)
def test_no_film_is_made_of_what_cannot_be_shown(
    two: Path, gym_mara: Cli, monkeypatch: pytest.MonkeyPatch, options: list[str], message: str
) -> None:
    monkeypatch.chdir(two)
    (two / "policy.gif").write_text("kept")
    code, _, error = gym_mara("watch", "--policy", two / "MARAReach-v0.onnx", *options)
    assert code == 2
    assert message in error
    assert (two / "policy.gif").read_text() == "kept"
    assert not list(two.glob("film*"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("watch --policy pretrained", "no pretrained policy for 'MARA-v0'; environments that have one: MARAPose-v0, MARAReach-v0"),
        ("evaluate --policy pretrained", "no pretrained policy for 'MARA-v0'"),
        ("watch --policy pretrianed", "Did you mean 'pretrained'? Valid: best, last, pretrained. Or name a file that ends in .onnx"),
        ("watch run --policy pretrained", "a run has its own policies, last and best: leave out the run folder, or --policy"),
        ("evaluate run --policy policy.onnx", "a run has its own policies"),
        ("watch --policy missing.onnx", "cannot read 'missing.onnx': there is no such file"),
        ("watch --policy policy.onnx --targets 3", "only --video has a length: leave out --targets"),
        ("watch --policy policy.onnx --seconds 3", "only --video has a length: leave out --seconds"),
        ("watch --policy policy.onnx --backend dart,mujoco", "give one --backend"),
        ("export run new.onnx --policy pretrained", "unknown policy 'pretrained'. Valid: best, last"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("two", "watched")
def test_wrong_arguments_are_errors(gym_mara: Cli, arguments: str, message: str) -> None:
    code, _, error = gym_mara(*arguments.split())
    assert code == 2
    assert message in error


def test_it_is_watched_without_torch(two: Path) -> None:
    program = f"""
import sys
from pathlib import Path

for name in ("torch", "stable_baselines3", "onnx"):
    sys.modules[name] = None
import gym_mara.pretrained
from gym_mara.cli import main
from gym_mara.viewer import exported

gym_mara.pretrained._FOLDER = Path({str(two)!r})
exported.watch = lambda env, *_, **__: print("watched", env)
sys.argv = ["gym-mara", "watch", "--policy", "pretrained", "--env", "MARAReach-v0"]
main()
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert result.stdout == "watched MARAReach-v0\n", result.stderr
