"""Plays episodes, many side by side, and records them as a data set."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np

from gym_mara.agents.evaluation.rollout import Begin
from gym_mara.agents.runs.evaluation import make_arms
from gym_mara.datasets.contents import contents_of
from gym_mara.datasets.episode import Episode, Steps
from gym_mara.datasets.formats import writer_class
from gym_mara.datasets.recorder import MOST_EPISODES, Recorded, recorder
from gym_mara.datasets.sources import Source
from gym_mara.envs import MaraVectorEnv
from gym_mara.envs.view import first_view
from gym_mara.errors import whole_number
from gym_mara.registration import environment
from gym_mara.rendering import Pictures

_MOST_ARMS = 64
"""So many episodes are played side by side; more would take more memory, and hardly less time."""
_RECORDING = 1
"""Tells the seeds of data sets apart from those of evaluations, which have no second number."""


def recording_seeds(seed: int, first: int, count: int) -> list[int]:
    """The seeds of a data set's episodes from number `first` on, each below 2**63, as those of trainings.

    Those of evaluations are larger: no evaluation repeats an episode of a data set.
    """
    sequences = (
        np.random.SeedSequence(seed, spawn_key=(first + i, _RECORDING)) for i in range(count)
    )
    return [int(sequence.generate_state(1, np.uint64)[0] >> 1) for sequence in sequences]


def record(
    source: Source,
    form: str,
    folder: Path,
    *,
    episodes: int,
    seed: int = 0,
    pixels: int | None = None,
) -> Recorded:
    """Play episodes, and record them as a data set.

    Args:
        source: what acts, and where.
        form: one of FORMATS.
        folder: a new folder.
        episodes: how many.
        seed: of the data set; an episode depends on it and on the episode's number alone (`recording_seeds`).
        pixels: the width and height of a picture at each step; None for no pictures.

    Raises:
        GymMaraError: as in `recorder`; a value is out of its range, or the source refuses the environment.
        MissingExtraError: a library is not installed.
    """
    reason = "more would hardly teach more"
    count = whole_number("episodes", episodes, at_most=MOST_EPISODES, reason=reason)
    writer_class(form)  # an error comes before the arms are made
    steps = environment(source.env).max_episode_steps
    arms = make_arms(
        source.env,
        source.backend,
        min(count, _MOST_ARMS),
        source.options,
        autoreset_mode="Disabled",
        max_episode_steps=steps,
    )
    with closing(arms):
        keywords = {"backend": source.backend, **source.keywords}
        contents = contents_of(arms.simulation, source.env, keywords, source.policy, pixels)
        pictures: Pictures | None = None
        if contents.pictures:
            at_home = first_view(arms.simulation)
            pictures = Pictures(arms.simulation.robot, contents.pictures, at_home)
        with recorder(form, folder, contents) as (add, recorded):
            for first in range(0, count, arms.num_envs):
                seeds = recording_seeds(seed, first, arms.num_envs)
                for episode in _play(arms, source.begin, pictures, seeds, count - first):
                    add(episode)
    return recorded


def _play(
    arms: MaraVectorEnv, begin: Begin, pictures: Pictures | None, seeds: list[int], wanted: int
) -> Iterator[Episode]:
    """Play an episode with each arm; yield those of the first arms, as many as are wanted."""
    simulation = arms.simulation
    observation, _ = arms.reset(seed=seeds)
    steps, act = Steps(simulation, observation, pictures), begin(simulation)
    low, high = simulation.action_space.low, simulation.action_space.high
    lengths = np.zeros(arms.num_envs, np.int64)
    while not lengths.all():
        # In the precision of the data set, so that its actions are the ones that the arms made.
        action = np.clip(act(observation), low, high).astype(np.float32)
        observation, _, terminated, truncated, _ = arms.step(action)
        assert simulation.outcome is not None
        steps.add(observation, action, simulation.outcome, truncated)
        ended = terminated | truncated
        lengths[ended & (lengths == 0)] = len(steps)
        if ended.any() and not lengths.all():  # their arms play on, until the last one ends
            observation, _ = arms.reset(options={"reset_mask": ended})
    for arm in range(min(wanted, arms.num_envs)):
        yield steps.episode(arm, int(lengths[arm]), seeds[arm])
