"""Shows a policy: in a film, of an episode on backends side by side or of targets in a row, or live in the viewer."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gym_mara.agents.evaluation.exported import begin_exported
from gym_mara.agents.evaluation.metrics import HELD, SETTLED, in_short
from gym_mara.agents.runs.evaluation import Player, Playing, options_on
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.deploy import OnnxPolicy
from gym_mara.deploy.environment import backend_of
from gym_mara.envs.outcome import Outcome
from gym_mara.envs.travel import VELOCITY_LIMIT, travel_note
from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError
from gym_mara.rendering.film import HIGHEST_RATE, Film, check_film_path, labelled
from gym_mara.viewer import watch

_STILL = 0.5
"""How long a film shows the start pose before the arm moves, and a collision, s."""


@dataclass(frozen=True)
class Show:
    """A policy that is shown."""

    backend: str
    """That of the training, or the default one if that does not work here."""
    play: Callable[[str, dict[str, Any], str], Playing]
    """Makes what plays it on a backend, with more keyword arguments of the environment, and with an autoreset mode (see `Playing`).

    It raises GymMaraError if the policy is missing or damaged or does not fit, or if an option is unknown or out of range.
    """


def show_run(run: RunFolder, which: str = "last") -> Show:
    """Shows a policy of a run, "last" or "best"."""

    def play(backend: str, options: dict[str, Any], mode: str) -> Playing:
        settings = options_on(backend, run.config, options)
        return Player(run, backend, settings, which=which, autoreset_mode=mode)

    return Show(run.config.backend, play)


def show_exported(policy: OnnxPolicy, env: str | None = None) -> Show:
    """Shows an exported policy in an environment of this name; by default that of its training."""

    def play(backend: str, options: dict[str, Any], mode: str) -> Playing:
        keywords = policy.keywords(env, backend, **options)
        backend = keywords.pop("backend")
        name, begin = env or policy.about.env, begin_exported(policy)
        return Playing(name, backend, keywords, begin, autoreset_mode=mode)

    return Show(backend_of(policy.about), play)


def film_episode(
    show: Show,
    path: Path,
    backends: list[str],
    options: dict[str, Any],
    *,
    seconds: float = 6.0,
    speed: float = 1.0,
    rate: float = HIGHEST_RATE,
    log: Callable[[str], None] | None = None,
) -> None:
    """Film the start of an episode of a policy on each backend, side by side.

    An arm whose episode ends before the film, such as by a collision, is shown there until the end of the film.
    Joints that would teleport move at the robot's velocity limit, unless the run or the options have max_joint_velocity.

    Args:
        show: the policy.
        path: a new file, .mp4 or .gif.
        backends: the backends.
        options: keyword arguments of the environment, in addition to those of the training.
        seconds: length of the filmed part of the episode, s.
        speed: times real time.
        rate: highest number of pictures per second.
        log: is called with a sentence about each backend whose joints get the velocity limit.

    Raises:
        GymMaraError: the file exists or cannot be written, the policy cannot be shown (see `Show`), or the control periods of the
            backends differ.
    """
    check_film_path(path)  # an error comes before the policy is played
    with ExitStack() as stack:
        players, labels = [], []
        for backend in backends:
            player = stack.enter_context(_filmed(show, backend, options, "Disabled", log))
            limit = player.options.get(VELOCITY_LIMIT)
            players.append(player)
            labels.append(backend if limit is None else f"{backend}, at most {limit:.3g} rad/s")
        period = _control_period(players, backends)
        every = math.ceil(speed / period / rate)
        film = stack.enter_context(Film(path, speed / period / every))
        start = _side_by_side(players, labels)
        for _ in range(math.ceil(_STILL * speed / period / every)):
            film.add(start)
        running = players
        for step in range(1, math.ceil(seconds / period) + 1):
            running = [player for player in running if not _has_ended(player.step())]
            if step % every == 0:
                film.add(_side_by_side(players, labels))


def _filmed(
    show: Show,
    backend: str,
    options: dict[str, Any],
    autoreset_mode: str,
    log: Callable[[str], None] | None,
) -> Playing:
    """What plays a policy, with pictures and with joints that travel."""
    travelling = _travelling(show, backend, options, log)
    return show.play(backend, travelling | {"render_mode": "rgb_array"}, autoreset_mode)


def _control_period(players: list[Playing], backends: list[str]) -> float:
    """The control period of all players, s.

    Raises:
        GymMaraError: they differ.
    """
    periods = [player.env.simulation.backend.control_period for player in players]
    for backend, period in zip(backends, periods, strict=True):
        if period != periods[0]:
            raise GymMaraError(
                f"a film of several backends steps them together, and a step lasts {periods[0]:g} s on {backends[0]}, and "
                f"{period:g} s on {backend}: film them one by one, or set control_period"
            )
    return periods[0]


def _has_ended(outcome: Outcome) -> bool:
    """Whether an episode without a time limit has ended: by the task, or because the state of the arm diverged."""
    diverged = outcome.truncated is not None and outcome.truncated[0]
    return bool(outcome.terminated[0] or diverged)


def _side_by_side(players: list[Playing], labels: list[str]) -> Any:
    """The players' pictures in one; if there are several, each with its label."""
    pictures = [pictures[0] for player in players if (pictures := player.env.render())]
    if len(players) > 1:
        pictures = [labelled(*pair) for pair in zip(pictures, labels, strict=True)]
    return np.concatenate(pictures, axis=1)


