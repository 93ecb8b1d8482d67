"""Whether paths ahead are free: the same answer as many checks give, with few."""

from __future__ import annotations

import numpy as np
import pytest

from gym_mara.collision import CollisionChecker, make_checker
from gym_mara.collision.coal import CoalChecker
from gym_mara.collision.free_poses import FreePoses
from gym_mara.robot import RobotModel
from gym_mara.ros2.safety.motion import Motion, MotionLimits
from gym_mara.ros2.safety.paths import PathChecker, free_move
from gym_mara.testing import COLLIDING_Q
from tests.helpers import PATH_ENDS, Floats, Mask, robot_model

PERIOD = 0.01


class Counting(CollisionChecker):
    """Coal, which counts the configurations; without margins if `margins` is false."""

    def __init__(self, robot: RobotModel, margins: bool = True) -> None:
        super().__init__(robot)
        self._exact, self._margins, self.count = CoalChecker(robot), margins, 0

    def check(self, q: Floats) -> Mask:
        self.count += len(q)
        return self._exact.check(q)

    def with_margin(self, displacement: Floats) -> CollisionChecker | None:
        if not self._margins:
            return None
        counting = Counting(self.robot)
        counting._exact = CoalChecker(self.robot, displacement)
        return counting


class Wall(CollisionChecker):
    """An engine that finds a collision where the first joint is within a range."""

    def __init__(self, robot: RobotModel, low: float, high: float, margins: bool) -> None:
        super().__init__(robot)
        self._low, self._high, self._margins = low, high, margins

    def check(self, q: Floats) -> Mask:
        return np.asarray((q[:, 0] > self._low) & (q[:, 0] < self._high))

    def with_margin(self, displacement: Floats) -> CollisionChecker | None:
        d = displacement[0]
        return Wall(self.robot, self._low - d, self._high + d, True) if self._margins else None


def _motion(robot: RobotModel, period: float = PERIOD) -> Motion:
    return Motion(MotionLimits.of(robot), robot.lower, robot.upper, period)


def _path(motion: Motion, count: int) -> Floats:
    """The proposed path, densely."""
    times = np.linspace(-motion.period, motion.stop_duration, count)
    return np.array([motion.proposed(time)[0] for time in times])


@pytest.mark.parametrize("name", ["mara", "panda"])
@pytest.mark.parametrize("margins", [True, False])
def test_the_answer_is_that_of_many_checks(name: str, margins: bool) -> None:
    robot, rng = robot_model(name), np.random.default_rng(5)
    motion, exact = _motion(robot), make_checker("coal", robot)
    paths = PathChecker(robot, Counting(robot, margins), np.array(motion.velocity))
    free = FreePoses(robot)
    hits = 0
    for move in range(6 if margins else 3):
        motion.rest_at(free._free_configuration(rng, exact).tolist())
        target = rng.uniform(robot.lower, robot.upper)
        while move % 2 and not exact.check(target[None])[0]:
            target = rng.uniform(robot.lower, robot.upper)
        for tick in range(400):
            motion.propose(target.tolist(), 1.0)
            found = paths.first_collision(motion)
            if tick % 40 == 0 or found is not None:
                dense = exact.check(_path(motion, 300))
                assert dense.any() == (found is not None)
            if found is not None:
                assert exact.check(found[None])[0]
                hits += 1
                break
            motion.accept()
    assert hits >= (3 if margins else 1)


@pytest.mark.parametrize("margins", [True, False])
@pytest.mark.parametrize("share", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("period", [0.002, 0.01, 0.1])
def test_a_wall_ahead_is_seen_at_any_speed(
    mara: RobotModel, margins: bool, share: float, period: float
) -> None:
    motion, place = _motion(mara, period), 0.01 + 0.5 * share**0.5
    paths = PathChecker(mara, Wall(mara, place, 9.0, margins), np.array(motion.velocity))
    motion.rest_at([0.0] * 6)
    for _ in range(20_000):
        motion.propose([1.0] * 6, share)
        if paths.first_collision(motion) is not None:
            break
        motion.accept()
        assert motion.q[0] <= place
    while not motion.follow_stop():
        assert motion.q[0] <= place
    way = share * motion.velocity[0] * period
    assert place - 1.5 * way - 0.002 <= motion.q[0] <= place


@pytest.mark.parametrize("margins", [True, False])
def test_a_wall_on_the_way_to_the_next_set_point_is_seen(mara: RobotModel, margins: bool) -> None:
    motion = _motion(mara, 0.5)
    paths = PathChecker(mara, Wall(mara, 0.05, 0.06, margins), np.array(motion.velocity))
    motion.rest_at([0.0] * 6)
    motion.propose([1.0] * 6, 1.0)
    assert motion.proposed(0.0)[0][0] > 0.06, "the stop begins behind the wall"
    found = paths.first_collision(motion)
    assert found is not None
    assert 0.05 < found[0] < 0.06


def test_an_arm_that_moves_slowly_or_rests_needs_few_checks(mara: RobotModel) -> None:
    motion, counting = _motion(mara), Counting(mara)
    paths = PathChecker(mara, counting, np.array(motion.velocity))
    motion.rest_at(mara.home.tolist())
    margins = [paths._coarse, paths._fine]
    for _ in range(200):
        motion.propose((mara.home + 0.04).tolist(), 0.01)
        assert paths.first_collision(motion) is None
        motion.accept()
    checks = counting.count + sum(each.count for each in margins if isinstance(each, Counting))
    assert checks < 30


def test_a_straight_move_is_free_or_not(mara: RobotModel) -> None:
    checker = make_checker("coal", mara)
    begin, end = map(np.array, PATH_ENDS)
    assert not free_move(mara, checker, begin, end), "the tool collides on the way"
    assert free_move(mara, checker, begin, begin)
    assert not free_move(mara, checker, mara.home, np.array(COLLIDING_Q)), "the end collides"
    assert not free_move(mara, checker, np.array(COLLIDING_Q), mara.home), "so does the begin"
    assert free_move(mara, checker, mara.home, mara.home + 0.2)
    beyond = mara.home.copy()
    beyond[1] = mara.upper[1] + 0.01
    assert not free_move(mara, checker, mara.home, beyond)
    assert not free_move(mara, checker, mara.home, np.full(6, np.nan))


def test_what_a_move_finds_free_the_filter_finds_free(mara: RobotModel) -> None:
    rng, checker = np.random.default_rng(2), make_checker("coal", mara)
    free, motion = FreePoses(mara), _motion(mara)
    paths = PathChecker(mara, checker, np.array(motion.velocity))
    moves = 0
    while moves < 5:
        begin = free._free_configuration(rng, checker)
        end = free._free_configuration(rng, checker)
        if not free_move(mara, checker, begin, end):
            continue
        motion.rest_at(begin.tolist())
        moves += 1
        for tick in range(1000):
            motion.propose(end.tolist(), min(0.5, 0.1 + 0.01 * tick))
            assert paths.first_collision(motion) is None
            motion.accept()
            if motion.resting:
                break
        np.testing.assert_array_equal(motion.q, end)
