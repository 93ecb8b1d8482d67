"""How well hidden parameters of simulated arms are identified, and how long it takes.

    python -m benchmarks.identification [--backend mujoco] [--seeds 1 2 3]

It runs as a module, in the root of the repository, because the hidden arms are those of the tests.
"""

from __future__ import annotations

import argparse
import os

import numpy as np

from gym_mara.identification import Identified, identify
from gym_mara.identification.parameters import DEFAULT, PRIORS
from gym_mara.robot import RobotModel
from gym_mara.types import Floats
from tests.identification.arms import hidden, log_of


def main() -> None:
    """Print what was hidden and what was found for each seed, then the largest errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="mara")
    parser.add_argument("--backend", default="mujoco")
    parser.add_argument("--duration", type=float, default=20.0, help="of the log, s")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--parameters", nargs="+", default=DEFAULT, choices=PRIORS)
    arguments = parser.parse_args()
    robot, backend = RobotModel.load(arguments.robot), arguments.backend
    errors: dict[str, list[float]] = {name: [] for name in arguments.parameters}
    unknown = dict.fromkeys(arguments.parameters, 0)
    for seed in arguments.seeds:
        true = hidden(robot, seed, names=arguments.parameters)
        log = log_of(robot, backend, true, arguments.duration, seed=seed)
        begin = sum(os.times()[:4])
        found = identify(log, robot, backend, arguments.parameters)
        print(f"{robot.name} on {backend}, {arguments.duration:g} s, seed {seed}:", end=" ")
        print(f"{sum(os.times()[:4]) - begin:.0f} s of processors")
        _compare(found, true, robot, errors, unknown)
    for name, parts in errors.items():
        most = f"{100.0 * max(parts):.2f} %" if parts else "none"
        print(f"{name:15} largest error {most} of {len(parts)}; {unknown[name]} not determined")


def _compare(
    found: Identified,
    true: dict[str, Floats],
    robot: RobotModel,
    errors: dict[str, list[float]],
    unknown: dict[str, int],
) -> None:
    print(f"error {1e3 * np.mean(list(found.error.values())):.3f} mrad,", end=" ")
    print(f"before {1e3 * np.mean(list(found.error_before.values())):.1f} mrad")
    for each in found.estimates:
        own = true[each.name]
        value = float(own if each.joint is None else own[robot.joint_names.index(each.joint)])
        print(f"{each.name:15} {each.joint or '':7} {value:8.4f}:", end=" ")
        if each.undetermined is not None:
            unknown[each.name] += 1
            print(each.undetermined)
            continue
        error = each.value / value - 1.0
        errors[each.name].append(abs(error))
        print(f"{each.value:.4f}, {100.0 * error:+.2f} %, range {each.low:.4g} to {each.high:.4g}")


if __name__ == "__main__":
    main()
