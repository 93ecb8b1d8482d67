"""Identification: the parameters of a backend that follows the log of a moving arm best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gym_mara.identification.following import Follower
from gym_mara.identification.identified import Estimate, Identified
from gym_mara.identification.log import Log
from gym_mara.identification.parameters import DEFAULT, Space
from gym_mara.identification.search import Search
from gym_mara.identification.start import SEGMENT, start
from gym_mara.robot import RobotModel
from gym_mara.types import Floats

_CLUSTER = 1.0
"""Errors less than this apart, s, are not taken to be independent."""
_TINY = 1e-6
"""A parameter that moves no joint by this part of its error is not determined."""


def identify(
    log: Log,
    robot: RobotModel,
    backend: str,
    parameters: Sequence[str] = DEFAULT,
    **settings: Any,
) -> Identified:
    """Find the parameters with which a backend follows a log best.

    Only joints that were told to move have parameters. Servos are ideal up to their effort limit: friction and masses show
    only while a motor is at its limit, and there (effort limits, friction, masses) and their multiples move the arm alike. So
    masses can be identified only without effort limits.

    Args:
        log: what happened. The arm touched nothing.
        robot: the arm.
        backend: a backend with dynamics and position servos: "dart" or "mujoco".
        parameters: names of `PRIORS`.
        **settings: keyword arguments of the backend.

    Raises:
        GymMaraError: the log is of another arm or does not move, a name or a setting is wrong.
        MissingExtraError: the engine is not installed.
    """
    log.require(robot.joint_names, robot.name)
    space = Space(robot, parameters, log.moving)
    follower = Follower(log, robot, backend, space, settings)
    try:
        before = follower.errors(space.nominal[None])[0]
        search = Search(space, follower, start(log, space, follower))
        search.descend(SEGMENT, 15, rough=True)
        search.try_frictions()
        unreached = search.leave_out_unreached()
        search.descend(math.inf, 15)
        search.try_frictions(near=True)
        unreached += search.leave_out_unreached()
        search.descend(math.inf, 8)  # each joint now counts by its own noise
        search.measure()
        errors = standard_errors(search, log)
    finally:
        follower.close()
    names = robot.joint_names
    return Identified(
        robot=robot.name,
        backend=backend,
        settings={**settings, "control_period": log.control_period},
        duration=log.duration,
        error=dict(zip(names, search.deviation.tolist(), strict=True)),
        error_before=dict(zip(names, np.sqrt((before**2).mean(axis=0)).tolist(), strict=True)),
        estimates=tuple(
            _estimate(space, index, search.vector[index], errors[index], index in unreached)
            for index in range(len(search.vector))
        ),
    )


def standard_errors(search: Search, log: Log) -> Floats:
    """The standard errors of the parameters (P,), infinite for those that the log does not determine.

    They are the larger of two: that of independent errors, s² (JᵀJ)⁻¹, and that of errors which within a second may be
    alike (the sandwich estimator with clusters). That of the latency has the deviation of a physics step as well.
    """
    space, own = search.space, search.searched
    jacobian, residuals = search.jacobian(search.vector), search.residuals()
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


def _estimate(space: Space, index: int, value: float, error: float, unreached: bool) -> Estimate:
    name, joint = space.entries[index]
    low, high = float(space.low[index]), float(space.high[index])
    reason = None
    if unreached:
        reason = "the effort limit was not reached"
    elif not math.isfinite(error):
        reason = "the joints move alike whatever it is"
    elif 4.0 * error > high - low:
        reason = f"its range is wider than what was allowed, {low:g} to {high:g}"
    known = reason is None
    return Estimate(
        name,
        None if joint is None else space.robot.joint_names[joint],
        float(value),
        float(error) if known else None,
        max(low, float(value - 2.0 * error)) if known else low,
        min(high, float(value + 2.0 * error)) if known else high,
        reason,
    )
