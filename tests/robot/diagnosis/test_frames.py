"""Which links are offered for the end-effector frame."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import pytest

from gym_mara.robot.catalog import find
from gym_mara.robot.diagnosis.frames import Frame, candidate_frames
from tests.helpers import joint_xml, urdf_xml
from tests.robot.arms import arm


def _candidates(text: str) -> list[Frame]:
    return candidate_frames(ElementTree.fromstring(text))


def test_the_tool_is_offered_first() -> None:
    assert _candidates(arm()) == [
        Frame("tool", 3, True),
        Frame("l3", 3, False),
        Frame("l2", 2, False),
    ]


def test_without_a_usual_name_the_last_link_is_offered() -> None:
    assert _candidates(urdf_xml(*map(joint_xml, range(4))))[0] == Frame("link4", 4, True)


def test_the_palm_is_offered_before_its_fingers() -> None:
    fingers = "".join(
        f'<link name="f{n}"/><joint name="jf{n}" type="prismatic"><parent link="link3"/><child link="f{n}"/></joint>'
        for n in (1, 2)
    )
    text = urdf_xml(*map(joint_xml, range(3))).replace("</robot>", f"{fingers}</robot>")
    assert _candidates(text)[0].link == "link3"


def test_the_gripper_is_offered_before_its_only_jaw() -> None:
    jaw = '<link name="jaw"/><joint name="j" type="revolute"><parent link="gripper"/><child link="jaw"/></joint>'
    text = urdf_xml(*map(joint_xml, range(3))).replace("link3", "gripper")
    assert _candidates(text.replace("</robot>", f"{jaw}</robot>"))[0].link == "gripper"


def test_a_urdf_without_joints_has_no_frames() -> None:
    assert _candidates('<robot name="block"><link name="block"/></robot>') == []


@pytest.mark.parametrize(
    ("name", "frame"), [("ur5", "tool0"), ("panda", "panda_hand_tcp"), ("xarm7", "link_eef")]
)
def test_the_frame_of_an_arm_of_the_catalogue_is_among_them(name: str, frame: str) -> None:
    assert frame in [f.link for f in _candidates(find(name).urdf.read_text())][:4]
