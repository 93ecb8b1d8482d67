"""Kills every long command with SIGKILL at random moments, runs it again, and compares the end with that of an unbroken run.

    python -m benchmarks.kills [--kills 20] [--seed 0] [--only train record]

It runs as a module, in the root of the repository, because the bag of `identify` is of an arm of the tests. Every other kill
comes at any moment of the command's usual time; the others come after its first file has appeared. Half of them kill the process
alone, as the system does when memory is short, the others its whole group. It prints a Markdown table, and exits with 1 if
something failed; then the folder is kept.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

from gym_mara.agents.experiments.search import Search, finished_trials, open_study
from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.robot import RobotModel
from gym_mara.ros2.bags.logs import write_episode
from tests.identification.arms import hidden, log_of

SMALL = ["--env", "MARA-v0", "--steps", "8192", "--checkpoint-every", "2048"]
SEARCH = Search("MARA-v0", "ppo", steps=4096, trials=3, seeds=1)
ENDED = "ended first"
COLUMNS = ("same end", "said what was lost", "left temporary files", "failed")


@dataclass(frozen=True)
class Command:
    """A long command, and what its result is."""

    arguments: list[str]
    """Those of gym-mara; the last one is the name of what it writes, beside which nothing else is written."""
    result: Callable[[Path], Any]
    """What two runs of the command must have in common."""
    again: list[str] | None = None
    """How it is resumed; None if by the same command."""
    grows: bool = False
    """Whether what it writes is there before it is complete."""
    keeps: Callable[[Path], set[Any]] = lambda _: set()
    """What must still be there when the command has been run again."""


def policy_of_run(run: Path) -> Any:
    """The last and the best policy, and the table without the columns of the clock."""
    folder, parts = RunFolder.open(run), {}
    for which in ("last", "best"):
        with zipfile.ZipFile(folder.policy(which) / "model.zip") as model:
            names = [name for name in model.namelist() if name.endswith(".pth")]
            parts.update({(which, name): model.read(name) for name in names})
    timed = ("time/time_elapsed", "time/fps")
    rows = [sorted(row.items()) for row in read_progress(folder.progress_file)]
    return parts, repr([[item for item in row if item[0] not in timed] for row in rows])


def grid(folder: Path) -> Any:
    """The results of all runs of a grid."""
    return {file.parent.name: policy_of_run(file.parent) for file in folder.rglob("config.json")}


def minari_set(folder: Path) -> Any:
    """Every array of a data set of Minari."""
    found: dict[str, Any] = {}
    with h5py.File(folder / "data" / "main_data.hdf5") as file:
        file.visititems(found.__setitem__)
        return {n: i[()].tobytes() for n, i in found.items() if isinstance(i, h5py.Dataset)}


def trials(folder: Path) -> set[Any]:
    """The finished trials of a search."""
    study = open_study(SEARCH, folder)
    return {(t.number, t.value) for t in study.get_trials() if t.state.is_finished() and t.value}


def enough_trials(folder: Path) -> Any:
    """Whether a search has as many trials as it should; which ones it draws depends on the clock."""
    return finished_trials(open_study(SEARCH, folder)) >= SEARCH.trials


def commands(bag: Path, run: Path) -> dict[str, Command]:
    """Name → command, given the bag of a moving arm and a finished training."""
    record = ["record", "--policy", "ik", "--env", "MARAReach-v0", "--episodes", "200"]
    of_arm = ["identify", str(bag), "--backend", "mujoco", "--parameters", "latency,servo_gain"]
    search = ["search", "--env", SEARCH.env, "--steps", str(SEARCH.steps)]
    search += ["--trials", str(SEARCH.trials), "--jobs", "1", "--out", "search"]
    jobs = ["--algo", "ppo,trpo", "--seeds", "1", "--jobs", "2", "--out", "grid"]
    resume = ["train", "--resume", "run"]
    return {
        "train": Command(["train", *SMALL, "--out", "run"], policy_of_run, resume, grows=True),
        "benchmark": Command(["benchmark", *SMALL, *jobs], grid, grows=True),
        "search": Command(search, enough_trials, grows=True, keeps=trials),
        "record": Command([*record, "--out", "reach-v0"], minari_set),
        "identify": Command([*of_arm, "--out", "arm.json"], Path.read_text),
        "export": Command(["export", str(run), "policy.onnx"], Path.read_bytes),
    }


def start(arguments: list[str], folder: Path) -> subprocess.Popen[str]:
    """Start gym-mara in a folder, in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "gym_mara.cli", *arguments],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def require(process: subprocess.Popen[str]) -> None:
    """Wait for the end of a command, which must succeed."""
    _, error = process.communicate(timeout=600)
    if process.returncode:
        raise SystemExit(error)


