"""An exported policy is measured like the policy of its run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gym_mara.agents.export.run import export
from gym_mara.agents.runs.folder import RunFolder
from tests.agents.conftest import shorten_episodes
from tests.helpers import Cli


@pytest.fixture(scope="module")
def file(finished_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The exported policy of the finished run."""
    path = tmp_path_factory.mktemp("exported") / "policy.onnx"
    export(finished_run, path)
    return path


@pytest.mark.parametrize(
    "more", [(), ("--backend", "mujoco", "--set", "max_joint_velocity=1")], ids=" ".join
)
def test_it_is_measured_like_the_policy_of_its_run(
    finished_run: RunFolder,
    file: Path,
    gym_mara: Cli,
    monkeypatch: pytest.MonkeyPatch,
    more: tuple[str, ...],
) -> None:
    shorten_episodes(monkeypatch, 50)
    asked = ("--episodes", "2", "--json", *more)
    both = [
        gym_mara("evaluate", *who, *asked) for who in ((finished_run.path,), ("--policy", file))
    ]
    assert [code for code, *_ in both] == [0, 0]
    wanted, found = (json.loads(out) for _, out, _ in both)
    assert found.keys() == wanted.keys()
    for name in ("position_error_mm", "angle_deg", "return"):
        assert found[name] == pytest.approx(wanted[name], rel=1e-4, abs=1e-3)


def test_the_table_says_what_was_measured(
    file: Path, gym_mara: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 5)
    monkeypatch.chdir(file.parent)
    code, out, _ = gym_mara("evaluate", "--policy", file.name, "--episodes", "2")
    assert code == 0
    assert "MARACollisionOrient-v0 on pinocchio, policy policy.onnx, seed 0, 2 episodes" in out


def test_another_environment_is_refused(file: Path, gym_mara: Cli) -> None:
    code, _, error = gym_mara("evaluate", "--policy", file, "--env", "MARA-v0")
    assert code == 2
    assert "does not fit the environment" in error
