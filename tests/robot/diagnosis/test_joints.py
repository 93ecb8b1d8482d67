"""Findings about joints: limits that are missing, zero or too low, and joints that follow others."""

from __future__ import annotations

import multiprocessing
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from gym_mara.backends import make_backend
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from tests.robot.arms import COLLISION, INERTIAL, LIMIT, TOOL, arm, arm_file

NO_LIMIT = '<limit effort="50" velocity="2"/>'
FAULTS = {
    "effort 0": (arm(limit=LIMIT.replace("50", "0")), "effort limit 0", "effort_limit=…"),
    "velocity 0": (
        arm(limit=LIMIT.replace('velocity="2"', 'velocity="0"')),
        "velocity limit 0",
        "velocity_limit=…",
    ),
    "no effort": (arm(kind="continuous", limit=""), "no effort limit", "effort_limit=…"),
    "no velocity": (arm(kind="continuous", limit=""), "no velocity limit", "velocity_limit=…"),
}


@pytest.mark.parametrize("backend", ["dart", "mujoco"])
@pytest.mark.parametrize("fault", FAULTS)
def test_only_backends_with_dynamics_refuse_limits_that_are_zero_or_missing(
    tmp_path: Path, fault: str, backend: str
) -> None:
    text, message, remedy = FAULTS[fault]
    robot = RobotModel.inspect(arm_file(tmp_path, text), TOOL)
    make_backend("pinocchio", robot, 1, {})
    with pytest.raises(GymMaraError, match=f"joints j1, j2, j3: {message}") as refused:
        make_backend(backend, robot, 1, {})
    assert remedy in str(refused.value)


def test_limits_that_are_given_mend_them(tmp_path: Path) -> None:
    urdf = arm_file(tmp_path, FAULTS["no effort"][0])
    robot = RobotModel.load(urdf, TOOL, effort_limit=50, velocity_limit=2)
    assert [f.message for f in robot.findings] == ["continuous, without end stops"]


@pytest.mark.parametrize(
    "text",
    [
        FAULTS["velocity 0"][0],
        FAULTS["no velocity"][0],
        arm().replace(LIMIT, NO_LIMIT, 1),
        arm(kind="prismatic").replace(LIMIT, NO_LIMIT, 1),
    ],
    ids=["velocity 0", "no velocity", "frozen", "frozen prismatic"],
)
@pytest.mark.filterwarnings("ignore:.*the lower limit equals the upper limit")
@pytest.mark.filterwarnings("ignore:.*velocity limit 0")
def test_the_spaces_of_such_arms_have_bounds_that_differ_and_are_sensible(
    tmp_path: Path, text: str
) -> None:
    env = gymnasium.make("gym_mara/MARA-v0", robot=str(arm_file(tmp_path, text)), ee_frame=TOOL)
    env.reset(seed=0)  # a test fails by a warning, such as Gymnasium's
    observation, *_ = env.step(env.action_space.sample())
    assert observation in env.observation_space
    for space in (env.observation_space, env.action_space):
        assert isinstance(space, gymnasium.spaces.Box)
        assert (space.low < space.high).all()
        assert np.abs([space.low, space.high]).max() < 100.0
    env.close()


@pytest.mark.parametrize("name", ["MARA-v0", "MARAReach-v0", "MARAPose-v0"])
@pytest.mark.parametrize("speed", ["0", "1e-30"])
def test_an_arm_of_velocity_0_moves_and_sees_finite_numbers_where_joints_jump(
    tmp_path: Path, name: str, speed: str
) -> None:
    urdf = arm_file(
        tmp_path, FAULTS["velocity 0"][0].replace('velocity="0"', f'velocity="{speed}"')
    )
    with pytest.warns(UserWarning, match="joints j1, j2, j3: velocity limit 0; .* 1 rad/s"):
        env = gymnasium.make(f"gym_mara/{name}", robot=str(urdf), ee_frame=TOOL, action="relative")
    backend = env.unwrapped.simulation.backend  # type: ignore[attr-defined]
    observation, _ = env.reset(seed=0)
    start = backend.state.q
    for _ in range(3):
        assert np.isfinite(observation).all()
        assert observation in env.observation_space
        observation, *_ = env.step(np.ones(3, np.float32))
    moved = backend.state.q - start
    assert (moved > 0.0).all()
    assert (moved < 3.001 * 0.02).all(), "1 rad/s for three steps of 0.02 s"
    env.close()


def test_no_velocity_limit_is_a_note_where_joints_jump(tmp_path: Path) -> None:
    robot = RobotModel.inspect(arm_file(tmp_path, FAULTS["no velocity"][0]), TOOL)
    (note,) = [f for f in robot.findings if f.message == "no velocity limit" and not f.dynamics]
    assert (note.severity, note.part) == ("note", "joints j1, j2, j3")


def test_an_arm_that_cannot_move_is_a_warning(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"joints j1, j2, j3: .*; the arm cannot move"):
        RobotModel.load(arm_file(tmp_path, arm(limit=NO_LIMIT)), TOOL)


def test_a_joint_that_cannot_move_is_a_warning(tmp_path: Path) -> None:
    text = arm().replace(LIMIT, NO_LIMIT, 1)
    with pytest.warns(UserWarning, match="joint j1: the lower limit equals the upper"):
        RobotModel.load(arm_file(tmp_path, text), TOOL)


