"""What is measured in an episode: accuracy, success, collisions, settling, tremble, smoothness and effort."""

from __future__ import annotations

import math

import numpy as np

from gym_mara.agents.evaluation.rollout import Trajectory
from gym_mara.types import Floats, Mask

SETTLED = 0.005
"""An arm is at its target within this position error, m, if its task has no tolerances of success."""
HELD = 0.5
"""How long an arm must stay at its target until the end of the episode to have settled, and the time over which tremble is
measured, s."""

METRICS = {
    "position_error_mm": "position error, mm",
    "position_error_mm_without_collision": "  without a collision",
    "angle_deg": "angle, deg",
    "angle_deg_without_collision": "  without a collision",
    "success_percent": "success",
    "collision_percent": "episodes with a collision",
    "collisions": "collisions",
    "reward_per_step": "reward per step",
    "return": "return",
    "settled_percent": "settled",
    "settling_time_s": "settling time, s",
    "settling_ratio": "settling / least time",
    "tremble_mm": "tremble, mm",
    "tremble_velocity": "tremble, rad/s",
    "action_rate": "action rate",
    "highest_torque": "highest torque / limit",
    "highest_velocity": "highest speed, rad/s",
}
"""The metrics and their titles in a table; docs/training.md defines them."""


def measure(played: Trajectory) -> dict[str, Floats]:
    """Each of METRICS for each of N episodes, (N,); NaN in an episode that has no such value.

    - Position error and angle are those of the last step; twice, the second time NaN in an episode with a collision.
    - `success_percent`: 100 if the last step is within the task's tolerances and no step collided, else 0. In the same way
      `collision_percent` and `settled_percent`: their means are shares.
    - `settling_time_s`: the time of the first step from which on the arm stays within the task's tolerances until the end, for
      at least HELD; within SETTLED if the task has none. 0 if it is there from the first step on.
    - `settling_ratio`: the settling time relative to the least time in which the joints' velocity limits allow a straight
      joint move from the start to the configuration in which the arm settled, max over joints |q_settled - q_start| / limit.
    - `tremble_mm`: the diagonal of the box, parallel to the world's axes, that holds the tool's path in the last HELD s.
      `tremble_velocity`: the highest speed of a joint in this time, rad/s. NaN in an episode that ends with a collision.
    - `action_rate`: the root mean square of the change of an action's components from one step to the next.
    - `highest_torque` of any joint, relative to its limit; `highest_velocity` of any joint, rad/s: the higher of the velocity
      at a step and the mean velocity since the step before.
    """
    lengths = played.steps.sum(axis=0)
    last = lengths - 1, np.arange(len(lengths))
    position, angle = 1000.0 * played.position_error[last], np.degrees(played.angle_error[last])
    collisions = (played.collided & played.steps).sum(axis=0, dtype=np.float64)
    free = collisions == 0.0
    success = np.where(np.isnan(played.success[last]), np.nan, 100.0 * played.success[last] * free)
    total = np.where(played.steps, played.reward, 0.0).sum(axis=0)
    measured = ~np.isnan(played.success[last]) | ~np.isnan(position)
    time, ratio = _settling(played, lengths)
    speed = _speed(played)
    torque = np.abs(played.torque / played.effort_limit).max(axis=2)
    end = _end(played, lengths) & ~played.collided[last]
    values = (
        position,
        np.where(free, position, np.nan),
        angle,
        np.where(free, angle, np.nan),
        success,
        np.where(free, 0.0, 100.0),
        collisions,
        total / lengths,
        total,
        np.where(measured, 100.0 * np.isfinite(time), np.nan),
        time,
        ratio,
        1000.0 * _diagonal(played.tool, end),
        _highest(speed, end),
        _action_rate(played),
        _highest(torque, played.steps),
        _highest(speed, played.steps),
    )
    return dict(zip(METRICS, values, strict=True))


def settling_time(played: Trajectory) -> Floats:
    """The settling time of each episode (N,), s, as in `measure`."""
    return _settling(played, played.steps.sum(axis=0))[0]


def _settling(played: Trajectory, lengths: Floats) -> tuple[Floats, Floats]:
    """The settling time, s, and its ratio to the least time, each (N,)."""
    near = np.where(np.isnan(played.success), played.position_error <= SETTLED, played.success > 0)
    away = played.steps & ~near
    # The first step from which on the arm is near.
    first = np.where(away.any(axis=0), len(away) - away[::-1].argmax(axis=0), 0)
    held = (lengths - first) * played.period >= HELD - 1e-9
    time = np.where(held, np.where(first > 0, first + 1, 0) * played.period, np.nan)
    settled_at = played.q[np.minimum(first, lengths - 1), np.arange(len(lengths))]
    # A joint that cannot move has the limit 0, and does not count.
    limit = np.where(played.velocity_limit > 0.0, played.velocity_limit, np.inf)
    least = (np.abs(settled_at - played.start) / limit).max(axis=1)
    moved = (first > 0) & (least > 0.0)
    return time, np.divide(time, least, out=np.full_like(time, np.nan), where=moved)


