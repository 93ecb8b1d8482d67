"""Uses every part of the environments for an hour, and reports memory growth, NaN, and observations outside their space.

    python benchmarks/soak.py --minutes 60

One round is every backend with every autoreset mode, single and goal environments, worker processes, pictures of both
renderers from several threads, and environments that are dropped without `close()`. Rounds are repeated until the time
is over. Growth compares the resident memory after the last tenth of the rounds with that after the second tenth; the
first tenth warms up. It prints a Markdown page, and exits with 1 if something was wrong.
"""

from __future__ import annotations

import argparse
import copy
import gc
import pickle
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from typing import Any

import gymnasium
import numpy as np
import psutil
from gymnasium.vector import AutoresetMode

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.backends import backend_settings, installed_backends
from gym_mara.rendering import RENDERERS

ARMS = 8
STEPS = 40
EPISODE = 25
"""Episodes are short, so that each round has many of them."""
GROWTH = 0.01
"""The largest growth of memory that passes."""
_RANDOMISATION = {"mass": (0.9, 1.1), "sensor_noise": (0.0, 0.01)}


@dataclass
class Tally:
    """What one scenario has done, and what was wrong."""

    done: Counter[str] = field(default_factory=Counter)
    _counting: threading.Lock = field(default_factory=threading.Lock)
    wrong: Counter[str] = field(default_factory=Counter)

    def observe(self, space: gymnasium.Space[Any], observation: Any, reward: Any) -> None:
        """Count a step, NaN, and observations outside their space."""
        parts = [*observation.values()] if isinstance(observation, dict) else [observation]
        finite = all(np.isfinite(part).all() for part in (*parts, reward))
        inside = space.contains(observation)
        with self._counting:  # three threads count
            self.done["steps"] += int(np.size(reward))
            self.wrong["NaN"] += int(not finite)
            self.wrong["outside the space"] += int(not inside)

    def compare(self, first: list[Any], again: list[Any]) -> None:
        """Count a comparison of two futures that must be equal."""
        self.done["comparisons"] += 1
        self.wrong["other future"] += int(pickle.dumps(first) != pickle.dumps(again))