def film_targets(
    show: Show,
    path: Path,
    backend: str,
    options: dict[str, Any],
    *,
    targets: int,
    speed: float = 1.0,
    rate: float = HIGHEST_RATE,
    log: Callable[[str], None] | None = None,
) -> None:
    """Film a policy that reaches random targets in a row: the arm goes on from where it is, without a reset.

    The next target comes when the tool has stayed at the last one for HELD s, or after the length of an episode. A straight joint
    move without a collision leads to it. If the arm collides, it is put back to where the film began, and the next target comes.

    Args:
        show, path, options, speed, rate, log: as in `film_episode`.
        backend: the backend.
        targets: how many.

    Raises:
        GymMaraError: as in `film_episode`; the task does not draw its targets, or the options have on_collision.
    """
    check_film_path(path)
    if "on_collision" in options:
        raise GymMaraError(
            "a film of several targets puts an arm that collides back to its start: leave out on_collision"
        )
    given = {**options, "on_collision": "reset"}
    with _filmed(show, backend, given, "SameStep", log) as player:
        simulation = player.env.simulation
        if not simulation.task.random_goal:
            raise GymMaraError(
                f"{player.env_name} has the same target in every episode: film a policy of an environment that draws its "
                "targets, such as MARAReach-v0, or one episode"
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


def _film_target(
    player: Playing, film: Film, title: str, shown: Iterator[bool], still: int
) -> None:
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


def _labelled_picture(player: Playing, text: str) -> Any:
    pictures = player.env.render()
    assert pictures is not None
    return labelled(pictures[0], text)


def _errors(player: Playing, outcome: Outcome) -> str:
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
        log: as in `film_episode`, which also tells how joints move that would teleport.

    Raises:
        GymMaraError: the policy is missing or damaged, a value is out of its range, or the viewer cannot open.
    """
    show = show_run(run, which)
    with show.play(backend, _travelling(show, backend, options, log), "SameStep") as player:
        begin, settings = player.begin, player.options
    watch(run.config.env, backend, settings, begin, speed=speed, seed=run.config.seed)


def _travelling(
    show: Show, backend: str, options: dict[str, Any], log: Callable[[str], None] | None
) -> dict[str, Any]:
    """The options with which a policy is shown: joints that would teleport travel, unless VELOCITY_LIMIT is given."""
    with show.play(backend, options, "SameStep") as player:
        limit = None if VELOCITY_LIMIT in player.options else player.velocity_limit
    if limit is None:
        return options
    if log is not None:
        log(travel_note(backend, limit))
    return options | {VELOCITY_LIMIT: limit}
