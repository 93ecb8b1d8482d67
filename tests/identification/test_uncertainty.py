"""What a log does not determine is said, with the reason."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gym_mara.identification import Estimate
from gym_mara.identification.following import Followers
from gym_mara.identification.parameters import DEFAULT, PRIORS, Space
from gym_mara.identification.search import Search
from gym_mara.identification.uncertainty import estimates
from gym_mara.robot import RobotModel
from tests.identification.arms import hidden, log_of


def at_the_truth(
    mara: RobotModel, names: Sequence[str], noise: float = 0.0002
) -> dict[tuple[str, str | None], Estimate]:
    """What is said where the search ended at the hidden parameters."""
    true = hidden(mara, 0, names=names)
    log = log_of(mara, "mujoco", true, 3.0, noise=noise)
    space = Space(mara, names, log.moving)
    followers = Followers(log, mara, "mujoco", space, {})
    vector = [true[name].flat[joint or 0] for name, joint in space.entries]
    search = Search(space, followers, np.array(vector))
    search.measure()
    found = estimates(search, log)
    followers.close()
    return {(each.name, each.joint): each for each in found}


def test_masses_and_efforts_together_show_only_their_ratios(mara: RobotModel) -> None:
    for (name, _), each in at_the_truth(mara, tuple(PRIORS)).items():
        if name in ("effort_limit", "joint_friction", "mass"):
            assert each.undetermined == "only ratios of efforts, frictions and masses show"
            assert each.standard_error is None
        else:
            assert each.undetermined is None


def test_masses_without_efforts_show(mara: RobotModel) -> None:
    found = at_the_truth(mara, ("latency", "servo_gain", "joint_friction", "mass"))
    last, second = found["mass", "motor6"], found["mass", "motor2"]
    assert last.undetermined is None
    assert last.high - last.low < 0.1 * last.value
    assert str(second.undetermined).startswith("too uncertain")  # in 3 s


def test_what_noise_hides_is_too_uncertain(mara: RobotModel) -> None:
    shoulder = "joint_friction", "motor2"
    clear = at_the_truth(mara, DEFAULT)[shoulder]
    assert clear.undetermined is None
    assert clear.high - clear.low < 0.1 * clear.value
    hidden_one = at_the_truth(mara, DEFAULT, noise=0.05)[shoulder]
    assert str(hidden_one.undetermined).startswith("too uncertain")
    assert hidden_one.high - hidden_one.low > hidden_one.value
