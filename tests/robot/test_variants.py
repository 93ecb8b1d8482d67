"""The robots that are one of gym_mara's own without some of its links."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from gym_mara.envs import MaraEnv
from gym_mara.robot import RobotModel
from gym_mara.robot.fingerprint import fingerprint
from tests.helpers import robot_model

THROUGH_THE_TABLE = np.array([0.0, 1.9, -0.3, 0.0, 0.0, 0.0], np.float32)


@pytest.fixture(scope="module")
def bare() -> RobotModel:
    return robot_model("mara_no_table")


def test_mara_without_its_table_differs_in_nothing_else(mara: RobotModel, bare: RobotModel) -> None:
    assert bare.collision_pairs == {pair for pair in mara.collision_pairs if "table" not in pair}
    assert len(bare.collision_pairs) < len(mara.collision_pairs)
    assert len(bare.shapes) == len(mara.shapes) - 1
    assert (bare.target, bare.findings) == (mara.target, ())
    q = np.random.default_rng(0).uniform(mara.lower, mara.upper, (20, 6))
    for of_bare, of_mara in zip(bare.kinematics().pose(q), mara.kinematics().pose(q), strict=True):
        np.testing.assert_array_equal(of_bare, of_mara)
    for one, other in zip(bare.model.inertias, mara.model.inertias, strict=True):
        assert one == other


def test_a_copy_has_no_table_either(mara: RobotModel, bare: RobotModel) -> None:
    for again in (copy.deepcopy(bare), pickle.loads(pickle.dumps(bare))):
        assert (again.name, again.without) == ("mara_no_table", ("table",))
        assert fingerprint(again) == fingerprint(bare) != fingerprint(mara)


@pytest.mark.parametrize("backend", ["pinocchio", "dart", "mujoco"])
def test_the_arm_moves_through_where_the_table_was(
    mara: RobotModel, bare: RobotModel, backend: str
) -> None:
    collisions = {}
    for robot in (mara, bare):
        env = MaraEnv("MARACollision-v0", robot=robot, backend=backend, on_collision="continue")
        env.reset(seed=0)
        for _ in range(60):
            *_, info = env.step(THROUGH_THE_TABLE)
        collisions[robot.name] = info["statistics"]["num_coll"]
        env.close()
    assert collisions["mara"] > 0
    assert collisions["mara_no_table"] == 0