def vector(
    seed: int,
    tally: Tally,
    *,
    backend: str,
    mode: AutoresetMode,
    name: str = "MARARandomTarget-v0",
    **options: Any,
) -> None:
    """Steps a vector environment, restores a snapshot, and steps again with the same actions."""
    envs: Any = gymnasium.make_vec(
        f"gym_mara/{name}",
        num_envs=ARMS,
        backend=backend,
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


def single(seed: int, tally: Tally, *, name: str, backend: str) -> None:
    """Steps one environment beyond its TimeLimit, restores a snapshot, and steps again with the same actions."""
    env: Any = gymnasium.make(name, backend=backend, max_episode_steps=EPISODE)
    try:
        env.reset(seed=seed)
        env.action_space.seed(seed)
        actions = [env.action_space.sample() for _ in range(STEPS)]
        for action in actions[: EPISODE // 3]:
            _step(env, action, tally)
        snapshot = env.unwrapped.save_state()
        first = [_step(env, action, tally) for action in actions]
        env.unwrapped.restore_state(snapshot)
        tally.compare(first, [_step(env, action, tally) for action in actions])
    finally:
        env.close()


def _step(env: Any, action: Any, tally: Tally) -> Any:
    observation, reward, terminated, truncated, _ = env.step(action)
    tally.observe(env.observation_space, observation, reward)
    if terminated or truncated:
        observation, _ = env.reset()
        tally.observe(env.observation_space, observation, reward)
    return [observation, reward, terminated, truncated]


def in_threads(seed: int, tally: Tally, *, backend: str) -> None:
    """Steps three equal environments at the same time in three threads; their results must be equal."""

    def play(_: int) -> list[Any]:
        env: Any = gymnasium.make("gym_mara/MARA-v0", backend=backend)
        try:
            env.reset(seed=seed)
            env.action_space.seed(seed)
            return [_step(env, env.action_space.sample(), tally) for _ in range(STEPS)]
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
            _step(env, env.action_space.sample(), tally)
            here = env.render()
            there = [pool.submit(env.render).result() for _ in range(2)]
            tally.done["pictures"] += 3
            tally.wrong["other picture"] += int(not all((here == one).all() for one in there))
            tally.wrong["black picture"] += int(not here.any())


def scenarios() -> dict[str, Callable[[int, Tally], None]]:
    """Name → one round of a scenario, called with a seed."""
    found: dict[str, Callable[[int, Tally], None]] = {}
    backends, reasons = installed_backends()
    if reasons:
        raise SystemExit("\n".join(reasons))
    for backend in backends:
        random = "randomisation" in backend_settings(backend)
        options: dict[str, Any] = {"randomisation": _RANDOMISATION} if random else {}
        for mode in AutoresetMode:
            found[f"{backend}, {ARMS} arms, {mode.value}"] = partial(
                vector, backend=backend, mode=mode, **options
            )
        for name in ("MARACollisionOrient-v0", "MARAGoal-v0"):
            found[f"{backend}, one {name}"] = partial(
                single, name=f"gym_mara/{name}", backend=backend
            )
        found[f"{backend}, {ARMS} arms of MARAGoal-v0"] = partial(
            vector, backend=backend, mode=AutoresetMode.SAME_STEP, name="MARAGoal-v0"
        )
        found[f"{backend}, three threads"] = partial(in_threads, backend=backend)
    same_step = AutoresetMode.SAME_STEP
    found["dart, two worker processes"] = partial(vector, backend="dart", mode=same_step, workers=2)
    found["pinocchio, limited joint speed"] = partial(
        vector, backend="pinocchio", mode=same_step, max_joint_velocity=1.57
    )
    for renderer in RENDERERS:
        found[f"pictures, {renderer}"] = partial(pictures, renderer=renderer)
    return found


@dataclass(frozen=True)
class Usage:
    """What this process and its children use."""

    memory: int
    """Resident, bytes."""
    threads: int
    files: int
    processes: int

    @classmethod
    def now(cls) -> Usage:
        """After a garbage collection."""
        gc.collect()
        process = psutil.Process()
        family = [process, *process.children(recursive=True)]
        memory = sum(one.memory_info().rss for one in family)
        return cls(memory, process.num_threads(), process.num_fds(), len(family))


def rounds(minutes: float) -> Iterator[int]:
    """The numbers of the rounds until the time is over; at least twenty."""
    end = time.monotonic() + 60.0 * minutes
    number = 0
    while number < 20 or time.monotonic() < end:
        yield number
        number += 1


def main() -> None:
    """Run the soak and print the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    arguments = parser.parse_args()
    started = time.monotonic()
    todo = scenarios()
    tallies = {name: Tally() for name in todo}
    usage: list[Usage] = []
    for number in rounds(arguments.minutes):
        for name, scenario in todo.items():
            scenario(number, tallies[name])
        usage.append(Usage.now())
        print(f"round {number + 1}: {usage[-1]}", file=sys.stderr)
    tenth = len(usage) // 10
    before, after = usage[tenth : 2 * tenth], usage[-tenth:]
    failed = _print_page(tallies, before, after, len(usage), time.monotonic() - started)
    raise SystemExit(failed)


def _print_page(
    tallies: dict[str, Tally], before: list[Usage], after: list[Usage], count: int, seconds: float
) -> bool:
    """Print the Markdown page; returns whether something was wrong."""
    packages = ("gymnasium", "numpy", "pin", "dartpy", "pyvista")
    print("# Soak\n")
    print(f"{count} rounds in {seconds / 60:.0f} minutes, by `python benchmarks/soak.py`, with")
    print(", ".join(f"{package} {version(package)}" for package in packages) + ".\n")
    columns = ("NaN", "outside the space", "other future", "other picture", "black picture")
    print("| scenario | steps | comparisons | pictures |", " | ".join(columns), "|")
    print("|---" * (4 + len(columns)) + "|")
    failed = False
    for name, tally in tallies.items():
        done = [f"{tally.done[key]:,}" for key in ("steps", "comparisons", "pictures")]
        wrong = [tally.wrong[key] for key in columns]
        failed |= any(wrong)
        print(f"| {name} |", " | ".join([*done, *map(str, wrong)]), "|")
    print("\n| median of | second tenth of the rounds | last tenth | growth |")
    print("|---|---|---|---|")
    for name in ("memory", "threads", "files", "processes"):
        first, last = (float(np.median([getattr(u, name) for u in us])) for us in (before, after))
        growth = last / first - 1.0
        failed |= growth > (GROWTH if name == "memory" else 0.0)
        shown = [f"{v / 2**20:.1f} MiB" if name == "memory" else f"{v:.0f}" for v in (first, last)]
        print(f"| {name} | {shown[0]} | {shown[1]} | {growth:+.2%} |")
    return failed


if __name__ == "__main__":
    main()
