"""gym-mara robot: what it finds out about an arm's files, and what it writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import pytest

from gym_mara.backends import simulated_backends, usable_backends
from gym_mara.robot import RobotModel
from tests.helpers import Cli, write
from tests.robot.arms import FOLDED, FOLLOWER, LIMIT, TOOL, UPRIGHT_REACH, arm, arm_file


def _json(gym_mara: Cli, *arguments: object) -> tuple[int, dict[str, Any]]:
    code, out, _ = gym_mara("robot", *arguments, "--json")
    return code, json.loads(out)


def test_an_arm_without_a_fault(gym_mara: Cli, tmp_path: Path) -> None:
    code, out, err = gym_mara("robot", arm_file(tmp_path), "--ee-frame", TOOL)
    assert (code, err) == (0, "")
    assert "Nothing is wrong with the files." in out
    assert all(name in out for name in ("j1", "j2", "j3", "l1", "l2", "l3"))
    assert "3 are checked; 3 joined by a joint" in out
    assert "Backend dart: works" in out
    assert "Backend pinocchio: works" in out


def test_the_json_has_the_same(gym_mara: Cli, tmp_path: Path) -> None:
    urdf = arm_file(tmp_path)
    code, found = _json(gym_mara, urdf, "--ee-frame", TOOL)
    assert code == 0
    assert (found["robot"], found["urdf"], found["ee_frame"]) == ("arm", str(urdf), TOOL)
    assert found["joints"][1] == {
        "name": "j2",
        "type": "revolute",
        "axis": [0.0, 1.0, 0.0],
        "lower": -2.0,
        "upper": 2.0,
        "velocity": 2.0,
        "effort": 50.0,
        "link": "l2",
        "mass": 1.0,
    }
    assert found["reach"] == pytest.approx(UPRIGHT_REACH - 0.02, abs=1e-3)
    assert found["pairs"]["checked"] == [["base", "l2"], ["base", "l3"], ["l1", "l3"]]
    assert list(found["backends"]) == simulated_backends()
    assert {name for name, error in found["backends"].items() if error is None} == set(
        usable_backends()[0]
    )


@pytest.mark.parametrize(
    ("backend", "code"), [("dart", 1), ("mujoco", 1), ("pinocchio", 0), (None, 0)], ids=str
)
def test_the_exit_code_says_whether_the_arm_works_on_the_backend(
    gym_mara: Cli, tmp_path: Path, backend: str | None, code: int
) -> None:
    urdf = arm_file(tmp_path, arm(inertial=""))
    chosen = [] if backend is None else ["--backend", backend]
    found = _json(gym_mara, urdf, "--ee-frame", TOOL, *chosen)
    assert found[0] == code
    assert [finding["part"] for finding in found[1]["findings"]] == ["links l1, l2, l3"]
    mended = _json(gym_mara, urdf, "--ee-frame", TOOL, *chosen, "--set", "default_mass=1")
    assert mended[0] == 0
    assert mended[1]["findings"] == []


def test_an_arm_that_cannot_move_is_shown_with_a_warning(gym_mara: Cli, tmp_path: Path) -> None:
    urdf = arm_file(tmp_path, arm(limit='<limit effort="1" velocity="1"/>'))
    code, out, _ = gym_mara("robot", urdf, "--ee-frame", TOOL)
    assert code == 0
    assert "the arm cannot move" in out
    assert "j3" in out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (arm(limit=LIMIT.replace('"2"', '"nan"')), "<limit> of joint 'j1'"),
        ("<robot><link", "is broken XML"),
    ],
)
def test_a_broken_file_is_one_line(gym_mara: Cli, tmp_path: Path, text: str, message: str) -> None:
    code, out, err = gym_mara("robot", arm_file(tmp_path, text), "--ee-frame", TOOL)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert message in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.urdf"], "there is no such file"),
        (["ur4"], "unknown robot 'ur4'. Did you mean"),
        (["arm.urdf", "--ee-frame", "hand"], "has no link 'hand'"),
        (["arm.urdf", "--ee-frame", TOOL, "--set", "gamma=1"], "unknown option of a robot 'gamma'"),
        (["arm.urdf", "--ee-frame", TOOL, "--set", "default_mass=-1"], "default_mass must be"),
        (["arm.urdf", "--ee-frame", TOOL, "--picture", "a.gif"], "unknown format of a picture"),
    ],
)
def test_what_it_cannot_look_at_is_an_error(
    gym_mara: Cli,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    message: str,
) -> None:
    arm_file(tmp_path)
    monkeypatch.chdir(tmp_path)
    code, out, err = gym_mara("robot", *arguments)
    assert (code, out) == (2, "")
    assert message in err


def test_without_a_frame_it_offers_some(gym_mara: Cli, tmp_path: Path) -> None:
    code, _, err = gym_mara("robot", arm_file(tmp_path))
    assert code == 2
    assert all(link in err for link in ("l2", "l3"))
    assert err.splitlines()[-1].endswith("such as --ee-frame tool")


def test_a_robot_of_the_catalogue(gym_mara: Cli) -> None:
    code, found = _json(gym_mara, "mara", "--backend", "pinocchio")
    assert code == 0
    assert found["default_target"]["position"] == [-0.40028, 0.095615, 0.72466]


def test_a_written_srdf_is_read_from_then_on(gym_mara: Cli, tmp_path: Path) -> None:
    urdf = arm_file(tmp_path, arm(origins=FOLDED))
    elsewhere = "--write-srdf", tmp_path / "other.srdf"
    _, out, _ = gym_mara("robot", urdf, "--ee-frame", TOOL, *elsewhere)
    assert "they touch in the start pose, but not in all poses" in out
    write_srdf = "--write-srdf", tmp_path / "arm.srdf"
    code, out, err = gym_mara("robot", urdf, "--ee-frame", TOOL, *write_srdf)
    assert code == 0
    assert "Nothing is wrong with the files" in out
    assert "are disabled: " in err
    assert "Adjacent 3" in err
    assert _json(gym_mara, urdf)[1]["findings"] == []
    assert RobotModel.load(urdf).ee_frame == TOOL


@pytest.mark.parametrize(("option", "name"), [("--write-srdf", "x.srdf"), ("--picture", "x.png")])
def test_an_existing_file_is_never_overwritten(
    gym_mara: Cli, tmp_path: Path, option: str, name: str
) -> None:
    existing = write(tmp_path / name, "mine")
    arguments = arm_file(tmp_path), "--ee-frame", TOOL, option, existing
    code, _, err = gym_mara("robot", *arguments)
    assert code == 2
    assert "exists and is not overwritten" in err
    assert existing.read_text() == "mine"


@pytest.mark.parametrize("more", ["", FOLLOWER], ids=["chain", "follower"])
def test_the_picture_shows_the_arm(gym_mara: Cli, tmp_path: Path, more: str) -> None:
    file, urdf = tmp_path / "arm.png", arm_file(tmp_path, arm(more=more))
    assert gym_mara("robot", urdf, "--ee-frame", TOOL, "--picture", file)[0] == 0
    picture = imageio.imread(file)
    assert picture.shape == (960, 1280, 3)
    assert (abs(picture.astype(int) - picture[0, 0]).max(axis=-1) > 60).mean() > 0.01
