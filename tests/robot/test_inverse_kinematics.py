"""Which poses an arm can reach."""

from __future__ import annotations

import numpy as np
import pytest

from gym_mara.collision import make_checker
from gym_mara.robot.inverse_kinematics import miss, solve_ik
from gym_mara.rotations import angle_between
from gym_mara.testing import uniform_q
from tests.helpers import robot_model


@pytest.mark.parametrize("name", ["mara", "ur5", "panda"])
def test_a_pose_that_the_arm_takes_is_reached_within_the_limits(name: str) -> None:
    robot = robot_model(name)
    kinematics = robot.kinematics()
    for q in uniform_q(robot, 5, 0):
        (position,), (quaternion,) = kinematics.pose(q[None])
        found = solve_ik(robot, position, quaternion)
        assert (robot.lower <= found).all()
        assert (found <= robot.upper).all()
        (there,), (turned,) = kinematics.pose(found[None])
        np.testing.assert_allclose(there, position, rtol=0.0, atol=1e-6)
        assert angle_between(turned, quaternion) < 1e-6
        distance, angle = miss(robot, position, quaternion)
        assert (distance, angle) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize(
    "point", [(0.0, 0.0, 2.5), (0.0, 1.4, 0.8), (-2.0, 1.0, 0.5), (2.0, 0.0, 1.0), (5.0, 0.0, 1.0)]
)
def test_a_point_out_of_reach_is_missed_by_the_least_distance_that_is_possible(
    point: tuple[float, float, float],
) -> None:
    mara = robot_model("mara")
    distance, angle = miss(mara, np.array(point), None)
    positions = mara.kinematics().pose(uniform_q(mara, 50_000, 1))[0]
    nearest = np.linalg.norm(positions - point, axis=1).min()
    assert angle == 0.0
    assert nearest - 0.1 < distance <= nearest


def test_a_pose_within_reach_in_position_only_is_missed_in_angle() -> None:
    mara = robot_model("mara")
    (highest,), (quaternion,) = mara.kinematics().pose(np.zeros((1, 6)))
    upside_down = np.array([0.0, 1.0, 0.0, 0.0])
    assert miss(mara, highest, None)[0] < 1e-6
    assert miss(mara, highest, quaternion) == pytest.approx((0.0, 0.0), abs=1e-6)
    distance, angle = miss(mara, highest, upside_down)
    assert distance > 1e-3 or angle > 1e-2


def test_the_target_of_mara_is_reached_without_collision() -> None:
    mara = robot_model("mara")
    q = solve_ik(
        mara, np.array([-0.40028, 0.095615, 0.72466]), np.array([0.0, 0.5**0.5, 0.5**0.5, 0.0])
    )
    assert not make_checker("coal", mara).check(q[None]).any()
    assert q[3] == pytest.approx(0.0, abs=1e-2)
