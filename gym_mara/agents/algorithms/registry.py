"""The algorithms by name. The command line's choices and help texts come from here."""

from __future__ import annotations

from gym_mara.agents.algorithms.base import Algorithm
from gym_mara.agents.algorithms.entries import acktr, ppo, ppo_lstm, sac, tqc, trpo
from gym_mara.errors import unknown

ALGORITHMS: dict[str, Algorithm] = {
    entry.name: entry
    for entry in (
        ppo.ALGORITHM,
        trpo.ALGORITHM,
        acktr.ALGORITHM,
        sac.ALGORITHM,
        tqc.ALGORITHM,
        ppo_lstm.ALGORITHM,
    )
}
DEFAULT_ALGORITHM = "ppo"
DEFAULT_PRESET = "tuned"


def algorithm(name: str) -> Algorithm:
    """The algorithm of this name.

    Raises:
        GymMaraError: there is no such algorithm.
    """
    if name not in ALGORITHMS:
        raise unknown("algorithm", name, ALGORITHMS)
    return ALGORITHMS[name]


def preset_names() -> list[str]:
    """The names of all presets, each once; not every algorithm must have them all."""
    return list(dict.fromkeys(name for entry in ALGORITHMS.values() for name in entry.presets))
