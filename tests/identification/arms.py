"""Simulated arms with hidden parameters, and the logs of their motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gym_mara.backends import make_backend
from gym_mara.backends.randomisation import PARAMETERS
from gym_mara.backends.servo import ServoBackend
from gym_mara.identification import Log, excitation
from gym_mara.identification.parameters import DEFAULT
from gym_mara.robot import RobotModel
from gym_mara.types import Floats

NOISE = 0.0002
"""Of the encoders, rad."""
WORKERS: dict[str, dict[str, Any]] = {"dart": {"workers": 1}, "mujoco": {"threads": 1}}


def hidden(
    robot: RobotModel,
    seed: int,
    joints: Sequence[int] | None = None,
    names: Sequence[str] = DEFAULT,
) -> dict[str, Floats]:
    """Parameters of an arm that is strong enough to hold itself; these of all its joints, or of some, differ from the robot's."""
    generator = np.random.default_rng(seed)
    count = robot.num_joints
    friction = generator.uniform(0.03, 0.1, count) * robot.effort_limit
    parameters = {
        "latency": np.array(generator.uniform(0.01, 0.1)),
        "servo_gain": generator.uniform(0.6, 1.8, count),
        "effort_limit": generator.uniform(0.4, 0.8, count),
        "joint_friction": friction,
        "mass": generator.uniform(0.6, 1.6, count),
    }
    parameters = {name: parameters[name] for name in names}
    for joint in range(count):
        if joints is not None and joint not in joints:
            for name in parameters.keys() - {"latency"}:
                parameters[name][joint] = PARAMETERS[name].nominal
    return parameters


def log_of(
    robot: RobotModel,
    backend: str,
    parameters: dict[str, Floats],
    duration: float,
    joints: Sequence[int] | None = None,
    seed: int = 0,
    noise: float = NOISE,
) -> Log:
    """The log of an arm with these parameters, of which only some joints are told to move."""
    targets = excitation(robot, duration, seed=seed)
    still = [j for j in range(robot.num_joints) if joints is not None and j not in joints]
    targets[:, still] = targets[0, still]
    ranges = {
        name: (0.0 if name in ("latency", "joint_friction") else 1e-3, 200.0) for name in parameters
    }
    if "latency" in ranges:
        ranges["latency"] = 0.0, 0.2
    options = {"randomisation": ranges, **WORKERS[backend]}
    arm = make_backend(backend, robot, 1, options)
    assert isinstance(arm, ServoBackend)
    arm.set_parameters({name: value[None] for name, value in parameters.items()})
    arm.reset(targets[:1])
    states = [arm.state, *(arm.step(target[None]) for target in targets[:-1])]
    arm.close()
    assert not any(state.collided[0] for state in states)
    generator = np.random.default_rng(seed)
    q = np.concatenate([state.q for state in states])
    q += noise * generator.standard_normal(q.shape)
    qd = np.vstack([np.zeros(robot.num_joints), np.diff(q, axis=0) / 0.02])
    return Log(np.arange(0.0, len(targets)) * np.float64(0.02), targets, q, qd, robot.joint_names)
