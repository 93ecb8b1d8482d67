"""The quick test for certain collisions: it is never wrong about one, and it finds most of them."""

from __future__ import annotations

import numpy as np
import pytest

from gym_mara.collision.cached import CachedChecker
from gym_mara.collision.coal import CoalChecker
from gym_mara.collision.overlaps import Overlaps
from gym_mara.robot import RobotModel
from gym_mara.testing import pickled
from gym_mara.types import Floats
from tests.helpers import MODULAR_ARMS, robot_model

ROBOTS = {"mara": "mara", **{f"{joints} joints": arm for joints, arm in MODULAR_ARMS.items()}}


def _random_actions(robot: RobotModel, count: int, seed: int) -> Floats:
    """The configurations (N, J), rad, that random actions ask for."""
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, robot.num_joints))
    return q.clip(robot.lower, robot.upper)


@pytest.mark.parametrize("name", ROBOTS)
def test_what_it_finds_collides(name: str) -> None:
    robot = RobotModel.load(ROBOTS[name])
    q = _random_actions(robot, 5_000, seed=1)
    found = Overlaps(robot).find(q)
    assert found.any()
    assert CoalChecker(robot).check(q[found]).all()


def test_what_it_finds_collides_at_the_edge_of_a_box(mara: RobotModel) -> None:
    # On the way from a free configuration to one that is found, down to the last bits.
    overlaps, exact = Overlaps(mara), CoalChecker(mara)
    q = _random_actions(mara, 200, seed=2)
    inside = q[overlaps.find(q)]
    outside = np.zeros_like(inside)
    for _ in range(50):
        middle = 0.5 * (inside + outside)
        found = overlaps.find(middle)[:, None]
        inside, outside = np.where(found, middle, inside), np.where(found, outside, middle)
    assert exact.check(inside).all()


def test_it_finds_most_collisions_of_random_actions_with_mara(mara: RobotModel) -> None:
    q = _random_actions(mara, 5_000, seed=3)
    found, collided = Overlaps(mara).find(q), CoalChecker(mara).check(q)
    assert found.sum() > 0.6 * collided.sum()


def test_an_arm_of_meshes_has_no_pair_to_test() -> None:
    robot = robot_model("ur5")
    assert not Overlaps(robot)


@pytest.mark.parametrize("name", ["mara", "ur5"])
def test_the_cached_checker_gives_the_same_answers_with_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = robot_model(name)
    monkeypatch.setattr(CachedChecker, "MANY", 1)
    checker, exact = CachedChecker(robot, CoalChecker(robot)), CoalChecker(robot)
    for seed in range(4):
        q = _random_actions(robot, 100, seed)
        for _ in range(3):  # arms that stay are tested with the margin
            np.testing.assert_array_equal(checker.check(q), exact.check(q))


def test_a_copy_finds_the_same(mara: RobotModel) -> None:
    overlaps, q = Overlaps(mara), _random_actions(mara, 300, seed=5)
    np.testing.assert_array_equal(pickled(overlaps).find(q), overlaps.find(q))
