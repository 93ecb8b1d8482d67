"""The action of a simulated arm, with stand-ins for control_msgs and for the server, which only a sourced ROS has."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy")

import numpy as np

from gym_mara.backends import make_backend
from gym_mara.robot import RobotModel
from gym_mara.ros2 import messages
from gym_mara.ros2.sim import follow_action
from gym_mara.ros2.sim.arm import SimulatedArm
from gym_mara.ros2.sim.follow_action import FollowAction
from tests.ros2.peers import Peer, eventually


class Result:
    INVALID_GOAL = -1
    error_code, error_string = 0, ""


class Goal:
    """The handle of a goal, which notes how it ended."""

    def __init__(self, trajectory: Any) -> None:
        self.request = SimpleNamespace(trajectory=trajectory)
        self.is_cancel_requested = False
        self.ended = ""

    def succeed(self) -> None:
        self.ended = "succeeded"

    def abort(self) -> None:
        self.ended = "aborted"

    def canceled(self) -> None:
        self.ended = "canceled"


class Logger:
    def warning(self, text: str, **_: Any) -> None: ...


@pytest.fixture
def arm(mara: RobotModel) -> SimulatedArm:
    return SimulatedArm(make_backend("pinocchio", mara, 1, {"servo_gain": 20.0}))


@pytest.fixture
def action(arm: SimulatedArm, monkeypatch: pytest.MonkeyPatch) -> FollowAction:
    kind = SimpleNamespace(Result=Result)
    monkeypatch.setattr(messages, "follow_joint_trajectory_type", lambda: kind)
    monkeypatch.setattr(follow_action, "ActionServer", lambda *_, **__: None)
    node = SimpleNamespace(get_logger=Logger, executor=None)
    return FollowAction(node, "follow", arm, lambda header: 0.0)


def run(action: FollowAction, arm: SimulatedArm, goal: Goal, ticks: int) -> Any:
    """The result, if the goal ends within so many ticks."""
    steps = action._execute(goal)
    for _ in range(ticks):
        try:
            steps.send(None)
        except StopIteration as end:
            return end.value
        arm.tick()
        action.update()
    return steps


def goal_of(mara: RobotModel, offset: float = 0.1) -> Goal:
    return Goal(messages.trajectory(mara.joint_names, mara.home + offset, None, 0.5))


def test_a_goal_succeeds_when_its_trajectory_is_over(
    action: FollowAction, arm: SimulatedArm, mara: RobotModel
) -> None:
    goal = goal_of(mara)
    assert run(action, arm, goal, 40).error_code == 0
    assert goal.ended == "succeeded"
    assert arm.time == pytest.approx(0.5)


def test_a_bad_goal_is_aborted(action: FollowAction, arm: SimulatedArm, mara: RobotModel) -> None:
    goal = goal_of(mara, np.nan)
    result = run(action, arm, goal, 1)
    assert (goal.ended, result.error_code) == ("aborted", -1)
    assert "finite" in result.error_string


def test_another_command_aborts_a_goal(
    action: FollowAction, arm: SimulatedArm, mara: RobotModel
) -> None:
    goal = goal_of(mara)
    steps = run(action, arm, goal, 5)
    arm.move_to(mara.home.tolist())
    arm.tick()
    action.update()
    with pytest.raises(StopIteration):
        steps.send(None)
    assert goal.ended == "aborted"


def test_a_goal_that_is_over_succeeds_though_another_command_comes_before_its_result(
    action: FollowAction, arm: SimulatedArm, mara: RobotModel
) -> None:
    goal = goal_of(mara)
    steps = run(action, arm, goal, 5)
    while action._running:
        arm.tick()
        action.update()
    arm.move_to(mara.home.tolist())
    with pytest.raises(StopIteration):
        steps.send(None)
    assert goal.ended == "succeeded"


def test_the_result_comes_at_once(
    action: FollowAction, arm: SimulatedArm, mara: RobotModel, peer: Peer
) -> None:
    action._node = peer.ros.node
    for _ in range(3):  # the executor looks by itself once a second
        goal = goal_of(mara)
        peer.ros.node.executor.create_task(action._execute(goal))
        eventually(lambda: action._running)
        time.sleep(0.1)  # it waits again
        while action._running:
            arm.tick()
            action.update()
        eventually(lambda goal=goal: goal.ended == "succeeded", 0.6)  # type: ignore[misc]


def test_a_goal_that_is_cancelled_stops_the_arm(
    action: FollowAction, arm: SimulatedArm, mara: RobotModel
) -> None:
    goal = goal_of(mara, 1.0)
    steps = run(action, arm, goal, 5)
    goal.is_cancel_requested = True
    for _ in range(10):
        action.update()
        arm.tick()
    with pytest.raises(StopIteration):
        steps.send(None)
    assert goal.ended == "canceled"
    assert not arm.state.qd.any()
