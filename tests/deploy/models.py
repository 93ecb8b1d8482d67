"""Small exported policies: an action is a sum of the observation, or a step of inverse kinematics."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from onnx import helper, numpy_helper

from gym_mara.deploy.about import METADATA_KEY, About, Action, Joint, Part, Robot, Training
from gym_mara.deploy.environment import interface
from gym_mara.envs import MaraEnv

JOINTS = (
    Joint("turn", "rad", -2.0, 2.5, 1.5, 0.03),
    Joint("slide", "m", 0.0, 0.4, 0.1, 0.002),
    Joint("free", "rad", -3.0, 3.0, None, None),
)
ABSOLUTE = Action("absolute", (-3.0,) * 3, (3.0,) * 3, (), "position")
RELATIVE = Action("relative", (-1.0,) * 3, (1.0,) * 3, (0.03, 0.001, 0.5), "position")
FROM_TARGET = dataclasses.replace(RELATIVE, reference="target")
TWIST = Action("cartesian", (-1.0,) * 6, (1.0,) * 6, (0.1,) * 3 + (0.5,) * 3, "position")
ARRAY = (
    Part("joint_positions", 3, "joint", "observation"),
    Part("position_error", 2, "m", "observation"),
)
PACED = (
    Part("joint_positions", 3, "joint", "observation"),
    Part("pace", 1, "", "observation"),
)
GROUPS = (
    Part("joint_positions", 3, "joint", "observation"),
    Part("target_position", 2, "m", "desired_goal"),
)


def about(action: Action = ABSOLUTE, observation: tuple[Part, ...] = ARRAY) -> About:
    return About(
        format=1,
        gym_mara="0.1.0",
        env="MARA-v0",
        target="position",
        control_period=0.02,
        robot=Robot("arm", "f00", "tool", JOINTS),
        action=action,
        observation=observation,
        training=Training("ppo", "tuned", 1000, 0, "last", "pinocchio", {"robot": "arm.urdf"}),
    )


def model(
    metadata: About,
    sizes: dict[str, int] | None = None,
    dtype: Any = np.float64,
    weights: Any = None,
) -> Any:
    """The model of a policy; `sizes` are those of its inputs if they differ from those of the metadata.

    The weights (O, A) are ones if none are given.
    """
    kind = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
    inputs = metadata.inputs if sizes is None else sizes
    actions = len(metadata.action.low)
    ones = np.ones((sum(inputs.values()), actions)) if weights is None else weights
    matrix = numpy_helper.from_array(ones.astype(dtype), "weights")
    nodes = [
        helper.make_node("Concat", [*inputs], ["all"], axis=1),
        helper.make_node("MatMul", ["all", "weights"], ["action"]),
    ]
    values = [helper.make_tensor_value_info(n, kind, ["N", s]) for n, s in inputs.items()]
    action = helper.make_tensor_value_info("action", kind, ["N", actions])
    graph = helper.make_graph(nodes, "sum", values, [action], [matrix])
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(made, {METADATA_KEY: metadata.to_json()})
    return made


def fitting(env: Any, name: str = "MARA-v0", **env_options: Any) -> About:
    """The metadata of a policy that was trained in an environment of this name with these keyword arguments."""
    training = dataclasses.replace(about().training, env_options=env_options)
    there = interface(env.simulation)._asdict()
    return dataclasses.replace(about(), env=name, training=training, **there)


def solving(path: Path, name: str, **env_options: Any) -> Path:
    """Write a policy that reaches targets: its action is the step of inverse kinematics that MARAReach-v0 observes."""
    env = MaraEnv(name, **env_options)
    metadata = fitting(env, name, **env_options)
    env.close()
    sizes = [part.size for part in metadata.observation]
    first = sum(sizes[: [part.name for part in metadata.observation].index("joint_steps")])
    joints = len(metadata.robot.joints)
    weights = np.zeros((sum(sizes), joints))
    weights[first : first + joints] = np.eye(joints)
    return write_model(path, model(metadata, weights=weights))


def write_model(path: Path, made: Any) -> Path:
    path.write_bytes(made.SerializeToString())
    return path
