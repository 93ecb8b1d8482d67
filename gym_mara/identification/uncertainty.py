"""How sure identified parameters are: standard errors, and what the log does not determine at all."""

from __future__ import annotations

import math

import numpy as np

from gym_mara.identification.identified import Estimate
from gym_mara.identification.log import Log
from gym_mara.identification.parameters import Space
from gym_mara.identification.retries import SEEN
from gym_mara.identification.search import Search
from gym_mara.types import Floats

_CLUSTER = 1.0
"""Errors less than this apart, s, are not taken to be independent."""
_TINY = 1e-6
"""A parameter that moves no joint by this part of its error is not determined."""
_ROUNDS = 3
"""How often uncertain directions are measured, each time over the standard errors that were found before."""
_WEAK, _LONGEST = 1e-2, 0.3
"""A standard error, in the coordinates of the search, from which on a direction is measured, and the longest step."""
_SCALED = ("effort_limit", "joint_friction", "mass")
"""Parameters whose multiples move the arm alike."""
_SCALE = 1.2
_UNCERTAIN = 0.2
"""Two standard errors of these parameters, in parts of their value, from which on they are not determined."""
_LEAST_FRICTION = 0.05
"""Smaller friction, in parts of the robot's effort limit, counts like this one there: it may be 0."""


def estimates(search: Search, log: Log) -> tuple[Estimate, ...]:
    """What the search found, with ranges of two standard errors, or the reason why the log does not determine it."""
    space, errors = search.space, standard_errors(search, log)
    scaled = _only_ratios(search)
    found = []
    for index, (name, joint) in enumerate(space.entries):
        low, high, error = float(space.low[index]), float(space.high[index]), float(errors[index])
        value, reason = float(search.vector[index]), None
        if index in search.left_out:
            reason = "the effort limit was not reached"
        elif index in scaled:
            reason = "only ratios of efforts, frictions and masses show"
        elif not math.isfinite(error):
            reason = "the joints move alike whatever it is"
        elif 2.0 * error > _UNCERTAIN * _size(space, index, value):
            reason = f"too uncertain, {value:.3g} ± {2.0 * error:.2g}"
        known = reason is None
        found.append(
            Estimate(
                name,
                None if joint is None else space.robot.joint_names[joint],
                value,
                error if known else None,
                max(low, value - 2.0 * error) if known else low,
                min(high, value + 2.0 * error) if known else high,
                reason,
            )
        )
    return tuple(found)


def _size(space: Space, index: int, value: float) -> float:
    """What the uncertainty of an entry is compared with."""
    name = space.entries[index][0]
    if name == "joint_friction":
        return max(value, _LEAST_FRICTION * space.effort_limit(index))
    return value if name in _SCALED else float(space.high[index] - space.low[index])


def _only_ratios(search: Search) -> list[int]:
    """The efforts, frictions and masses, by number, if the log does not show by what they are all multiplied."""
    space = search.space
    if not space.of("effort_limit") or not space.of("mass"):
        return []
    own = [index for name in _SCALED for index in space.of(name)]
    vectors = np.tile(search.vector, (2, 1))
    vectors[1, own] *= _SCALE
    squares = ((search.errors(vectors) / search.deviation) ** 2).sum(axis=(1, 2))
    return own if squares[1] - squares[0] < SEEN else []


def standard_errors(search: Search, log: Log) -> Floats:
    """The standard errors of the parameters (P,), infinite for those that the log does not determine.

    They are the larger of two: that of independent errors, s² (JᵀJ)⁻¹, and that of errors which within a second may be
    alike (the sandwich estimator with clusters). That of the latency has the deviation of a physics step as well.
    """
    space, own = search.space, search.searched
    jacobian, residuals = _derivatives(search), search.residuals(search.vector)
    _, lengths, directions = np.linalg.svd(jacobian, full_matrices=False)
    known = lengths > _TINY * math.sqrt(len(residuals))
    with np.errstate(divide="ignore"):
        inverse = np.where(known, 1.0 / lengths, 0.0)
    bread = (directions.T * inverse**2) @ directions
    freedom = max(1, len(residuals) - len(own))
    variance = np.diag(bread) * (residuals @ residuals) / freedom
    rows = round(_CLUSTER / log.control_period) * log.q.shape[1]
    scores = np.array(
        [
            residuals[at : at + rows] @ jacobian[at : at + rows]
            for at in range(0, len(residuals), rows)
        ]
    )
    clustered = np.diag(bread @ (scores.T @ scores) @ bread)
    errors = np.full(len(search.vector), np.inf)
    lost = (directions[~known] ** 2).sum(axis=0) > _TINY
    found = np.sqrt(np.maximum(variance, clustered)) * space.slope(search.vector)[own]
    errors[own] = np.where(lost, np.inf, found)
    # A motor at its limit feels a target only from the next physics step on.
    errors[space.of("latency")] += search.physics_step / math.sqrt(12.0)
    return errors


def _derivatives(search: Search) -> Floats:
    """The derivatives of the residuals ((T - 1) J, S), those of uncertain directions over two standard errors.

    Finite differences with short steps see small jumps, where friction sticks and slips. Where the log hardly shows a
    parameter, they would pass for knowledge of it.
    """
    jacobian = search.jacobian(search.vector)
    space, own = search.space, search.searched
    middle = space.stretched(search.vector)[own]
    low, high = space.stretched(space.low)[own], space.stretched(space.high)[own]
    for _ in range(_ROUNDS):
        _, lengths, directions = np.linalg.svd(jacobian, full_matrices=False)
        weak = lengths * _WEAK < 1.0
        if not weak.any():
            break
        ways = directions[weak]
        steps = np.minimum(1.0 / np.maximum(lengths[weak], 1e-9), _LONGEST)[:, None] * ways
        ends = np.stack(
            [middle + _within(sign * steps, low - middle, high - middle) for sign in (1, -1)]
        )
        widths = ((ends[0] - ends[1]) * ways).sum(axis=1)
        errors = search.errors(search.vectors(ends.reshape(-1, len(own)))) / search.deviation
        ahead, behind = errors.reshape(2, len(ways), -1)
        measured = (ahead - behind) / np.maximum(widths, 1e-9)[:, None]
        jacobian = jacobian + (measured.T - jacobian @ ways.T) @ ways
    return np.asarray(jacobian)


def _within(steps: Floats, low: Floats, high: Floats) -> Floats:
    """Steps (K, S), those that do not end within these ends (S,) made shorter."""
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(steps > 0.0, high / steps, np.where(steps < 0.0, low / steps, np.inf))
    return steps * np.clip(room.min(axis=1, keepdims=True), 0.0, 1.0)
