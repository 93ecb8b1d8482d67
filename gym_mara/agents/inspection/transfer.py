"""One policy on every backend, side by side: what it loses on the way from a simple simulation to a full one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_mara.agents.inspection.rollout import Player, record
from gym_mara.agents.runs.evaluation import options_beyond_backend
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.backends.registry import all_backend_settings
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel

SETTLED = 0.005
"""An arm has settled once its position error stays this near to its last, m."""


class Transferred(NamedTuple):
    """How a policy did on one backend; each (N,), over N episodes."""

    backend: str
    """Its name, and the settings that are not its defaults."""
    position_error_mm: NDArray[np.float64]
    """At the last step."""
    angle_deg: NDArray[np.float64]
    """At the last step."""
    return_: NDArray[np.float64]
    collisions: NDArray[np.float64]
    settling_time_s: NDArray[np.float64]
    """From when on the position error stays within 5 mm of its last."""
    highest_torque: NDArray[np.float64]
    """Of any joint, relative to its limit; NaN on a backend without torques."""
    highest_velocity: NDArray[np.float64]
    """Of any joint, rad/s."""


def transfer(
    run: RunFolder, *, episodes: int = 1, which: str = "last", options: dict[str, Any] | None = None
) -> list[Transferred]:
    """Play a run's deterministic policy on every backend.

    Args:
        run: the run.
        episodes: how many on each; they differ only where the options make them random.
        which: the policy, "last" or "best".
        options: keyword arguments of the environment; a backend's settings go to the backends that know them.

    Returns:
        A row for each backend; the kinematic one has two, with teleporting joints and with the robot's velocity limit.

    Raises:
        GymMaraError: the policy is missing or damaged, or an option is unknown to every backend.
    """
    if episodes < 1:
        raise GymMaraError(f"episodes must be at least 1, not {episodes}")
    of_env, given = options_beyond_backend(run.config), options or {}
    settings = all_backend_settings()
    if lost := set(given).difference(*settings.values()):
        raise GymMaraError(f"no backend knows the setting {min(lost)!r}")
    rows = []
    for name, known in settings.items():
        chosen = {k: v for k, v in given.items() if k in known}
        variants = [chosen]
        if name == "pinocchio" and "max_joint_velocity" not in chosen:
            robot = RobotModel.load(of_env.get("robot", "mara"), of_env.get("ee_frame"))
            variants.append({**chosen, "max_joint_velocity": float(robot.velocity_limit.min())})
        for variant in variants:
            title = ", ".join([name, *(f"{key}={value}" for key, value in variant.items())])
            rows.append(_play(run, title, name, {**of_env, **variant}, episodes, which))
    return rows


def _play(
    run: RunFolder, title: str, backend: str, options: dict[str, Any], episodes: int, which: str
) -> Transferred:
    with Player(run, backend, options, which=which, episodes=episodes) as player:
        played = record(player)
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


def settled_after(error: NDArray[np.float64]) -> NDArray[np.float64]:
    """The number of steps after which the errors (T, N), m, stay within SETTLED of their last."""
    astray = np.abs(error - error[-1]) > SETTLED
    steps = len(error) - astray[::-1].argmax(axis=0)
    return np.where(astray.any(axis=0), steps, 0).astype(np.float64)
