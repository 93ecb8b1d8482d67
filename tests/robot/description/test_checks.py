"""What is broken in a URDF is an error that names the link or joint; what is only ignored is a warning."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from tests.helpers import upright_arm, write

INERTIA = '<inertia ixx="0.01" iyy="0.01" izz="0.005" ixy="0" ixz="0" iyz="0"/>'
BOX = '<geometry><box size="0.06 0.06 0.22"/></geometry>'
LIMIT = '<limit lower="-2" upper="2" effort="50" velocity="2"/>'
COLLISION = f'<collision><origin xyz="0 0 0.15"/>{BOX}</collision>'
RED = '<material name="red"><color rgba="1 0 0 1"/></material>'


def _load(folder: Path, old: str, new: str) -> RobotModel:
    """Load the arm with one part replaced where it occurs first; the whole file ends with the placeholder </robot>."""
    text = upright_arm()
    assert old in text
    return RobotModel.load(write(folder / "arm.urdf", text.replace(old, new, 1)), "tool")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (INERTIA, "", "<inertial> of link 'l1' has no <inertia>"),
        ('<mass value="1"/>', "", "<inertial> of link 'l1' has no <mass>"),
        ('<mass value="1"/>', "<mass>1</mass>", "<mass> of link 'l1' has no value"),
        ('<mass value="1"/>', '<mass value="-1"/>', "<mass> of link 'l1' has value='-1'"),
        ('izz="0.005"', "", "<inertia> of link 'l1' has no izz"),
        ('ixx="0.01"', 'ixx="-0.01"', "<inertia> of link 'l1' has the principal moment -0.01"),
        ('ixy="0"', 'ixy="0.02"', "<inertia> of link 'l1' has the principal moment -0.01"),
        ('ixx="0.01"', 'ixx="1_0"', "<inertia> of link 'l1' has ixx='1_0'"),
        ('xyz="0 0 0.15"/><geo', 'xyz="0 0.15"/><geo', "<origin> of link 'l1' has xyz='0 0.15'; 3"),
        ('xyz="0 0 0.15"/><geo', 'rpy="0 0 x"/><geo', "<origin> of link 'l1' has rpy='0 0 x'"),
        (BOX, "", "<collision> of link 'l1' has no <geometry>"),
        (BOX, "<geometry/>", "<geometry> of link 'l1' holds nothing"),
        (BOX, "<geometry><cube/></geometry>", "<geometry> of link 'l1' holds <cube>"),
        (BOX, BOX.replace("<box", '<sphere radius="1"/><box'), "link 'l1' holds <sphere>, <box>"),
        (BOX, "<geometry><box/></geometry>", "<box> of link 'l1' has no size"),
        (COLLISION, "<visual/>", "<visual> of link 'l1' has no <geometry>"),
        ('name="l2"', "", "link.* has no name"),
        ('name="l2"', 'name=""', "link '' has no name"),
        ('name="l2"', 'name="l1"', "2 elements <link> have the name 'l1'"),
        ('name="j2"', 'name="j1"', "2 elements <joint> have the name 'j1'"),
        (LIMIT, "", "joint 'j1' is revolute and has no <limit>"),
        (LIMIT, '<limit effort="50"/>', "the <limit> of joint 'j1' lacks velocity"),
        ('lower="-2"', 'lower="3"', "joint 'j1' has the lower limit 3, above its upper limit 2"),
        ('axis xyz="0 0 1"', 'axis xyz="0 0 0"', "the axis of joint 'j1' has length zero"),
        ('axis xyz="0 0 1"', "axis", "<axis> of joint 'j1' has no xyz"),
        ('type="revolute"', 'type="rotary"', "joint 'j1' has type='rotary'; allowed are revolute"),
        ('type="revolute"', "", "joint 'j1' has no type"),
        ('<parent link="base"/>', "", "joint 'j1' has no <parent>"),
        ('<parent link="base"/>', "<parent/>", "<parent> of joint 'j1' has no link"),
        (
            'parent link="base"',
            'parent link="bass"',
            "the parent of joint 'j1' is 'bass', which is",
        ),
        ('child link="l1"', 'child link="l2"', "link 'l2' is the child of joint 'j1' and of joint"),
        ('parent link="base"', 'parent link="l3"', "the joints form a loop"),
        (
            "</robot>",
            '<link name="camera"/></robot>',
            "2 links are the child of no joint: base, ca",
        ),
        ("</robot>", f"{RED}{RED}</robot>", "2 elements <material> have the name 'red'"),
        (
            'type="revolute">',
            'type="continuous"><limit effort="50"/>',
            "the <limit> of joint 'j1' lacks velocity",
        ),
    ],
)
def test_a_broken_part_is_an_error_that_names_it(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        _load(tmp_path, old, new)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (COLLISION, f"<Collision>{BOX}</Collision>", "link 'l1': URDF has no element <Collision>"),
        (COLLISION, f"<colision>{BOX}</colision>", "Probably <collision> is meant"),
        (COLLISION, BOX, "link 'l1': <geometry> stands in <link>; it is ignored"),
        ("</robot>", f"{COLLISION}</robot>", "<collision> stands in <robot>"),
        (COLLISION, f"{COLLISION}{INERTIA}", "<inertia> stands in <link>"),
        (
            'xyz="0 0 0.02"',
            'XYZ="0 0 0.02"',
            "joint 'j1': <origin> has no attribute 'XYZ'.* Probably 'xyz",
        ),
        (INERTIA, INERTIA + INERTIA, "link 'l1': <inertial> has 2 elements <inertia>.*the first"),
        ('<origin xyz="0 0 0.02"/>', "<origin>0 0 0.02</origin>", "<origin> holds the text '0 0 0"),
    ],
)
def test_what_the_parser_ignores_is_a_warning(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    with pytest.warns(UserWarning, match=message):
        _load(tmp_path, old, new)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("</robot>", '<gazebo reference="l1"><collision/><mass>1</mass></gazebo></robot>'),
        (COLLISION, f'{COLLISION}<sensor name="s"><origin>0 0 1</origin></sensor>'),
        (COLLISION, f'<visual>{BOX}<material name=""><texture filename=""/></material></visual>'),
        (LIMIT, LIMIT.replace("<limit", '<limit acceleration="1"')),
        ('xyz="0 0 0.02"', 'xyz=" 0  0 0.02 "'),
        ('effort="50"', 'effort=" 50 "'),
        ('<robot name="upright">', '<robot name="upright" xmlns:xacro="http://ros.org/xacro">'),
    ],
)
def test_extensions_and_habits_of_other_programs_load_without_a_word(
    tmp_path: Path, old: str, new: str
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = _load(tmp_path, old, new)
    assert robot.num_joints == 3
    assert sum(inertia.mass for inertia in robot.model.inertias) == 3.0
    assert robot.model.jointPlacements[1].translation[2] == 0.02
