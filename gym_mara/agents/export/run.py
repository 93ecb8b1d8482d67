"""Exports a run's policy into one ONNX file, with all that a robot's program must know in its metadata."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx.reference
from gymnasium.vector.utils import batch_space

from gym_mara import __version__
from gym_mara.agents.export.graph import to_onnx
from gym_mara.agents.runs.description import PolicyDescription
from gym_mara.agents.runs.evaluation import make_arms
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.runs.policy import Policy, load_policy
from gym_mara.deploy.about import ACTION, FORMAT, METADATA_KEY, OBSERVATION, About, Action, Training
from gym_mara.deploy.environment import interface
from gym_mara.envs import MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.files import written_aside

ENDING = ".onnx"
_COMPARED = 100
# Rounding in float32 is smaller by far; what a class computes otherwise is larger.
_TOLERANCE = 1e-3


def export(run: RunFolder, file: Path, *, which: str = "last") -> About:
    """Write a run's deterministic policy as an ONNX model; `gym_mara.deploy.OnnxPolicy` plays it.

    Args:
        run: the run.
        file: the file, a new one whose name ends in ".onnx".
        which: the policy, "last" or "best".

    Returns:
        The metadata in the file.

    Raises:
        GymMaraError: the file exists or cannot be written; the policy is missing, damaged or of another robot than the run's
            today; or its network cannot be exported.
        MissingExtraError: the engine of the run's backend is not installed.
    """
    if file.suffix != ENDING:
        raise GymMaraError(f"cannot export to {str(file)!r}: the name must end in {ENDING}")
    with written_aside(file, new=True) as temporary:
        policy = load_policy(run, which)
        model = to_onnx(policy.network, policy.about)
        config = run.config
        env = make_arms(config.env, config.backend, 1, config.env_options)
        try:
            policy.check(env.simulation)
            about = _about(run, which, policy.about, env)
            _compare(model, policy, env)
        finally:
            env.close()
        model.producer_name, model.producer_version = "gym_mara", __version__
        onnx.helper.set_model_props(model, {METADATA_KEY: about.to_json()})
        onnx.checker.check_model(model)
        temporary.write_bytes(model.SerializeToString())
    return about


def _about(run: RunFolder, which: str, policy: PolicyDescription, env: MaraVectorEnv) -> About:
    """The metadata of a run's policy, with what its environment tells of the robot and the observation."""
    config, there = run.config, interface(env.simulation)
    oriented = getattr(env.simulation.task, "orientation", None)
    return About(
        format=FORMAT,
        gym_mara=__version__,
        env=config.env,
        target=None if oriented is None else "pose" if oriented else "position",
        control_period=there.control_period,
        robot=there.robot,
        action=_action(policy),
        observation=there.observation,
        training=Training(
            algorithm=config.algo,
            preset=config.preset_name,
            steps=run.policy_steps(which),
            seed=config.seed,
            policy=which,
            backend=config.backend,
            env_options=_without_folders(config.env_options),
        ),
    )


def _action(policy: PolicyDescription) -> Action:
    """What the actions of a policy mean."""
    action = policy.action
    low, high, steps = tuple(policy.low), tuple(policy.high), tuple(action.steps)
    return Action(action.mode, low, high, steps, action.reference)


def _without_folders(value: Any) -> Any:
    """Options in which only the last part of each absolute path is left: the file may be given to anyone."""
    if isinstance(value, dict):
        return {name: _without_folders(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_without_folders(each) for each in value]
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value


def _compare(model: onnx.ModelProto, policy: Policy, env: MaraVectorEnv) -> None:
    """Compare the graph with the policy: a class derived from a known one may compute something else.

    Raises:
        GymMaraError: they differ.
    """
    space = batch_space(env.single_observation_space, _COMPARED)
    space.seed(0)
    observed: Any = space.sample()
    inputs = observed if isinstance(observed, dict) else {OBSERVATION: observed}
    (actions,) = onnx.reference.ReferenceEvaluator(model).run([ACTION], inputs)
    wanted, _ = policy.predict(observed)
    ranges = np.array(policy.about.high) - np.array(policy.about.low)
    if not (np.abs(actions - wanted) <= _TOLERANCE * ranges).all():
        raise GymMaraError(
            f"cannot export a policy of the class {type(policy.network).__name__}: it does not act as its layers do"
        )