def _speed(played: Trajectory) -> Floats:
    """The highest speed of a joint at each step (T, N), rad/s."""
    before = np.concatenate([played.start[None], played.q[:-1]])
    # The mean counts because kinematic joints that reach their targets rest at every step. After a collision an arm may have
    # been put back, which is no motion.
    put_back = np.concatenate([np.zeros_like(played.collided[:1]), played.collided[:-1]])
    mean = np.where(put_back[..., None], 0.0, np.abs(played.q - before) / played.period)
    return np.maximum(np.abs(played.qd), mean).max(axis=2)


def _end(played: Trajectory, lengths: Floats) -> Mask:
    """The last HELD seconds of each episode (T, N); no step of an episode that is shorter."""
    count = max(2, math.ceil(HELD / played.period - 1e-9))
    step = np.arange(len(played.steps))[:, None]
    return played.steps & (step >= lengths - count) & (lengths >= count)


def _diagonal(path: Floats, chosen: Mask) -> Floats:
    """The diagonal (N,) of the box around the chosen (T, N) points of a path (T, N, 3); NaN if none is chosen."""
    rows = chosen[..., None]
    side = np.where(rows, path, -np.inf).max(axis=0) - np.where(rows, path, np.inf).min(axis=0)
    return np.where(chosen.any(axis=0), np.linalg.norm(side, axis=1), np.nan)


def _highest(values: Floats, chosen: Mask) -> Floats:
    """The highest of the chosen values (T, N) of each episode (N,); NaN if none is chosen, or if one is NaN."""
    highest = np.where(chosen, values, -np.inf).max(axis=0)
    return np.where(np.isneginf(highest), np.nan, highest)


def _action_rate(played: Trajectory) -> Floats:
    """The root mean square change of an action (N,); NaN in an episode of one step."""
    change = np.square(np.diff(played.action, axis=0)).mean(axis=2)
    counted = played.steps[1:]
    count = counted.sum(axis=0)
    total = np.where(counted, change, 0.0).sum(axis=0)
    return np.sqrt(np.divide(total, count, out=np.full(len(count), np.nan), where=count > 0))


STATISTICS = ("mean", "std", "min", "max", "p50", "p95")


def spread(metrics: dict[str, Floats]) -> dict[str, dict[str, float] | None]:
    """The STATISTICS of each metric over the episodes that have a value; None if none has.

    `p50` and `p95` are percentiles, which NumPy interpolates linearly.
    """
    return {name: _spread(values[~np.isnan(values)]) for name, values in metrics.items()}


def _spread(values: Floats) -> dict[str, float] | None:
    if not len(values):
        return None
    mean, std, (middle, high) = values.mean(), values.std(), np.percentile(values, [50.0, 95.0])
    found = (mean, std, values.min(), values.max(), middle, high)
    return {name: float(value) for name, value in zip(STATISTICS, found, strict=True)}


def in_short(value: float) -> str:
    """A number for a table: fewer digits after the point the larger it is, and two significant digits below 0.1."""
    size = abs(value)
    if 1e-6 <= size < 0.1:
        return f"{value:.2g}"
    digits = 3 if size < 10.0 else 2 if size < 100.0 else 1 if size < 1000.0 else 0
    return f"{value:.{digits}f}"


def statistics_in_short(name: str, values: Floats) -> list[str]:
    """The STATISTICS of one of METRICS; only the mean of a share. "-" if no episode has a value."""
    found = spread({name: values})[name]
    if found is None:
        return ["-"]
    if name.endswith("_percent"):
        return [f"{found['mean']:.1f} %"]
    return [in_short(value) for value in found.values()]


def mean_in_short(name: str, values: Floats) -> str:
    """The mean and the standard deviation of one of METRICS, and how many episodes have a value if some have none."""
    mean, *more = statistics_in_short(name, values)
    there = int(np.count_nonzero(~np.isnan(values)))
    text = f"{mean} ± {more[0]}" if more and there > 1 else mean
    return text if there in (0, len(values)) else f"{text} ({there} of {len(values)} episodes)"
