"""Helpers of the tests: cached robots, configurations, golden values, small URDFs, processes, the command."""

from __future__ import annotations

import csv
import functools
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gym_mara import cli
from gym_mara.backends import simulated_backends
from gym_mara.robot import RobotModel

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

TASK_NAMES = ("MARA-v0", "MARAOrient-v0", "MARACollision-v0", "MARACollisionOrient-v0")
ENV_IDS = tuple(f"gym_mara/{name}" for name in TASK_NAMES)
TARGET_Q = (-0.237, -0.5528, 0.8681, 0.0, 1.7207, -0.237)
"""A configuration of MARA within 0.02 mm of the default target."""
PATH_ENDS = ((0.5, -1.9, -0.3, -2.4, 1.1, -2.6), (0.5, -1.9, -0.3, 2.4, 1.1, -2.6))
"""Two collision-free configurations of MARA. On the way, with motor4 between about -1.15 and 1.06 rad, the tool
collides with the arm."""

WARP_DEVICE = os.environ.get("WARP_DEVICE", "cpu")
"""Where Warp runs in tests. It is slow on a CPU; on a machine with a GPU, set the variable to "cuda:0"."""
DEVICES: dict[str, dict[str, Any]] = {"warp": {"device": WARP_DEVICE}}
"""The settings that a backend needs on this machine, by its name."""
EVERY_BACKEND = [
    pytest.param(name, marks=pytest.mark.slow if name in DEVICES else ())
    for name in simulated_backends()
]

MODULAR_ARMS: dict[int, list[str]] = {
    3: ["base", "motor_large", "motor_medium", "tool"],
    4: ["base", "motor_large", "link_straight", "motor_medium", "tool"],
    5: ["base", "motor_large", "motor_medium", "link_bent", "motor_small", "tool"],
    6: [
        "base",
        "motor_medium",
        "link_straight",
        "motor_medium",
        "link_bent",
        "motor_small",
        "tool",
    ],
    7: [
        "base",
        "motor_large",
        "motor_large",
        "link_bent",
        "motor_medium",
        "link_bent",
        "motor_small",
        "tool",
    ],
}
"""One arm of MARA's modules for each number of joints."""

robot_model = functools.cache(RobotModel.load)


def golden(name: str) -> dict[str, Floats]:
    """The columns of a file of golden values."""
    with (Path(__file__).parent / "data" / name).open() as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}


def golden_q() -> Floats:
    """The configurations (N, 6) of the golden kinematics."""
    columns = golden("kinematics_golden.csv")
    return np.stack([columns[f"q{joint}"] for joint in range(1, 7)], axis=-1)


def joint_xml(
    number: int,
    kind: str = "revolute",
    axis: str = "0 0 1",
    extra: str = "",
    limit: str = '<limit lower="-2" upper="1.5" effort="10" velocity="2"/>',
) -> str:
    """A joint from link NUMBER to link NUMBER + 1, translated by 0.3 m along x and 0.2 m along z, and rotated."""
    return f"""
      <joint name="joint{number}" type="{kind}">
        <parent link="link{number}"/><child link="link{number + 1}"/>
        <origin xyz="0.3 0 0.2" rpy="0.4 -0.3 0.2"/><axis xyz="{axis}"/>{limit}{extra}
      </joint>"""


def urdf_xml(*joints: str) -> str:
    """The URDF of a serial chain link0, link1, …, with a sphere on each link."""
    links = "".join(
        f"""
      <link name="link{number}">
        <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
        <collision><origin xyz="0.1 0 0"/><geometry><sphere radius="0.05"/></geometry></collision>
      </link>"""
        for number in range(len(joints) + 1)
    )
    return f'<robot name="stick">{links}{"".join(joints)}</robot>'


def upright_arm(extra: str = "") -> str:
    """The URDF of an arm of three joints, j1 about z, j2 and j3 about y, on a box; its links are base, l1, l2, l3 and tool.

    Args:
        extra: more elements.
    """
    moving = "".join(
        f"""
      <link name="l{number}">
        <inertial><origin xyz="0 0 0.15"/><mass value="1"/>
          <inertia ixx="0.01" iyy="0.01" izz="0.005" ixy="0" ixz="0" iyz="0"/></inertial>
        <collision><origin xyz="0 0 0.15"/><geometry><box size="0.06 0.06 0.22"/></geometry></collision>
      </link>
      <joint name="j{number}" type="revolute">
        <parent link="{"base" if number == 1 else f"l{number - 1}"}"/><child link="l{number}"/>
        <origin xyz="0 0 {0.02 if number == 1 else 0.3}"/><axis xyz="{"0 0 1" if number == 1 else "0 1 0"}"/>
        <limit lower="-2" upper="2" effort="50" velocity="2"/>
      </joint>"""
        for number in (1, 2, 3)
    )
    return f"""<robot name="upright">
      <link name="base">
        <collision><origin xyz="0 0 -0.05"/><geometry><box size="0.3 0.3 0.1"/></geometry></collision>
      </link>{moving}
      <link name="tool"/>
      <joint name="jt" type="fixed">
        <parent link="l3"/><child link="tool"/><origin xyz="0 0 0.3"/>
      </joint>{extra}
    </robot>"""


def write(path: Path, text: str) -> Path:
    """Write a file and return its path."""
    path.write_text(text)
    return path


@contextmanager
def started(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run Python with these arguments in its own process group, and always kill the group at the end."""
    process = subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Limit the files that this process and its children write, bytes. Python compiles nothing then: it would keep half of a module."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)
        patch.setenv("PYTHONDONTWRITEBYTECODE", "1")
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class Cli:
    """Runs the command in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys = monkeypatch, capsys

    def __call__(self, *arguments: object) -> tuple[int, str, str]:
        """The exit code, the output and the error output."""
        self._monkeypatch.setattr(sys, "argv", ["gym-mara", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        printed = self._capsys.readouterr()
        code = exit_.value.code
        return code if isinstance(code, int) else int(bool(code)), printed.out, printed.err
