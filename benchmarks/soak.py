"""Uses every part of the package for an hour, and reports growth, NaN, observations outside their space, and other results.

    python benchmarks/soak.py --minutes 60

One round is every scenario of benchmarks/soaking: every backend with every autoreset mode, single and goal environments,
any target with three kinds of actions, worker processes, pictures as observations and of both renderers, data sets of both
formats, exported policies, and, with a simulated arm in a process of its own, ROS 2. Rounds are repeated until the time is
over. Growth compares the memory after the last tenth of the rounds with that after the second tenth; the first tenth warms up. It
prints a Markdown page, and exits with 1 if something was wrong.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import numpy as np
from soaking import environments, ros, written
from soaking.tally import DONE, WRONG, Tally, Usage

GROWTH = {"memory": 0.01, "memory_of_children": 0.01, "resident_memory": math.inf}
"""The largest growth that passes; that of what is not named is 0."""
PACKAGES = (
    *("gymnasium", "numpy", "pin", "dartpy", "mujoco", "warp-lang", "mujoco-warp", "pyvista"),
    *("embreex", "minari", "pyarrow", "onnxruntime", "rosbags", "ros-jazzy-rclpy"),
)


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
    _keep_one_arena()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the simulated arm ends, too
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, ros.simulated_arm():
        todo = {
            **environments.scenarios(),
            **written.scenarios(Path(folder)),
            **ros.scenarios(),
        }
        tallies = {name: Tally() for name in todo}
        usage: list[Usage] = []
        for number in rounds(arguments.minutes):
            for name, scenario in todo.items():
                scenario(number, tallies[name])
            usage.append(Usage.now())
            print(f"round {number + 1}: {usage[-1]}", file=sys.stderr, flush=True)
    failed = _print_page(tallies, usage, time.monotonic() - started)
    raise SystemExit(failed)


def _keep_one_arena() -> None:
    """Start the program again with one heap of glibc for all threads, so that what is allocated there can be told from other memory."""
    if os.environ.get("MALLOC_ARENA_MAX") != "1":
        sys.stdout.flush()
        os.execve(
            sys.executable, [sys.executable, *sys.argv], {**os.environ, "MALLOC_ARENA_MAX": "1"}
        )


def _print_page(tallies: dict[str, Tally], usage: list[Usage], seconds: float) -> bool:
    """Print the Markdown page; returns whether something was wrong."""
    print("# Soak\n")
    print(
        f"{len(usage)} rounds in {seconds / 60:.0f} minutes, by `python benchmarks/soak.py`, with"
    )
    print(", ".join(f"{package} {version(package)}" for package in PACKAGES) + ".\n")
    print("| scenario |", " | ".join([*DONE, *WRONG]), "|")
    print("|---" * (1 + len(DONE) + len(WRONG)) + "|")
    failed = False
    for name, tally in tallies.items():
        failed |= any(tally.wrong.values())
        done = [f"{tally.done[key]:,}" for key in DONE]
        print(f"| {name} |", " | ".join([*done, *(str(tally.wrong[key]) for key in WRONG)]), "|")
    tenth = len(usage) // 10
    before, after = usage[tenth : 2 * tenth], usage[-tenth:]
    print("\n| median of | second tenth of the rounds | last tenth | growth |")
    print("|---|---|---|---|")
    for name in vars(usage[0]):
        first, last = (float(np.median([getattr(u, name) for u in us])) for us in (before, after))
        growth = last / first - 1.0
        of_memory = "memory" in name
        failed |= growth > GROWTH.get(name, 0.0)
        shown = [f"{v / 2**20:.1f} MiB" if of_memory else f"{v:.0f}" for v in (first, last)]
        print(f"| {name.replace('_', ' ')} | {shown[0]} | {shown[1]} | {growth:+.2%} |")
    return failed


if __name__ == "__main__":
    main()
