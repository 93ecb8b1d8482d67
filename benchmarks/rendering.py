"""Time of a picture with each renderer, and the cost of a render mode in steps without a picture."""

from __future__ import annotations

import time

import numpy as np

from gym_mara.envs import MaraEnv
from gym_mara.rendering import RENDERERS

PICTURES = 40
STEPS = 3000
ROUNDS = 9
TARGETS = {"vtk": 60.0, "raycast": 200.0}


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
    """Print both tables."""
    print("| 640 × 480 | MARA, ms | UR5, ms | goal for MARA, ms |")
    print("|---|---|---|---|")
    for renderer in RENDERERS:
        mara, ur5 = picture_ms(renderer, "mara"), picture_ms(renderer, "ur5")
        print(f"| `{renderer}` | {mara:.0f} | {ur5:.0f} | {TARGETS[renderer]:.0f} |")
    print()
    ratio = cost_of_not_rendering()
    print(
        f'With render_mode="rgb_array", a step without a picture takes {ratio:.3f} times as long.'
    )


if __name__ == "__main__":
    main()
