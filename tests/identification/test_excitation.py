"""Excitations: within limits, free of collisions, and lively."""

from __future__ import annotations

import numpy as np
import pytest

from gym_mara.collision.coal import CoalChecker
from gym_mara.errors import GymMaraError
from gym_mara.identification import excitation
from tests.helpers import robot_model


@pytest.mark.parametrize("name", ["mara", "ur5", "panda"])
def test_the_targets_are_free_and_within_limits(name: str) -> None:
    robot = robot_model(name)
    targets = excitation(robot, 8.0, seed=3)
    assert targets.shape == (401, robot.num_joints)
    assert ((targets >= robot.lower) & (targets <= robot.upper)).all()
    assert not CoalChecker(robot).check(targets).any()
    # Each joint is anywhere while the others are anywhere else.
    mixed = np.random.default_rng(0).permuted(targets, axis=0)
    assert not CoalChecker(robot).check(mixed).any()
    assert (np.ptp(targets, axis=0) > 0.15).all()
    fastest = np.abs(np.diff(targets, axis=0)).max(axis=0) / 0.02
    assert (fastest > robot.velocity_limit).all()


def test_it_is_the_same_for_a_seed() -> None:
    robot = robot_model("mara")
    one, same, other = (excitation(robot, 2.0, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_a_duration_must_be_positive() -> None:
    with pytest.raises(GymMaraError, match="duration must be"):
        excitation(robot_model("mara"), -1.0)
