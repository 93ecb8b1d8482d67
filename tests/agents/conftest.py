"""A small training that several tests use."""

from __future__ import annotations

from pathlib import Path

import pytest

from gym_mara.agents.runs import evaluation
from gym_mara.agents.runs.folder import RunConfig, RunFolder
from gym_mara.agents.training.train import train, use_one_thread
from gym_mara.registration import Environment, environment

ROLLOUT = 256 * 2
"""Steps between two updates of PPO's tuned preset."""


def config(**changes: object) -> RunConfig:
    """A run of three updates, with a checkpoint after each."""
    values: dict[str, object] = {
        "env": "MARACollisionOrient-v0",
        "algo": "ppo",
        "backend": "pinocchio",
        "steps": 3 * ROLLOUT,
        "seed": 5,
        "checkpoint_every": ROLLOUT,
    }
    return RunConfig(**{**values, **changes})  # type: ignore[arg-type]


def silent(steps: int, shown: dict[str, float]) -> None:
    """Ignore the progress."""


def shorten_episodes(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    """Let the episodes in which policies are measured have this many steps."""

    def short(name: str) -> Environment:
        return environment(name)._replace(max_episode_steps=steps)

    monkeypatch.setattr(evaluation, "environment", short)


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Test processes share the cores."""
    use_one_thread()


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run; tests must not change it."""
    return train(config(), Path(tmp_path_factory.mktemp("runs")) / "run", silent)
