"""Reward regression: record a task's rewards at a fixed set of states, and later find the values that have changed.

A record is a CSV file. Its first line is a comment with the environment, the backend and the options. Then follows one
row per state: the arm's configuration, the terms of the reward, and the reward. A check reads the states from the
record, so that its result depends only on the code under test. Relative paths of a robot and of its
packages are relative to the record.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np

from gym_mara.backends import DEFAULT_BACKEND, backend_settings
from gym_mara.envs import MaraVectorEnv, make_vector_env, task_keywords
from gym_mara.envs.simulation import Simulation
from gym_mara.errors import GymMaraError, short, unknown, whole_number
from gym_mara.files import DamagedFileError, parsed_json, read_text, write_text
from gym_mara.robot.inverse_kinematics import solve_ik
from gym_mara.robot.options import ROBOT_KEYWORDS, with_paths
from gym_mara.types import Floats

MOST_STATES = 100_000
_HEADER = "# gym_mara reward record: "
_LARGEST = 2**26
"""Of a record, bytes."""
_OF_MACHINE = {"workers", "threads"}
_BLOCK = 256
"""How many states are computed at a time."""


@dataclass(frozen=True)
class Record:
    """The rewards of one environment on one backend at S states."""

    env: str
    backend: str
    options: dict[str, Any]
    """Keyword arguments of the environment: those of the task, the robot and the backend."""
    q: Floats
    """The configurations (S, J), rad (m for a prismatic joint)."""
    values: dict[str, Floats]
    """The terms of the reward, `collided` and `reward` by name, each (S,)."""


@dataclass(frozen=True)
class _About:
    """The first line of a record."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}
    env: str
    backend: str
    options: dict[str, Any]


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
        GymMaraError: a name is unknown, an option has no effect on a reward, or `states` is not a whole number from 2 to
            100,000.
    """
    if not 2 <= whole_number("states", states) <= MOST_STATES:
        raise GymMaraError(f"states must be from 2 to {MOST_STATES:,}, not {short(states)}")
    arms = _arms(env, backend, options or {}, 1)
    try:
        q = _sample_q(arms.simulation, states)
    finally:
        arms.close()
    return compute(env, backend, options or {}, q)


def compute(env: str, backend: str, options: dict[str, Any], q: Floats) -> Record:
    """Compute the rewards of an environment with the arm at rest at configurations q (S, J), rad.

    Raises:
        GymMaraError: a name is unknown, an option has no effect on a reward, or a configuration has the wrong length or
            exceeds the joint limits.
    """
    if q.ndim != 2 or len(q) < 1:
        raise GymMaraError("a record needs at least one state")
    blocks = [q[start : start + _BLOCK] for start in range(0, len(q), _BLOCK)]
    arms = _arms(env, backend, options, len(blocks[0]))
    try:
        for number, row in enumerate(q):
            arms.simulation.robot.checked_q(row, f"state {number} of the record")
        values = [_values(arms.simulation, block) for block in blocks]
    finally:
        arms.close()
    columns = {name: np.concatenate([part[name] for part in values]) for name in values[0]}
    return Record(env, backend, options, q, columns)


def _values(simulation: Simulation, q: Floats) -> dict[str, Floats]:
    """The values at configurations (B, J), of which there are at most as many as arms."""
    unused = np.repeat(q[-1:], simulation.num_envs - len(q), axis=0)
    simulation.backend.reset(np.concatenate([q, unused]))
    state = simulation.backend.state
    reward, terms = simulation.rewards(state)
    values = {**terms, "collided": state.collided, "reward": reward}
    return {name: column[: len(q)].astype(np.float64) for name, column in values.items()}


def compare(recorded: Record, now: Record, tolerance: float = 1e-9) -> list[Moved]:
    """The values that differ by more than the tolerance, in the order of the states.

    Raises:
        GymMaraError: the two records do not have the same terms, or the tolerance is negative or not finite.
    """
    _check_tolerance(tolerance)
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

    Another backend gets those of the record's settings that it has.

    Raises:
        GymMaraError: the file is missing or damaged, the task now has other terms, or the tolerance is negative or not
            finite.
    """
    _check_tolerance(tolerance)
    recorded = read(file)
    backend = backend or recorded.backend
    now = compute(recorded.env, backend, _options_for(backend, recorded), recorded.q)
    return compare(recorded, now, tolerance)


