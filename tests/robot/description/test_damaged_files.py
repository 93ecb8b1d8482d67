"""Robot files from strangers: each loads, or ends in a GymMaraError at once."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from tests.helpers import joint_xml, urdf_xml, write

STICK = urdf_xml(*(joint_xml(number) for number in range(3)))
SPHERE = '<sphere radius="0.05"/>'
BILLION_LAUGHS = (
    '<!DOCTYPE robot [<!ENTITY l1 "lol">'
    + "".join(f'<!ENTITY l{n} "{10 * f"&l{n - 1};"}">' for n in range(2, 11))
    + "]><robot name='&l10;'/>"
)


def _load(urdf: Path) -> RobotModel:
    return RobotModel.load(urdf, "link3")


def test_a_pipe_a_device_and_a_folder_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.urdf")
    (tmp_path / "device.urdf").symlink_to("/dev/zero")
    (tmp_path / "folder.urdf").mkdir()
    with (tmp_path / "huge.urdf").open("wb") as stream:
        stream.truncate(2**35)  # sparse
    for name in ("pipe", "device", "folder", "huge"):
        with pytest.raises(GymMaraError, match=rf"cannot read .*{name}\.urdf"):
            _load(tmp_path / f"{name}.urdf")
    os.mkfifo(tmp_path / "pipe.srdf")
    with pytest.raises(GymMaraError, match=r"cannot read .*pipe\.srdf"):
        RobotModel.from_urdf(write(tmp_path / "stick.urdf", STICK), "link3", tmp_path / "pipe.srdf")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BILLION_LAUGHS, "broken XML"),
        ('<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>', "broken XML"),
        ('<?xml version="1.0" encoding="none"?><robot/>', "broken XML"),
        ("<robot>" + 100_000 * "<a>" + 100_000 * "</a>" + "</robot>", "nested more than 100 deep"),
        (
            STICK.replace("</robot>", 1000 * '<link name="x"/>' + "</robot>"),
            "1,004 elements <link>",
        ),
        (
            urdf_xml(*(joint_xml(number) for number in range(200))).replace("link200", "tool"),
            "200 joints lead to 'tool'",
        ),
        (
            STICK.replace('parent link="link0"', 'parent link="link3"'),
            "the joints form a loop at 'link",
        ),
        (STICK.replace('lower="-2"', 'lower="nan"'), "has lower='nan'"),
        (STICK.replace('upper="1.5"', 'upper="1e308"'), "has upper='1e308'"),
        (STICK.replace('upper="1.5"', 'upper=""'), "has upper=''"),
        (STICK.replace('lower="-2"', 'lower="2"'), "lower limit 2, above its upper limit 1.5"),
        (STICK.replace('axis xyz="0 0 1"', 'axis xyz="0 0 0"'), "axis of joint .* length zero"),
        (STICK.replace('axis xyz="0 0 1"', 'axis xyz="1"'), "has xyz='1'; 3 finite"),
        (STICK.replace('radius="0.05"', 'radius="-1"'), "radius='-1'; 1 finite .* from 0"),
        (STICK.replace('mass value="1"', 'mass value="${mass}"'), "value='\\${mass}'"),
        (STICK.replace('name="link2"', 'name="link1"'), "2 elements <link> have the name 'link1'"),
    ],
)
def test_a_hostile_urdf_is_refused(tmp_path: Path, text: str, message: str) -> None:
    frame = "tool" if "tool" in text else "link3"
    with pytest.raises(GymMaraError, match=message):
        RobotModel.load(write(tmp_path / "stick.urdf", text), frame)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("package://meshes/pipe.stl", "pipe.stl.*not a plain file"),
        ("/dev/zero", "/dev/zero.*not a plain file"),
        ("file:///tmp", "/tmp.*not a plain file"),
        ("package://meshes/huge.stl", "meshes of .* larger than 1,073,741,824 bytes"),
        ("package://meshes/garbage.stl", "garbage.stl.*no triangles"),
        ("package://meshes/none.stl", "none.stl"),
        ("package://meshes/nan.obj", "nan.obj.*three finite numbers"),
        ("http://localhost/a.stl", "http"),
    ],
)
def test_a_hostile_mesh_is_refused(tmp_path: Path, name: str, message: str) -> None:
    (meshes := tmp_path / "meshes").mkdir()
    os.mkfifo(meshes / "pipe.stl")
    with (meshes / "huge.stl").open("wb") as stream:
        stream.truncate(2**35)
    (meshes / "garbage.stl").write_bytes(bytes(range(256)) * 4)
    write(meshes / "nan.obj", "v nan nan nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    text = STICK.replace(SPHERE, f'<mesh filename="{name}"/>', 1)
    with pytest.raises(GymMaraError, match=message) as caught:
        _load(write(tmp_path / "stick.urdf", text))
    assert "\n" not in str(caught.value)
