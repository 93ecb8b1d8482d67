"""Reward regression: record a task's rewards at a fixed set of states, and later find the values that have changed.

A record is a CSV file. Its first line is a comment with the environment, the backend and the options. Then follows one
row per state: the arm's configuration, the terms of the reward, and the reward. A check reads the states from the
record, so that its result depends only on the code under test.
"""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.envs.options import Options
from gym_mara.envs.simulation import Simulation
from gym_mara.errors import GymMaraError
from gym_mara.robot.inverse_kinematics import solve_ik

Floats = NDArray[np.float64]

_HEADER = "# gym_mara reward record: "


@dataclass(frozen=True)
class Record:
    """The rewards of one environment on one backend at S states."""

    env: str
    backend: str
    options: dict[str, Any]
    """The keyword arguments of the environment, without the backend."""
    q: Floats
    """The configurations (S, J), rad (m for a prismatic joint)."""
    values: dict[str, Floats]
    """The terms of the reward, `collided` and `reward` by name, each (S,)."""


@dataclass(frozen=True)
class Moved:
    """A value that differs from its record."""

    row: int
    """The index of the state, from 0."""
    name: str
    recorded: float
    now: float

    def __str__(self) -> str:
        return (
            f"state {self.row}: {self.name} was {self.recorded:.9g}, is {self.now:.9g} "
            f"(moved by {self.now - self.recorded:+.3g})"
        )


def record(
    env: str,
    backend: str = DEFAULT_BACKEND,
    options: dict[str, Any] | None = None,
    states: int = 256,
) -> Record:
    """Compute the rewards of an environment at a set of states.

    One half of the states is spread evenly over the joint ranges (a Kronecker sequence). The other half lies on the
    straight line in joint space from the home configuration to the target. These states become denser towards the
    target, where the reward is steep; the last one is about 0.1 mm or less away from it.

    Raises:
        GymMaraError: a name is unknown, or there are fewer than two states.
    """
    if states < 2:
        raise GymMaraError(f"states must be at least 2, not {states}")
    simulation = _simulation(env, backend, options or {}, 1)
    try:
        q = _grid(simulation, states)
    finally:
        simulation.close()
    return evaluate(env, backend, options or {}, q)


def evaluate(env: str, backend: str, options: dict[str, Any], q: Floats) -> Record:
    """Compute the rewards of an environment with the arm at rest at configurations q (S, J), rad.

    Raises:
        GymMaraError: a name is unknown, or a configuration has the wrong length or exceeds the joint limits.
    """
    if q.ndim != 2 or len(q) < 1:
        raise GymMaraError("a record needs at least one state")
    simulation = _simulation(env, backend, options, len(q))
    try:
        for number, row in enumerate(q):
            simulation.robot.checked_q(row, f"state {number} of the record")
        simulation.backend.reset(q)
        state = simulation.backend.state
        reward, terms = simulation.task.reward(state, simulation.goal)
    finally:
        simulation.close()
    values = {**terms, "collided": state.collided.astype(np.float64), "reward": reward}
    return Record(env, backend, options, q, values)


def compare(recorded: Record, now: Record, tolerance: float = 1e-9) -> list[Moved]:
    """The values that differ by more than the tolerance, in the order of the states.

    Raises:
        GymMaraError: the two records do not have the same terms.
    """
    if recorded.values.keys() != now.values.keys():
        raise GymMaraError(
            f"the record has the terms {', '.join(recorded.values)}, but the task now has {', '.join(now.values)}: "
            "if this is intended, delete the record and write a new one"
        )
    moved = [
        Moved(row, name, float(old), float(new))
        for name, column in recorded.values.items()
        for row, (old, new) in enumerate(zip(column, now.values[name], strict=True))
        if not abs(new - old) <= tolerance
    ]
    return sorted(moved, key=lambda m: m.row)


def check(file: Path, backend: str | None = None, tolerance: float = 1e-9) -> list[Moved]:
    """Compute the rewards of a record again, on its backend or another, and return the values that have changed.

    Raises:
        GymMaraError: the file is missing or damaged, or the task now has other terms.
    """
    recorded = read(file)
    now = evaluate(recorded.env, backend or recorded.backend, recorded.options, recorded.q)
    return compare(recorded, now, tolerance)


def write(file: Path, recorded: Record) -> None:
    """Write a record to a new file.

    Raises:
        GymMaraError: the file exists and is not overwritten, or it cannot be written.
    """
    about = {"env": recorded.env, "backend": recorded.backend, "options": recorded.options}
    text = io.StringIO()
    text.write(_HEADER + json.dumps(about) + "\n")
    writer = csv.writer(text, lineterminator="\n")
    joints = [f"q{j + 1}" for j in range(recorded.q.shape[1])]
    writer.writerow([*joints, *recorded.values])
    columns = np.column_stack([recorded.q, *recorded.values.values()])
    writer.writerows([repr(value) for value in row] for row in columns.tolist())
    try:
        with file.open("x") as stream:
            stream.write(text.getvalue())
    except FileExistsError:
        raise GymMaraError(
            f"{str(file)!r} exists and is not overwritten: delete it first"
        ) from None
    except OSError as error:
        raise GymMaraError(f"cannot write {str(file)!r}: {error.strerror}") from error


def read(file: Path) -> Record:
    """Read a record.

    Raises:
        GymMaraError: the file is missing or damaged.
    """
    try:
        header, *lines = file.read_text().splitlines()
        if not header.startswith(_HEADER):
            raise ValueError("its first line is not the header of a record")
        about = json.loads(header.removeprefix(_HEADER))
        names = lines[0].split(",")
        columns = np.array([[float(x) for x in line.split(",")] for line in lines[1:]]).T
        joints = sum(name.removeprefix("q").isdigit() for name in names)
        values = dict(zip(names[joints:], columns[joints:], strict=True))
        return Record(about["env"], about["backend"], about["options"], columns[:joints].T, values)
    except OSError as error:
        raise GymMaraError(f"cannot read {str(file)!r}: {error.strerror}") from error
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise GymMaraError(f"{str(file)!r} is not a reward record: {error}") from error


def _simulation(env: str, backend: str, options: dict[str, Any], num_envs: int) -> Simulation:
    """A simulation of N arms, from the keyword arguments of an environment."""
    rest = {name: v for name, v in options.items() if name not in ("robot", "ee_frame")}
    robot, ee_frame = options.get("robot", "mara"), options.get("ee_frame")
    return Simulation(Options.sort(env, robot, ee_frame, backend, rest), num_envs)


def _grid(simulation: Simulation, states: int) -> Floats:
    """The configurations (S, J) of `record`, rad."""
    robot, goal = simulation.robot, simulation.goal
    # The Kronecker sequence of the generalised golden ratio is evenly spread in any number of dimensions.
    phi = 2.0
    for _ in range(64):
        phi = (1.0 + phi) ** (1.0 / (robot.num_joints + 1))
    steps = phi ** -np.arange(1.0, robot.num_joints + 1)
    spread_out = states // 2
    unit = (0.5 + np.outer(np.arange(1, spread_out + 1), steps)) % 1.0
    even = simulation.target_low + unit * (simulation.target_high - simulation.target_low)
    at_target = solve_ik(robot, goal.position[0], goal.quaternion[0])
    left = np.geomspace(1.0, 1e-4, states - spread_out)[:, None]
    near = at_target + left * (robot.home - at_target)
    return np.vstack([even, near])
