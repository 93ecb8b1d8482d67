"""Time of a picture with each renderer, the cost of a render mode in steps without a picture, and pictures as observations a second."""

from __future__ import annotations

import argparse
import multiprocessing
import time
from typing import Any

import numpy as np

from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.rendering import RENDERERS

PICTURES = 40
STEPS = 3000
ROUNDS = 9
TARGETS = {"vtk": 60.0, "raycast": 200.0}
ARMS, OBSERVED, PROCESSES = 32, 10, 2
"""The arms of a vector environment, its steps, and how many processes have one each."""
PIXELS: dict[str, dict[str, Any]] = {
    "camera of the scene": {},
    "with random appearance": {
        "pixel_randomisation": {"light": 0.5, "colour": 0.3, "camera": 0.05}
    },
    "with depth and segmentation": {"pixel_channels": ["rgb", "depth", "segmentation"]},
    "camera on the tool": {"pixel_camera": "tool"},
}


def picture_ms(renderer: str, robot: str) -> float:
    """The median time of a picture of 640 × 480 pixels, each of a different pose, ms."""
    env = MaraEnv(render_mode="rgb_array", renderer=renderer, robot=robot)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    env.render()  # makes the renderer
    times = []
    for _ in range(PICTURES):
        env.step(rng.uniform(-1.0, 1.0, env.simulation.robot.num_joints).astype(np.float32))
        begin = time.perf_counter()
        env.render()
        times.append(time.perf_counter() - begin)
    env.close()
    return 1000.0 * float(np.median(times))


def observing(robot: str, options: dict[str, Any], start: Any, rates: Any) -> None:
    """Put into a queue how many arms a second a vector environment steps and observes by pictures of 84 × 84 pixels."""
    env = MaraVectorEnv(ARMS, "MARAReach-v0", robot=robot, observation="joints+pixels", **options)
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(OBSERVED)]
    env.step(actions[0])
    start.wait()
    begin = time.perf_counter()
    for action in actions:
        env.step(action)
    rates.put(ARMS * OBSERVED / (time.perf_counter() - begin))
    env.close()


def pictures_a_second(robot: str, options: dict[str, Any], processes: int) -> float:
    """The pictures a second of some processes together."""
    context = multiprocessing.get_context("spawn")
    start, rates = context.Barrier(processes), context.Queue()
    workers = [
        context.Process(target=observing, args=(robot, options, start, rates), daemon=True)
        for _ in range(processes)
    ]
    for worker in workers:
        worker.start()
    total = sum(rates.get(timeout=300.0) for _ in workers)
    for worker in workers:
        worker.join()
    return total


def seconds(env: MaraEnv) -> float:
    """The duration of STEPS steps without a picture, s."""
    action = np.zeros(6, np.float32)
    begin = time.perf_counter()
    for _ in range(STEPS):
        env.step(action)
    return time.perf_counter() - begin


def cost_of_not_rendering() -> float:
    """The time of a step with a render mode, relative to a step without one: the median ratio, measured in turn."""
    without, with_mode = MaraEnv(), MaraEnv(render_mode="rgb_array")
    for env in (without, with_mode):
        env.reset(seed=0)
        seconds(env)
    return float(np.median([seconds(with_mode) / seconds(without) for _ in range(ROUNDS)]))


def main() -> None:
    """Print the tables."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    print("| 640 × 480 | MARA, ms | UR5, ms | goal for MARA, ms |")
    print("|---|---|---|---|")
    for renderer in RENDERERS:
        mara, ur5 = picture_ms(renderer, "mara"), picture_ms(renderer, "ur5")
        print(f"| `{renderer}` | {mara:.0f} | {ur5:.0f} | {TARGETS[renderer]:.0f} |")
    print()
    print(
        f"| pictures a second | MARA, 1 process | MARA, {PROCESSES} processes | UR5, {PROCESSES} processes |"
    )
    print("|---|---|---|---|")
    for name, options in PIXELS.items():
        one, *both = (
            pictures_a_second(robot, options, processes)
            for robot, processes in (("mara", 1), ("mara", PROCESSES), ("ur5", PROCESSES))
        )
        print(f"| {name} | {one:.0f} | {both[0]:.0f} | {both[1]:.0f} |", flush=True)
    print()
    ratio = cost_of_not_rendering()
    print(
        f'With render_mode="rgb_array", a step without a picture takes {ratio:.3f} times as long.'
    )


if __name__ == "__main__":
    main()
