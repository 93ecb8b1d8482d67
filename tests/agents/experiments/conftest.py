"""A small grid that several tests use."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from gym_mara.agents.experiments.executor import Job, OnMessage, failure_of
from gym_mara.agents.experiments.grid import Grid, run_grid

# The environment with the shortest episodes, because evaluations take most of the time.
GRID = Grid(
    envs=("MARAGoal-v0",), algos=("ppo", "acktr"), seeds=1, steps=4096, checkpoint_every=2048
)


def ignore(name: str, message: Any) -> None:
    """Messages go nowhere."""


def in_this_process(jobs: Mapping[str, Job], on_message: OnMessage) -> dict[str, str]:
    """An executor that starts no process, which takes seconds."""
    ended = {name: failure_of(job, partial(on_message, name)) for name, job in jobs.items()}
    return {name: reason for name, reason in ended.items() if reason is not None}


@pytest.fixture(scope="package")
def finished_grid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grid that was trained to its end; tests must not change it."""
    folder = Path(tmp_path_factory.mktemp("grids")) / "grid"
    assert run_grid(folder, GRID, in_this_process, ignore) == {}
    return folder
