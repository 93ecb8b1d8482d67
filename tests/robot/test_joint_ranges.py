"""The ranges of joint targets: ±π in the paper, whole ranges where joints have longer ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gym_mara.collision.free_poses import FreePoses, reachable_pose
from gym_mara.envs import MaraEnv
from gym_mara.robot import RobotModel
from gym_mara.robot.inverse_kinematics import miss
from gym_mara.robot.joint_ranges import action_range, nearest_turns, reachable_range
from tests.helpers import joint_xml, robot_model, urdf_xml, write


def _arm(tmp_path: Path, lower: float, upper: float, kind: str = "revolute") -> RobotModel:
    """An arm whose first joint has these limits."""
    limit = f'<limit lower="{lower}" upper="{upper}" effort="10" velocity="2"/>'
    xml = urdf_xml(joint_xml(0, kind, limit=limit), joint_xml(1, axis="0 1 0"))
    return RobotModel.load(write(tmp_path / "arm.urdf", xml), "link2")


@pytest.mark.parametrize(
    ("lower", "upper"), [(-2 * np.pi, 2 * np.pi), (0.52, 5.76), (-3.2, 1.0), (4.0, 5.0)]
)
def test_a_joint_with_limits_beyond_pi_has_its_whole_range(
    tmp_path: Path, lower: float, upper: float
) -> None:
    arm = _arm(tmp_path, lower, upper)
    for low, high in (action_range(arm), reachable_range(arm)):
        assert (low[0], high[0]) == (lower, upper)
    env = MaraEnv(robot=arm, collision="none")
    env.reset(seed=0)
    for end in (lower, upper):
        env.step(np.array([end, 0.0], np.float32))
        assert env.simulation.backend.state.q[0, 0] == pytest.approx(end, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "lower", "upper", "low", "high"),
    [
        ("revolute", -1e9, 1e9, -np.pi, np.pi),
        ("revolute", -170.0, 170.0, -np.pi, np.pi),  # in degrees
        ("revolute", 0.0, 360.0, 0.0, 2 * np.pi),
        ("prismatic", -999999.0, 999999.0, -5.0, 5.0),
        ("prismatic", 0.0, 1e6, 0.0, 10.0),
    ],
)
def test_of_limits_that_mean_none_a_turn_or_ten_metres_are_used(
    tmp_path: Path, kind: str, lower: float, upper: float, low: float, high: float
) -> None:
    with pytest.warns(UserWarning, match="joint joint0: the limits are beyond"):
        arm = _arm(tmp_path, lower, upper, kind)
    assert (arm.lower[0], arm.upper[0]) == (lower, upper)
    for ends in (action_range(arm), reachable_range(arm)):
        np.testing.assert_allclose([end[0] for end in ends], [low, high])
    poses = FreePoses(arm)
    for seed in range(3):
        begin, position, quaternion = poses.draw_move(np.random.default_rng(seed))
        assert low <= begin[0] <= high
        assert max(miss(arm, position, quaternion)) < 1e-6
    assert arm.checked_q([upper, 0.0], "start_q")[0] == upper


@pytest.mark.parametrize(("kind", "far"), [("revolute", 8 * np.pi), ("prismatic", 1000.0)])
def test_long_ranges_that_an_arm_may_have_are_whole(tmp_path: Path, kind: str, far: float) -> None:
    arm = _arm(tmp_path, -far, far, kind)  # a test fails by a warning
    assert [end[0] for end in action_range(arm)] == [-far, far]


def test_any_other_revolute_joint_has_pi_and_reaches_its_limits(tmp_path: Path) -> None:
    arm = _arm(tmp_path, -1.0, 2.0)
    assert [end[0] for end in action_range(arm)] == [-np.pi, np.pi]
    assert [end[0] for end in reachable_range(arm)] == [-1.0, 2.0]


def test_limits_that_are_pi_but_for_rounding_stay_pi() -> None:
    mara = robot_model("mara")
    assert mara.upper[0] > np.pi
    low, high = action_range(mara)
    np.testing.assert_array_equal([low, high], [np.full(6, -np.pi), np.full(6, np.pi)])
    assert [end[0] for end in reachable_range(mara)] == [-np.pi, np.pi]


def test_whole_turns_bring_joints_as_near_as_their_limits_allow(tmp_path: Path) -> None:
    arm = _arm(tmp_path, -2 * np.pi, 2 * np.pi)
    near = np.array([[3.0, 0.0], [6.0, 0.0], [-6.0, 0.0], [0.0, 0.0]])
    q = np.array([[-3.0, 1.0], [-1.0, 1.0], [1.0, 1.0], [3.0, 1.0]])
    expected = [2 * np.pi - 3.0, 2 * np.pi - 1.0, 1.0 - 2 * np.pi, 3.0]
    turned = nearest_turns(arm, q, near)
    np.testing.assert_allclose(turned, np.column_stack([expected, np.ones(4)]), atol=1e-12)
    unknown = np.full((4, 2), np.inf)
    np.testing.assert_array_equal(nearest_turns(arm, unknown, near), unknown)
    still = nearest_turns(
        _arm(tmp_path, -np.pi / 2, np.pi / 2), np.array([[-1.5, 0.0]]), np.array([[1.5, 0.0]])
    )
    assert still.tolist() == [[-1.5, 0.0]]
    rail = _arm(tmp_path, -20.0, 20.0, "prismatic")
    assert nearest_turns(rail, np.array([[-3.0, 0.0]]), np.array([[3.0, 0.0]]))[0, 0] == -3.0


def test_targets_are_drawn_from_the_whole_travel_of_a_long_rail(tmp_path: Path) -> None:
    rail = _arm(tmp_path, 0.0, 12.0, "prismatic")
    generator, poses = np.random.default_rng(0), FreePoses(rail)
    drawn = np.array([poses.draw(generator)[0] for _ in range(200)])
    start, _ = rail.kinematics().pose(np.array([[0.0, 0.0]]))
    assert np.linalg.norm(drawn - start, axis=1).max() > 11.0
    assert np.linalg.norm(reachable_pose(rail)[0] - start) > 3.2


@pytest.mark.parametrize("angle", [0.6, 3.0, 4.5, 5.7])
def test_poses_in_the_whole_range_of_a_joint_are_found(tmp_path: Path, angle: float) -> None:
    arm = _arm(tmp_path, 0.52, 5.76)
    (position,), (quaternion,) = arm.kinematics().pose(np.array([[angle, 1.0]]))
    distance, turn = miss(arm, position, quaternion)
    assert distance < 1e-6
    assert turn < 1e-6
