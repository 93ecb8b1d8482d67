"""A run's deterministic policy, played step by step, and the trajectory that it makes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np

from gym_mara.agents.runs.evaluation import chose_robot, make_arms
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.runs.policy import load_policy
from gym_mara.backends import backend_settings
from gym_mara.envs.outcome import Outcome
from gym_mara.registration import environment
from gym_mara.types import Floats, Mask

VELOCITY_LIMIT = "max_joint_velocity"
"""The setting with which joints travel that would else teleport."""


class Player:
    """A run's deterministic policy on N arms of one backend, at the start of an episode without a time limit.

    Use it in a `with` statement.

    Args:
        run: the run.
        backend: the backend.
        options: keyword arguments of the environment, from `options_on`.
        which: the policy, "last" or "best".
        episodes: N.

    Raises:
        GymMaraError: the policy is missing, damaged or of another environment or robot, or an option is unknown or out of range.
    """

    def __init__(
        self,
        run: RunFolder,
        backend: str,
        options: dict[str, Any],
        *,
        which: str = "last",
        episodes: int = 1,
    ) -> None:
        config = run.config
        self.policy = load_policy(run, which)
        self.episode_steps = environment(config.env).max_episode_steps
        """The length of an episode, steps."""
        self.options = self.policy.about.keywords(backend, options)
        """The keyword arguments of the environment, with the policy's action mode and steps."""
        self.env = make_arms(config.env, backend, episodes, self.options, max_episode_steps=None)
        try:
            self.policy.check(self.env.simulation, any_robot=chose_robot(options))
            self._observation, _ = self.env.reset(seed=config.seed)
        except BaseException:
            self.env.close()
            raise

    def act(self, observation: Floats) -> Floats:
        """The actions (N, A) for observations (N, O)."""
        return self.policy.predict(observation)[0]

    def step(self) -> Outcome:
        """Let the policy act for one step; the outcome holds the state that the task judged."""
        self._observation, *_ = self.env.step(self.act(self._observation))
        outcome = self.env.simulation.outcome
        assert outcome is not None
        return outcome

    @property
    def velocity_limit(self) -> float | None:
        """If the joints teleport, the value of VELOCITY_LIMIT with which they travel: the robot's lowest velocity limit, rad/s.

        None if they do not teleport, or if the backend or the robot has no limit.
        """
        simulation = self.env.simulation
        lowest = float(simulation.robot.velocity_limit.min())
        limited = VELOCITY_LIMIT in backend_settings(simulation.backend_name)
        if simulation.backend.teleports and limited and 0.0 < lowest < math.inf:
            return lowest
        return None

    def __enter__(self) -> Player:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.env.close()


@dataclass(frozen=True, eq=False)
class Trajectory:
    """N episodes of T steps, as the task judged them: after a collision this is the colliding pose, not the reset one."""

    period: float
    """Between two steps, s."""
    q: Floats
    """(T, N, J), rad."""
    qd: Floats
    """(T, N, J), rad/s."""
    torque: Floats
    """(T, N, J), Nm; NaN on a backend without dynamics."""
    tool: Floats
    """The position of the end-effector frame (T, N, 3), m."""
    position_error: Floats
    """(T, N), m; NaN where the task has none."""
    angle_error: Floats
    """(T, N), rad; NaN where the task has none."""
    reward: Floats
    """(T, N)."""
    collided: Mask
    """(T, N)."""


def roll_out(player: Player, steps: int | None = None) -> Trajectory:
    """Let a player's policy act for this many steps; by default for the length of an episode."""
    rows = [_row(player.step()) for _ in range(steps or player.episode_steps)]
    period = player.env.simulation.backend.control_period
    return Trajectory(period, *map(np.array, zip(*rows, strict=True)))


def _row(outcome: Outcome) -> tuple[Any, ...]:
    """One step of a trajectory, in the order of its fields."""
    state, info = outcome.state, outcome.info
    absent = np.full(len(state.q), np.nan)
    return (
        state.q,
        state.qd,
        np.full_like(state.q, np.nan) if state.torque is None else state.torque,
        state.ee_position,
        info.get("position_error", absent),
        info.get("angle_error", absent),
        outcome.reward,
        state.collided,
    )
