"""SimState: the state of the simulation, all that passes from a backend to a task, a recorder or a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from gym_mara.types import Floats, Mask


class Contact(NamedTuple):
    """Two links in contact."""

    links: tuple[str, str]
    """Their names, in alphabetical order."""
    depth: float
    """The deepest penetration during the last control period, m."""


@dataclass(frozen=True, eq=False, slots=True)
class SimState:
    """The state of N arms at one instant; every array is fresh and may be kept.

    Positions and orientations are those of the robot's end-effector frame in the world frame.
    """

    q: Floats
    """Joint positions (N, J), rad (m for a prismatic joint)."""
    qd: Floats
    """Joint velocities (N, J), rad/s (m/s), at this instant."""
    ee_position: Floats
    """(N, 3), m."""
    ee_quaternion: Floats
    """(N, 4), [w, x, y, z], w >= 0."""
    ee_velocity: Floats
    """Linear velocity J(q) q̇ of the end-effector frame's origin (N, 3), m/s."""
    collided: Mask
    """(N,): links that may collide touched at this instant or at any during the last control period."""
    time: Floats
    """Simulated time since the arm's last reset (N,), s."""
    torque: Floats | None = None
    """What the motors exerted in the last physics step (N, J), Nm (N for a prismatic joint); None without dynamics."""
    contacts: tuple[tuple[Contact, ...], ...] | None = None
    """The contacts of each arm during the last control period, N tuples; None where an engine reports none."""
    diverged: Mask | None = None
    """(N,): the arm's state diverged in the last step, and the one before is reported; None where that cannot be."""
    parameters: Mapping[str, Floats] | None = None
    """What was drawn for each arm's episode, name → (N, …); None where nothing is random."""
