"""Poses that an arm takes without a collision: random ones, and each robot's fixed one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gym_mara.collision import make_checker
from gym_mara.collision.free_poses import FreePoses, reachable_pose
from gym_mara.collision.room import ROOM
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.catalog import robot_names
from gym_mara.robot.inverse_kinematics import solve_ik
from gym_mara.robot.joint_ranges import reachable_range
from gym_mara.rotations import angle_between
from gym_mara.testing import COLLIDING_Q
from tests.helpers import joint_xml, robot_model, urdf_xml, write


@pytest.mark.parametrize("name", robot_names())
def test_the_own_target_of_a_robot_is_reachable_free_and_always_the_same(name: str) -> None:
    robot = robot_model(name)
    position, quaternion = reachable_pose(robot)
    again = reachable_pose(robot)
    np.testing.assert_array_equal(position, again[0])
    np.testing.assert_array_equal(quaternion, again[1])
    away = np.linalg.norm(position - robot.kinematics().pose(robot.home[None])[0][0])
    assert away > 0.05, "a task whose target is the start is none"
    q = solve_ik(robot, position, quaternion)
    (there,), (turned,) = robot.kinematics().pose(q[None])
    np.testing.assert_allclose(there, position, rtol=0.0, atol=1e-3)
    assert angle_between(turned, quaternion) < 1e-2


def test_random_poses_are_those_of_free_configurations_within_the_limits() -> None:
    mara = robot_model("mara")
    position, quaternion = FreePoses(mara).draw(np.random.default_rng(3))
    rng, checker = np.random.default_rng(3), make_checker("coal", mara)
    q = rng.uniform(mara.lower.clip(-np.pi), mara.upper.clip(max=np.pi))[None]
    while checker.check(q)[0]:
        q = rng.uniform(mara.lower.clip(-np.pi), mara.upper.clip(max=np.pi))[None]
    expected = mara.kinematics().pose(q)
    np.testing.assert_array_equal(position, expected[0][0])
    np.testing.assert_array_equal(quaternion, expected[1][0])


def test_a_robot_that_always_collides_is_an_error(tmp_path: Path) -> None:
    # Without an SRDF links that touch at home would not collide.
    srdf = '<robot name="stick"><disable_collisions link1="link0" link2="link1"/></robot>'
    write(tmp_path / "stick.srdf", srdf)
    large = urdf_xml(joint_xml(0), joint_xml(1)).replace('radius="0.05"', 'radius="5"')
    with pytest.warns(UserWarning, match="they touch in 100 % of random poses"):
        robot = RobotModel.load(write(tmp_path / "stick.urdf", large), "link2")
    with pytest.raises(GymMaraError, match=r"stick collides at all of 10000 random.*its SRDF"):
        FreePoses(robot).draw(np.random.default_rng(0))


def test_a_random_move_is_free_from_its_start_to_its_pose() -> None:
    mara = robot_model("mara")
    poses, checker = FreePoses(mara), make_checker("coal", mara)
    with_room = checker.with_margin(np.full(6, ROOM))
    assert with_room is not None
    collided = 0
    for seed in range(30):
        start, position, quaternion = poses.draw_move(np.random.default_rng(seed))
        # The end is the last free configuration that the generator gives before its pose is this one.
        rng, low, high = np.random.default_rng(seed), *reachable_range(mara)
        while True:
            end = rng.uniform(low, high)
            place, turn = mara.kinematics().pose(end[None])
            if np.array_equal(place[0], position) and np.array_equal(turn[0], quaternion):
                break
        fine = start + np.linspace(0.0, 1.0, 1001)[:, None] * (end - start)
        touched = checker.check(fine)
        assert not touched[[0, -1]].any()
        assert not with_room.check(fine[[0, -1]]).any()
        collided += int(touched.sum())
    # Between two checks the arm may graze itself: at most in a few of 30,000 configurations.
    assert collided < 30


def test_a_random_move_can_have_a_given_start() -> None:
    mara = robot_model("mara")
    start, position, _ = FreePoses(mara).draw_move(np.random.default_rng(0), mara.home)
    np.testing.assert_array_equal(start, mara.home)
    assert np.linalg.norm(position - mara.kinematics().pose(mara.home[None])[0][0]) > 0.0


def test_a_start_that_collides_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gym_mara.collision.free_poses._TRIES", 20)
    with pytest.raises(GymMaraError, match=r"20 random joint moves from .*choose another start_q"):
        FreePoses(robot_model("mara")).draw_move(np.random.default_rng(0), np.array(COLLIDING_Q))
