"""Shows an exported policy in the viewer, where the arm follows the target that the user drags."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gym_mara.deploy import OnnxPolicy
from gym_mara.envs import make_vector_env
from gym_mara.envs.travel import VELOCITY_LIMIT, travel_note, travel_velocity
from gym_mara.viewer import watch


def watch_exported(
    file: Path,
    env: str | None,
    backend: str | None,
    options: dict[str, Any],
    speed: float,
    log: Callable[[str], None],
) -> None:
    """Play an exported policy in the viewer until the user interrupts.

    Where targets are random the policy follows the one that the user drags: there is one episode without an end, and no
    collision ends it. Elsewhere it plays one episode after the other.

    Args:
        file: the policy.
        env: the name of an environment; None for that of the training.
        backend: the name of a backend; None for that of the training.
        options: keyword arguments of the environment that replace those of the training.
        speed: times real time.
        log: is called with a sentence if joints travel that would teleport.

    Raises:
        GymMaraError: the file is missing or damaged, the policy does not fit the environment, a value is out of its range, or
            the viewer cannot open.
        MissingExtraError: a library is not installed.
    """
    policy = OnnxPolicy(file)
    name, keywords = env or policy.about.env, policy.keywords(env, backend, **options)
    arms = make_vector_env(name, 1, **keywords)
    try:
        policy.check(arms)
        follows, limit = arms.simulation.task.random_goal, travel_velocity(arms.simulation)
    finally:
        arms.close()
    if follows:
        keywords = {**keywords, "on_collision": "continue", **options}
    # Only joint targets can be far away; the policy's steps are as short as joints travel.
    if policy.about.action.mode == "absolute" and limit and VELOCITY_LIMIT not in options:
        keywords[VELOCITY_LIMIT] = limit
        log(travel_note(keywords["backend"], limit))
    watch(
        name,
        keywords.pop("backend"),
        keywords,
        lambda _: lambda observation: policy.predict(observation)[0],
        speed=speed,
        endless=follows,
    )
