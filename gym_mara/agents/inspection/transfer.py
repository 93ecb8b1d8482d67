"""One policy on every backend, side by side: how well it transfers from one simulation to another."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from gym_mara.agents.inspection.rollout import VELOCITY_LIMIT, Player, roll_out
from gym_mara.agents.runs.evaluation import options_beyond_backend, with_options
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.backends import backend_settings, usable_backends
from gym_mara.envs import task_keywords
from gym_mara.envs.actions import ActionSettings
from gym_mara.envs.sensors import SensorSettings
from gym_mara.errors import unknown, whole_number
from gym_mara.robot.options import ROBOT_KEYWORDS
from gym_mara.types import Floats

SETTLED = 0.005
"""An arm has settled at the target once its position error stays below this value, m."""
HELD = 1.0
"""How long it must have stayed there at the end of an episode to count as settled, s."""


class Transferred(NamedTuple):
    """How a policy did on one backend; each array is (N,), over N episodes."""

    backend: str
    """Its name."""
    settings: dict[str, Any]
    """Those of its settings that differ from its defaults."""
    position_error_mm: Floats
    """At the last step."""
    angle_deg: Floats
    """At the last step."""
    return_: Floats
    collisions: Floats
    settling_time_s: Floats
    """From this time on the arm stays within 5 mm of the target; NaN in an episode in which it never settles there."""
    highest_torque: Floats
    """Of any joint, relative to its limit; NaN on a backend without dynamics."""
    highest_velocity: Floats
    """Of any joint, rad/s; NaN where the joints teleport."""

    @property
    def metrics(self) -> dict[str, Floats]:
        """The arrays by name; that of `return_` is "return"."""
        names = (name.rstrip("_") for name in self._fields[2:])
        return dict(zip(names, self[2:], strict=True))


def transfer(
    run: RunFolder,
    *,
    backends: Sequence[str] = (),
    episodes: int = 1,
    which: str = "last",
    options: dict[str, Any] | None = None,
) -> list[Transferred]:
    """Play a run's deterministic policy on several backends.

    Args:
        run: the run.
        backends: their names; if none is given all that work on this machine, with a warning for each of the others.
        episodes: how many on each backend; they differ only if the options make them random.
        which: the policy, "last" or "best".
        options: keyword arguments of the environment. Those of the task, the sensors and the robot count on every
            backend; a setting of backends goes to those that know it.

    Returns:
        A row for each backend with its defaults. A row before it has the settings of the training, if it had some. A
        backend whose joints teleport and that can limit their velocity has a further row, with the robot's lowest velocity
        limit for all joints.

    Raises:
        GymMaraError: the policy is missing or damaged; a backend is unknown or does not work; or an option is unknown or out
            of range.
    """
    whole_number("episodes", episodes)
    of_env, given = options_beyond_backend(run.config), options or {}
    if not backends:
        backends, reasons = usable_backends()
        for reason in reasons:
            warnings.warn(f"left out: {reason}", stacklevel=2)
    settings = {name: backend_settings(name) for name in backends}
    of_env_too = {f.name for form in (SensorSettings, ActionSettings) for f in fields(form)}
    everywhere = {*ROBOT_KEYWORDS, *task_keywords(run.config.env), *of_env_too}
    for name in given:
        valid = everywhere.union(*settings.values())
        if name not in valid:
            raise unknown("keyword argument", name, valid, " on any of these backends")
    rows = []
    for name, known in settings.items():
        chosen = {key: value for key, value in given.items() if key in everywhere or key in known}
        trained = run.config.env_options if name == run.config.backend else {}
        if own := {key: value for key, value in trained.items() if key in known}:
            rows.append(_play(run, name, of_env, {**own, **chosen}, episodes, which)[0])
        row, velocity_limit = _play(run, name, of_env, chosen, episodes, which)
        rows.append(row)
        if velocity_limit is not None:
            limited = {**chosen, VELOCITY_LIMIT: velocity_limit}
            rows.append(_play(run, name, of_env, limited, episodes, which)[0])
    return rows


def _play(
    run: RunFolder,
    backend: str,
    of_env: dict[str, Any],
    chosen: dict[str, Any],
    episodes: int,
    which: str,
) -> tuple[Transferred, float | None]:
    """How a policy does on a backend; and the player's velocity limit."""
    options = with_options(of_env, chosen)
    with Player(run, backend, options, which=which, episodes=episodes) as player:
        played = roll_out(player)
        robot, velocity_limit = player.env.simulation.robot, player.velocity_limit
        teleports = player.env.simulation.backend.teleports
    known = backend_settings(backend)
    row = Transferred(
        backend=backend,
        settings={key: value for key, value in chosen.items() if key in known},
        position_error_mm=1000.0 * played.position_error[-1],
        angle_deg=np.degrees(played.angle_error[-1]),
        return_=played.reward.sum(axis=0),
        collisions=played.collided.sum(axis=0, dtype=np.float64),
        settling_time_s=settling_time(played.position_error, played.period),
        highest_torque=np.abs(played.torque / robot.effort_limit).max(axis=(0, 2)),
        highest_velocity=np.abs(played.qd).max(axis=(0, 2)) + (np.nan if teleports else 0.0),
    )
    return row, velocity_limit


def settling_time(error: Floats, period: float) -> Floats:
    """The time (N,), s, after which an arm stays within SETTLED of the target; NaN if it is not there for the last HELD s.

    Args:
        error: position errors (T, N), m, the first of them one period after the start.
        period: between two of them, s.
    """
    away = ~(error <= SETTLED)  # NaN is away, too
    steps = np.where(away.any(axis=0), len(error) - away[::-1].argmax(axis=0), 0)
    held = (len(error) - steps) * period
    return np.where(held >= HELD, steps * period, np.nan)
