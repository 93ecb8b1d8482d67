"""Which arrays are accepted as actions, and the class of actions in [-1, 1]."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction

from gym_mara.envs import MaraEnv, MaraGoalEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.types import UnitActions

TARGETS = np.array([0.25, -0.5, 0.5, 0.0, 0.25, -0.25], np.float32)


def _units() -> UnitActions:
    return TARGETS.copy().view(UnitActions)


MAKES: list[Any] = [MaraEnv, MaraGoalEnv, MaraVectorEnv]


@pytest.fixture(params=MAKES)
def step(request: pytest.FixtureRequest) -> Callable[[Any], Any]:
    """Steps an environment of one arm with the action of that arm."""
    env = request.param()
    env.reset()
    if request.param is MaraVectorEnv:
        return lambda action: env.step(np.asanyarray(action)[None])
    return lambda action: env.step(action)  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (TARGETS.astype(complex), "integers or floats .*not of complex128"),
        (TARGETS.astype(str), "integers or floats .*not of <U32"),
        (TARGETS > 0, "integers or floats .*not of bool"),
        (TARGETS.astype(object), "integers or floats .*not of object"),
        (np.ma.masked_array(TARGETS, TARGETS > 0), "cannot be a masked array"),
        (np.ma.masked_array(TARGETS), "cannot be a masked array"),
    ],
)
def test_other_arrays_than_of_numbers_are_refused(
    step: Callable[[Any], Any], action: Any, message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        step(action)


def test_integers_are_joint_targets(step: Callable[[Any], Any]) -> None:
    step(np.ones(6, np.int64))
    step(np.zeros(6, np.uint8))


@pytest.mark.parametrize("action", [[True] * 6, "up", [[1.0], [1.0, 2.0]], ["a"] * 6, [1j] * 6])
def test_lists_of_other_things_than_numbers_are_refused(action: Any) -> None:
    env = MaraEnv()
    env.reset()
    with pytest.raises(GymMaraError, match="an action must be an array of"):
        env.step(action)


# UnitActions.


def test_actions_of_a_policy_are_refused_as_joint_targets(step: Callable[[Any], Any]) -> None:
    with pytest.raises(GymMaraError, match=r"in \[-1, 1\].*RescaleAction.*load_policy"):
        step(_units())


def test_actions_of_a_policy_are_refused_in_a_list() -> None:
    envs = MaraVectorEnv(2)
    envs.reset()
    with pytest.raises(GymMaraError, match="RescaleAction"):
        envs.step([_units(), _units()])  # type: ignore[list-item]


def test_rescaled_actions_of_a_policy_are_accepted() -> None:
    env = RescaleAction(gymnasium.make("gym_mara/MARA-v0"), np.float32(-1), np.float32(1))
    env.reset()
    q = env.step(_units())[0][:6]
    np.testing.assert_allclose(q, TARGETS * np.pi, atol=1e-6)


@pytest.mark.parametrize(
    "same",
    [
        lambda a: a[:3],
        lambda a: a[None],
        lambda a: a[None][0],
        lambda a: np.stack([a, a]),
        lambda a: a.copy(),
        lambda a: a.reshape(2, 3),
        copy.deepcopy,
        lambda a: pickle.loads(pickle.dumps(a)),
    ],
)
def test_views_and_copies_are_still_in_minus_one_to_one(same: Callable[[Any], Any]) -> None:
    assert type(same(_units())) is UnitActions


@pytest.mark.parametrize(
    "computed",
    [
        lambda a: 2.0 * a,
        lambda a: a + np.ones(6, np.float32),
        lambda a: np.clip(a, -1.0, 1.0),
        lambda a: np.multiply(a, 2.0, out=a),
        lambda a: a[None].mean(axis=0),
    ],
)
def test_arithmetic_gives_plain_arrays(computed: Callable[[Any], Any]) -> None:
    result = computed(_units())
    assert type(result) is np.ndarray


def test_a_sum_is_a_plain_number() -> None:
    assert type(_units().sum()) is np.float32
