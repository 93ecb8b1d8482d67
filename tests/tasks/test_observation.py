"""Observations: named parts with bounds, concatenated in order."""

from __future__ import annotations

import numpy as np
import pytest

from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.tasks import TASKS, Goal, Observation, Part
from gym_mara.testing import pickled, uniform_q
from gym_mara.types import Floats
from tests.helpers import robot_model


def _time(state: SimState, goal: Goal) -> Floats:
    return state.time[:, None]


def _observation(task: str, robot: RobotModel) -> tuple[Observation, Goal]:
    goal = TASKS[task].goal(robot, RobotWorkspace(robot), 5)
    return Observation(TASKS[task].observation(robot, goal, robot.velocity_limit)), goal


def _state(robot: RobotModel) -> SimState:
    q = uniform_q(robot, 5, 0)
    position, quaternion = robot.kinematics().pose(q)
    no_velocity = np.zeros((5, 3))
    return SimState(
        q, 0.0 * q, position, quaternion, no_velocity, np.zeros(5, np.bool_), np.arange(5.0)
    )


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("robot", ["mara", "panda"])
def test_split_recovers_the_parts_of_a_flat_observation(task: str, robot: str) -> None:
    arm = robot_model(robot)
    observation, goal = _observation(task, arm)
    state = _state(arm)
    flat = observation(state, goal)
    parts = observation.split(flat)
    assert list(parts) == [part.name for part in observation.parts]
    np.testing.assert_array_equal(np.concatenate(list(parts.values()), axis=-1), flat)
    np.testing.assert_array_equal(parts["joint_positions"], state.q)
    if "tool_velocity" in parts:
        np.testing.assert_array_equal(parts["tool_velocity"], state.ee_velocity)
    if "joint_velocities" in parts:
        np.testing.assert_array_equal(parts["joint_velocities"], state.qd)
    one = observation.split(flat[3])
    for name, values in parts.items():
        np.testing.assert_array_equal(one[name], values[3])
    for row in flat:
        assert observation.space.contains(row)


def test_the_bounds_have_the_order_of_the_values(mara: RobotModel) -> None:
    observation, _ = _observation("MARAOrient-v0", mara)
    bounds = observation.split(np.array(observation.space.high))
    for part in observation.parts:
        np.testing.assert_array_equal(bounds[part.name], part.high)


def test_a_custom_part_is_observed_and_can_be_pickled(mara: RobotModel) -> None:
    observation, goal = _observation("MARA-v0", mara)
    clock = Part("clock", np.zeros(1), np.full(1, np.inf), _time)
    extended: Observation = pickled(Observation([*observation.parts, clock]))
    np.testing.assert_array_equal(extended(_state(mara), goal)[:, -1], np.arange(5.0))


def test_two_parts_with_the_same_name_are_refused(mara: RobotModel) -> None:
    observation, _ = _observation("MARA-v0", mara)
    with pytest.raises(GymMaraError, match="two parts of an observation have the same name"):
        Observation([*observation.parts, observation.parts[0]])


@pytest.mark.parametrize("high", [np.zeros(2), np.zeros((1, 3)), np.float64(0.0)])
def test_bounds_of_different_shapes_are_refused(high: Floats) -> None:
    with pytest.raises(GymMaraError, match="bounds of 'odd'"):
        Observation([Part("odd", np.zeros(3), high, _time)])
