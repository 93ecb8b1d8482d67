"""Collision checking: what collides and what does not, and python-fcl against Coal."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from gym_mara.collision import make_checker
from gym_mara.collision.base import CollisionChecker
from gym_mara.collision.cached import CachedChecker
from gym_mara.collision.coal import CoalChecker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import COLLIDING_Q, COPIES, uniform_q
from tests.helpers import PATH_ENDS, TARGET_Q, Floats, robot_model
from tests.shape_pairs import clearance, held

ENGINES = ("coal", "coal in threads", "fcl")
CONTACT = 1e-4
"""Nearer to contact than this, m, the engines may differ."""
CHUNKS = 8


@functools.cache
def _checker(engine: str, robot: str) -> CollisionChecker:
    name, _, threads = engine.partition(" ")
    return make_checker(name, robot_model(robot), 2 if threads else 1)


def _assert_agree(name: str, q: Floats) -> None:
    coal, threads, fcl = (_checker(engine, name).check(q) for engine in ENGINES)
    assert threads.tolist() == coal.tolist()
    assert coal.any()
    assert not coal.all()
    apart = {int(row): clearance(robot_model(name), q[row]) for row in np.flatnonzero(coal != fcl)}
    assert {row: d for row, d in apart.items() if abs(d) > CONTACT} == {}


@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_fcl_and_coal_agree_on_ten_thousand_configurations_of_mara(chunk: int) -> None:
    q = uniform_q(robot_model("mara"), 10_000, 0)
    _assert_agree("mara", q[chunk::CHUNKS])


# A mesh is a surface to both engines: a body wholly inside another does not touch it.
@pytest.mark.parametrize("name", ["ur5", "panda", "panda_collision"])
def test_fcl_and_coal_agree_on_robots_of_meshes_and_capsules(name: str) -> None:
    _assert_agree(name, uniform_q(robot_model(name), 200, 1))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("q", "collides"),
    [
        pytest.param((0.0,) * 6, False, id="upright"),
        pytest.param(TARGET_Q, False, id="at the target"),
        pytest.param(COLLIDING_Q, True, id="in the table"),
        pytest.param(PATH_ENDS[0], False, id="one end of the path"),
        pytest.param((*PATH_ENDS[0][:3], 0.0, *PATH_ENDS[0][4:]), True, id="tool in the arm"),
        pytest.param(PATH_ENDS[1], False, id="the other end"),
    ],
)
def test_known_configurations(engine: str, q: tuple[float, ...], collides: bool) -> None:
    assert _checker(engine, "mara").check(np.array([q])).tolist() == [collides]


@pytest.mark.parametrize("engine", ENGINES)
def test_clearance_decides(engine: str) -> None:
    """Beyond 0.1 mm of contact a flag is the sign of Coal's signed distance."""
    mara = robot_model("mara")
    q = uniform_q(mara, 300, 2)
    distance = np.array([clearance(mara, row) for row in q])
    clear = np.abs(distance) > CONTACT
    flags = _checker(engine, "mara").check(q)
    np.testing.assert_array_equal(flags[clear], distance[clear] < 0.0)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("count", [1, 3, 7, 8, 9, 40])
def test_a_flag_does_not_depend_on_its_batch(engine: str, count: int) -> None:
    q = uniform_q(robot_model("mara"), count, 3)
    checker = _checker(engine, "mara")
    flags = checker.check(q)
    assert flags.shape == (count,)
    assert flags.dtype == np.bool_
    assert flags.tolist() == [bool(checker.check(q[row : row + 1])[0]) for row in range(count)]


@pytest.mark.parametrize("engine", ENGINES)
def test_flags_are_never_changed_by_later_calls(engine: str) -> None:
    checker = _checker(engine, "mara")
    q = uniform_q(robot_model("mara"), 40, 4)
    first = checker.check(q)
    kept = first.copy()
    checker.check(q[::-1])
    np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("duplicate", COPIES)
