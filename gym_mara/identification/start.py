"""Where the search for parameters begins: the best of grids, so that it does not end in a local minimum."""

from __future__ import annotations

import numpy as np

from gym_mara.backends.servo_motion import late_servo_motion
from gym_mara.identification.following import Followers
from gym_mara.identification.log import Log
from gym_mara.identification.parameters import Space
from gym_mara.types import Floats

SEGMENT = 0.3
"""How long arms whose parameters are far off follow from a measured state, s."""
_LATENCIES, _GAINS, _EFFORTS = 41, 25, 9
FRICTIONS = np.array([0.02, 0.15, 0.3, 0.5, 0.7])
"""Joint friction that is tried, as parts of the effort limit."""
_ALIKE = 1.02
"""Parameters whose squared error is this close to the smallest one explain the log as well."""


def start(log: Log, space: Space, followers: Followers) -> Floats:
    """A parameter vector (P,) from which least squares can begin.

    The latency and the gains are those with which ideal servos, without inertia, follow the log best. Then the backend
    follows with effort limits and joint frictions from low to high, and each joint takes its best.
    """
    vector = space.nominal.copy()
    _servos(log, space, followers, vector)
    if space.of("effort_limit"):
        _efforts(space, followers, vector)
    return space.inside(vector)


def _servos(log: Log, space: Space, followers: Followers, vector: Floats) -> None:
    latency, gains = space.of("latency"), space.of("servo_gain")
    late, scale = np.zeros(1), np.ones(1)
    if latency:
        late = np.linspace(0.0, space.high[latency[0]], _LATENCIES)
    if gains:
        scale = np.geomspace(space.low[gains[0]], space.high[gains[0]], _GAINS)
    gain = followers.servo_gain * scale
    errors = _ideal_errors(log, late, gain, followers.joint_velocity, followers.starts(SEGMENT))
    best = errors.min(axis=1)
    # Each joint counts alike, however far it moves.
    chosen = int((best / best.min(axis=0)).sum(axis=1).argmin())
    if latency:
        vector[latency[0]] = late[chosen]
    for index in gains:
        vector[index] = scale[errors[chosen, :, space.entries[index][1]].argmin()]


def _ideal_errors(
    log: Log, latency: Floats, gain: Floats, joint_velocity: Floats, starts: range
) -> Floats:
    """The squared errors of servos without inertia (L, G, J), for latencies (L,), s, and gains (G,), 1/s."""
    period = log.control_period
    whole = np.floor(latency / period).astype(int)
    change = (latency - whole * period)[:, None, None]
    late, gains = whole[:, None, None], gain[:, None]
    shape = (len(latency), len(gain), log.q.shape[1])
    q, errors = np.empty(shape), np.full(shape, 1e-12)
    joints, times = np.arange(shape[2]), np.array([0.0, period])[:, None, None, None]
    for tick in range(len(log.times) - 1):
        if tick in starts:
            q[:] = log.q[tick]
        newest = tick - late
        both = (log.targets[np.maximum(newest - n, 0), joints] for n in (1, 0))
        q += late_servo_motion(q, (next(both), next(both)), gains, joint_velocity, times, change)[
            -1
        ]
        errors += (q - log.q[tick + 1]) ** 2
    return errors


def _efforts(space: Space, followers: Followers, vector: Floats) -> None:
    """Give each joint the best of a grid of effort limits and frictions; all joints take the same at the same time."""
    efforts, frictions = space.of("effort_limit"), space.of("joint_friction")
    scales = np.geomspace(space.low[efforts[0]], space.high[efforts[0]], _EFFORTS)
    parts = FRICTIONS[::2] if frictions else FRICTIONS[:1]
    scale, part = (grid.ravel() for grid in np.meshgrid(scales, parts, indexing="ij"))
    tried = np.tile(vector, (len(scale), 1))
    tried[:, efforts] = scale[:, None]
    for index in frictions:
        tried[:, index] = part * scale * space.effort_limit(index)
    tried = space.inside(tried)
    errors = (followers.errors(tried, SEGMENT) ** 2).mean(axis=1)
    for index in (*efforts, *frictions):
        column = errors[:, space.entries[index][1]]
        best = int(column.argmin())
        strongest = int(np.argmax(scale >= 1.0))
        if column[strongest] <= _ALIKE * column[best]:  # its limit is not reached
            best = strongest
        vector[index] = tried[best, index]
