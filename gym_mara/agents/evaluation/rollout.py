"""The trajectories of N episodes that are played side by side, and what the task said of each step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gym_mara.envs import MaraVectorEnv
from gym_mara.envs.outcome import Outcome
from gym_mara.envs.simulation import Simulation
from gym_mara.types import Floats, Mask

Act = Callable[[Any], Floats]
"""The actions (N, A) for the observations of N arms."""
Begin = Callable[[Simulation], Act]
"""Is called at the start of the episodes, and returns what acts in them."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """N episodes of up to T steps, as the task judged them: after a collision this is the colliding pose, not the reset one."""

    period: float
    """Between two steps, s."""
    velocity_limit: Floats
    """Of each joint (J,), rad/s; infinite where the joints teleport."""
    effort_limit: Floats
    """Of each joint (J,), Nm."""
    start: Floats
    """The joint positions before the first step (N, J), rad."""
    target: Floats
    """The position of the goal (N, 3), m."""
    steps: Mask
    """Which steps belong to the episode (T, N); the values of the others mean nothing."""
    q: Floats
    """(T, N, J), rad."""
    qd: Floats
    """(T, N, J), rad/s; NaN where the joints teleport."""
    torque: Floats
    """(T, N, J), Nm; NaN on a backend without dynamics."""
    tool: Floats
    """The position of the end-effector frame (T, N, 3), m."""
    position_error: Floats
    """(T, N), m; NaN where the task has none."""
    angle_error: Floats
    """(T, N), rad; NaN where the task has none."""
    success: Floats
    """Whether the arm is within the task's tolerances (T, N), 1 or 0; NaN where the task has none."""
    reward: Floats
    """(T, N)."""
    collided: Mask
    """(T, N)."""
    action: Floats
    """(T, N, A), in the units of the action space."""


def roll_out(arms: MaraVectorEnv, begin: Begin, seeds: Sequence[int], steps: int) -> Trajectory:
    """Play an episode with each arm. All begin together, and end after this many steps or where the task ends them.

    Args:
        arms: N arms with the autoreset mode SAME_STEP and without a time limit.
        begin: what acts.
        seeds: of the episodes (N,).
        steps: the length of an episode.
    """
    observation, _ = arms.reset(seed=seeds)
    simulation = arms.simulation
    backend, start, target = (
        simulation.backend,
        simulation.backend.state.q,
        simulation.goal.position,
    )
    act = begin(simulation)
    low, high = simulation.action_space.low, simulation.action_space.high
    running = np.ones(arms.num_envs, np.bool_)
    belongs: list[Mask] = []
    rows: list[tuple[Any, ...]] = []
    while len(rows) < steps and running.any():
        action = np.clip(act(observation), low, high)
        observation, _, terminated, truncated, _ = arms.step(action)
        assert simulation.outcome is not None
        belongs.append(running)
        rows.append(_row(simulation.outcome, action, backend.teleports))
        running = running & ~(terminated | truncated)
    return Trajectory(
        backend.control_period,
        np.full_like(start[0], np.inf) if backend.teleports else backend.joint_velocity,
        simulation.robot.effort_limit,
        start,
        target,
        np.array(belongs),
        *map(np.array, zip(*rows, strict=True)),
    )


def _row(outcome: Outcome, action: Floats, teleports: bool) -> tuple[Any, ...]:
    """One step of a trajectory, in the order of its fields from `q` on."""
    state, info = outcome.state, outcome.info
    absent, of_joints = np.full(len(state.q), np.nan), np.full_like(state.q, np.nan)
    success = info.get("success", info.get("is_success", absent))
    return (
        state.q,
        of_joints if teleports else state.qd,
        of_joints if state.torque is None else state.torque,
        state.ee_position,
        info.get("position_error", absent),
        info.get("angle_error", absent),
        success.astype(np.float64),
        outcome.reward,
        state.collided,
        action,
    )
