"""What plays the episodes of a data set: inverse kinematics, a run's policy, or an exported one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gym_mara.agents.evaluation.baselines import BASELINES
from gym_mara.agents.evaluation.exported import begin_exported
from gym_mara.agents.evaluation.rollout import Act, Begin
from gym_mara.agents.runs.evaluation import chose_robot, options_on
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.runs.policy import load_policy
from gym_mara.deploy import OnnxPolicy
from gym_mara.envs.simulation import Simulation
from gym_mara.errors import one_of
from gym_mara.robot.options import ROBOT_KEYWORDS


@dataclass(frozen=True)
class Source:
    """What acts, and in which environment."""

    env: str
    """The name of the environment."""
    backend: str
    """The name of the backend."""
    options: dict[str, Any]
    """Keyword arguments of the environment."""
    begin: Begin
    """Is called at the start of the episodes, and returns what acts in them."""
    policy: str
    """The name of what acts, for the data set."""
    keywords: dict[str, Any]
    """The options in the form of JSON: with the keyword arguments of a robot where they have the robot itself."""


def baseline(name: str, env: str, backend: str, options: dict[str, Any]) -> Source:
    """A baseline of evaluations as the source, such as "ik".

    Raises:
        GymMaraError: there is no such baseline.
    """
    begin = BASELINES[one_of("baseline", name, BASELINES)]
    return Source(env, backend, options, begin, name, options)


def exported(file: Path, env: str | None, backend: str | None, options: dict[str, Any]) -> Source:
    """An exported policy as the source.

    Args:
        file: the policy.
        env: the name of the environment; None for that of the training.
        backend: the name of the backend; None for that of the training.
        options: keyword arguments of the environment that replace those of the training.

    Raises:
        GymMaraError: the file is missing or damaged, or a name is unknown.
        MissingExtraError: onnxruntime is not installed.
    """
    policy = OnnxPolicy(file)
    name, keywords = env or policy.about.env, policy.keywords(env, backend, **options)
    backend = keywords.pop("backend")
    return Source(name, backend, keywords, begin_exported(policy), file.name, keywords)


def of_run(folder: Path, backend: str | None, options: dict[str, Any]) -> Source:
    """The last policy of a run as the source.

    Args:
        folder: the run folder.
        backend: the name of the backend; None for that of the training.
        options: keyword arguments of the environment, in addition to those of the run.

    Raises:
        GymMaraError: the run or its policy is missing or damaged, or an option is unknown.
    """
    run = RunFolder.open(folder)
    backend = backend or run.config.backend
    settings, policy = options_on(backend, run.config, options), load_policy(run)

    def begin(simulation: Simulation) -> Act:
        policy.check(simulation, any_robot=chose_robot(settings))
        return lambda observation: policy.predict(observation)[0]

    made = policy.about.keywords(backend, settings)
    keywords = made
    if chose_robot(settings):  # `options_on` has replaced the keywords of the robot by the robot
        own = {**run.config.env_options, **options}
        robot = {name: own[name] for name in ROBOT_KEYWORDS if name in own}
        keywords = {name: value for name, value in made.items() if name != "robot"} | robot
    return Source(run.config.env, backend, made, begin, f"{run.config.algo} of a run", keywords)
