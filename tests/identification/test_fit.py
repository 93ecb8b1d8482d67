"""The hidden parameters of simulated arms are found again, and what the log does not show is said."""

from __future__ import annotations

import numpy as np
import pytest

from gym_mara.backends.randomisation import Randomisation
from gym_mara.errors import GymMaraError
from gym_mara.identification import Estimate, Identified, Log, identify
from gym_mara.robot import RobotModel
from tests.identification.arms import hidden, log_of

SHOULDER = 1
"""A joint of MARA that carries much, so that its effort limit and friction show."""
WRIST = 5
"""A joint of MARA that carries nearly nothing."""


def by_name(found: Identified) -> dict[str, Estimate]:
    return {each.name: each for each in found.estimates}


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["dart", "mujoco"])
def test_one_joint(backend: str, mara: RobotModel) -> None:
    true = hidden(mara, 0, [SHOULDER])
    found = identify(log_of(mara, backend, true, 3.0, [SHOULDER]), mara, backend)
    estimates = by_name(found)
    assert [each.joint for each in found.estimates] == [None, *["motor2"] * 3]
    assert estimates["latency"].value == pytest.approx(true["latency"], abs=0.02)
    assert estimates["servo_gain"].value == pytest.approx(true["servo_gain"][SHOULDER], rel=0.05)
    for name in ("effort_limit", "joint_friction"):
        assert estimates[name].value == pytest.approx(true[name][SHOULDER], rel=0.2)
    for each in found.estimates:
        assert each.undetermined is None
        assert each.standard_error is not None
        assert each.low < each.value < each.high
        assert found.randomisation[each.name] == (each.low, each.high)
    assert found.error["motor2"] < 0.1 * found.error_before["motor2"]
    Randomisation(found.to_json()["randomisation"], mara)  # which takes them as they are


def test_an_effort_limit_that_is_not_reached_is_said(mara: RobotModel) -> None:
    true, names = hidden(mara, 0, [WRIST]), ("latency", "servo_gain", "effort_limit")
    log = log_of(mara, "mujoco", true | {"joint_friction": np.zeros(6)}, 2.5, [WRIST])
    found = identify(log, mara, "mujoco", names)
    estimates = by_name(found)
    assert estimates["effort_limit"].undetermined == "the effort limit was not reached"
    assert estimates["effort_limit"].standard_error is None
    assert sorted(found.randomisation) == ["latency", "servo_gain"]
    assert estimates["servo_gain"].value == pytest.approx(true["servo_gain"][WRIST], rel=0.05)


def test_without_a_delay_and_noise_the_ranges_stay_positive(mara: RobotModel) -> None:
    true = hidden(mara, 1, [WRIST]) | {"latency": np.array(0.0)}
    log = log_of(mara, "mujoco", true, 2.1, [WRIST], noise=0.0)
    found = identify(log, mara, "mujoco", ("latency", "servo_gain"))
    low, high = found.randomisation["latency"]
    assert 0.0 <= low <= high < 0.005


@pytest.mark.nightly
def test_three_joints(mara: RobotModel) -> None:
    joints = [0, 1, 2]
    true = hidden(mara, 2, joints)
    found = identify(log_of(mara, "mujoco", true, 8.0, joints), mara, "mujoco")
    for each in found.estimates:
        own = true[each.name]
        value = float(own if each.joint is None else own[mara.joint_names.index(each.joint)])
        if each.joint == "motor3" and each.name != "servo_gain":
            # It never brakes at its limit here, so that only what friction leaves of the effort shows.
            assert str(each.undetermined).startswith("too uncertain")
            assert each.low < value < each.high
            continue
        assert each.standard_error is not None
        if each.name == "latency":
            assert each.value == pytest.approx(value, abs=0.02)
        else:
            assert each.value == pytest.approx(
                value, rel=0.05 if each.name == "servo_gain" else 0.2
            )
        assert abs(each.value - value) < 4.0 * each.standard_error + 1e-9
    assert max(found.error.values()) < 0.0003


def test_another_arm_is_refused(mara: RobotModel) -> None:
    still = np.zeros((150, 3))
    log = Log(np.arange(0.0, 3.0, 0.02), still, still, still)
    with pytest.raises(GymMaraError, match="3 joints, and mara has 6"):
        identify(log, mara, "mujoco")


def test_what_cannot_be_identified_is_refused(mara: RobotModel) -> None:
    targets = np.zeros((150, 6))
    targets[50:, 1] = 0.3
    log = Log(np.arange(0.0, 3.0, 0.02), targets, targets, np.zeros((150, 6)), mara.joint_names)
    for parameters, message in (
        ((), "once"),
        (("latency", "latency"), "once"),
        (("colour",), "unknown parameter"),
    ):
        with pytest.raises(GymMaraError, match=message):
            identify(log, mara, "mujoco", parameters)
    with pytest.raises(GymMaraError, match="use dart or mujoco"):
        identify(log, mara, "pinocchio")
    with pytest.raises(GymMaraError, match="randomisation is given"):
        identify(log, mara, "mujoco", randomisation={})
