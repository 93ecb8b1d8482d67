"""RobotOptions: the limits and masses that replace those of a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.fingerprint import fingerprint
from tests.robot.arms import LIMIT, TOOL, arm, arm_file

NAMES = ("effort_limit", "velocity_limit")
ZERO = LIMIT.replace('effort="50" velocity="2"', 'effort="0" velocity="0"')


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("given", "limits"),
    [
        (7, [7.0, 7.0, 7.0]),
        ([7, 8, 9.5], [7.0, 8.0, 9.5]),
        (np.array([7.0, 8.0, 9.0]), [7.0, 8.0, 9.0]),
        ({"j1": 7, "j2": 8, "j3": 9}, [7.0, 8.0, 9.0]),
    ],
)
def test_a_limit_replaces_that_of_the_file(
    tmp_path: Path, name: str, given: Any, limits: list[float]
) -> None:
    urdf = arm_file(tmp_path, arm(limit=ZERO))
    before = RobotModel.inspect(urdf, TOOL)
    robot = RobotModel.inspect(urdf, TOOL, **{name: given})
    np.testing.assert_array_equal(getattr(robot, name), limits)
    pinocchio = robot.model.effortLimit if name == "effort_limit" else robot.model.velocityLimit
    np.testing.assert_array_equal(pinocchio, limits)
    mended = {f.message for f in before.findings} - {f.message for f in robot.findings}
    assert mended == {name.replace("_", " ") + " 0"}
    assert fingerprint(robot) != fingerprint(before)


@pytest.mark.parametrize("name", NAMES)
def test_a_limit_by_name_leaves_the_other_joints(tmp_path: Path, name: str) -> None:
    robot = RobotModel.load(arm_file(tmp_path), TOOL, **{name: {"j2": 9}})
    before = RobotModel.load(robot.urdf, TOOL)
    expected = getattr(before, name).copy()
    expected[1] = 9.0
    np.testing.assert_array_equal(getattr(robot, name), expected)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("given", "message"),
    [
        (0, "must be finite and positive"),
        ("fast", "must be finite and positive"),
        ([1.0, 2.0], "has 2 values; the arm has 3 joints: j1, j2, j3"),
        ([1.0, 2.0, -3.0], "must be finite and positive"),
        ({"j4": 1.0}, "unknown joint 'j4' in"),
        ({"j1": None}, r"\['j1'\] must be finite and positive"),
    ],
)
def test_a_wrong_limit_is_an_error(tmp_path: Path, name: str, given: Any, message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        RobotModel.load(arm_file(tmp_path), TOOL, **{name: given})


@pytest.mark.parametrize("given", [0.0, -1.0, "heavy", True])
def test_a_wrong_default_mass_is_an_error(tmp_path: Path, given: Any) -> None:
    with pytest.raises(GymMaraError, match="default_mass must be"):
        RobotModel.load(arm_file(tmp_path), TOOL, default_mass=given)


@pytest.mark.filterwarnings("ignore:.*velocity limit 0")
def test_an_arm_of_zeros_is_mended_by_keywords_of_the_environment(tmp_path: Path) -> None:
    urdf = str(arm_file(tmp_path, arm(inertial="", limit=ZERO)))
    mended: dict[str, Any] = {"default_mass": 1.0, "effort_limit": 50.0, "velocity_limit": 2.0}
    with pytest.raises(GymMaraError, match="cannot be simulated with dynamics"):
        MaraEnv(robot=urdf, ee_frame=TOOL, backend="dart")
    env = MaraEnv(robot=urdf, ee_frame=TOOL, backend="dart", **mended)
    env.reset(seed=0)
    for _ in range(150):
        env.step(np.array([0.5, 0.6, -0.7], np.float32))
    np.testing.assert_allclose(env.simulation.backend.state.q[0], [0.5, 0.6, -0.7], atol=1e-3)
    env.close()
