"""The sources of randomness of an arm: one stream for each purpose, so that none changes another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from gymnasium.utils.seeding import np_random


class Streams(NamedTuple):
    """Independent random generators, spawned from the environment's own."""

    goals: np.random.Generator
    """Draws the goal of each episode."""
    parameters: np.random.Generator
    """Seeds the physical parameters of each episode."""
    sensors: np.random.Generator
    """Draws the sensors' noise."""
    backends: np.random.Generator
    """Seeds the parameters after a switch of the backend."""

    @classmethod
    def of(cls, generator: np.random.Generator) -> Streams:
        """The streams of an arm with this generator.

        Source: `numpy.random.Generator.spawn`, which spawns from the generator's SeedSequence.
        """
        return cls(*generator.spawn(len(cls._fields)))

    @classmethod
    def seeded(cls, seed: int | None) -> Streams:
        """The streams of an arm with this seed, those of an environment that is reset with it; None for any."""
        return cls.of(np_random(seed)[0])
