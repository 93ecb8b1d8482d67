"""The random generators of an arm, an independent one for each purpose, and what they draw for a new episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from gym_mara.envs.given import Given
from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.snapshots import check_fits
from gym_mara.tasks import Task
from gym_mara.types import Floats, Mask


class Streams(NamedTuple):
    """Independent random generators, spawned from the generator of the environment."""

    goals: np.random.Generator
    """Draws the start and the goal of each episode."""
    parameters: np.random.Generator
    """Seeds the physical parameters of each episode."""
    sensors: np.random.Generator
    """Draws the sensors' noise."""
    backends: np.random.Generator
    """Seeds the physical parameters after a switch of the backend."""
    pixels: np.random.Generator
    """Seeds how the pictures of each episode look."""

    @classmethod
    def of(cls, generator: np.random.Generator) -> Streams:
        """Spawn the streams of an arm from this generator.

        `numpy.random.Generator.spawn` uses the generator's SeedSequence.
        """
        return cls(*generator.spawn(len(cls._fields)))

    @classmethod
    def seeded(cls, seed: int | None) -> Streams:
        """The streams of an environment after reset(seed=seed); None for a random seed."""
        return cls.of(np_random(seed)[0])


def parameter_seeds(streams: Sequence[Streams], chosen: Mask) -> NDArray[np.uint64]:
    """The seeds (N,) from which a backend draws the parameters of new episodes, for the chosen arms (N,)."""
    seeds = np.zeros(len(chosen), np.uint64)
    for arm in np.flatnonzero(chosen).tolist():
        seeds[arm] = streams[arm].parameters.integers(2**63)
    return seeds


def drawn_episodes(
    task: Task,
    workspace: RobotWorkspace,
    streams: Sequence[Streams],
    chosen: Mask,
    start: Floats,
    given: Given | None = None,
) -> tuple[Floats, Floats, Floats]:
    """What is drawn for new episodes of the chosen arms (N,).

    Args:
        task: it draws.
        workspace: of the arms.
        streams: the random generators of each arm.
        chosen: NumPy's mask (N,).
        start: start configurations (N, J), rad; they stay for the other arms, and where the task draws none.
        given: what is not drawn.

    Returns:
        Start configurations (N, J), rad, and goals: positions (N, 3), m, and quaternions (N, 4), zero for the other arms.
    """
    start = start.copy()
    position, quaternion = np.zeros((len(chosen), 3)), np.zeros((len(chosen), 4))
    for arm in np.flatnonzero(chosen).tolist():
        generator = streams[arm].goals
        own, position[arm], quaternion[arm] = (
            task.draw(workspace, generator)
            if given is None
            else given.draw(arm, task, workspace, generator)
        )
        if own is not None:
            start[arm] = own
    return start, position, quaternion


def check_streams(streams: Any, num_envs: int) -> None:
    """Check the streams of a snapshot: those of N arms, or none.

    Raises:
        GymMaraError: they are something else.
    """
    of_arm = Streams(*[np.random.Generator] * len(Streams._fields))  # type: ignore[arg-type]
    check_fits("streams", streams, (of_arm,) * (num_envs if streams else 0))
