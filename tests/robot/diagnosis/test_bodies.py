"""Findings about bodies: what cannot be simulated with dynamics, and what is probably not meant."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from gym_mara.backends import make_backend
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import pickled
from tests.robot.arms import COLLISION, INERTIA, INERTIAL, TOOL, arm, arm_file

NO_INERTIA = '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'
FAULTS = {
    "no mass": (arm(inertial=""), "links l1, l2, l3: no mass"),
    "no inertia": (
        arm(inertial=INERTIAL.replace(INERTIA, NO_INERTIA)),
        "links l1, l2, l3: a mass, but no moment of inertia",
    ),
    "no inertia, no shapes": (
        arm(inertial=INERTIAL.replace(INERTIA, NO_INERTIA)).replace(COLLISION, "", 2),
        "links l1, l2, l3: a mass, but no moment of inertia",
    ),
}
HEAVY = arm(inertial=INERTIAL.replace('mass value="1"', 'mass value="1000000"'))
STRONG = {"effort_limit": 1e8}


def test_an_arm_without_a_fault_has_no_findings(tmp_path: Path) -> None:
    assert RobotModel.load(arm_file(tmp_path), TOOL).findings == ()


@pytest.mark.parametrize("backend", ["dart", "mujoco"])
@pytest.mark.parametrize("fault", FAULTS)
def test_only_backends_with_dynamics_refuse_what_they_cannot_simulate(
    tmp_path: Path, fault: str, backend: str
) -> None:
    text, message = FAULTS[fault]
    robot = RobotModel.load(arm_file(tmp_path, text), TOOL)
    make_backend("pinocchio", robot, 1, {})
    with pytest.raises(GymMaraError, match=message) as refused:
        make_backend(backend, robot, 1, {})
    assert "default_mass=…" in str(refused.value)


@pytest.mark.parametrize("name", ["dart", "mujoco"])
@pytest.mark.parametrize("fault", FAULTS)
def test_default_mass_mends_them_and_the_arm_moves_to_its_target(
    tmp_path: Path, fault: str, name: str
) -> None:
    robot = RobotModel.load(arm_file(tmp_path, FAULTS[fault][0]), TOOL, default_mass=1.0)
    assert not [finding for finding in robot.findings if finding.dynamics]
    backend = make_backend(name, robot, 1, {})
    target = np.array([[0.5, 0.6, -0.7]])
    for _ in range(150):
        state = backend.step(target)
    np.testing.assert_allclose(state.q, target, atol=1e-3)


def test_the_mass_of_a_link_that_is_fixed_to_the_moving_one_counts(tmp_path: Path) -> None:
    payload = (
        f'<link name="payload">{INERTIAL}</link><joint name="jp" type="fixed"><parent link="l3"/>'
        '<child link="payload"/></joint>'
    )
    text = arm(more=payload).replace(f'<link name="l3">{INERTIAL}', '<link name="l3">')
    assert RobotModel.load(arm_file(tmp_path, text), TOOL).findings == ()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('izz="0.005"', 'izz="0.03"', "larger than the sum of the others"),
        ('xyz="0 0 0.15"/><mass', 'xyz="0 0 150"/><mass', "centre of mass is far outside"),
        ('mass value="1"', 'mass value="1000000"', "more than 10000 kg"),
    ],
)
def test_an_implausible_inertia_is_one_warning_with_dynamics(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in INERTIAL
    text = arm(inertial=INERTIAL.replace(old, new))
    robot = RobotModel.load(arm_file(tmp_path, text), TOOL, **STRONG)
    make_backend("pinocchio", robot, 1, {})
    with pytest.warns(UserWarning, match=f"links l1, l2, l3: .*{message}") as warned:
        make_backend("dart", robot, 1, {})
    assert len(warned) == 1


def test_a_rounded_inertia_is_no_warning(tmp_path: Path) -> None:
    text = arm(inertial=INERTIAL.replace('izz="0.005"', 'izz="0.0201"'))
    assert RobotModel.load(arm_file(tmp_path, text), TOOL).findings == ()


def test_an_arm_warns_once_whatever_is_made_of_it(tmp_path: Path) -> None:
    robot = RobotModel.load(arm_file(tmp_path, HEAVY), TOOL, **STRONG)
    with pytest.warns(UserWarning, match="kg"):
        robot.require_dynamics()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot.require_dynamics()
        RobotModel.load(robot.urdf, TOOL, **STRONG).require_dynamics()
        pickled(robot).require_dynamics()
        RobotModel.inspect(robot.urdf, TOOL, **STRONG).require_dynamics()


def test_a_copy_has_the_findings(tmp_path: Path) -> None:
    robot = RobotModel.load(arm_file(tmp_path, HEAVY), TOOL, **STRONG)
    assert pickled(robot).findings == robot.findings != ()
