"""Shows a policy: in a film, of an episode on backends side by side or of targets in a row, or live in the viewer."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from gym_mara.agents.evaluation.metrics import HELD, SETTLED, in_short
from gym_mara.agents.runs.evaluation import Player, options_on
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.envs.outcome import Outcome
from gym_mara.envs.travel import VELOCITY_LIMIT, travel_note
from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError
from gym_mara.rendering.film import HIGHEST_RATE, Film, check_film_path, labelled
from gym_mara.viewer import watch

_STILL = 0.5
"""How long a film shows the start pose before the arm moves, and a collision, s."""


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


def film_targets(
    run: RunFolder,
    path: Path,
    backend: str,
    options: dict[str, Any],
    *,
    targets: int,
    which: str = "last",
    speed: float = 1.0,
    rate: float = HIGHEST_RATE,
    log: Callable[[str], None] | None = None,
) -> None:
    """Film a run's policy that reaches random targets in a row: the arm goes on from where it is, without a reset.

    The next target comes when the tool has stayed at the last one for HELD s, or after the length of an episode. A straight joint
    move without a collision leads to it. If the arm collides, it is put back to where the film began, and the next target comes.

    Args:
        run, path, options, which, speed, rate, log: as in `film_run`.
        backend: the backend.
        targets: how many.

    Raises:
        GymMaraError: as in `film_run`; the task does not draw its targets, or the options have on_collision.
    """
    check_film_path(path)
    if "on_collision" in options:
        raise GymMaraError(
            "a film of several targets puts an arm that collides back to its start: leave out on_collision"
        )
    settings = _settings(run, backend, {**options, "on_collision": "reset"}, which, log)
    with Player(run, backend, settings | {"render_mode": "rgb_array"}, which=which) as player:
        simulation = player.env.simulation
        if not simulation.task.random_goal:
            raise GymMaraError(
                f"{run.config.env} has the same target in every episode: film a run of an environment that draws its targets, "
                "such as MARAReach-v0, or one episode"
            )
        workspace, generator = RobotWorkspace(simulation.robot), np.random.default_rng(0)
        period = simulation.backend.control_period
        every = math.ceil(speed / period / rate)
        still = math.ceil(_STILL * speed / period / every)
        shown = (step % every == 0 for step in itertools.count(1))
        with Film(path, speed / period / every) as film:
            for number in range(1, targets + 1):
                title = f"target {number} of {targets}"
                if number == 1:
                    _add(film, _labelled_picture(player, title), still)
                else:
                    _, *pose = workspace.draw_move(generator, simulation.backend.state.q[0])
                    simulation.set_goal(*pose)
                _film_target(player, film, title, shown, still)


def _film_target(player: Player, film: Film, title: str, shown: Iterator[bool], still: int) -> None:
    """Film the way to a target, until it is reached or given up, or the arm collides.

    Args:
        player: plays.
        film: the film.
        title: names the target.
        shown: for each step of the film, whether it is shown.
        still: for how many pictures a collision is shown.
    """
    near, enough = 0, math.ceil(HELD / player.env.simulation.backend.control_period)
    for _ in range(player.episode_steps):
        outcome = player.step()
        if outcome.state.collided[0]:
            _add(film, _labelled_picture(player, f"{title}: collision"), still)
            return
        if next(shown):
            film.add(_labelled_picture(player, f"{title}: {_errors(player, outcome)}"))
        near = near + 1 if _is_near(outcome) else 0
        if near == enough:
            return


def _add(film: Film, picture: Any, times: int) -> None:
    for _ in range(times):
        film.add(picture)


def _labelled_picture(player: Player, text: str) -> Any:
    pictures = player.env.render()
    assert pictures is not None
    return labelled(pictures[0], text)


def _errors(player: Player, outcome: Outcome) -> str:
    """How far the arm is from its target, as a text; the angle only if the task judges it."""
    info, texts = outcome.info, []
    if "position_error" in info:
        texts.append(f"{in_short(1000.0 * info['position_error'][0])} mm")
    if "angle_error" in info and getattr(player.env.simulation.task, "orientation", False):
        texts.append(f"{in_short(np.degrees(info['angle_error'][0]))}°")
    return ", ".join(texts)


def _is_near(outcome: Outcome) -> bool:
    """Whether the arm is at its target, as in `measure`."""
    info = outcome.info
    success = info.get("success", info.get("is_success"))
    if success is None:
        return bool(info.get("position_error", [math.inf])[0] <= SETTLED)
    return bool(success[0])


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
        begin, settings = player.begin, player.options
    watch(run.config.env, backend, settings, begin, speed=speed, seed=run.config.seed)


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
