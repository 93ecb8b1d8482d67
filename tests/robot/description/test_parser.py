"""What C++ writes to standard error while it parses is in the exception, or in a finding."""

from __future__ import annotations

import os
from pathlib import Path

import pinocchio as pin
import pytest

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.description.parser import parsing
from tests.helpers import upright_arm, write


def test_the_reason_of_the_parser_is_in_the_exception(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    text = upright_arm().replace("<axis", "<dynamics/><axis", 1)
    with pytest.raises(GymMaraError, match=r"arm\.urdf.*no damping and no friction") as caught:
        RobotModel.load(write(tmp_path / "arm.urdf", text), "tool")
    assert "joint.cpp" not in str(caught.value), "places in the parser's source help nobody"
    assert capfd.readouterr().err == ""


def test_what_the_parser_writes_on_success_is_warned_of(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    build = pin.buildModelFromXML

    def with_a_warning(text: str) -> pin.Model:
        os.write(2, b"Warning: odd\n         at line 3 in /src/link.cpp\n")
        return build(text)

    monkeypatch.setattr(pin, "buildModelFromXML", with_a_warning)
    with pytest.warns(UserWarning, match=r"URDF: Warning: odd; the parser ignores it\."):
        RobotModel.load(write(tmp_path / "arm.urdf", upright_arm()), "tool")
    assert capfd.readouterr().err == ""


def test_standard_error_is_back_after_a_failure(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(KeyError), parsing(Path("arm.urdf")):
        raise KeyError
    os.write(2, b"heard\n")
    assert capfd.readouterr().err == "heard\n"


def test_a_process_without_standard_error_parses(capfd: pytest.CaptureFixture[str]) -> None:
    kept = os.dup(2)
    os.close(2)
    try:
        with pytest.raises(GymMaraError, match="reason"), parsing(Path("arm.urdf")):
            raise ValueError("reason")
    finally:
        os.dup2(kept, 2)
        os.close(kept)
