"""The velocity limit with which joints travel that would else teleport."""

from __future__ import annotations

from gym_mara.backends import backend_settings
from gym_mara.envs.simulation import Simulation
from gym_mara.errors import LARGEST, SMALLEST

VELOCITY_LIMIT = "max_joint_velocity"
"""The setting of a backend that limits the velocity of joints."""


def travel_velocity(simulation: Simulation) -> float | None:
    """If the joints teleport, the value of VELOCITY_LIMIT with which they travel: the robot's lowest velocity limit, rad/s.

    None if they do not teleport, or if the backend or the robot has no limit.
    """
    lowest = float(simulation.robot.velocity_limit.min())
    limited = VELOCITY_LIMIT in backend_settings(simulation.backend_name)
    if simulation.backend.teleports and limited and SMALLEST <= lowest < LARGEST:
        return lowest
    return None


def travel_note(backend: str, limit: float) -> str:
    """The note that joints are shown travelling."""
    return (
        f"{backend}: shown with joints of at most {limit:.3g} rad/s, the robot's limit; "
        f"to see them teleport, --set {VELOCITY_LIMIT}=null"
    )
