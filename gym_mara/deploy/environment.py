"""What an environment observes and what its actions mean, in the form of an exported policy's metadata; and the way back."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from gym_mara.deploy.about import OBSERVATION, About, Action, Joint, Part, Robot
from gym_mara.errors import GymMaraError, unknown

_OF_MACHINE = {"collision_threads", "device", "package_dirs", "threads", "workers"}
"""Keyword arguments of a training that have a meaning on its machine alone."""
_OF_ACTIONS = {"action", "action_from", "action_scale"}
"""Those that `Action.keywords` replaces."""


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
    groups = simulation.form(numbers)
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
                f"the policy of {about.env} does not fit the environment: it {what} {ours}, and the environment has {theirs}"
            )
    if about.robot.fingerprint != there.robot.fingerprint:
        raise GymMaraError(
            f"the policy of {about.env} does not fit the environment: it was trained for another robot, {about.robot.name!r}, with the same "
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


def backend_of(about: About) -> str:
    """The backend of a policy's training, or the default one, with a warning, where that does not work on this machine."""
    from gym_mara.backends import DEFAULT_BACKEND
    from gym_mara.backends.registry import backend_class

    name = about.training.backend
    try:
        backend_class(name).require_machine()
    except GymMaraError as error:
        warnings.warn(
            f"the policy was trained on {name!r} and plays on {DEFAULT_BACKEND!r} here: {error}",
            stacklevel=2,
        )
        return DEFAULT_BACKEND
    return name


def keywords(about: About, env: str, backend: str, given: dict[str, Any]) -> dict[str, Any]:
    """The keyword arguments of an environment in which a policy with this metadata acts; see `OnnxPolicy.keywords`.

    Raises:
        GymMaraError: a name is unknown, or the environment of the training has no such keyword argument.
    """
    from gym_mara.backends import backend_settings
    from gym_mara.envs import task_keywords
    from gym_mara.envs.sensors import SensorSettings
    from gym_mara.robot.options import ROBOT_KEYWORDS

    training, settings = about.training, backend_settings(backend)
    # A stranger's file must not set options of the viewer, so these are all that it can set.
    known = {*ROBOT_KEYWORDS, *task_keywords(env), *settings, *SensorSettings.__dataclass_fields__}
    own = dict(training.env_options)
    for name in own.keys() & (_OF_MACHINE | _OF_ACTIONS):
        del own[name]
    for name in own.keys() - known:
        if (env, backend) == (about.env, training.backend):
            raise unknown("keyword argument", name, known, " in the metadata of the policy")
        del own[name]
    if given.get("action", about.action.mode) == about.action.mode:  # else `check_fits` refuses it
        own |= about.action.keywords
    if "control_period" in settings:
        own["control_period"] = about.control_period
    return {"backend": backend, **own, **given}
