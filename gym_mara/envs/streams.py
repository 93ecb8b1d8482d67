"""The random generators of an arm: an independent one for each purpose, so that one use does not affect another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from gymnasium.utils.seeding import np_random


class Streams(NamedTuple):
    """Independent random generators, spawned from the generator of the environment."""

    goals: np.random.Generator
    """Draws the goal of each episode."""
    parameters: np.random.Generator
    """Seeds the physical parameters of each episode."""
    sensors: np.random.Generator
    """Draws the sensors' noise."""
    backends: np.random.Generator
    """Seeds the physical parameters after a switch of the backend."""

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
