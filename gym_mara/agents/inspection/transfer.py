"""One policy on every backend, side by side: how well it transfers from one simulation to another."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from typing import Any, NamedTuple

from gym_mara.agents.runs.evaluation import (
    measure_run,
    options_beyond_backend,
    with_options,
)
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.backends import backend_settings, usable_backends
from gym_mara.envs import task_keywords
from gym_mara.envs.actions import ActionSettings
from gym_mara.envs.sensors import SensorSettings
from gym_mara.envs.travel import VELOCITY_LIMIT
from gym_mara.errors import unknown
from gym_mara.robot.options import ROBOT_KEYWORDS
from gym_mara.types import Floats


class Transferred(NamedTuple):
    """How a policy did on one backend."""

    backend: str
    """Its name."""
    settings: dict[str, Any]
    """Those of its settings that differ from its defaults."""
    metrics: dict[str, Floats]
    """Each of METRICS over N episodes (N,), see `gym_mara.agents.evaluation.metrics.measure`."""


def transfer(
    run: RunFolder,
    *,
    backends: Sequence[str] = (),
    episodes: int = 1,
    seed: int = 0,
    which: str = "last",
    options: dict[str, Any] | None = None,
) -> list[Transferred]:
    """Play a run's deterministic policy on several backends.

    Args:
        run: the run.
        backends: their names; if none is given all that work on this machine, with a warning for each of the others.
        episodes: how many on each backend; they differ only if something in the environment is random.
        seed: of the evaluation.
        which: the policy, "last" or "best".
        options: keyword arguments of the environment. Those of the task, the sensors and the robot count on every
            backend; a setting of backends goes to those that know it.

    Returns:
        A row for each backend with its defaults. A row before it has the settings of the training, if it had some. A
        backend whose joints teleport and that can limit their velocity has a further row, with the robot's lowest velocity
        limit for all joints.

    Raises:
        GymMaraError: the policy is missing or damaged; a backend is unknown or does not work; or an option is unknown or out
            of range.
    """
    play = partial(measure_run, run, episodes=episodes, seed=seed, which=which)
    of_env, given = options_beyond_backend(run.config), options or {}
    if not backends:
        backends, reasons = usable_backends()
        for reason in reasons:
            warnings.warn(f"left out: {reason}", stacklevel=2)
    settings = {name: backend_settings(name) for name in backends}
    of_env_too = {f.name for form in (SensorSettings, ActionSettings) for f in fields(form)}
    everywhere = {*ROBOT_KEYWORDS, *task_keywords(run.config.env), *of_env_too}
    for name in given:
        valid = everywhere.union(*settings.values())
        if name not in valid:
            raise unknown("keyword argument", name, valid, " on any of these backends")
    rows = []
    for name, known in settings.items():
        chosen = {key: value for key, value in given.items() if key in everywhere or key in known}
        trained = run.config.env_options if name == run.config.backend else {}
        ways = [chosen]
        if own := {key: value for key, value in trained.items() if key in known}:
            ways.insert(0, {**own, **chosen})
        for way in ways:
            metrics, velocity_limit = play(name, with_options(of_env, way))
            rows.append(Transferred(name, _of(way, known), metrics))
        if velocity_limit is not None:
            way = {**chosen, VELOCITY_LIMIT: velocity_limit}
            metrics, _ = play(name, with_options(of_env, way))
            rows.append(Transferred(name, _of(way, known), metrics))
    return rows


def _of(chosen: dict[str, Any], known: Sequence[str]) -> dict[str, Any]:
    """Those of the chosen options that are settings of a backend."""
    return {key: value for key, value in chosen.items() if key in known}
