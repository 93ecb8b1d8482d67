"""Measures an exported policy, in the same episodes and in the same way as a run's."""

from __future__ import annotations

from typing import Any

from gym_mara.agents.evaluation.rollout import Act, Begin
from gym_mara.agents.runs.evaluation import measure_acting
from gym_mara.deploy import OnnxPolicy
from gym_mara.deploy.environment import check_fits
from gym_mara.envs.simulation import Simulation
from gym_mara.types import Floats


def evaluate_exported(
    policy: OnnxPolicy, env: str, options: dict[str, Any], *, episodes: int = 10, seed: int = 0
) -> dict[str, Floats]:
    """Play the episodes that `evaluate_run` plays with the same arguments, with an exported policy.

    Args:
        policy: the policy.
        env: the name of the environment.
        options: keyword arguments of the environment with its `backend`, from `OnnxPolicy.keywords`.
        episodes: the number of episodes.
        seed: of the evaluation.

    Returns:
        Each of METRICS per episode (episodes,).

    Raises:
        GymMaraError: the policy does not fit the environment, a name is unknown, or a value is out of its range.
    """
    others = dict(options)
    backend = others.pop("backend")
    begin = begin_exported(policy)
    return measure_acting(begin, env, backend, others, episodes=episodes, seed=seed)


def begin_exported(policy: OnnxPolicy) -> Begin:
    """Lets an exported policy act, in environments that it fits; it refuses others with a GymMaraError."""

    def begin(simulation: Simulation) -> Act:
        check_fits(policy.about, simulation)
        return lambda observation: policy.predict(observation)[0]

    return begin
