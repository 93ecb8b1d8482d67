"""Shows a policy: in a film, backends side by side, or live in the viewer."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from gym_mara.agents.inspection.rollout import Player
from gym_mara.agents.runs.evaluation import options_on
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.rendering.film import HIGHEST_RATE, Film, check_film_path
from gym_mara.viewer import watch

_STILL = 0.5
"""How long a film shows the start pose before the arm moves, s."""


def film_run(
    run: RunFolder,
    path: Path,
    backends: list[str],
    options: dict[str, Any],
    *,
    which: str = "last",
    seconds: float = 6.0,
    speed: float = 1.0,
    rate: float = HIGHEST_RATE,
) -> None:
    """Film the start of an episode of a run's policy on each backend, side by side.

    Args:
        run: the run.
        path: a new file, .mp4 or .gif.
        backends: the backends.
        options: keyword arguments of the environment, in addition to those of the run.
        which: the policy, "last" or "best".
        seconds: length of the filmed part of the episode, s.
        speed: times real time.
        rate: highest number of pictures per second.

    Raises:
        GymMaraError: the file exists or cannot be written, the policy is missing or damaged, or a value is out of its range.
    """
    check_film_path(path)  # an error comes before the policy is played
    with ExitStack() as stack:
        players = []
        for backend in backends:
            settings = {**options_on(backend, run.config, options), "render_mode": "rgb_array"}
            players.append(stack.enter_context(Player(run, backend, settings, which=which)))
        period = players[0].env.simulation.backend.control_period
        every = math.ceil(speed / period / rate)
        film = stack.enter_context(Film(path, speed / period / every))
        start = _side_by_side(players)
        for _ in range(math.ceil(_STILL * speed / period / every)):
            film.add(start)
        for step in range(1, math.ceil(seconds / period) + 1):
            for player in players:
                player.step()
            if step % every == 0:
                film.add(_side_by_side(players))


def _side_by_side(players: list[Player]) -> Any:
    pictures = [player.env.render() for player in players]
    return np.concatenate([picture[0] for picture in pictures if picture], axis=1)


def watch_run(
    run: RunFolder, backend: str, options: dict[str, Any], which: str, speed: float
) -> None:
    """Play a run's policy in the viewer, episode after episode, until the user interrupts."""
    settings = options_on(backend, run.config, options)
    with Player(run, backend, settings, which=which) as player:
        act = player.act
    watch(run.config.env, backend, settings, act, speed=speed, seed=run.config.seed)
