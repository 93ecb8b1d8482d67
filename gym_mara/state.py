"""SimState: the state of the simulation, the only data that tasks, recorders and renderers receive from a backend."""

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


@dataclass(frozen=True, eq=False, init=False)
class SimState:
    """The state of N arms at one instant. All arrays are fresh: a backend never changes them later.

    The end-effector pose and velocity are those of the robot's end-effector frame in the world frame.
    """

    q: Floats
    """Joint positions (N, J), rad (m for a prismatic joint)."""
    qd: Floats
    """Joint velocities (N, J), rad/s (m/s), at this instant."""
    ee_position: Floats
    """End-effector position (N, 3), m."""
    ee_quaternion: Floats
    """End-effector orientation (N, 4), [w, x, y, z], w >= 0."""
    ee_velocity: Floats
    """Linear velocity J(q) q̇ of the end-effector frame's origin (N, 3), m/s."""
    collided: Mask
    """Whether links that are checked for collisions touched, now or during the last control period (N,)."""
    time: Floats
    """Simulated time since the arm's last reset (N,), s."""
    torque: Floats | None = None
    """Motor torques of the last physics step (N, J), Nm (N for a prismatic joint); None without dynamics."""
    contacts: tuple[tuple[Contact, ...], ...] | None = None
    """The contacts of each arm during the last control period, N tuples; None if the engine reports no contacts."""
    diverged: Mask | None = None
    """Whether the arm's state diverged in the last step (N,); the other fields then hold the state before that step, without torques
    and contacts. None if the state cannot diverge."""
    parameters: Mapping[str, Floats] | None = None
    """The random parameters of each arm's episode by name, each (N, …); None without randomisation."""
    action: Floats | None = None
    """The last action of each arm (N, A), in the units of the action space, zero at the start of an episode. The simulation
    fills this field and the next one; a backend leaves both None."""
    last_action: Floats | None = None
    """The action before it (N, A)."""
    timing: Mapping[str, Floats] | None = None
    """How punctual the last step of a real arm was, each (N,): `lateness`, how long after its tick the action came, s;
    `missed_ticks`, how many control periods passed without an action; `state_age`, s. None in a simulation."""

    def __init__(
        self,
        q: Floats,
        qd: Floats,
        ee_position: Floats,
        ee_quaternion: Floats,
        ee_velocity: Floats,
        collided: Mask,
        time: Floats,
        torque: Floats | None = None,
        contacts: tuple[tuple[Contact, ...], ...] | None = None,
        diverged: Mask | None = None,
        parameters: Mapping[str, Floats] | None = None,
        action: Floats | None = None,
        last_action: Floats | None = None,
        timing: Mapping[str, Floats] | None = None,
    ) -> None:
        # The constructor that a frozen dataclass generates takes almost twice as long, and every step makes a state.
        vars(self).update(
            q=q,
            qd=qd,
            ee_position=ee_position,
            ee_quaternion=ee_quaternion,
            ee_velocity=ee_velocity,
            collided=collided,
            time=time,
            torque=torque,
            contacts=contacts,
            diverged=diverged,
            parameters=parameters,
            action=action,
            last_action=last_action,
            timing=timing,
        )

    def with_q(self, q: Floats) -> SimState:
        """The same state with other joint positions (N, J); in a fifth of the time that `dataclasses.replace` takes."""
        state = object.__new__(SimState)
        vars(state).update(vars(self), q=q)
        return state

    def fill_actions(self, action: Floats, last_action: Floats) -> None:
        """Set the last action of each arm and the one before it, each (N, A), in a state that nobody else has yet."""
        vars(self).update(
            action=action, last_action=last_action
        )  # a copy would take four times as long
