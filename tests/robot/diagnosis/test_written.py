"""Findings about what a URDF writes of its joints, and about the poses of its SRDF."""

from __future__ import annotations

from pathlib import Path

import pytest

from gym_mara.robot import RobotModel
from gym_mara.robot.diagnosis import Finding
from tests.robot.arms import LIMIT, TOOL, arm, arm_file


def _note(folder: Path, text: str, srdf: str | None = None) -> Finding:
    """The only finding of an arm, which is a note."""
    (note,) = RobotModel.load(arm_file(folder, text, srdf), TOOL).findings
    assert note.severity == "note"
    return note


def test_continuous_joints_are_a_note(tmp_path: Path) -> None:
    note = _note(
        tmp_path, arm().replace('name="j2" type="revolute"', 'name="j2" type="continuous"')
    )
    assert note.part == "joint j2"
    assert "±π" in note.effect


@pytest.mark.parametrize(
    ("soft", "shown"),
    [
        ('soft_lower_limit="-1.5" soft_upper_limit="1.9"', "[-1.5, 1.9]"),
        ('soft_upper_limit="1"', "[-2, 1]"),
        ('soft_lower_limit="-2" soft_upper_limit="2"', None),
        ('soft_lower_limit="-3" soft_upper_limit="2.0005"', None),
        ('soft_lower_limit="0" soft_upper_limit="0"', None),
        ("", None),
    ],
)
def test_narrower_soft_limits_are_a_note(tmp_path: Path, soft: str, shown: str | None) -> None:
    text = arm().replace(LIMIT, f'{LIMIT}<safety_controller k_velocity="10" {soft}/>', 1)
    if shown is None:
        assert RobotModel.load(arm_file(tmp_path, text), TOOL).findings == ()
    else:
        note = _note(tmp_path, text)
        assert note.part == "joint j1"
        assert note.message.endswith(f"j1 {shown}")


def test_floating_joints_are_a_note(tmp_path: Path) -> None:
    ball = (
        '<link name="ball"/><joint name="free" type="floating"><parent link="base"/><child link="ball"/>'
        '<origin xyz="1 0 0"/></joint>'
    )
    note = _note(tmp_path, arm(more=ball))
    assert (note.part, note.message) == ("joint free", "floating")


def test_an_srdf_without_a_pose_of_every_joint_is_a_note(tmp_path: Path) -> None:
    pose = '<group_state name="{}"><joint name="{}" value="0.5"/></group_state>'
    note = _note(tmp_path, arm(), pose.format("open", "jt") + pose.format("up", "j2"))
    assert "'up' lacks j1, j3" in note.message
    assert "the start pose is zero" in note.effect
