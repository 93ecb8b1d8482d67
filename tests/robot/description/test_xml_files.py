"""Files that are not URDFs or SRDFs, but almost, are answered by what to do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from tests.helpers import upright_arm, write

XACRO = '<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include filename="a"/></robot>'


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("arm.urdf.xacro", XACRO, "is xacro.*<xacro:include>.*xacro arm.urdf.xacro > arm_expanded"),
        ("arm.xacro", XACRO, "xacro arm.xacro > arm_expanded.urdf"),
        ("arm.urdf", XACRO, "xacro arm.urdf > arm_expanded.urdf"),
        ("arm.xacro", "<robot><xacro:arm/></robot>", "is xacro"),
        ("arm.urdf", upright_arm().replace('"2"', '"${pi/2}"'), "<limit> has upper='\\${pi/2}'"),
        ("arm.urdf", upright_arm().replace('"l1"', '"$(arg l)"', 1), r"name='\$\(arg l\)'"),
    ],
)
def test_xacro_is_answered_by_how_to_expand_it(
    tmp_path: Path, name: str, text: str, message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        RobotModel.load(str(write(tmp_path / name, text)), "tool")


@pytest.mark.parametrize("used", ["", "${width}"])
def test_a_property_of_xacro_that_is_not_used_is_no_template(tmp_path: Path, used: str) -> None:
    element = '<xacro:property name="width" value=".2"/><xacro:arg name="a" default="1"/>'
    text = re.sub(
        "<robot[^>]*>", f'<robot name="{used}" xmlns:xacro="xacro">{element}', upright_arm()
    )
    urdf = write(tmp_path / "arm.urdf", text.replace('upper="2"', f'upper="{used or 2}"'))
    if used:
        with pytest.raises(GymMaraError, match=r"<limit> has upper='\${width}'"):
            RobotModel.load(urdf, "tool")
    else:
        assert RobotModel.load(urdf, "tool").num_joints == 3


@pytest.mark.parametrize(
    ("joint", "message"),
    [
        ('<joint name="j1"/>', "has a <joint> without 'value'"),
        ('<joint name="j1" value="${pi/2}"/>', r"SRDF .* is xacro.*xacro arm\.srdf > arm_expanded"),
    ],
)
def test_an_srdf_with_residue_is_refused(tmp_path: Path, joint: str, message: str) -> None:
    state = f'<robot xmlns:xacro="x"><group_state name="a" group="b">{joint}</group_state></robot>'
    write(tmp_path / "arm.srdf", state)
    with pytest.raises(GymMaraError, match=message):
        RobotModel.load(write(tmp_path / "arm.urdf", upright_arm()), "tool")


def test_a_urdf_may_have_any_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("arm.URDF", "arm"):
        assert RobotModel.load(str(write(tmp_path / name, upright_arm())), "tool").num_joints == 3
    monkeypatch.chdir(tmp_path)
    assert RobotModel.load("./arm", "tool").num_joints == 3
    with pytest.raises(GymMaraError, match=r"no robot's name; .* write '\./arm'"):
        RobotModel.load("arm", "tool")


def test_a_folder_is_answered_by_its_urdfs(tmp_path: Path) -> None:
    write(tmp_path / "arm.urdf", upright_arm())
    with pytest.raises(GymMaraError, match=r"is a folder; name one of its URDFs: arm\.urdf"):
        RobotModel.load(str(tmp_path), "tool")


def test_broken_xml_is_answered_by_its_line(tmp_path: Path) -> None:
    text = upright_arm().replace("<link", "\n<<<<<<< HEAD\n<link", 1)
    with pytest.raises(GymMaraError, match=r"broken XML: .*line 3, column 1: '<<<<<<< HEAD'"):
        RobotModel.load(str(write(tmp_path / "arm.urdf", text)), "tool")


@pytest.mark.parametrize("content", [b"", b"\n", b"\xff\xfe<\x00", b"<robot>"])
def test_broken_xml_without_such_a_line_is_still_an_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "arm.urdf").write_bytes(content)
    with pytest.raises(GymMaraError, match="broken XML"):
        RobotModel.load(str(tmp_path / "arm.urdf"), "tool")


@pytest.mark.parametrize("name", ["", ' name=""'])
def test_a_robot_without_a_name_gets_that_of_its_file(tmp_path: Path, name: str) -> None:
    text = re.sub("<robot[^>]*>", f"<robot{name}>", upright_arm())
    robot = RobotModel.load(str(write(tmp_path / "bar.urdf", text)), "tool")
    assert robot.name == "bar"
    assert [finding.part for finding in robot.findings if "name" in finding.message] == ["<robot>"]
