"""Scenarios of environments: every backend and autoreset mode, snapshots, threads, targets, and pictures as observations."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.backends import backend_settings, installed_backends
from gym_mara.rendering import RENDERERS
from gym_mara.rendering.settings import CHANNELS
from soaking.tally import Scenario, Tally

ARMS = 8
STEPS = 40
EPISODE = 25
"""Episodes are short, so that each round has many of them."""
SPEED = 1.57
"""Of joints that travel, rad/s."""
_RANDOMISATION = {"mass": (0.9, 1.1), "sensor_noise": (0.0, 0.01)}
_LATE_AND_NOISY = {"latency": (0.0, 0.04), "sensor_noise": (0.0, 0.005)}
_PICTURES: dict[str, Any] = {
    "observation": "state+pixels",
    "pixel_size": 32,
    "pixel_channels": CHANNELS,
    "pixel_randomisation": {"light": 0.5, "colour": 0.3, "camera": 0.05},
    "max_joint_velocity": SPEED,
}


def vector(
    seed: int,
    tally: Tally,
    *,
    mode: AutoresetMode = AutoresetMode.SAME_STEP,
    name: str = "MARARandomTarget-v0",
    **options: Any,
) -> None:
    """Steps a vector environment, restores a snapshot, and steps again with the same actions."""
    envs: Any = gymnasium.make_vec(
        f"gym_mara/{name}",
        num_envs=ARMS,
        autoreset_mode=mode,
        max_episode_steps=EPISODE,
        **options,
    )
    try:
        envs.reset(seed=seed)
        envs.action_space.seed(seed)
        actions = [envs.action_space.sample() for _ in range(STEPS)]
        for action in actions:
            _step_vector(envs, action, mode, tally)
        snapshot = pickle.loads(pickle.dumps(envs.save_state()))
        first = [_step_vector(envs, action, mode, tally) for action in actions]
        envs.restore_state(snapshot)
        tally.compare(first, [_step_vector(envs, action, mode, tally) for action in actions])
    finally:
        envs.close()


def _step_vector(envs: Any, action: Any, mode: AutoresetMode, tally: Tally) -> Any:
    observation, reward, terminated, truncated, _ = envs.step(action)
    tally.observe(envs.observation_space, observation, reward)
    result = copy.deepcopy([observation, reward, terminated, truncated])
    ended = terminated | truncated
    if mode is AutoresetMode.DISABLED and ended.any():
        observation, _ = envs.reset(options={"reset_mask": ended})
        tally.observe(envs.observation_space, observation, reward)
        result.append(copy.deepcopy(observation))
    return result


def single(seed: int, tally: Tally, *, name: str, **options: Any) -> None:
    """Steps one environment beyond its TimeLimit, restores a snapshot, and steps again with the same actions."""
    env: Any = gymnasium.make(f"gym_mara/{name}", max_episode_steps=EPISODE, **options)
    try:
        env.reset(seed=seed)
        env.action_space.seed(seed)
        actions = [env.action_space.sample() for _ in range(STEPS)]
        for action in actions[: EPISODE // 3]:
            step(env, action, tally)
        snapshot = env.unwrapped.save_state()
        first = [step(env, action, tally) for action in actions]
        env.unwrapped.restore_state(snapshot)
        tally.compare(first, [step(env, action, tally) for action in actions])
    finally:
        env.close()


def step(env: Any, action: Any, tally: Tally) -> Any:
    """Steps one environment; it is reset where its episode ends."""
    observation, reward, terminated, truncated, _ = env.step(action)
    tally.observe(env.observation_space, observation, reward)
    if terminated or truncated:
        observation, _ = env.reset()
        tally.observe(env.observation_space, observation, reward)
    return [observation, reward, terminated, truncated]


def in_threads(seed: int, tally: Tally, **options: Any) -> None:
    """Steps three equal environments at the same time in three threads; their results must be equal."""

    def play(_: int) -> list[Any]:
        env: Any = gymnasium.make("gym_mara/MARA-v0", **options)
        try:
            env.reset(seed=seed)
            env.action_space.seed(seed)
            return [step(env, env.action_space.sample(), tally) for _ in range(STEPS)]
        finally:
            env.close()

    with ThreadPoolExecutor(3) as pool:
        first, *others = pool.map(play, range(3))
    for other in others:
        tally.compare(first, other)


def pictures(seed: int, tally: Tally, *, renderer: str) -> None:
    """Draws the same states in this thread and in two others, and drops the environment without `close()`."""
    env: Any = gymnasium.make(
        "gym_mara/MARAOrient-v0",
        render_mode="rgb_array",
        renderer=renderer,
        width=96,
        height=72,
    )
    env.reset(seed=seed)
    env.action_space.seed(seed)
    with ThreadPoolExecutor(2) as pool:
        for _ in range(3):
            step(env, env.action_space.sample(), tally)
            here = env.render()
            there = [pool.submit(env.render).result() for _ in range(2)]
            tally.done["pictures"] += 3
            tally.wrong["other result"] += int(not all((here == one).all() for one in there))
            tally.wrong["black picture"] += int(not here.any())


def observed_pictures(seed: int, tally: Tally, *, one: bool = False, **options: Any) -> None:
    """As `vector`, or as `single`, with pictures in the observations."""
    before = tally.done["steps"]
    (single if one else vector)(seed, tally, **options)
    channels = len(options.get("pixel_channels", ["rgb"]))
    tally.done["pictures"] += channels * (tally.done["steps"] - before)


def scenarios() -> dict[str, Scenario]:
    """Name → scenario, for every backend that is installed."""
    found: dict[str, Scenario] = {}
    backends, reasons = installed_backends()
    if reasons:
        raise SystemExit("\n".join(reasons))
    for backend in backends:
        # A GPU of NVIDIA is not everywhere.
        on: dict[str, Any] = {"backend": backend} | ({"device": "cpu"} if backend == "warp" else {})
        random = "randomisation" in backend_settings(backend)
        drawn: dict[str, Any] = {"randomisation": _RANDOMISATION} if random else {}
        for mode in AutoresetMode:
            found[f"{backend}, {ARMS} arms, {mode.value}"] = partial(
                vector, mode=mode, **on, **drawn
            )
        for name in ("MARACollisionOrient-v0", "MARAGoal-v0"):
            found[f"{backend}, one {name}"] = partial(single, name=name, **on)
        found[f"{backend}, {ARMS} arms of MARAGoal-v0"] = partial(vector, name="MARAGoal-v0", **on)
        found[f"{backend}, three threads"] = partial(in_threads, **on)
    found["dart, two worker processes"] = partial(vector, backend="dart", workers=2)
    return {**found, **_of_any_target(), **_of_pictures()}


def _of_any_target() -> dict[str, Scenario]:
    """Travelling joints, with steps of joints and with twists of the tool."""
    kinematic: dict[str, Any] = {"backend": "pinocchio", "max_joint_velocity": SPEED}
    dynamic = {**kinematic, "backend": "mujoco", "randomisation": _LATE_AND_NOISY}
    found: dict[str, Scenario] = {"pinocchio, limited joint speed": partial(vector, **kinematic)}
    for text, on in (("pinocchio", kinematic), ("mujoco, late and noisy", dynamic)):
        for name in ("MARAReach-v0", "MARAPose-v0"):
            for action in ("relative", "cartesian"):
                found[f"{text}, {ARMS} arms of {name}, {action} actions"] = partial(
                    vector, name=name, action=action, **on
                )
    return found


def _of_pictures() -> dict[str, Scenario]:
    found: dict[str, Scenario] = {
        f"pictures, {renderer}": partial(pictures, renderer=renderer) for renderer in RENDERERS
    }
    observed = partial(observed_pictures, name="MARAReach-v0", **_PICTURES)
    found[f"pictures as observations, {ARMS} arms"] = observed
    found[f"pictures as observations, {ARMS} arms, camera on the tool"] = partial(
        observed, pixel_camera="tool"
    )
    found["pictures as observations, one MARACamera-v0"] = partial(
        observed_pictures, one=True, name="MARACamera-v0"
    )
    return found
