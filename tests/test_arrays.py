"""Arrays of two libraries: rewards, rotations and goals give the same numbers with NumPy and torch.

The tolerances: 1e-12 with float64, and for an angle also what the arc cosine makes of a rounded number. With float32 1e-5, because
float32 has seven digits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gym_mara import rotations
from gym_mara.arrays import Constants, contiguous, host, namespace, zeros_like
from gym_mara.envs.statistics import EpisodeStatistics
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.tasks import TASKS, AnyTargetTask, Goal, Observation, rewards
from gym_mara.types import Array, Floats, Mask

FLOAT32 = 1e-5
EXACT = ("terminated", "distance", "position_error", "reward_distance", "reward_collision")
"""What does not depend on an angle."""
FLAGS = ("terminated", "success")

distances = arrays(np.float64, 8, elements=st.floats(0.0, 3.0))
angles = arrays(np.float64, 8, elements=st.floats(0.0, np.pi))
flags = arrays(np.bool_, 8)
_components = st.one_of(st.integers(-1, 1).map(float), st.floats(-1.0, 1.0, allow_subnormal=False))
quaternions = (
    arrays(np.float64, (8, 4), elements=_components)
    .filter(lambda q: bool((np.linalg.norm(q, axis=-1) > 0.1).all()))
    .map(lambda q: q / np.linalg.norm(q, axis=-1, keepdims=True))
)
positions = arrays(np.float64, (8, 3), elements=st.floats(-1.5, 1.5))


def _assert_same(
    function: Callable[..., Array],
    *values: Any,
    float64: float | Floats = 1e-12,
    float32: float | None = FLOAT32,
) -> None:
    """A function gives the same numbers with NumPy, and with tensors of float64 and float32; it leaves its arguments alone."""
    before = [np.array(value) for value in values]
    expected = function(*values)
    assert isinstance(expected, np.ndarray)
    tolerances: tuple[tuple[torch.dtype, Any], ...]
    tolerances = (torch.float64, float64), (torch.float32, float32)
    for dtype, atol in tolerances:
        tensors = [_tensor(value, dtype) for value in values]
        result = function(*tensors)
        assert isinstance(result, torch.Tensor)
        assert result.dtype == dtype
        if atol is not None:
            assert (np.abs(host(result) - expected) <= atol).all()
        for tensor, value in zip(tensors, before, strict=True):
            assert torch.equal(tensor, _tensor(value, dtype))


def _angle_tolerance(a: Floats, b: Floats) -> Floats:
    """How far two libraries' float64 angles between quaternions may be apart (N,), rad, at whatever angle.

    The sum of four products is accurate to some 2e-16, and so is the cosine of half the angle. An angle near zero is less accurate,
    because the arc cosine is steep there: 6e-8.
    """
    cosine, rounding = np.abs(np.vecdot(a, b)), 4.0 * np.finfo(np.float64).eps
    least, most = np.maximum(cosine - rounding, 0.0), np.minimum(cosine + rounding, 1.0)
    return 1e-12 + 2.0 * (np.arccos(least) - np.arccos(most))


def _in_float32(values: Array) -> Array:
    """Positions that float32 has as well, so that their differences are exact: multiples of a micrometre. Other values stay."""
    grid = 2.0**20
    return np.round(values * grid) / grid if values.shape[-1] == 3 else values


def _tensor(value: Any, dtype: torch.dtype) -> torch.Tensor:
    array = np.asarray(value)
    return torch.tensor(array, dtype=None if array.dtype == np.bool_ else dtype)


# arrays.


def test_the_namespace_of_an_array_is_its_librarys() -> None:
    assert namespace(np.zeros(2)) is np
    assert namespace(np.float64(2.0)) is np
    assert namespace(None) is np
    assert namespace(torch.zeros(2)).__name__ == "array_api_compat.torch"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_constants_have_the_form_of_an_array(dtype: torch.dtype) -> None:
    constants = Constants(0.1, [1.0, 2.0], [3, 4])
    xp, number, _, index = constants.like(np.zeros(3))
    assert xp is np
    assert (number.shape, number.dtype, index.dtype.kind) == ((), np.float64, "i")
    xp, *tensors = constants.like(torch.zeros(3, dtype=dtype))
    assert xp is namespace(torch.zeros(1))
    assert [t.dtype for t in tensors] == [dtype, dtype, torch.int64]
    assert [t.tolist() for t in tensors[1:]] == [[1.0, 2.0], [3, 4]]
    assert constants.like(torch.ones(1, dtype=dtype))[1] is tensors[0]
    assert constants.like(torch.ones(1, dtype=dtype, device="meta"))[1].device.type == "meta"


def test_constants_made_in_inference_mode_are_ordinary_tensors() -> None:
    constants = Constants(2.0)
    with torch.inference_mode():
        constants.like(torch.zeros(1))
    value = torch.ones(1, requires_grad=True)
    (value * constants.like(value)[1]).sum().backward()
    assert value.grad is not None
    assert value.grad.item() == 2.0


def test_host_and_contiguous_and_zeros_keep_the_values_and_the_type() -> None:
    matrix = np.arange(6.0).reshape(2, 3)
    tensor = torch.tensor(matrix, dtype=torch.float32, requires_grad=True)
    np.testing.assert_array_equal(host(tensor.T), matrix.T)
    assert contiguous(tensor.T).is_contiguous()
    assert contiguous(matrix.T).flags.c_contiguous
    assert zeros_like(tensor).dtype == torch.float32
    assert zeros_like(matrix > 0).dtype == np.bool_
    copied = host(tensor)
    copied[:] = 9.0
    assert tensor[0, 1].item() == 1.0


# Rewards.


@given(distances, st.floats(0.1, 10.0), st.floats(0.01, 1.0))
def test_the_distance_reward_is_the_same(distance: Floats, alpha: float, kappa: float) -> None:
    # Its slope is up to 10 α/κ, which multiplies the rounding of the distance.
    tolerance = FLOAT32 * max(1.0, alpha / kappa)
    _assert_same(lambda d: rewards.distance_reward(d, alpha, kappa), distance, float32=tolerance)


@given(angles, st.floats(0.5, 5.0), st.floats(0.0, 5.0))
def test_the_orientation_factor_is_the_same(angle: Floats, beta: float, gamma: float) -> None:
    _assert_same(lambda a: rewards.orientation_factor(a, beta, gamma), angle)


@given(distances, flags, st.floats(0.1, 5.0), st.floats(0.01, 2.0))
def test_the_collision_penalty_is_the_same(
    distance: Floats, collided: Mask, delta: float, eta: float
) -> None:
    def penalty(d: Array, c: Array) -> Array:
        return rewards.collision_penalty(c, d, delta, eta)

    smooth = np.where(
        distance < 1e-6, 0.0, distance
    )  # below float32's reach the power has no slope
    _assert_same(penalty, smooth, collided, float32=1e-4)


# Rotations.


@given(quaternions, quaternions)
def test_products_and_conjugates_are_the_same(a: Floats, b: Floats) -> None:
    _assert_same(rotations.multiply, a, b)
    _assert_same(rotations.conjugate, a)
    _assert_same(rotations.normalised, 3.0 * a)


@given(quaternions, quaternions)
def test_angles_are_the_same(a: Floats, b: Floats) -> None:
    _assert_same(rotations.angle_between, a, b, float64=_angle_tolerance(a, b))


@given(quaternions)
def test_the_canonical_sign_is_the_same(q: Floats) -> None:
    # float32 rounds what is just not zero: the sign there is another.
    clear = ((np.abs(q) > 1e-6) | (q == 0.0)).all()
    _assert_same(rotations.canonical, q, float32=FLOAT32 if clear else None)


@given(quaternions)
def test_quaternions_of_matrices_are_the_same(q: Floats) -> None:
    w, v = q[:, :1, None], q[:, 1:]
    cross = np.cross(np.eye(3), v[:, None])  # v ↦ u × v, row by row
    eye = np.eye(3)
    matrix = (2.0 * w**2 - 1.0) * eye + 2.0 * v[:, :, None] * v[:, None] + 2.0 * w * cross
    _assert_same(rotations.from_matrix, matrix, float32=None)


# Goals and tasks.


@given(quaternions, quaternions)
def test_orientation_errors_are_the_same(goal: Floats, quaternion: Floats) -> None:
    product = rotations.multiply(quaternion, rotations.conjugate(goal))
    if (np.abs(product[:, 0]) > 1e-6).all():  # near half a turn rounding chooses the sign

        def error(g: Array, q: Array) -> Array:
            return Goal(q * 0.0, g).orientation_error(q)

        _assert_same(error, goal, quaternion)


@pytest.mark.parametrize("name", list(TASKS))
@given(positions, positions, quaternions, quaternions, flags)
def test_the_rewards_and_terms_of_every_task_are_the_same(
    name: str, at: Floats, to: Floats, turn: Floats, wanted: Floats, collided: Mask
) -> None:
    task = TASKS[name]
    # What a radian changes at most, and what the digits of float32 make of it.
    steepest, single = 3.0, 1e-4
    if isinstance(task, AnyTargetTask) and task.orientation:
        steepest = 100.0

    def judged(*values: Array) -> dict[str, Array]:
        position, target, quaternion, goal, touching = values
        zero = position * 0.0
        state = SimState(zero, zero, position, quaternion, zero, touching, zero[:, 0])
        total, terms = task.reward(state, Goal(target, goal))
        return {"reward": total, "terminated": task.terminated(state, Goal(target, goal)), **terms}

    values: tuple[Array, ...] = (at, to, turn, wanted, collided)
    tolerances = {
        torch.float64: steepest * _angle_tolerance(turn, wanted),
        torch.float32: single,
    }
    for dtype, atol in tolerances.items():
        if dtype == torch.float32:
            values = tuple(map(_in_float32, values))
        expected = judged(*values)
        result = judged(*(_tensor(value, dtype) for value in values))
        assert result.keys() == expected.keys()
        for key, value in result.items():
            assert value.dtype == (torch.bool if key in FLAGS else dtype), key
            if (
                key == "success"
            ):  # rounding decides at the tolerances; tests/tasks/test_any_target.py
                continue
            exact = np.asarray(expected[key], np.float64)
            own = 1e-12 if dtype == torch.float64 and key in EXACT else atol
            assert (np.abs(host(value) - exact) <= own).all(), key


@pytest.mark.parametrize("name", list(TASKS))
def test_no_task_reads_a_value_or_leaves_the_device(mara: RobotModel, name: str) -> None:
    """Tensors of the device "meta" have no values: a question to them, or a tensor of another device, is an error."""

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Any:
        return torch.empty(shape, dtype=dtype, device="meta")

    task, flags = TASKS[name], empty(8, dtype=torch.bool)
    q, position, quaternion = empty(8, 6), empty(8, 3), empty(8, 4)
    state = SimState(q, q, position, quaternion, position, flags, empty(8))
    goal = Goal(position, quaternion)
    home = Goal(np.zeros((8, 3)), np.zeros((8, 4)))
    parts = task.observation(mara, home, mara.velocity_limit)
    reward, terms = task.reward(state, goal)
    statistics = EpisodeStatistics(8, q)
    statistics.add(terms["distance"], reward, state.collided)
    statistics.clear(flags)
    results: dict[str, Any] = {
        "observation": Observation(parts)(state, goal),
        "reward": reward,
        "terminated": task.terminated(state, goal),
        **terms,
        **statistics.summary(),
    }
    assert {value.device.type for value in results.values()} == {"meta"}
    assert {value.dtype for value in results.values()} == {torch.float32, torch.bool, torch.int64}
