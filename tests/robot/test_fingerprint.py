"""The fingerprint of a robot: it changes with what a simulation uses of the robot, and with nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from gym_mara.robot import RobotModel
from gym_mara.robot.fingerprint import fingerprint
from tests.helpers import joint_xml, urdf_xml, write

ARM = urdf_xml(joint_xml(0), joint_xml(1), joint_xml(2))


def of(path: Path, text: str, ee_frame: str = "link3") -> str:
    """The fingerprint of the arm that a URDF describes."""
    return fingerprint(RobotModel.from_urdf(write(path / "arm.urdf", text), ee_frame))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<robot ", "<!-- a comment --><robot "),
        ('<joint name="joint0"', '<joint  name="joint0"'),
        ('mass value="1"', 'mass value="1.0"'),
    ],
)
def test_the_text_of_the_urdf_does_not_count(tmp_path: Path, old: str, new: str) -> None:
    assert old in ARM
    assert of(tmp_path, ARM.replace(old, new)) == of(tmp_path, ARM)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('xyz="0.3 0 0.2"', 'xyz="0.45 0 0.2"'),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 1 0"/>'),
        ('upper="1.5"', 'upper="1.6"'),
        ('effort="10"', 'effort="11"'),
        ('velocity="2"', 'velocity="3"'),
        ('mass value="1"', 'mass value="2"'),
        ('ixx="1"', 'ixx="2"'),
        ('radius="0.05"', 'radius="0.06"'),
        ('origin xyz="0.1 0 0"', 'origin xyz="0.2 0 0"'),
        ('<sphere radius="0.05"/>', '<box size="0.1 0.1 0.1"/>'),
    ],
)
def test_another_arm_has_another_fingerprint(tmp_path: Path, old: str, new: str) -> None:
    assert old in ARM
    assert of(tmp_path, ARM.replace(old, new)) != of(tmp_path, ARM)


def test_another_end_effector_is_another_arm(tmp_path: Path) -> None:
    text = ARM.replace(
        "</robot>",
        '<link name="tip"/><joint name="fixed" type="fixed"><parent link="link3"/><child link="tip"/>'
        '<origin xyz="0 0 0.1"/></joint></robot>',
    )
    assert of(tmp_path, text, "link3") != of(tmp_path, text, "tip")


def test_the_vertices_of_a_mesh_count_and_the_path_does_not(tmp_path: Path) -> None:
    def with_mesh(folder: str, height: float) -> str:
        (tmp_path / folder).mkdir()
        points = ("0 0 0", "0.05 0 0", "0 0.05 0", f"0 0 {height}")
        faces = ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))
        lines = [f"v {point}" for point in points]
        lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
        write(tmp_path / folder / "part.obj", "\n".join(lines) + "\n")
        text = ARM.replace('<sphere radius="0.05"/>', '<mesh filename="part.obj"/>')
        return of(tmp_path / folder, text)

    assert with_mesh("a", 0.05) == with_mesh("b", 0.05)
    assert with_mesh("c", 0.06) != with_mesh("d", 0.05)
