"""A small training that several tests use, with short episodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from gym_mara.agents.runs.folder import RunConfig, RunFolder
from gym_mara.agents.training.train import train, use_one_thread
from gym_mara.registration import ENVIRONMENTS

ROLLOUT = 256 * 2
"""Steps between two updates of PPO's tuned preset."""
EPISODE = 256
"""The most steps of an episode in these tests. Those of the paper have 2,048, and evaluations would take most of the time."""


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
    """Let the episodes of trainings, evaluations and films have at most this many steps."""
    for name, known in ENVIRONMENTS.items():
        fewer = min(steps, known.max_episode_steps)
        monkeypatch.setitem(ENVIRONMENTS, name, known._replace(max_episode_steps=fewer))


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Test processes share the cores."""
    use_one_thread()


@pytest.fixture(scope="package", autouse=True)
def _short_episodes() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        shorten_episodes(patch, EPISODE)
        yield


@pytest.fixture(scope="package")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run; tests must not change it."""
    return train(config(), Path(tmp_path_factory.mktemp("runs")) / "run", silent)
