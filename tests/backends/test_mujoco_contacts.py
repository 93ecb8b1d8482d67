"""The contacts of the backend "mujoco": those that Coal finds, with the links' names and depths."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from gym_mara.backends.mujoco.backend import MujocoBackend
from gym_mara.backends.mujoco.model import link_pairs
from gym_mara.collision import make_checker
from gym_mara.robot import RobotModel
from gym_mara.testing import COLLIDING_Q, uniform_q
from gym_mara.types import Floats
from tests.helpers import MODULAR_ARMS, robot_model

WITHIN = 1e-3
"""The distance within which engines may disagree, m."""


def _distances(robot: RobotModel, q: Floats) -> dict[tuple[str, str], float]:
    """Coal's distance of each pair of links at a configuration (J,), m; negative or zero where they touch."""
    data, nearest = robot.geometry.createData(), dict.fromkeys(link_pairs(robot), np.inf)
    pin.computeDistances(robot.model, robot.model.createData(), robot.geometry, data, q)
    for pair, result in zip(robot.geometry.collisionPairs, data.distanceResults, strict=True):
        one, other = sorted((robot.link_of(pair.first), robot.link_of(pair.second)))
        nearest[one, other] = min(nearest[one, other], result.min_distance)
    return nearest


def _assert_same_contacts(robot: RobotModel, count: int) -> None:
    """Arms at random configurations have contacts of the pairs of links that Coal finds in touch."""
    q = uniform_q(robot, count, seed=8)
    backend = MujocoBackend(robot, count)
    backend.reset(q)
    contacts = backend.state.contacts
    assert contacts is not None
    expected = make_checker("coal", robot).check(q)
    assert expected.any()
    assert not expected.all()
    for row, found, flag in zip(q, contacts, expected, strict=True):
        if bool(found) != flag:
            assert abs(min(_distances(robot, row).values())) < WITHIN
    for row, found in zip(q[:200], contacts[:200], strict=True):
        touching = {contact.links for contact in found}
        for pair, distance in _distances(robot, row).items():
            assert (pair in touching) == (distance <= 0.0) or abs(distance) < WITHIN


def test_at_equal_q_contacts_are_those_of_coal() -> None:
    _assert_same_contacts(robot_model("mara"), 4000)


@pytest.mark.parametrize("joints", [3, 7])
def test_modular_arms_have_contacts_where_coal_finds_them(joints: int) -> None:
    _assert_same_contacts(RobotModel.from_modules(MODULAR_ARMS[joints]), 500)


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_arms_with_meshes_have_contacts_where_coal_finds_them(name: str) -> None:
    robot = robot_model(name)
    q = uniform_q(robot, 300, seed=4)
    backend = MujocoBackend(robot, 300)
    backend.reset(q)
    np.testing.assert_array_equal(backend.state.collided, make_checker("coal", robot).check(q))


def test_contacts_name_the_links_and_their_depth(mara: RobotModel) -> None:
    backend = MujocoBackend(mara, 2)
    backend.reset(np.array([COLLIDING_Q, np.zeros(6)]))
    assert backend.state.contacts is not None
    colliding, free = backend.state.contacts
    assert free == ()
    assert colliding
    for contact in colliding:
        assert "table" in contact.links
        assert 0.0 < contact.depth < 0.5


def test_the_table_stops_the_arm(mara: RobotModel) -> None:
    """It stops within what it moves in two physics steps, and rests there."""
    backend, target = MujocoBackend(mara, 1), np.array([[0.0, 2.0, 0.0, 0.0, 0.0, 0.0]])
    assert make_checker("coal", mara).check(target)
    states = [backend.step(target) for _ in range(200)]
    assert np.abs(states[-1].q - target).max() > 0.1
    np.testing.assert_allclose(states[-1].qd, 0.0, atol=5e-3)
    deepest = 0.0
    for state in states:
        assert state.contacts is not None
        for contact in state.contacts[0]:
            assert "table" in contact.links
            deepest = max(deepest, contact.depth)
    assert 0.0 < deepest < 5e-3
    assert states[-1].collided[0]


def test_no_contact_between_the_ends_of_a_period_is_missed(mara: RobotModel) -> None:
    """The contacts of a period of ten physics steps are those of ten periods of one, each with its largest depth."""
    long, short = MujocoBackend(mara, 40), MujocoBackend(mara, 40, control_period=0.002)
    velocities = np.tile(np.random.default_rng(5).uniform(-1.57, 1.57, (1, 40, 6)), (10, 1, 1))
    q = uniform_q(mara, 40, seed=6)
    for backend in (long, short):
        backend.reset(q)
    expected: list[dict[tuple[str, str], float]] = [{} for _ in q]
    for velocity in velocities:
        for deepest, contacts in zip(expected, short._run(velocity[None]).contacts, strict=True):
            for links, depth in contacts:
                deepest[links] = max(depth, deepest.get(links, 0.0))
    found = [dict(contacts) for contacts in long._run(velocities).contacts]
    assert sum(map(bool, found)) > 10
    assert [set(each) for each in found] == [set(each) for each in expected]
    for mine, theirs in zip(found, expected, strict=True):
        for links, depth in mine.items():
            np.testing.assert_allclose(depth, theirs[links], rtol=0.0, atol=1e-4)
