"""One policy on every backend, side by side: how well it transfers from one simulation to another."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from gym_mara.agents.inspection.rollout import Player, roll_out, velocity_limit
from gym_mara.agents.runs.evaluation import options_beyond_backend
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.backends import backend_settings, installed_backends
from gym_mara.errors import GymMaraError, whole_number
from gym_mara.types import Floats

SETTLED = 0.005
"""An arm has settled once its position error stays this close to its final value, m."""


class Transferred(NamedTuple):
    """How a policy did on one backend; each array is (N,), over N episodes."""

    backend: str
    """Its name, and the settings that differ from its defaults."""
    position_error_mm: Floats
    """At the last step."""
    angle_deg: Floats
    """At the last step."""
    return_: Floats
    collisions: Floats
    settling_time_s: Floats
    """From this time on the position error stays within 5 mm of its final value."""
    highest_torque: Floats
    """Of any joint, relative to its limit; NaN on a backend without dynamics."""
    highest_velocity: Floats
    """Of any joint, rad/s."""


def transfer(
    run: RunFolder, *, episodes: int = 1, which: str = "last", options: dict[str, Any] | None = None
) -> list[Transferred]:
    """Play a run's deterministic policy on every installed backend.

    Args:
        run: the run.
        episodes: how many on each backend; they differ only if the options make them random.
        which: the policy, "last" or "best".
        options: settings of backends; each backend gets those that it knows.

    Returns:
        A row for each backend. A backend whose joints teleport and that can limit their velocity has a second row, with the
        robot's lowest velocity limit for all joints.

    Raises:
        GymMaraError: the policy is missing or damaged, or no installed backend knows an option.
    """
    whole_number("episodes", episodes)
    of_env, given = options_beyond_backend(run.config), options or {}
    installed, reasons = installed_backends()
    for reason in reasons:
        warnings.warn(reason, stacklevel=2)
    settings = {name: backend_settings(name) for name in installed}
    if lost := set(given).difference(*settings.values()):
        raise GymMaraError(
            f"no installed backend knows the setting {min(lost)!r}; "
            f"known: {', '.join(sorted(set().union(*settings.values())))}"
        )
    rows = []
    for name, known in settings.items():
        chosen = {key: value for key, value in given.items() if key in known}
        limit = velocity_limit(run.config.env, name, {**of_env, **chosen})
        for variant in [chosen, {**chosen, **limit}] if limit else [chosen]:
            title = ", ".join([name, *(f"{key}={value}" for key, value in variant.items())])
            rows.append(_play(run, title, name, {**of_env, **variant}, episodes, which))
    return rows


def _play(
    run: RunFolder, title: str, backend: str, options: dict[str, Any], episodes: int, which: str
) -> Transferred:
    with Player(run, backend, options, which=which, episodes=episodes) as player:
        played = roll_out(player)
        effort_limit = player.env.simulation.robot.effort_limit
    return Transferred(
        backend=title,
        position_error_mm=1000.0 * played.position_error[-1],
        angle_deg=np.degrees(played.angle_error[-1]),
        return_=played.reward.sum(axis=0),
        collisions=played.collided.sum(axis=0, dtype=np.float64),
        settling_time_s=played.period * settled_after(played.position_error),
        highest_torque=np.abs(played.torque / effort_limit).max(axis=(0, 2)),
        highest_velocity=np.abs(played.qd).max(axis=(0, 2)),
    )


def settled_after(error: Floats) -> Floats:
    """The number of steps (N,) after which the errors (T, N), m, stay within SETTLED of their final values."""
    unsettled = np.abs(error - error[-1]) > SETTLED
    steps = len(error) - unsettled[::-1].argmax(axis=0)
    return np.where(unsettled.any(axis=0), steps, 0).astype(np.float64)
