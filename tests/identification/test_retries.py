"""The search leaves false minima, and arms in several processes follow as in one."""

from __future__ import annotations

import numpy as np
import pytest

from gym_mara.identification import following
from gym_mara.identification.following import Followers
from gym_mara.identification.parameters import DEFAULT, Space
from gym_mara.identification.retries import leave_out_unreached, retry
from gym_mara.identification.search import Search
from gym_mara.robot import RobotModel
from tests.identification.arms import hidden, log_of

ELBOW = 2


@pytest.mark.parametrize("friction", [True, False])
def test_a_limit_that_seemed_not_to_be_reached_is_found(friction: bool, mara: RobotModel) -> None:
    names = DEFAULT if friction else DEFAULT[:3]
    true = hidden(mara, 0, [ELBOW], names)
    log = log_of(mara, "mujoco", true, 2.5, [ELBOW])
    space = Space(mara, names, log.moving)
    followers = Followers(log, mara, "mujoco", space, {})
    values = [float(true["latency"]), float(true["servo_gain"][ELBOW]), 2.0, 0.0]
    search = Search(space, followers, space.inside(np.array(values[: len(names)])))
    leave_out_unreached(search)  # its upper end is all that there is to compare with
    assert search.left_out == [2, 3][: len(names) - 2]
    assert not retry(search)
    assert retry(search, unreached=True)
    assert search.left_out == []
    assert search.searched == [0, 1, 2, 3][: len(names)]
    limit = mara.effort_limit[ELBOW]
    net = search.vector[2] * limit - search.vector[3:].sum()
    wanted = true["effort_limit"][ELBOW] * limit
    if friction:
        wanted -= true["joint_friction"][ELBOW]
    assert net == pytest.approx(wanted, rel=0.4)
    followers.close()


def test_arms_in_processes_follow_as_in_one(
    mara: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = log_of(mara, "mujoco", hidden(mara, 0), 2.0)
    space = Space(mara, DEFAULT, log.moving)
    vectors = space.inside(np.linspace(space.nominal, 0.5 * (space.low + space.high), 3))
    errors = []
    for count in (1, 2, 4):
        monkeypatch.setattr(following, "choose_workers", lambda *_, count=count: count)
        followers = Followers(log, mara, "mujoco", space, {})
        errors.append(followers.errors(vectors, 0.5))
        followers.close()
    assert errors[0].shape == (3, 100, 6)
    np.testing.assert_array_equal(errors[1], errors[0])
    np.testing.assert_array_equal(errors[2], errors[0])