@pytest.mark.parametrize(("written", "missing"), [('lower="-2"', "upper"), ('upper="2"', "lower")])
def test_one_missing_position_limit_is_a_warning(
    tmp_path: Path, written: str, missing: str
) -> None:
    text = arm().replace(LIMIT, f'<limit {written} effort="50" velocity="2"/>', 1)
    with pytest.warns(UserWarning, match=f"joint j1: .* but no {missing}=; it counts as 0"):
        robot = RobotModel.load(arm_file(tmp_path, text), TOOL)
    assert getattr(robot, missing)[0] == 0.0


# Motors.


def _lying(effort: float) -> str:
    """An arm that lies along x in its start pose, where gravity exerts 5.886 Nm on j2 and 1.4715 Nm on j3."""
    flat = ('xyz="0 0 0.2"', 'xyz="0 0 0" rpy="0 1.57079633 0"', 'xyz="0 0 0.3"')
    return arm(origins=flat, limit=LIMIT.replace("50", str(effort)))


def test_the_weight_in_the_start_pose_is_that_of_the_start_pose(tmp_path: Path) -> None:
    text = _lying(3.0).replace("1.57079633", "1.2")  # 5.886 Nm · sin 1.2
    with pytest.warns(UserWarning, match=r"joint j2: .* in its start pose: 3 < 5\.49 Nm"):
        RobotModel.load(arm_file(tmp_path, text), TOOL).require_dynamics()


@pytest.mark.parametrize("name", ["dart", "mujoco"])
def test_a_motor_that_cannot_hold_the_arm_at_home_is_a_warning(tmp_path: Path, name: str) -> None:
    robot = RobotModel.load(arm_file(tmp_path, _lying(3.0)), TOOL)
    with pytest.warns(UserWarning, match=r"joint j2: .* in its start pose: 3 < 5\.89 Nm") as warned:
        backend = make_backend(name, robot, 1, {})
    assert len(warned) == 1
    for _ in range(25):
        state = backend.step(robot.home[None])
    assert abs(state.q[0, 1]) > 0.5, "the arm has dropped"


def test_a_motor_that_cannot_hold_the_arm_elsewhere_is_a_warning(tmp_path: Path) -> None:
    robot = RobotModel.load(arm_file(tmp_path, arm(limit=LIMIT.replace("50", "3"))), TOOL)
    with pytest.warns(UserWarning, match=r"joint j2: .* in some poses: 3 < 5\.8") as warned:
        make_backend("dart", robot, 1, {})
    assert len(warned) == 1


@pytest.mark.parametrize("name", ["dart", "mujoco"])
def test_a_motor_that_just_holds_the_arm_is_no_warning(tmp_path: Path, name: str) -> None:
    robot = RobotModel.load(arm_file(tmp_path, _lying(5.9)), TOOL)
    backend = make_backend(name, robot, 1, {})
    for _ in range(25):
        state = backend.step(robot.home[None])
    np.testing.assert_allclose(state.q[0], robot.home, atol=1e-3)


@pytest.mark.slow
def test_worker_processes_do_not_warn_again(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # A forked process would have the arm itself, not a copy.
    monkeypatch.setattr(multiprocessing, "Process", multiprocessing.get_context("spawn").Process)
    robot = RobotModel.load(arm_file(tmp_path, _lying(3.0)), TOOL)
    with pytest.warns(UserWarning, match="below the weight") as warned:
        backend = make_backend("dart", robot, 2, {"workers": 2})
    try:
        backend.step(np.tile(robot.home, (2, 1)))
    finally:
        backend.close()
    assert len(warned) == 1
    assert "below the weight" not in capfd.readouterr().err


# Joints that follow others.


def _with_follower(body: str, limit: str = 'lower="-2" upper="2"') -> str:
    """An arm with a joint f at its last link, which mimics j3."""
    return arm(
        more=f'<link name="finger">{body}</link><joint name="f" type="revolute"><parent link="l3"/>'
        '<child link="finger"/><origin xyz="0 0.2 0"/><axis xyz="0 1 0"/>'
        f'<limit {limit} effort="1" velocity="1"/><mimic joint="j3" multiplier="-1"/></joint>'
    )


@pytest.mark.parametrize("body", [COLLISION, INERTIAL])
def test_a_follower_that_can_touch_or_weighs_something_is_a_note(tmp_path: Path, body: str) -> None:
    robot = RobotModel.load(arm_file(tmp_path, _with_follower(body)), TOOL)
    (note,) = robot.findings
    assert (note.severity, note.part, note.dynamics) == ("note", "joint f", True)
    assert "mimics" in note.message


def test_a_follower_without_a_body_is_no_finding(tmp_path: Path) -> None:
    assert RobotModel.load(arm_file(tmp_path, _with_follower("")), TOOL).findings == ()


def test_a_follower_that_leaves_its_own_limits_is_a_note(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        urdf = arm_file(tmp_path, _with_follower("", 'lower="0" upper="2"'))
        (note,) = RobotModel.load(urdf, TOOL).findings
    assert (note.severity, note.part) == ("note", "joint f")
    assert "beyond its own limits" in note.message