def write(file: Path, recorded: Record) -> None:
    """Write a record to a new file.

    Raises:
        GymMaraError: the file exists and is not overwritten, or it cannot be written; a value is not finite, or an option is
            not a plain value.
    """
    for name, column in recorded.values.items():
        if not np.isfinite(column).all():
            state = int(np.argmin(np.isfinite(column)))
            raise GymMaraError(
                f"{name} is {column[state]} in state {state}; a record needs numbers"
            )
    options = with_paths(recorded.options, lambda path: os.path.relpath(path, file.parent))
    about = vars(_About(recorded.env, recorded.backend, options))
    text = io.StringIO()
    text.write(_HEADER + json.dumps(about, default=_plain) + "\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_joint_names(recorded.q.shape[1]), *recorded.values])
    columns = np.column_stack([recorded.q, *recorded.values.values()])
    writer.writerows([repr(value) for value in row] for row in columns.tolist())
    write_text(file, text.getvalue(), new=True)


def read(file: Path) -> Record:
    """Read a record.

    Raises:
        GymMaraError: the file is missing or damaged.
    """
    header, *lines = read_text(file, _LARGEST).splitlines() or [""]
    if not header.startswith(_HEADER):
        _refuse(file, "its first line is not the header of a record")
    about = parsed_json(
        header.removeprefix(_HEADER), _About, f"{str(file)!r} is not a reward record"
    )
    names = lines[0].split(",") if lines else []
    joints = sum(
        1 for name, joint in zip(names, _joint_names(len(names)), strict=True) if name == joint
    )
    if not joints or "reward" not in names[joints:] or len(set(names)) < len(names):
        _refuse(file, "its second line does not name the joints q1, q2, … and the terms, each once")
    if not 1 <= len(lines) - 1 <= MOST_STATES:
        _refuse(file, f"it has {len(lines) - 1:,} states, and 1 to {MOST_STATES:,} are allowed")
    rows = [_row(file, number, line, len(names)) for number, line in enumerate(lines[1:], start=3)]
    columns = np.array(rows).T
    values = dict(zip(names[joints:], columns[joints:], strict=True))
    options = with_paths(about.options, lambda path: os.path.join(file.parent, path))
    return Record(about.env, about.backend, options, columns[:joints].T, values)


def _row(file: Path, number: int, line: str, length: int) -> Floats:
    """The numbers of a line."""
    cells = line.split(",")
    if len(cells) != length:
        _refuse(file, f"line {number} has {len(cells)} values, not {length}")
    try:
        row = np.array(cells, np.float64)
    except ValueError as error:
        _refuse(file, f"line {number}: {error}")
    if not np.isfinite(row).all():
        _refuse(file, f"line {number}: {cells[int(np.argmin(np.isfinite(row)))]} is not finite")
    return row


def _refuse(file: Path, reason: str) -> NoReturn:
    raise DamagedFileError(f"{str(file)!r} is not a reward record: {reason}")


def _joint_names(number: int) -> list[str]:
    return [f"q{joint + 1}" for joint in range(number)]


def _plain(value: Any) -> Any:
    """An option as a value that JSON knows."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise GymMaraError(
        f"a record holds plain values, not {short(value)}; name a robot by its name, path or modules"
    )


def _check_tolerance(tolerance: float) -> None:
    """Raises GymMaraError if a tolerance is negative or not finite."""
    if not 0.0 <= tolerance < math.inf:
        raise GymMaraError(f"tolerance must be finite and not negative, not {tolerance!r}")


def _known(env: str, backend: str) -> set[str]:
    """The names of the options that a record may have."""
    return {*ROBOT_KEYWORDS, *task_keywords(env), *backend_settings(backend)} - _OF_MACHINE


def _options_for(backend: str, recorded: Record) -> dict[str, Any]:
    """The options of a record, without the settings of its backend that another backend does not have."""
    if backend == recorded.backend:
        return recorded.options
    foreign = recorded.options.keys() - _known(recorded.env, backend)
    dropped = foreign.intersection(backend_settings(recorded.backend)) if foreign else foreign
    return {name: value for name, value in recorded.options.items() if name not in dropped}


def _check_options(env: str, backend: str, options: dict[str, Any]) -> None:
    """Raises GymMaraError if an option has no effect on a reward, such as one of the pictures."""
    known = _known(env, backend)
    for name in options:
        if name not in known:
            raise unknown("keyword argument", name, known, " of a reward record")


def _arms(env: str, backend: str, options: dict[str, Any], num_envs: int) -> MaraVectorEnv:
    """N arms, from the keyword arguments of an environment."""
    _check_options(env, backend, options)
    return make_vector_env(env, num_envs, backend=backend, **options)


def _sample_q(simulation: Simulation, states: int) -> Floats:
    """The configurations (S, J) of `record`, rad."""
    robot, goal = simulation.robot, simulation.goal
    # The Kronecker sequence of the generalised golden ratio is evenly spread in any number of dimensions.
    phi = 2.0
    for _ in range(64):
        phi = (1.0 + phi) ** (1.0 / (robot.num_joints + 1))
    steps = phi ** -np.arange(1.0, robot.num_joints + 1)
    num_even = states // 2
    unit = (0.5 + np.outer(np.arange(1, num_even + 1), steps)) % 1.0
    even = simulation.target_low + unit * (simulation.target_high - simulation.target_low)
    at_target = solve_ik(robot, goal.position[0], goal.quaternion[0])
    remaining = np.geomspace(1.0, 1e-4, states - num_even)[:, None]
    near = at_target + remaining * (robot.home - at_target)
    return np.vstack([even, near])