def first_file(process: subprocess.Popen[str], folder: Path) -> None:
    """Wait until the command has written something, or has ended."""
    while not any(folder.iterdir()) and process.poll() is None:
        time.sleep(0.001)


class Case:
    """A command, its unbroken run, and its kills."""

    def __init__(self, command: Command, place: Path) -> None:
        self.command, self.place = command, place
        self.out = command.arguments[-1]
        folder = self.place / "unbroken"
        folder.mkdir(parents=True)
        started = time.monotonic()
        process = start(command.arguments, folder)
        first_file(process, folder)
        self.before_files = time.monotonic() - started
        require(process)
        self.seconds = time.monotonic() - started
        self.result = command.result(folder / self.out)

    def kill(self, number: int, draw: random.Random) -> str:
        """Kill the command once and run it again; returns one of COLUMNS or ENDED, and details after a colon."""
        folder = self.place / f"kill-{number}"
        folder.mkdir()
        process = start(self.command.arguments, folder)
        after_first = number % 2 == 1
        if after_first:
            first_file(process, folder)
        time.sleep(draw.random() * (self.seconds - (self.before_files if after_first else 0.0)))
        running = process.poll() is None
        with suppress(ProcessLookupError):
            (os.killpg if draw.random() < 0.5 else os.kill)(process.pid, signal.SIGKILL)
        try:
            process.wait()
            outcome = self._run_again(folder) if running else ENDED
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.stderr.close()  # type: ignore[union-attr]
        if not outcome.startswith("failed"):
            shutil.rmtree(folder)
        return outcome

    def _run_again(self, folder: Path) -> str:
        """Run the command again after a kill; returns as `kill`."""
        command, out = self.command, folder / self.out
        there = out.exists()
        if there and not command.grows:
            return "same end" if self._same(out) else f"failed: {out} is not complete"
        kept = command.keeps(out) if there else set()
        arguments = command.again if there and command.again else command.arguments
        process = start(arguments, folder)
        _, error = process.communicate(timeout=600)
        lost = process.returncode == 2 and error.startswith("error: ") and error.count("\n") == 1
        if process.returncode and not lost:
            return f"failed: {' '.join(arguments)} in {folder}: {error}"
        if lost and "has finished" not in error:
            return f"said what was lost: {error.strip()}"
        if not kept <= command.keeps(out):
            return f"failed: {folder} has lost {kept - command.keeps(out)}"
        if not self._same(out):
            return f"failed: {out} has another end"
        left = [file.name for file in folder.rglob(".*") if not file.name.endswith(".lock")]
        return f"left temporary files: {left}" if left else "same end"

    def _same(self, out: Path) -> bool:
        try:
            return bool(self.command.result(out) == self.result)
        except Exception as error:  # whatever a half file makes its reader raise
            print(f"{out}: {error!r}", file=sys.stderr)
            return False


def main() -> None:
    """Kill each command, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20, help="of each command")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--only", nargs="+", help="the commands; by default all")
    arguments = parser.parse_args()
    place = Path(tempfile.mkdtemp(prefix="kills-"))
    run, bag, temporary = place / "run", place / "bag", place / "tmp"
    temporary.mkdir()
    robot = RobotModel.load("mara")
    names = ("latency", "servo_gain")
    write_episode(bag, log_of(robot, "mujoco", hidden(robot, 1, (0, 1), names), 6.0, (0, 1)), robot)
    os.environ.update(TMPDIR=str(temporary), PYTHONPATH=os.getcwd())
    require(start(["train", *SMALL, "--out", "run"], place))
    tallies: dict[str, tuple[float, Counter[str]]] = {}
    for name, command in commands(bag, run).items():
        if arguments.only and name not in arguments.only:
            continue
        case, tally = Case(command, place / name), Counter[str]()
        draw, number = random.Random(f"{arguments.seed} {name}"), 0
        while tally.total() - tally[ENDED] < arguments.kills:
            outcome = case.kill(number, draw)
            number += 1
            tally[outcome.partition(":")[0]] += 1
            print(f"{name}, {number}: {outcome}", file=sys.stderr)
        tallies[name] = case.seconds, tally
    print("| command | usual time, s | kills |", " | ".join(COLUMNS), "|")
    print("|---|" + "---:|" * (2 + len(COLUMNS)))
    for name, (seconds, tally) in tallies.items():
        counts = [tally.total() - tally[ENDED], *(tally[column] for column in COLUMNS)]
        print(f"| `{name}` | {seconds:.1f} |", " | ".join(map(str, counts)), "|")
    failed = sum(tally["failed"] for _, tally in tallies.values())
    if not failed:
        shutil.rmtree(place)
    raise SystemExit(1 if failed else 0)


if __name__ == "__main__":
    main()
