"""Quaternions: their algebra, and a comparison with Pinocchio."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gym_mara import rotations
from gym_mara.types import Floats


def _is_direction(q: Floats) -> bool:
    return bool(np.linalg.norm(q) > 0.1)


# Integer components produce the degenerate cases: w = 0, half turns, equal components.
_components = st.one_of(st.integers(-1, 1).map(float), st.floats(-1.0, 1.0, allow_subnormal=False))
quaternions = (
    arrays(np.float64, 4, elements=_components)
    .filter(_is_direction)
    .map(lambda q: q / np.linalg.norm(q))
)


def _matrix(q: Floats) -> Floats:
    w, x, y, z = q
    return np.asarray(pin.Quaternion(w, x, y, z).matrix())


def _same_rotation(a: Floats, b: Floats) -> bool:
    # Near half a turn the sign of w is lost, where w counts as zero.
    atol = 1e-12 if abs(b[0]) > rotations.ZERO else 4.0 * rotations.ZERO + 1e-12
    return bool(np.allclose(_matrix(a), _matrix(b), rtol=0.0, atol=atol))


@given(quaternions, quaternions)
def test_multiply_equals_the_product_of_the_matrices(a: Floats, b: Floats) -> None:
    product = rotations.multiply(a, b)
    assert np.linalg.norm(product) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(_matrix(product), _matrix(a) @ _matrix(b), rtol=0.0, atol=1e-12)


@given(quaternions, quaternions, quaternions)
def test_multiply_is_associative(a: Floats, b: Floats, c: Floats) -> None:
    left = rotations.multiply(rotations.multiply(a, b), c)
    right = rotations.multiply(a, rotations.multiply(b, c))
    np.testing.assert_allclose(left, right, rtol=0.0, atol=1e-12)


def test_multiply_follows_hamiltons_convention() -> None:
    one, i, j, k = np.eye(4)
    np.testing.assert_array_equal(rotations.multiply(i, j), k)
    np.testing.assert_array_equal(rotations.multiply(j, i), -k)
    np.testing.assert_array_equal(rotations.multiply(k, k), -one)


@given(quaternions)
def test_conjugate_is_the_inverse(q: Floats) -> None:
    product = rotations.multiply(q, rotations.conjugate(q))
    np.testing.assert_allclose(product, [1.0, 0.0, 0.0, 0.0], rtol=0.0, atol=1e-12)


@given(quaternions)
@example(np.array([-1e-9, 0.0, 0.0, 1.0]))
def test_canonical_keeps_the_rotation_and_makes_w_not_negative(q: Floats) -> None:
    chosen = rotations.canonical(q)
    assert chosen[0] >= 0.0
    assert _same_rotation(chosen, q)
    np.testing.assert_array_equal(rotations.canonical(chosen), chosen)


@given(quaternions)
@example(np.array([-1e-9, 0.0, 0.0, 1.0]))
def test_from_matrix_inverts_the_conversion_to_a_matrix(q: Floats) -> None:
    (result,) = rotations.from_matrix(_matrix(q)[None])
    assert np.linalg.norm(result) == pytest.approx(1.0, abs=1e-12)
    assert result[0] >= 0.0
    assert _same_rotation(result, q)


def test_from_matrix_agrees_with_pinocchio_on_many_random_rotations() -> None:
    matrices = np.array([pin.SE3.Random().rotation for _ in range(1000)])
    expected = np.array([pin.Quaternion(m).coeffs()[[3, 0, 1, 2]] for m in matrices])
    np.testing.assert_allclose(
        rotations.from_matrix(matrices), rotations.canonical(expected), rtol=0.0, atol=1e-12
    )


@given(quaternions, quaternions)
def test_the_angle_is_symmetric_and_agrees_with_pinocchio(a: Floats, b: Floats) -> None:
    angle = rotations.angle_between(a, b)
    assert 0.0 <= angle <= np.pi
    assert angle == rotations.angle_between(b, a)
    assert angle == rotations.angle_between(-a, b)
    turn = np.linalg.norm(pin.log3(_matrix(a) @ _matrix(b).T))
    # The arccosine of a number near 1 has only half of the digits.
    assert angle == pytest.approx(turn, abs=1e-7)


def test_the_angle_of_known_rotations() -> None:
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    turns = np.array([0.0, 0.3, np.pi / 2, np.pi])
    about_y = np.stack([np.cos(turns / 2), np.zeros(4), np.sin(turns / 2), np.zeros(4)], axis=-1)
    np.testing.assert_allclose(rotations.angle_between(about_y, identity), turns, atol=1e-12)


@pytest.mark.parametrize("form", [np.float32, torch.tensor], ids=["numpy", "torch"])
def test_small_angles_are_as_accurate_in_single_precision(form: Any) -> None:
    # Multiples of 2e-5 from 0 on; the arc cosine would be wrong by up to 1e-3 rad at all of them.
    turns = 2e-5 * np.arange(50.0)
    axis = np.array([0.48, -0.6, 0.64])
    small = np.column_stack([np.cos(turns / 2), np.sin(turns / 2)[:, None] * axis])
    target = np.tile([0.5, 0.1, -0.7, 0.5], (50, 1))
    a, b = (form(q.astype(np.float32)) for q in (rotations.multiply(small, target), target))
    angle = np.asarray(rotations.angle_between(a, b))
    assert angle.dtype == np.float32
    np.testing.assert_allclose(angle, turns, rtol=0.0, atol=5e-7)
    assert (np.asarray(rotations.angle_between(-a, b)) == angle).all()


@given(arrays(np.float64, 4, elements=st.floats(-1e3, 1e3)).filter(_is_direction))
def test_normalised_keeps_the_direction(q: Floats) -> None:
    unit = rotations.normalised(q)
    np.testing.assert_allclose(unit * np.linalg.norm(q), q, rtol=1e-12, atol=1e-12)
    assert np.linalg.norm(unit) == pytest.approx(1.0, abs=1e-12)


def test_the_result_of_a_row_does_not_depend_on_the_batch() -> None:
    rng = np.random.default_rng(0)
    a, b = rotations.normalised(rng.normal(size=(2, 40, 4)))
    matrices = np.array([_matrix(q) for q in a])
    batch = (
        rotations.multiply(a, b),
        rotations.angle_between(a, b),
        rotations.from_matrix(matrices),
    )
    for row in range(40):
        one = slice(row, row + 1)
        single = (
            rotations.multiply(a[one], b[one]),
            rotations.angle_between(a[one], b[one]),
            rotations.from_matrix(matrices[one]),
        )
        for all_rows, one_row in zip(batch, single, strict=True):
            np.testing.assert_allclose(all_rows[one], one_row, rtol=0.0, atol=1e-15)


@given(quaternions)
def test_a_matrix_is_that_of_pinocchio_and_leads_back(q: Floats) -> None:
    (matrix,) = rotations.to_matrix(q[None])
    np.testing.assert_allclose(matrix, _matrix(q), rtol=0.0, atol=1e-12)
    assert _same_rotation(rotations.from_matrix(matrix[None])[0], rotations.canonical(q))


@given(quaternions)
def test_a_rotation_vector_is_that_of_pinocchio(q: Floats) -> None:
    q = rotations.canonical(q)
    np.testing.assert_allclose(pin.exp3(rotations.to_vector(q)), _matrix(q), rtol=0.0, atol=1e-9)
    assert np.linalg.norm(rotations.to_vector(q)) <= np.pi + 1e-12
