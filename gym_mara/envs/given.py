"""What `reset(options=…)` gives for new episodes in place of what a task draws: the start, and the target or a part of it."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gym_mara import rotations
from gym_mara.arrays import host, is_tensor
from gym_mara.collision.coal import touching_links
from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError, finite_numbers
from gym_mara.robot import RobotModel
from gym_mara.tasks import Draw, Task
from gym_mara.tasks.reach import check_unit, out_of_reach
from gym_mara.types import Floats, Mask

GIVEN = ("target_position", "target_quaternion", "start_q")
"""The options of `reset`; the keyword arguments of the tasks have the same names."""


@dataclass(frozen=True)
class Given:
    """Values for new episodes of N arms. None stands for a value that is drawn as usual."""

    target_position: Floats | None
    """(N, 3), m."""
    target_quaternion: Floats | None
    """(N, 4), [w, x, y, z], of length 1, w >= 0."""
    start_q: Floats | None
    """(N, J), rad (m for a prismatic joint)."""

    @classmethod
    def of(
        cls,
        options: Mapping[str, Any],
        task: Task,
        robot: RobotModel,
        workspace: RobotWorkspace,
        chosen: Mask,
    ) -> Given | None:
        """The values of options for the chosen arms (N,); None if no option gives one.

        Raises:
            GymMaraError: a value has the wrong shape or is not finite, the task does not take it, the start is beyond the limits
                or collides, or the target is out of reach or only reached with a collision.
        """
        sizes = dict(zip(GIVEN, (3, 4, robot.num_joints), strict=True))
        rows = {
            name: _rows(name, options[name], size, chosen)
            for name, size in sizes.items()
            if options.get(name) is not None
        }
        if not rows:
            return None
        _check_task(task, [name for name in rows if name != "start_q"])
        position, quaternion, start = map(rows.get, GIVEN)
        if start is not None:
            for arm in _distinct(chosen, start):
                _check_start(robot, start[arm])
        if quaternion is not None:
            for each in quaternion[chosen].tolist():
                check_unit("target_quaternion", each)
            quaternion[chosen] = rotations.canonical(rotations.normalised(quaternion[chosen]))
        for arm in _distinct(chosen, position, quaternion):
            target = _row(position, arm), _row(quaternion, arm)
            if far := out_of_reach(robot, workspace, *target):
                raise GymMaraError(f"{far}: give another")
            workspace.pose_with(*target)
        return cls(position, quaternion, start)

    def draw(
        self, arm: int, task: Task, workspace: RobotWorkspace, generator: np.random.Generator
    ) -> Draw:
        """What is drawn for an episode of an arm, with the given values in it.

        The generator is used as if nothing were given, so that later episodes do not depend on it. What must fit to a given
        value is drawn again from a copy of the generator: the target of a given start, or the rest of a target.
        """
        again = copy.deepcopy(generator)
        drawn = task.draw(workspace, generator)
        position, quaternion = _row(self.target_position, arm), _row(self.target_quaternion, arm)
        if self.start_q is not None:
            start = self.start_q[arm]
            if position is None and quaternion is None:
                drawn = dataclasses.replace(task, start_q=tuple(start)).draw(workspace, again)
            drawn = drawn._replace(start=start)
        if _oriented(task) and (position is None) != (quaternion is None):
            position, quaternion = workspace.pose_with(position, quaternion, again)
        if position is not None:
            drawn = drawn._replace(position=position)
        if quaternion is not None:
            drawn = drawn._replace(quaternion=quaternion)
        return drawn


def _oriented(task: Task) -> bool:
    """Whether the targets of a task have an orientation."""
    return bool(getattr(task, "orientation", False))


def _check_task(task: Task, target: list[str]) -> None:
    """Raises GymMaraError if the task does not take these parts of a target."""
    if target and not task.random_goal:
        keyword = f"give {target[0]} to gymnasium.make, or " if hasattr(task, target[0]) else ""
        raise GymMaraError(
            f"this environment has one target for all episodes, so reset has no option {target[0]!r}: {keyword}"
            "choose an environment that draws its targets, such as MARAReach-v0"
        )
    if "target_quaternion" in target and not _oriented(task):
        raise GymMaraError(
            "the targets of this environment have no orientation: leave out target_quaternion, or choose one with "
            "an orientation, such as MARAPose-v0"
        )


def _check_start(robot: RobotModel, q: Floats) -> None:
    """Raises GymMaraError if a start (J,), rad, is beyond a joint's limits or collides."""
    robot.checked_q(q, "start_q")
    if links := sorted(touching_links(robot, q)):
        raise GymMaraError(
            f"start_q {q.tolist()} is in collision, where these links touch: {', '.join(links)}; give another start"
        )


def _rows(name: str, value: Any, size: int, chosen: Mask) -> Floats:
    """A value as one row for each arm (N, size); the rows of arms that are not chosen (N,) are not checked.

    Raises:
        GymMaraError: it is neither `size` finite numbers for all arms, nor as many for each.
    """
    count, value = len(chosen), host(value) if is_tensor(value) else value
    try:
        shape = np.shape(value)
    except ValueError:  # lists of different lengths
        shape = ()
    if len(shape) != 2:
        return np.tile(finite_numbers(name, value, size), (count, 1))
    if shape != (count, size):
        each = f", or of shape {(count, size)} with a row for each arm" if count > 1 else ""
        raise GymMaraError(f"{name} must be {size} numbers{each}, not of shape {shape}")
    rows = np.zeros((count, size))
    for arm in np.flatnonzero(chosen).tolist():
        rows[arm] = finite_numbers(name, value[arm], size)
    return rows


def _row(rows: Floats | None, arm: int) -> Floats | None:
    return None if rows is None else rows[arm]


def _distinct(chosen: Mask, *values: Floats | None) -> list[int]:
    """The chosen arms, but for those whose rows of the values that are not None are those of another arm."""
    given = [rows[chosen] for rows in values if rows is not None]
    if not given:
        return []
    _, first = np.unique(np.hstack(given), axis=0, return_index=True)
    return [int(arm) for arm in np.flatnonzero(chosen)[np.sort(first)]]
