"""What an environment observes and what its actions mean, in the form of an exported policy's metadata."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gym_mara.deploy.about import OBSERVATION, About, Action, Joint, Part, Robot
from gym_mara.errors import GymMaraError


class Interface(NamedTuple):
    """The part of the metadata that must be the same in an environment."""

    control_period: float
    robot: Robot
    action: Action
    observation: tuple[Part, ...]


def interface(simulation: Any) -> Interface:
    """The interface of a `gym_mara.envs.simulation.Simulation`."""
    from gym_mara.robot.fingerprint import fingerprint

    robot, backend = simulation.robot, simulation.backend
    velocity = robot.velocity_limit if backend.teleports else backend.joint_velocity
    # A servo's motor has the speed gain · (target - q), so it is at its limit, for the whole period, at this distance.
    lag = 1.0 / gain if (gain := backend.servo_gain) else 0.0
    limits = [float(v) if 0.0 < v < np.inf else None for v in velocity]
    joints = tuple(
        Joint(
            name=name,
            unit="m" if prismatic else "rad",
            lower=float(lower),
            upper=float(upper),
            velocity=limit,
            travel=None if limit is None else limit * (backend.control_period + lag),
        )
        for name, prismatic, lower, upper, limit in zip(
            robot.joint_names,
            robot.kinematics().prismatic,
            simulation.target_low,
            simulation.target_high,
            limits,
            strict=True,
        )
    )
    return Interface(
        backend.control_period,
        Robot(robot.name, fingerprint(robot), robot.ee_frame, joints),
        action_of(simulation),
        _parts(simulation),
    )


def action_of(simulation: Any) -> Action:
    """What the actions of a simulation mean."""
    space = simulation.action_space
    low, high = (tuple(map(float, bounds)) for bounds in (space.low, space.high))
    actions = simulation.actions
    steps = tuple(map(float, actions.steps))
    return Action(actions.mode, low, high, steps, actions.settings.action_from)


def _parts(simulation: Any) -> tuple[Part, ...]:
    """The parts of the observation, each in the entry of the dictionary that it belongs to, if there is one."""
    parts = simulation.observation.parts
    numbers = np.arange(sum(len(part.low) for part in parts))
    groups = simulation.present(numbers)
    if not isinstance(groups, dict):
        groups = {OBSERVATION: numbers}
    starts = np.cumsum([0, *(len(part.low) for part in parts)])
    return tuple(
        Part(part.name, len(part.low), part.unit, name)
        for part, start in zip(parts, starts[:-1], strict=True)
        for name, own in groups.items()
        if start in own
    )


def check_fits(about: About, simulation: Any) -> None:
    """Check that a policy with this metadata can act in a simulation.

    Raises:
        GymMaraError: the robot, the observation, the actions or the control period are others.
    """
    there = interface(simulation)
    for what, ours, theirs in (
        ("moves the joints", _names(about.robot), _names(there.robot)),
        ("observes", _layout(about.observation), _layout(there.observation)),
        ("acts with", _meaning(about.action), _meaning(there.action)),
        ("acts every", f"{about.control_period:.6g} s", f"{there.control_period:.6g} s"),
    ):
        if ours != theirs:
            raise GymMaraError(
                f"the policy does not fit the environment: it {what} {ours}, and the environment has {theirs}"
            )
    if about.robot.fingerprint != there.robot.fingerprint:
        raise GymMaraError(
            f"the policy does not fit the environment: it was trained for another robot, {about.robot.name!r}, with the same "
            "joints' names: make the environment with the robot of the training, or export a policy of this one"
        )


def _names(robot: Robot) -> str:
    return ", ".join(joint.name for joint in robot.joints)


def _layout(parts: tuple[Part, ...]) -> str:
    return ", ".join(f"{part.input}: {part.name} ({part.size})" for part in parts)


def _meaning(action: Action) -> str:
    numbers = ", ".join(
        f"{name} {[float(f'{v:.6g}') for v in values]}"
        for name, values in (("low", action.low), ("high", action.high), ("steps", action.steps))
        if values
    )
    start = f" from the {action.reference}" if action.mode == "relative" else ""
    return f"{action.mode} actions{start}, {numbers}"
