"""Shows a policy: in a film, backends side by side, or live in the viewer."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from gym_mara.agents.runs.evaluation import Player, options_on
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.envs.travel import VELOCITY_LIMIT, travel_note
from gym_mara.rendering.film import HIGHEST_RATE, Film, check_film_path, labelled
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
    log: Callable[[str], None] | None = None,
) -> None:
    """Film the start of an episode of a run's policy on each backend, side by side.

    Joints that would teleport move at the robot's velocity limit, unless the run or the options have max_joint_velocity.

    Args:
        run: the run.
        path: a new file, .mp4 or .gif.
        backends: the backends.
        options: keyword arguments of the environment, in addition to those of the run.
        which: the policy, "last" or "best".
        seconds: length of the filmed part of the episode, s.
        speed: times real time.
        rate: highest number of pictures per second.
        log: is called with a sentence about each backend whose joints get the velocity limit.

    Raises:
        GymMaraError: the file exists or cannot be written, the policy is missing or damaged, or a value is out of its range.
    """
    check_film_path(path)  # an error comes before the policy is played
    with ExitStack() as stack:
        players, labels = [], []
        for backend in backends:
            settings = _settings(run, backend, options, which, log) | {"render_mode": "rgb_array"}
            players.append(stack.enter_context(Player(run, backend, settings, which=which)))
            limit = settings.get(VELOCITY_LIMIT)
            labels.append(backend if limit is None else f"{backend}, at most {limit:.3g} rad/s")
        period = players[0].env.simulation.backend.control_period
        every = math.ceil(speed / period / rate)
        film = stack.enter_context(Film(path, speed / period / every))
        start = _side_by_side(players, labels)
        for _ in range(math.ceil(_STILL * speed / period / every)):
            film.add(start)
        for step in range(1, math.ceil(seconds / period) + 1):
            for player in players:
                player.step()
            if step % every == 0:
                film.add(_side_by_side(players, labels))


def _side_by_side(players: list[Player], labels: list[str]) -> Any:
    """The players' pictures in one; if there are several, each with its label."""
    pictures = [pictures[0] for player in players if (pictures := player.env.render())]
    if len(players) > 1:
        pictures = [labelled(*pair) for pair in zip(pictures, labels, strict=True)]
    return np.concatenate(pictures, axis=1)


def watch_run(
    run: RunFolder,
    backend: str,
    options: dict[str, Any],
    which: str,
    speed: float,
    log: Callable[[str], None] | None = None,
) -> None:
    """Play a run's policy in the viewer, episode after episode, until the user interrupts.

    Args:
        run: the run.
        backend: the backend.
        options: keyword arguments of the environment, in addition to those of the run.
        which: the policy, "last" or "best".
        speed: times real time.
        log: as in `film_run`, which also tells how joints move that would teleport.

    Raises:
        GymMaraError: the policy is missing or damaged, a value is out of its range, or the viewer cannot open.
    """
    settings = _settings(run, backend, options, which, log)
    with Player(run, backend, settings, which=which) as player:
        act, settings = player.act, player.options
    watch(run.config.env, backend, settings, act, speed=speed, seed=run.config.seed)


def _settings(
    run: RunFolder,
    backend: str,
    options: dict[str, Any],
    which: str,
    log: Callable[[str], None] | None,
) -> dict[str, Any]:
    """The keyword arguments with which a run is shown on a backend."""
    settings = options_on(backend, run.config, options)
    if VELOCITY_LIMIT in settings:
        return settings
    with Player(run, backend, settings, which=which) as player:
        limit = player.velocity_limit
    if limit is None:
        return settings
    if log is not None:
        log(travel_note(backend, limit))
    return settings | {VELOCITY_LIMIT: limit}
