"""The viewer: shows an arm in the browser and lets the user move it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from gym_mara.envs import make_vector_env
from gym_mara.envs.simulation import Simulation
from gym_mara.envs.streams import Streams
from gym_mara.registration import environment

__all__ = ["watch"]


def watch(
    env: str,
    backend: str,
    keywords: dict[str, Any],
    begin: Callable[[Simulation], Callable[[Any], ArrayLike]] | None = None,
    *,
    speed: float = 1.0,
    seed: int | None = None,
    endless: bool = False,
) -> None:
    """Open a viewer and step an environment until the user interrupts with Ctrl+C.

    Args:
        env: the name of an environment.
        backend: the name of a backend.
        keywords: keyword arguments of the environment.
        begin: is called once with the simulation, and returns a policy: it maps observations of one arm, with a leading axis of
            length 1, to actions (1, A). None: the user moves the joints with the sliders, from the home configuration, in one
            episode without an end.
        speed: the speed of the simulation relative to real time.
        seed: the seed of the environment.
        endless: whether the policy's episode goes on until something terminates it; else one episode of the environment's length
            follows the other.

    Raises:
        GymMaraError: a name is unknown, a value is out of its range, or the viewer cannot listen on its address.
        MissingExtraError: a library is not installed.
    """
    from gym_mara.viewer.viewer import Viewer

    arms = make_vector_env(env, 1, backend=backend, **keywords)
    simulation = arms.simulation
    viewer: Viewer | None = None
    try:
        simulation.streams = (Streams.seeded(seed),)
        viewer = Viewer(simulation, simulation.options.rendering)
        viewer.set_speed(speed)
        if begin is not None:
            viewer.run(begin(simulation), None if endless else environment(env).max_episode_steps)
        else:
            viewer.jog()
            viewer.run(lambda _: None, None)
    finally:
        if viewer is not None:
            viewer.close()
        arms.close()
