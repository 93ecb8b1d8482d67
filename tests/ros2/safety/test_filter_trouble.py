"""What stops the arm: commands that are none, bad states, clocks, and messages that are too old."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2.safety.filter import Mode
from tests.ros2.safety.arms import Arm, in_motion, state_of

NO_COMMANDS: dict[str, tuple[Any, str]] = {
    "nan": (
        np.array([0.0, np.nan, 0.0, 0.0, 0.0, 0.0]),
        "the command is not finite: nan for motor2",
    ),
    "inf": (np.array([np.inf] + [0.0] * 5), "the command is not finite: inf for motor1"),
    "short": (np.zeros(5), r"the command has shape \(5,\), not \(6,\)"),
    "batch": (np.zeros((1, 6)), r"the command has shape \(1, 6\)"),
    "number": (0.0, r"the command has shape \(\)"),
    "text": ("home", "the command is not made of real numbers"),
    "ragged": ([[0.0], 0.0], "the command is not made of real numbers"),
    "complex": (np.zeros(6, complex), "the command is not made of real numbers"),
    "object": ([None] * 6, "the command is not made of real numbers"),
    "none": (None, "the commands have ended"),
}


@pytest.mark.parametrize("name", NO_COMMANDS)
def test_what_is_no_command_stops_the_arm(mara: RobotModel, name: str) -> None:
    arm, (command, reason) = in_motion(mara), NO_COMMANDS[name]
    arm.tick(command)
    _stops(arm, reason)


TROUBLES: dict[str, tuple[dict[str, Callable[[Arm], Any]], str]] = {
    "no state": ({"state": lambda arm: None}, "the arm reports no state"),
    "old state": (
        {"state": lambda arm: state_of(arm.q, arm.now - 0.15)},
        r"the arm's state is 0\.16 s old, and 0\.1 s are allowed",
    ),
    "future state": (
        {"state": lambda arm: state_of(arm.q, arm.now + 5.0)},
        "state has the time 16",
    ),
    "timeless state": ({"state": lambda arm: state_of(arm.q, np.nan)}, "state has the time nan"),
    "nan in a state": (
        {"state": lambda arm: state_of(arm.q * np.nan, arm.now)},
        "is not finite: nan",
    ),
    "partial state": (
        {"state": lambda arm: state_of(arm.q[:3], arm.now)},
        r"state has shape \(3,\)",
    ),
    "not following": (
        {"state": lambda arm: state_of(arm.q - [0, 0, 0.25, 0, 0, 0], arm.now)},
        r"the arm does not follow: motor3 is 0\.2\d* rad \(m\) from its set-point, and 0\.2 are",
    ),
    "old command": (
        {"commanded": lambda arm: arm.now - 0.25},
        r"the command is 0\.26 s old, and 0\.2 s are allowed",
    ),
    "timeless command": ({"commanded": lambda arm: np.nan}, "the command has the time nan"),
    "clock stands": ({"now": lambda arm: arm.now}, "the clock stands still"),
    "clock back": ({"now": lambda arm: arm.now - 5.0}, r"the clock jumps from 11\.3 to 6\.3 s"),
    "no clock": ({"now": lambda arm: np.nan}, r"the clock jumps from 11\.3 to nan s"),
    "clock ahead": ({"now": lambda arm: arm.now + 5.0}, r"the arm's state is 4\.99 s old"),
    "paused": (
        {
            "now": lambda arm: arm.now + 0.5,
            "state": lambda arm: state_of(arm.q, arm.now + 0.5),
            "commanded": lambda arm: arm.now + 0.5,
        },
        r"no set-point was sent for 0\.5 s, and the arm moved",
    ),
    "broken state": ({"state": lambda arm: "no state"}, "the safety filter failed: AttributeError"),
}


@pytest.mark.parametrize("name", TROUBLES)
def test_trouble_stops_the_arm(mara: RobotModel, name: str) -> None:
    arm, (changes, reason) = in_motion(mara), TROUBLES[name]
    arm.tick(mara.home + 1.5, **{key: change(arm) for key, change in changes.items()})
    _stops(arm, reason)


def _stops(arm: Arm, reason: str) -> None:
    """Check that the arm decelerates for this reason, holds, and resumes from where it is."""
    arm.is_in(Mode.STOPPING)
    arm.until_stopped(arm.robot.home + 1.5)
    held = arm.q
    for setpoint in arm.ticks(arm.robot.home, 10):
        np.testing.assert_array_equal(setpoint.q, held)
        assert not setpoint.qd.any()
        assert not setpoint.qdd.any()
    arm.filter.stop("too late")
    assert arm.filter.reason is not None
    with pytest.raises(GymMaraError, match=reason):
        raise GymMaraError(arm.filter.reason)
    with pytest.raises(GymMaraError, match=r"is stopped .* an operator must resume"):
        arm.filter.start(state_of(arm.q, arm.now), arm.now)
    arm.resume()
    arm.is_in(Mode.WAITING)
    np.testing.assert_array_equal(arm.tick(arm.robot.home, commanded=arm.now - 0.05).q, held)
    assert np.abs(arm.tick(arm.robot.home).q - held).max() < 1e-3
    arm.is_in(Mode.MOVING)
