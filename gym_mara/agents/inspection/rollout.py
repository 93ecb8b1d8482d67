"""A run's deterministic policy, played step by step, and what is kept of it."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.agents.runs.evaluation import make_env
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.runs.policy import load_policy
from gym_mara.tasks import MAX_EPISODE_STEPS

Floats = NDArray[np.float64]


class Player:
    """A run's deterministic policy on N arms of one backend, at the beginning of an episode without end.

    Use it in a `with` statement.

    Args:
        run: the run.
        backend: the backend.
        options: keyword arguments of the environment.
        which: the policy, "last" or "best".
        episodes: N.

    Raises:
        GymMaraError: the policy is missing, damaged or of another environment, or a value is out of its range.
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
        vec_env = make_env(config.env, backend, episodes, options, max_episode_steps=None)
        self.env = vec_env.env
        try:
            self._targets = vec_env.targets
            self._policy, self._normalisation = load_policy(run.policy(which), config, vec_env)
            self._observation, _ = self.env.reset(seed=config.seed)
        except BaseException:
            self.env.close()
            raise

    def act(self, observation: Floats) -> Floats:
        """The joint targets (N, J), rad, for observations (N, O)."""
        seen: Any = self._normalisation.normalize_obs(observation)
        action, _ = self._policy.predict(seen, deterministic=True)
        return self._targets(action)

    def step(self) -> tuple[Floats, dict[str, Any]]:
        """Take a step; the rewards (N,) and the info."""
        targets = self.act(self._observation)
        self._observation, reward, _, _, info = self.env.step(targets)
        return reward, info

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
    """N episodes of T steps."""

    period: float
    """Between two steps, s."""
    q: Floats
    """(T, N, J), rad."""
    qd: Floats
    """(T, N, J), rad/s."""
    torque: Floats
    """(T, N, J), Nm; NaN on a backend without torques."""
    tool: Floats
    """The position of the end-effector frame (T, N, 3), m."""
    position_error: Floats
    """(T, N), m; NaN where the task has none."""
    angle_error: Floats
    """(T, N), rad; NaN where the task has none."""
    reward: Floats
    """(T, N)."""
    collided: NDArray[np.bool_]
    """(T, N)."""


def record(player: Player, steps: int = MAX_EPISODE_STEPS) -> Trajectory:
    """Play so many steps and keep them."""
    rows: list[tuple[Any, ...]] = []
    simulation = player.env.simulation
    nothing = np.full(player.env.num_envs, np.nan)
    for _ in range(steps):
        reward, info = player.step()
        state = simulation.backend.state
        rows.append(
            (
                state.q,
                state.qd,
                info.get("joint_torque", np.full_like(state.q, np.nan)),
                state.ee_position,
                info.get("position_error", nothing),
                info.get("angle_error", nothing),
                reward,
                info["collided"],
            )
        )
    return Trajectory(simulation.backend.control_period, *map(np.array, zip(*rows, strict=True)))
