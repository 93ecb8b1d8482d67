"""What a data set contains: its environment, its spaces, and what the numbers of its arrays are."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from gymnasium.spaces import Box, Dict, Space
from gymnasium.wrappers import AddRenderObservation

from gym_mara.deploy.environment import interface
from gym_mara.envs.simulation import Simulation
from gym_mara.errors import GymMaraError
from gym_mara.registration import environment, environment_id
from gym_mara.rendering import RenderSettings
from gym_mara.rendering.settings import PIXELS, STATE

LOWEST_PIXELS, MOST_PIXELS = 32, 512
"""The range of the width and height of pictures: Minari takes no smaller array for a picture."""


@dataclass(frozen=True)
class Contents:
    """What every episode of a data set has in common."""

    spec: EnvSpec
    """What makes its environment again, pictures included."""
    observation_space: Space[Any]
    """That of the environment, with the pictures if there are some."""
    action_space: Box[np.float32]
    """(A,)."""
    state_names: dict[str, tuple[str, ...]]
    """The name of each number of an observation, for each array of it; the key is STATE if the observation is an array."""
    action_names: tuple[str, ...]
    """The name of each number of an action (A,)."""
    robot: str
    """The name of the robot."""
    control_period: float
    """Between two steps, s."""
    policy: str
    """What acted."""
    pictures: RenderSettings | None
    """How the pictures are drawn; None for none."""


def contents_of(
    simulation: Simulation, env: str, keywords: dict[str, Any], policy: str, pixels: int | None
) -> Contents:
    """What a data set of a simulation contains.

    Args:
        simulation: the arms.
        env: the name of the environment.
        keywords: its keyword arguments, in the form of JSON.
        policy: what acts.
        pixels: the width and height of a picture at each step; None for no pictures.

    Raises:
        GymMaraError: the size of the pictures is out of its range.
    """
    if simulation.pixels is not None:
        raise GymMaraError(
            f"give pixels (--pixels) to record pictures, and leave out observation={simulation.pixels.settings.observation!r}"
        )
    space, kind = simulation.observation_space, interface(simulation)
    pictures: RenderSettings | None = None
    wrappers: tuple[WrapperSpec, ...] = ()
    if pixels is not None:
        pictures = dataclasses.replace(
            simulation.options.rendering, width=checked_pixels(pixels), height=pixels
        )
        box = Box(0, 255, (pixels, pixels, 3), np.uint8)
        if isinstance(space, Dict):
            space = Dict({PIXELS: box, **space.spaces})
        else:
            space = Dict({STATE: space, PIXELS: box})
        keywords = {**keywords, "render_mode": "rgb_array", "width": pixels, "height": pixels}
        wrappers = (_with_pictures(),)
    names: dict[str, tuple[str, ...]] = {}
    for part in kind.observation:
        key = part.input if isinstance(simulation.observation_space, Dict) else STATE
        names[key] = (*names.get(key, ()), *(f"{part.name}_{i}" for i in range(part.size)))
    joints = tuple(joint.name for joint in kind.robot.joints)
    twist = tuple(f"{name}_{axis}" for name in ("linear", "angular") for axis in "xyz")
    return Contents(
        _spec(env, keywords, wrappers),
        space,
        simulation.action_space,
        names,
        twist if kind.action.mode == "cartesian" else joints,
        kind.robot.name,
        simulation.backend.control_period,
        policy,
        pictures,
    )


def checked_pixels(pixels: int) -> int:
    """The width and height of pictures.

    Raises:
        GymMaraError: it is odd, which films cannot be, or out of its range.
    """
    if pixels % 2 or not LOWEST_PIXELS <= pixels <= MOST_PIXELS:
        raise GymMaraError(
            f"pixels must be an even number from {LOWEST_PIXELS} to {MOST_PIXELS}, not {pixels}"
        )
    return pixels


def _spec(env: str, keywords: dict[str, Any], wrappers: tuple[WrapperSpec, ...]) -> EnvSpec:
    made = environment(env)
    kind = "Goal" if made.goals else ""
    return EnvSpec(
        environment_id(env),
        entry_point=f"gym_mara.envs:Mara{kind}Env",
        vector_entry_point=f"gym_mara.envs:Mara{kind}VectorEnv",
        max_episode_steps=made.max_episode_steps,
        kwargs={"task": made.task, **keywords},
        additional_wrappers=wrappers,
    )


def _with_pictures() -> WrapperSpec:
    kind = AddRenderObservation
    keywords = {"render_only": False, "render_key": PIXELS, "obs_key": STATE}
    return WrapperSpec(kind.__name__, f"{kind.__module__}:{kind.__name__}", keywords)
