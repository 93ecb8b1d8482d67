"""Configurations of poses: each reaches its pose with room around it, and few poses have none."""

from __future__ import annotations

import numpy as np
import pytest

from gym_mara import rotations
from gym_mara.collision.coal import CoalChecker
from gym_mara.collision.configurations import STARTS, Configurations
from gym_mara.collision.room import ROOM
from gym_mara.robot import RobotModel
from gym_mara.testing import uniform_q
from gym_mara.types import Floats
from tests.helpers import robot_model


def _with_room(robot: RobotModel, count: int) -> Floats:
    q = uniform_q(robot, 20 * count, seed=3)
    return q[~CoalChecker(robot, np.full(robot.num_joints, ROOM)).check(q)][:count]


@pytest.mark.parametrize("orientation", [True, False])
@pytest.mark.parametrize("name", ["mara", "ur5", "panda"])
def test_they_reach_their_pose_within_the_limits_and_have_room(
    name: str, orientation: bool
) -> None:
    robot = robot_model(name)
    position, quaternion = robot.kinematics().pose(_with_room(robot, 12))
    start = np.tile(robot.home, (12, 1))
    found = Configurations(robot, orientation)(position, quaternion if orientation else None, start)
    assert found.shape == (12, STARTS, robot.num_joints)
    known = np.isfinite(found).all(axis=2)
    assert np.count_nonzero(known.sum(axis=1)) > 0.9 * 12
    assert np.isinf(found[~known]).all()
    reached, turned = robot.kinematics().pose(found[known])
    arm = np.nonzero(known)[0]
    np.testing.assert_allclose(reached, position[arm], atol=2e-3)
    if orientation:
        assert rotations.angle_between(turned, quaternion[arm]).max() < 0.02
    assert (found[known] >= robot.lower).all()
    assert (found[known] <= robot.upper).all()
    checker = CoalChecker(robot, np.full(robot.num_joints, ROOM))
    assert not checker.check(found[known]).any()


def test_the_same_pose_has_the_same_configurations_alone_and_beside_others() -> None:
    robot = robot_model("mara")
    position, quaternion = robot.kinematics().pose(_with_room(robot, 5))
    search = Configurations(robot, orientation=True)
    start = np.tile(robot.home, (5, 1))
    together = search(position, quaternion, start)
    for arm in range(5):
        one = slice(arm, arm + 1)
        alone = search(position[one], quaternion[one], start[one])[0]
        both = np.isfinite(alone) & np.isfinite(together[arm])
        assert both.mean() > 0.9 * np.isfinite(alone).mean()
        np.testing.assert_allclose(alone[both], together[arm][both], atol=1e-6)


def test_a_pose_out_of_reach_has_none() -> None:
    search = Configurations(robot_model("mara"), orientation=True)
    pose = np.array([[9.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0, 0.0]])
    assert np.isinf(search(*pose, np.zeros((1, 6)))).all()


@pytest.mark.parametrize("name", ["mara", "ur5"])
def test_the_straight_way_to_the_nearest_one_is_free(name: str) -> None:
    robot = robot_model(name)
    free = _with_room(robot, 120)
    start, end = free[:60], free[60:]
    found = Configurations(robot, orientation=True)(*robot.kinematics().pose(end), start)
    nearest = np.abs(found - start[:, None]).max(axis=2).argmin(axis=1)
    checker, blocked = CoalChecker(robot), 0
    for begin, goal in zip(start, found[np.arange(60), nearest], strict=True):
        steps = np.linspace(0.0, 1.0, 200)[:, None]
        blocked += bool(
            np.isfinite(goal).all() and checker.check(begin + steps * (goal - begin)).any()
        )
    assert blocked <= 1  # between two checks an arm may graze itself
