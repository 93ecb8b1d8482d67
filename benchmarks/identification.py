"""How well hidden parameters of a simulated arm are identified, and how long it takes.

    python -m benchmarks.identification [--backend mujoco]

It runs as a module, in the root of the repository, because the hidden arms are those of the tests.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from gym_mara.identification import identify
from gym_mara.robot import RobotModel
from tests.identification.arms import hidden, log_of


def main() -> None:
    """Print what was hidden, what was found, and the time on a processor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--backend", default="mujoco")
    parser.add_argument("--duration", type=float, default=20.0, help="of the log, s")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    robot = RobotModel.load("mara")
    true = hidden(robot, arguments.seed)
    log = log_of(robot, arguments.backend, true, arguments.duration, seed=arguments.seed)
    begin = time.process_time()
    found = identify(log, robot, arguments.backend)
    print(f"{arguments.backend}, {arguments.duration:g} s, seed {arguments.seed}:", end=" ")
    print(f"{time.process_time() - begin:.0f} s of a processor")
    print(f"error {1e3 * np.mean(list(found.error.values())):.3f} mrad,", end=" ")
    print(f"before {1e3 * np.mean(list(found.error_before.values())):.1f} mrad")
    for each in found.estimates:
        own = true[each.name]
        value = float(own if each.joint is None else own[robot.joint_names.index(each.joint)])
        told = each.undetermined or f"{each.value:.4f}, {100 * (each.value / value - 1.0):+.2f} %"
        print(f"{each.name:15} {each.joint or '':7} {value:8.4f}: {told}")


if __name__ == "__main__":
    main()
