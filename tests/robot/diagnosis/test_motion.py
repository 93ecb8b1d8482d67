"""Findings about joints and bodies: what cannot be simulated with dynamics, and what is probably not meant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gym_mara.backends import make_backend
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import pickled
from tests.robot.arms import INERTIA, INERTIAL, LIMIT, TOOL, arm, arm_file

NO_INERTIA = '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'
FAULTS = {
    "no mass": (arm(inertial=""), "links l1, l2, l3: no mass", "default_mass=…"),
    "no inertia": (
        arm(inertial=INERTIAL.replace(INERTIA, NO_INERTIA)),
        "links l1, l2, l3: it has a mass, but no moment of inertia",
        "default_mass=…",
    ),
    "effort 0": (
        arm(limit=LIMIT.replace("50", "0")),
        "joints j1, j2, j3: effort limit 0",
        "effort_limit=…",
    ),
    "velocity 0": (
        arm(limit=LIMIT.replace('velocity="2"', 'velocity="0"')),
        "joints j1, j2, j3: velocity limit 0",
        "velocity_limit=…",
    ),
}


def test_an_arm_without_a_fault_has_no_findings(tmp_path: Path) -> None:
    assert RobotModel.load(arm_file(tmp_path), TOOL).findings == ()


@pytest.mark.parametrize("fault", FAULTS)
def test_only_backends_with_dynamics_refuse_what_they_cannot_simulate(
    tmp_path: Path, fault: str
) -> None:
    text, message, remedy = FAULTS[fault]
    robot = RobotModel.load(arm_file(tmp_path, text), TOOL)
    make_backend("pinocchio", robot, 1, {})
    with pytest.raises(GymMaraError, match=message) as refused:
        make_backend("dart", robot, 1, {})
    assert remedy in str(refused.value)


def test_the_mass_of_a_link_that_is_fixed_to_the_moving_one_counts(tmp_path: Path) -> None:
    payload = (
        f'<link name="payload">{INERTIAL}</link><joint name="jp" type="fixed"><parent link="l3"/>'
        '<child link="payload"/></joint>'
    )
    text = arm(more=payload).replace(f'<link name="l3">{INERTIAL}', '<link name="l3">')
    assert RobotModel.load(arm_file(tmp_path, text), TOOL).findings == ()


def test_an_arm_that_cannot_move_is_refused(tmp_path: Path) -> None:
    text = arm(limit='<limit effort="50" velocity="2"/>')
    with pytest.raises(GymMaraError, match=r"joints j1, j2, j3: the lower limit equals the upper"):
        RobotModel.load(arm_file(tmp_path, text), TOOL)


def test_a_joint_that_cannot_move_is_a_warning(tmp_path: Path) -> None:
    text = arm().replace(LIMIT, '<limit effort="50" velocity="2"/>', 1)
    with pytest.warns(UserWarning, match="joint j1: the lower limit equals the upper"):
        RobotModel.load(arm_file(tmp_path, text), TOOL)


def test_a_joint_without_limits_is_a_note(tmp_path: Path) -> None:
    robot = RobotModel.load(arm_file(tmp_path, arm(kind="continuous", limit="")), TOOL)
    notes = [(finding.severity, finding.message) for finding in robot.findings]
    assert notes == [("note", "no effort limit"), ("note", "no velocity limit")]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('izz="0.005"', 'izz="0.03"', "larger than the sum of the others"),
        ('xyz="0 0 0.15"/><mass', 'xyz="0 0 150"/><mass', "centre of mass is far outside"),
        ('mass value="1"', 'mass value="1000000"', "more than 10000 kg"),
    ],
)
def test_an_implausible_inertia_is_one_warning(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in INERTIAL
    text = arm(inertial=INERTIAL.replace(old, new))
    with pytest.warns(UserWarning, match=f"links l1, l2, l3: .*{message}") as warned:
        RobotModel.load(arm_file(tmp_path, text), TOOL)
    assert len(warned) == 1


def test_a_rounded_inertia_is_no_warning(tmp_path: Path) -> None:
    text = arm(inertial=INERTIAL.replace('izz="0.005"', 'izz="0.0201"'))
    assert RobotModel.load(arm_file(tmp_path, text), TOOL).findings == ()


def test_a_copy_has_the_findings_and_does_not_warn(tmp_path: Path) -> None:
    text = arm(inertial=INERTIAL.replace('mass value="1"', 'mass value="1000000"'))
    with pytest.warns(UserWarning, match="kg"):
        robot = RobotModel.load(arm_file(tmp_path, text), TOOL)
    assert pickled(robot).findings == robot.findings != ()


def test_default_mass_moves_an_arm_without_masses_to_its_target(tmp_path: Path) -> None:
    urdf = arm_file(tmp_path, FAULTS["no mass"][0])
    robot = RobotModel.load(urdf, TOOL, default_mass=1.0)
    assert robot.findings == ()
    backend = make_backend("dart", robot, 1, {})
    target = np.array([[0.5, 0.6, -0.7]])
    for _ in range(150):
        state = backend.step(target)
    np.testing.assert_allclose(state.q, target, atol=1e-3)
