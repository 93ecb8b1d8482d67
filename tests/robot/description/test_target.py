"""The default target of a robot, a file beside its URDF."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gym_mara.collision.free_poses import reachable_pose
from gym_mara.envs import MaraEnv
from gym_mara.files import DamagedFileError
from gym_mara.robot import RobotModel
from gym_mara.robot.description.modules import MARA
from gym_mara.testing import pickled
from tests.helpers import joint_xml, urdf_xml, write

POSITION, QUATERNION = [0.3, 0.2, 0.5], [0.0, 0.6, 0.8, 0.0]


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    """An arm of one's own, with the name of another robot."""
    xml = urdf_xml(joint_xml(0), joint_xml(1, axis="0 1 0"))
    return write(tmp_path / "arm.urdf", xml.replace('"stick"', '"mara"'))


def _write_target(urdf: Path, text: str) -> None:
    write(urdf.with_name("arm.target.json"), text)


def test_a_name_gives_no_target(urdf: Path) -> None:
    robot = RobotModel.load(urdf, "link2")
    assert robot.name == "mara"
    assert robot.target is None
    position, quaternion = reachable_pose(robot)
    goal = MaraEnv(robot=robot).simulation.goal
    np.testing.assert_array_equal(goal.position, [position])
    np.testing.assert_allclose(np.abs(goal.quaternion), np.abs([quaternion]), atol=1e-12)


def test_a_file_beside_the_urdf_gives_the_target(urdf: Path) -> None:
    _write_target(urdf, json.dumps({"position": POSITION, "quaternion": QUATERNION}))
    loaded = RobotModel.load(str(urdf), "link2"), RobotModel.from_urdf(urdf, "link2")
    for robot in (*loaded, pickled(loaded[0])):
        goal = MaraEnv(robot=robot).simulation.goal
        np.testing.assert_array_equal(goal.position, [POSITION])
        np.testing.assert_allclose(goal.quaternion, [QUATERNION], atol=1e-12)


def test_the_modules_of_mara_have_its_target(mara: RobotModel) -> None:
    assert mara.target is not None
    assert RobotModel.from_modules(MARA).target == mara.target
    assert RobotModel.from_modules(["base", "motor_large", "motor_medium", "tool"]).target is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"position": [0, 0, 1]}',
        '{"position": [0, 1], "quaternion": [1, 0, 0, 0]}',
        '{"position": [0, 0, "1"], "quaternion": [1, 0, 0, 0]}',
        '{"position": [0, 0, NaN], "quaternion": [1, 0, 0, 0]}',
        '{"position": [0, 0, 1], "quaternion": [1, 0, 0, 1]}',
        '{"position": [0, 0, 1], "quaternion": [1, 0, 0, 0], "colour": "red"}',
    ],
)
def test_a_damaged_file_is_an_error_that_names_it(urdf: Path, text: str) -> None:
    _write_target(urdf, text)
    with pytest.raises(DamagedFileError, match=r"arm\.target\.json"):
        RobotModel.load(urdf, "link2")
