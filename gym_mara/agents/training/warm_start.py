"""A training that starts with the policy of another run: kinematics first, for example, then dynamics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from gym_mara.agents.algorithms.base import Preset
from gym_mara.agents.runs.archive import read_weights
from gym_mara.agents.runs.config import RunConfig, Start
from gym_mara.agents.runs.description import PolicyDescription, described, read_description
from gym_mara.agents.runs.evaluation import options_beyond_backend
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.runs.policy import base_env, normalisation, read_policy
from gym_mara.agents.training.checkpoint import variables_of
from gym_mara.errors import GymMaraError
from gym_mara.robot.options import ROBOT_KEYWORDS

# Arguments of a network that do not change what its weights mean: how they are drawn, how they are learnt, and the rates of
# the natural Gaussian, which `take_over` converts.
_FREE = (
    "log_std_init",
    "ortho_init",
    "optimizer_class",
    "covariance_rate",
    "bias_rate",
    "widening",
)


def started_from(
    run: RunFolder,
    which: str = "last",
    env_options: dict[str, Any] | None = None,
    **changes: Any,
) -> RunConfig:
    """The configuration of a run that starts with the policy of another one.

    Args:
        run: the other run. Its environment, keyword arguments, backend, algorithm and preset are the defaults; on another
            backend without the settings of its own.
        which: its policy, "last" or "best".
        env_options: keyword arguments of the environment that replace those of the other run.
        **changes: other fields of RunConfig, such as `backend` and `steps`.

    Raises:
        GymMaraError: the run has no such policy, or a value is out of its range.
    """
    config = run.config
    backend = changes.get("backend", config.backend)
    own = config.env_options if backend == config.backend else options_beyond_backend(config)
    about = read_description(run.policy(which))
    start = Start(str(run.path.absolute()), which, run.trained_steps())
    options = about.keywords(backend, {**own, **(env_options or {})})
    return replace(config, preset={}, env_options=options, start=start, **changes)


def begin_with(model: BaseAlgorithm, config: RunConfig) -> None:
    """Give an untrained model the weights, and the statistics of the observations, with which its run starts.

    Raises:
        DamagedRunError: the other run is missing or damaged.
        GymMaraError: its policy does not fit the environment or the preset; the message says what differs.
    """
    start = config.start
    assert start is not None
    run = RunFolder.open(Path(start.run))
    folder = run.policy(start.policy)
    theirs, preset = run.config.made_preset(), config.made_preset()
    policy = read_policy(folder, theirs)
    other_robot = any(
        config.env_options.get(name) != run.config.env_options.get(name) for name in ROBOT_KEYWORDS
    )
    policy.check(base_env(model).env.simulation, any_robot=other_robot)
    differences = _differences(policy.about, model, theirs, preset)
    if differences:
        raise GymMaraError(
            f"the policy of {start.run!r} does not fit the new run: "
            + "; ".join(f"{name} is {old} there, {new} here" for name, old, new in differences)
        )
    model.policy.take_over(policy.network)  # type: ignore[operator]
    statistics = policy.about.normalisation
    if statistics is not None:
        running: Any = normalisation(model).obs_rms
        running.mean[:], running.var[:] = statistics.mean, statistics.var
        running.count = float(max(start.steps, 1))  # each step was an observation
    if isinstance(model, OffPolicyAlgorithm):
        saved = read_weights(folder / "model.zip", "pytorch_variables.pth")
        with torch.no_grad():
            for name, variable in variables_of(model).items():
                if name in saved:  # not if only one of the two learns its entropy coefficient
                    variable.copy_(saved[name].reshape(variable.shape))


def _differences(
    about: PolicyDescription, model: BaseAlgorithm, theirs: Preset, preset: Preset
) -> list[tuple[str, Any, Any]]:
    """What differs in the robot's joints, the actions, the normalisation and the network: name, value there, value here."""
    now = described(base_env(model).env.simulation, None)
    pairs = {name: (getattr(about, name), getattr(now, name)) for name in ("joints", "low", "high")}
    pairs["normalise_observation"] = (theirs.normalise_observation, preset.normalise_observation)
    pairs["the network"] = (theirs.policy, preset.policy)
    old, new = (
        {k: v for k, v in each.arguments.get("policy_kwargs", {}).items() if k not in _FREE}
        for each in (theirs, preset)
    )
    pairs |= {name: (old.get(name), new.get(name)) for name in sorted({*old, *new})}
    return [(name, before, after) for name, (before, after) in pairs.items() if before != after]
