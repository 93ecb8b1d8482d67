"""What the tests share: robots loaded once, configurations, comparisons, small URDFs."""

from __future__ import annotations

import copy
import csv
import dataclasses
import functools
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gym_mara.robot import RobotModel
from gym_mara.state import SimState

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

TASK_NAMES = ("MARA-v0", "MARAOrient-v0", "MARACollision-v0", "MARACollisionOrient-v0")
ENV_IDS = tuple(f"gym_mara/{name}" for name in TASK_NAMES)
TARGET_Q = (-0.237, -0.5528, 0.8681, 0.0, 1.7207, -0.237)
"""A configuration of MARA within 0.02 mm of the default target."""
COLLIDING_Q = (1.5, 2.0, 0.0, 0.0, 0.0, 0.0)
"""A configuration of MARA with its forearm in the table, and of FakeBackend beyond its wall."""
PATH_ENDS = ((0.5, -1.9, -0.3, -2.4, 1.1, -2.6), (0.5, -1.9, -0.3, 2.4, 1.1, -2.6))
"""Two free configurations of MARA between which motor4 takes the tool through the arm, near -1.15 to 1.06 rad."""


def pickled(thing: Any) -> Any:
    """What pickling and unpickling makes of it."""
    return pickle.loads(pickle.dumps(thing))


COPIES = (pytest.param(copy.deepcopy, id="deepcopy"), pytest.param(pickled, id="pickle"))
"""The two ways to duplicate an object."""

robot_model = functools.cache(RobotModel.load)


def golden(name: str) -> dict[str, Floats]:
    """The columns of a file of golden values."""
    with (Path(__file__).parent / "data" / name).open() as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}


def golden_q() -> Floats:
    """The configurations (N, 6) of the golden kinematics."""
    columns = golden("kinematics_golden.csv")
    return np.stack([columns[f"q{joint}"] for joint in range(1, 7)], axis=-1)


def uniform_q(robot: RobotModel, count: int, seed: int) -> Floats:
    """Configurations (N, J) all over what an action can ask for."""
    low, high = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (count, robot.num_joints))


def arrays_of(state: SimState) -> dict[str, NDArray[Any]]:
    """The arrays of a state by name."""
    return {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}


def assert_same_arrays(
    actual: dict[str, NDArray[Any]], expected: dict[str, NDArray[Any]], atol: float = 0.0
) -> None:
    """Equal names; equal flags and counts; floats equal within atol."""
    assert actual.keys() == expected.keys()
    for name, values in expected.items():
        if values.dtype.kind == "f":
            np.testing.assert_allclose(actual[name], values, rtol=0.0, atol=atol, err_msg=name)
        else:
            np.testing.assert_array_equal(actual[name], values, err_msg=name)


def assert_same_state(actual: SimState, expected: SimState, atol: float = 0.0) -> None:
    assert_same_arrays(arrays_of(actual), arrays_of(expected), atol)


def joint_xml(
    number: int,
    kind: str = "revolute",
    axis: str = "0 0 1",
    extra: str = "",
    limit: str = '<limit lower="-2" upper="1.5" effort="10" velocity="2"/>',
) -> str:
    """A joint from link NUMBER to link NUMBER + 1, 0.3 m along x and 0.2 m along z, skewed."""
    return f"""
      <joint name="joint{number}" type="{kind}">
        <parent link="link{number}"/><child link="link{number + 1}"/>
        <origin xyz="0.3 0 0.2" rpy="0.4 -0.3 0.2"/><axis xyz="{axis}"/>{limit}{extra}
      </joint>"""


def urdf_xml(*joints: str) -> str:
    """A URDF of one chain, link0, link1, …, with a ball on each link."""
    links = "".join(
        f"""
      <link name="link{number}">
        <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
        <collision><origin xyz="0.1 0 0"/><geometry><sphere radius="0.05"/></geometry></collision>
      </link>"""
        for number in range(len(joints) + 1)
    )
    return f'<robot name="stick">{links}{"".join(joints)}</robot>'


def write(path: Path, text: str) -> Path:
    """Write a file and return its path."""
    path.write_text(text)
    return path
