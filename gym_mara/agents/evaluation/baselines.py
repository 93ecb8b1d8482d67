"""Baselines that need no training, in the same episodes and measured in the same way as a policy."""

from __future__ import annotations

from typing import Any

import numpy as np

from gym_mara.agents.evaluation.rollout import Begin
from gym_mara.agents.runs.evaluation import measure_acting
from gym_mara.envs.actions.straight import StraightActions
from gym_mara.envs.simulation import Simulation
from gym_mara.errors import GymMaraError, one_of
from gym_mara.robot.inverse_kinematics import solve_ik
from gym_mara.types import Floats


class StraightMove:
    """Inverse kinematics, then a straight joint move at the joints' velocity limits; it sees no obstacle.

    The configuration of each target is the one that the search finds from the start configuration, or from elsewhere if that
    search fails (`solve_ik`). In 60 random poses of MARA that move took 11 % longer, on average, than that to the nearest of
    25 solutions, which would take ten times as long to compute. If the task knows configurations (`guide`), it is the nearest
    of them. All joints arrive together: the slowest moves at its limit.
    The move knows the true joint positions, also where sensors are noisy.

    Args:
        simulation: N arms at the start of their episodes.

    Raises:
        GymMaraError: the task has no pose to reach, or the actions are not those of joints.
    """

    def __init__(self, simulation: Simulation) -> None:
        task, robot, backend = simulation.task, simulation.robot, simulation.backend
        actions, state = simulation.actions, backend.state
        self._move = StraightActions(simulation)
        state.fill_actions(actions.action, actions.last_action)
        if "position_error" not in simulation.rewards(state)[1]:
            raise GymMaraError(
                f"inverse kinematics needs a task with a pose to reach, and the info of {type(task).__name__} has no "
                "position_error: choose another --env, or evaluate a trained policy"
            )
        self._simulation = simulation
        self._goal = self._found(state.q.clip(robot.lower, robot.upper))

    def _found(self, start: Floats) -> Floats:
        """The configurations (N, J) to move to from the start (N, J), rad (m)."""
        goal, robot = self._simulation.goal, self._simulation.robot
        orientation = getattr(self._simulation.task, "orientation", False)
        ways = goal.ways(start)
        return np.array(
            [
                q + way
                if way.any()
                else solve_ik(robot, position, turn if orientation else None, q)
                for q, way, position, turn in zip(
                    start, ways, goal.position, goal.quaternion, strict=True
                )
            ]
        )

    def __call__(self, observation: Any) -> Floats:
        """The actions (N, J) of the next step."""
        return self._move.to(self._goal)


BASELINES: dict[str, Begin] = {"ik": StraightMove}
"""The baselines by name."""


def evaluate_baseline(
    name: str,
    env: str,
    *,
    backend: str,
    episodes: int = 10,
    seed: int = 0,
    options: dict[str, Any] | None = None,
) -> dict[str, Floats]:
    """Play the episodes that `evaluate_run` plays with the same arguments, with a baseline.

    Args:
        name: one of BASELINES.
        env: the name of the environment.
        backend: the name of the backend.
        episodes: the number of episodes.
        seed: of the evaluation.
        options: keyword arguments of the environment.

    Returns:
        Each of METRICS per episode (episodes,).

    Raises:
        GymMaraError: the baseline cannot act in this environment, a name is unknown, or a value is out of its range.
    """
    begin = BASELINES[one_of("baseline", name, BASELINES)]
    return measure_acting(begin, env, backend, options or {}, episodes=episodes, seed=seed)
