"""What tests of backends and environments share: configurations, copies, and comparisons of states."""

from __future__ import annotations

import copy
import dataclasses
import functools
import pickle
from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from gym_mara.collision import make_checker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.types import Floats, Mask

COLLIDING_Q = (1.5, 2.0, 0.0, 0.0, 0.0, 0.0)
"""A configuration of MARA with its forearm in the table, and of FakeBackend beyond its wall."""


def pickled(thing: Any) -> Any:
    """The object, pickled and unpickled."""
    return pickle.loads(pickle.dumps(thing))


COPIES = (pytest.param(copy.deepcopy, id="deepcopy"), pytest.param(pickled, id="pickle"))
"""The two ways to duplicate an object."""


def uniform_q(robot: RobotModel, count: int, seed: int, furthest: float = np.pi) -> Floats:
    """Random configurations (N, J) within the joint limits, each joint at most `furthest`, rad, from zero if it can."""
    low, high = (np.clip(end, robot.lower, robot.upper) for end in (-furthest, furthest))
    return np.random.default_rng(seed).uniform(low, high, (count, robot.num_joints))


@functools.cache
def colliding_q(robot: RobotModel) -> tuple[float, ...]:
    """A configuration (J,) with links deep inside each other: MARA's is known, others are searched at random.

    Raises:
        GymMaraError: no collision was found.
    """
    if robot.name == "mara":
        return COLLIDING_Q
    q = uniform_q(robot, 500, seed=0)
    q = q[make_checker("coal", robot).check(q)]
    if not len(q):
        raise GymMaraError(f"no collision of {robot.name} was found; take a robot that can collide")
    data, geometry_data = robot.model.createData(), robot.geometry.createData()

    def distance(row: Floats) -> float:
        pin.computeDistances(robot.model, data, robot.geometry, geometry_data, row)
        return min(result.min_distance for result in geometry_data.distanceResults)

    return tuple(min(q, key=distance).tolist())


def arrays_of(state: SimState) -> dict[str, NDArray[Any]]:
    """The arrays of a state by name; those of its parameters as "parameters.NAME"."""
    arrays: dict[str, NDArray[Any]] = {}
    for field in dataclasses.fields(state):
        value = getattr(state, field.name)
        if isinstance(value, np.ndarray):
            arrays[field.name] = value
        elif isinstance(value, Mapping):
            arrays |= {f"{field.name}.{name}": array for name, array in value.items()}
    return arrays


def arms_of(state: SimState, arms: slice | Mask) -> SimState:
    """The state of some of the arms."""

    def chosen(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: array[arms] for name, array in value.items()}
        if isinstance(value, tuple):
            return tuple(value[index] for index in np.arange(len(value))[arms])
        return None if value is None else value[arms]

    fields = dataclasses.fields(state)
    return SimState(**{field.name: chosen(getattr(state, field.name)) for field in fields})


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
    """Equal states; floats equal within atol."""
    assert_same_arrays(arrays_of(actual), arrays_of(expected), atol)
    if actual.contacts is None or expected.contacts is None:
        assert actual.contacts is expected.contacts
        return
    mine, theirs = (
        [[contact.links for contact in contacts] for contacts in state.contacts or ()]
        for state in (actual, expected)
    )
    assert mine == theirs
    for contacts, others in zip(actual.contacts, expected.contacts, strict=True):
        depths, expected_depths = [c.depth for c in contacts], [c.depth for c in others]
        np.testing.assert_allclose(depths, expected_depths, rtol=0.0, atol=atol)