def test_a_copy_gives_the_same_answers(
    engine: str, duplicate: Callable[[CollisionChecker], CollisionChecker]
) -> None:
    q = uniform_q(robot_model("mara"), 20, 5)
    checker = _checker(engine, "mara")
    np.testing.assert_array_equal(duplicate(checker).check(q), checker.check(q))


def test_two_checkers_of_one_robot_do_not_disturb_each_other(mara: RobotModel) -> None:
    q = uniform_q(mara, 20, 6)
    first, second = make_checker("coal", mara), make_checker("coal", mara)
    expected = first.check(q)
    for row in range(20):
        second.check(q[19 - row : 20 - row])
        assert first.check(q[row : row + 1])[0] == expected[row]


@pytest.mark.parametrize("name", ["mara", "ur5"])
def test_caching_changes_no_answer(name: str) -> None:
    robot, exact = robot_model(name), _checker("coal", name)
    assert isinstance(exact, CoalChecker)
    checker = CachedChecker(robot, CoalChecker(robot))
    rng = np.random.default_rng(0)
    centre, asked, hits = uniform_q(robot, 24, seed=1), 0, 0
    checker._exact = SpiedChecker(robot)
    for step in range(60):
        if step % 20 == 0:  # some arms go elsewhere, among them to the edge of a collision
            centre[:12] = uniform_q(robot, 12, seed=step)
        scale = rng.choice([1e-3, 5e-3, 2e-2, 0.2], (24, 1))
        q = np.clip(centre + scale * rng.standard_normal(centre.shape), robot.lower, robot.upper)
        expected = exact.check(q)
        np.testing.assert_array_equal(checker.check(q), expected)
        asked, hits = asked + len(q), hits + int(expected.sum())
    assert 0 < hits < asked
    assert checker._exact.asked < 0.9 * asked, "it saves checks"


class SpiedChecker(CoalChecker):
    """Counts the configurations that it checks."""

    asked = 0

    def check(self, q: Floats) -> NDArray[np.bool_]:
        self.asked += len(q)
        return super().check(q)


def test_arms_that_stay_in_free_places_are_not_checked(mara: RobotModel) -> None:
    spied = SpiedChecker(mara)
    checker = CachedChecker(mara, spied)
    q = np.tile(TARGET_Q, (16, 1))
    for step in range(20):
        assert not checker.check(q + 1e-4 * step).any()
    assert spied.asked == 2 * 16, "once to get there, once to see that they stay"
    assert checker.check(np.tile(COLLIDING_Q, (16, 1))).all()


def test_none_finds_no_collision(mara: RobotModel) -> None:
    assert make_checker("none", mara).check(np.array([COLLIDING_Q] * 3)).tolist() == [False] * 3


def test_an_unknown_engine_is_named_with_the_known_ones(mara: RobotModel) -> None:
    with pytest.raises(GymMaraError, match=r"unknown collision engine 'bullet'.*coal, fcl, none"):
        make_checker("bullet", mara)


@pytest.mark.parametrize(("engine", "threads"), [("coal", 0), ("coal", -1), ("fcl", 2)])
def test_an_engine_refuses_threads_that_it_does_not_support(
    mara: RobotModel, engine: str, threads: int
) -> None:
    with pytest.raises(
        GymMaraError, match=f"(at least 1|1 unless collision='coal').* not {threads}"
    ):
        make_checker(engine, mara, threads)


def test_with_a_margin_no_collision_of_meshes_nearby_is_missed(tmp_path: Path) -> None:
    """The margin is checked on the meshes' hulls, which is quick, and reports a little more."""
    trimesh.creation.torus(0.2, 0.05).export(tmp_path / "torus.stl")
    torus = f'<mesh filename="{tmp_path}/torus.stl"/>'
    robot = held(tmp_path, torus, torus)
    coal, step = make_checker("coal", robot), np.full(6, 0.02)
    near = coal.with_margin(step)
    assert near is not None
    q = uniform_q(robot, 200, 0)
    moved = q + np.random.default_rng(0).uniform(-step, step, q.shape)
    free = ~near.check(q)
    assert free.any()
    assert not (free & coal.check(moved)).any()
