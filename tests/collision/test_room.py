"""Room around configurations: arms whose links are always near each other have it, too, and those that have none say so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gym_mara.collision.coal import CoalChecker
from gym_mara.collision.free_poses import FreePoses, straight_move
from gym_mara.collision.room import ROOM, room_checker
from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import uniform_q
from tests.helpers import robot_model, write


def _arm(folder: Path, second: str, shapes: str, base: str) -> RobotModel:
    """An arm of a base, a link without a shape that turns about z, and a third link, so that only base and "far" can collide.

    Args:
        folder: for the URDF.
        second: type, axis and limits of the second joint.
        shapes: of the third link.
        base: shapes of the base.
    """
    urdf = f"""<robot name="close">
      <link name="base">{base}</link>
      <link name="middle"/>
      <link name="far">{shapes}</link>
      <joint name="turn" type="revolute">
        <parent link="base"/><child link="middle"/><axis xyz="0 0 1"/>
        <limit lower="-2" upper="2" effort="10" velocity="2"/>
      </joint>
      <joint name="second" {second}</joint>
    </robot>"""
    return RobotModel.inspect(write(folder / "close.urdf", urdf), "far")


def _shape(xyz: str, geometry: str) -> str:
    return f'<collision><origin xyz="{xyz}"/><geometry><{geometry}/></geometry></collision>'


_BALL, _FLOOR = 'sphere radius="0.05"', _shape("0 0 -0.25", 'box size="2 2 0.1"')


def _close_arm(folder: Path) -> RobotModel:
    """Its third link begins 5 mm from the base, always; its end, 0.5 m away, can touch the floor."""
    tilt = """type="revolute">
      <parent link="middle"/><child link="far"/><origin xyz="0 0 0.105"/><axis xyz="0 1 0"/>
      <limit lower="-3" upper="3" effort="10" velocity="2"/>"""
    links = _shape("0 0 0", _BALL) + _shape("0 0 0.5", _BALL)
    return _arm(folder, tilt, links, _shape("0 0 0", _BALL) + _FLOOR)


def test_an_arm_whose_links_are_always_near_each_other_has_room_where_nothing_collides_nearby(
    tmp_path: Path,
) -> None:
    robot = _close_arm(tmp_path)
    exact, q = CoalChecker(robot), uniform_q(robot, 500, 0)
    without = room_checker(robot).check(q)
    assert CoalChecker(robot, np.full(2, ROOM)).check(q).all(), "the quick bound refuses all"
    assert exact.check(q).mean() < without.mean() < 0.5
    with_room, random = q[~without], np.random.default_rng(0)
    for _ in range(20):
        moved = with_room + random.uniform(-ROOM, ROOM, with_room.shape)
        assert not exact.check(np.clip(moved, robot.lower, robot.upper)).any()


@pytest.mark.parametrize("env_id", ["MARAReach-v0", "MARAPose-v0"])
def test_the_tasks_with_any_target_start_on_such_an_arm(tmp_path: Path, env_id: str) -> None:
    robot = _close_arm(tmp_path)
    checker = room_checker(robot)
    env = MaraEnv(env_id, robot=robot, guide=True)
    for seed in range(5):
        observation, _ = env.reset(seed=seed)
        assert np.isfinite(observation).all()
        assert not checker.check(env.simulation.backend.state.q)[0]
    env.close()


@pytest.mark.parametrize("name", ["mara", "ur5", "panda"])
def test_the_room_of_arms_with_published_results_is_that_of_the_quick_bound(name: str) -> None:
    robot = robot_model(name)
    q = uniform_q(robot, 100, 0)
    bound = CoalChecker(robot, np.full(robot.num_joints, ROOM))
    np.testing.assert_array_equal(room_checker(robot).check(q), bound.check(q))


def test_an_arm_that_is_free_but_never_has_room_is_another_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gym_mara.collision.free_poses._TRIES", 1000)
    # It slides between two walls: 2 cm of 2 m are free.
    slide = """type="prismatic">
      <parent link="middle"/><child link="far"/><axis xyz="0 0 1"/>
      <limit lower="-1" upper="1" effort="10" velocity="2"/>"""
    walls = "".join(_shape(f"0 0 {z}", 'box size="1 1 1.04"') for z in (0.58, -0.58))
    poses = FreePoses(_arm(tmp_path, slide, _shape("0 0 0", _BALL), walls))
    assert abs(poses.draw(np.random.default_rng(0))[0][2]) < 0.01
    with pytest.raises(
        GymMaraError, match=r"close is free at [0-2][.0-9]* % of .*none of 1000: .*0\.02.*its SRDF"
    ):
        poses.draw_move(np.random.default_rng(0))


def test_a_joint_of_a_huge_range_is_an_error_and_takes_no_memory(tmp_path: Path) -> None:
    slide = """type="prismatic">
      <parent link="middle"/><child link="far"/><axis xyz="0 0 1"/>
      <limit lower="-900" upper="900" effort="10" velocity="2"/>"""
    poses = FreePoses(_arm(tmp_path, slide, _shape("0 0 0", _BALL), _FLOOR))
    with pytest.raises(GymMaraError, match=r"joint 1, .*1800 .* up to 1000: .* true limits"):
        poses.draw_move(np.random.default_rng(0))
    with pytest.raises(GymMaraError, match=r"joint 0, .*1001 "):
        straight_move(np.array([0.0, 3.0]), np.array([-1001.0, 2.0]))
    assert len(straight_move(np.zeros(2), np.array([1.0, 1000.0]))) == 20_000
