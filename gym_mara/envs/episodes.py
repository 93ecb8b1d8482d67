"""Where each arm begins its episode, and what it aims at."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gym_mara import rotations
from gym_mara.arrays import host, like, namespace
from gym_mara.collision.coal import touching_links
from gym_mara.envs.given import Given
from gym_mara.envs.streams import Streams, drawn_episodes
from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError, finite_numbers
from gym_mara.robot import RobotModel
from gym_mara.tasks import Goal, Task
from gym_mara.types import Array, Floats, Mask


class Episodes:
    """The start and the goal of the episode of each of N arms: fixed, drawn by the task, or given to `reset`.

    Args:
        task: it has the usual start, and draws if its goals are random.
        robot: the arm.
        num_envs: N.
        asarray: makes the arrays of the simulation from those of NumPy.

    Raises:
        GymMaraError: the start of the task is beyond the limits of a joint.
    """

    def __init__(
        self, task: Task, robot: RobotModel, num_envs: int, asarray: Callable[[ArrayLike], Array]
    ) -> None:
        self._task, self._robot, self._num_envs = task, robot, num_envs
        self._workspace = RobotWorkspace(robot)
        self.first_goal = task.goal(robot, self._workspace, num_envs)
        """The goals before the first episode, in NumPy's arrays."""
        start = robot.home if task.start_q is None else task.start_q
        self._usual_start = asarray(np.tile(robot.checked_q(start, "start_q"), (num_envs, 1)))
        self.start: Floats = self._usual_start
        """The start configurations (N, J), rad."""
        self._aimed_from = self.start
        poses = self.first_goal.position, self.first_goal.quaternion
        self.goal = Goal(*map(asarray, poses))
        """The goals of the N arms."""

    def given(self, options: Mapping[str, Any] | None, mask: Mask | None = None) -> Given | None:
        """The values that options of `reset` give for the arms of the mask (N,), all by default; None if they give none.

        Raises:
            GymMaraError: as in `Given.of`.
        """
        if not options:
            return None
        chosen = self._chosen(mask)
        return Given.of(options, self._task, self._robot, self._workspace, chosen)

    def begin(
        self, streams: Sequence[Streams], mask: Mask | None, given: Given | None = None
    ) -> None:
        """Choose the start and the goal of new episodes of the arms of the mask (N,), or of all.

        Args:
            streams: the random generators of each arm; needed if the task draws.
            mask: in the simulation's arrays.
            given: what is not drawn.

        Raises:
            GymMaraError: nothing fitting is found. The starts and the goals stay then.
        """
        start = self._usual_start
        if given is not None and given.start_q is not None:
            start = like(given.start_q, start)
        new, old = [start], [self.start, self.goal.position, self.goal.quaternion]
        if self._task.random_goal:
            chosen = self._chosen(mask)
            drawn = drawn_episodes(self._task, self._workspace, streams, chosen, host(start), given)
            new = [like(values, start) for values in drawn]
        if mask is not None:
            where, rows = namespace(start).where, mask[:, None]
            new = [where(rows, values, kept) for values, kept in zip(new, old, strict=False)]
        self.start, *goal = new
        if goal:
            self._aim(goal, mask, self.start)

    def warn_of_collisions(self, collided: Mask) -> None:
        """Warn if arms (N,) have collided at their starts: what the keyword argument gives is not checked before."""
        xp = namespace(collided)
        if xp.count_nonzero(collided):
            q = host(self.start)[int(xp.argmax(xp.astype(collided, xp.int64)))]
            links = ", ".join(sorted(touching_links(self._robot, q)))
            warnings.warn(
                f"start_q {q.tolist()} is in collision{f', where these links touch: {links}' if links else ''}; give another start",
                stacklevel=4,
            )

    def _chosen(self, mask: Mask | None) -> Mask:
        return np.ones(self._num_envs, np.bool_) if mask is None else host(mask)

    def set_goal(self, position: ArrayLike, quaternion: ArrayLike, q: Floats) -> None:
        """Set the goal of every arm, as `Simulation.set_goal` does; the arms are at q (N, J), rad (m)."""
        point = finite_numbers("position", position, 3)
        turn = np.array(finite_numbers("quaternion", quaternion, 4))
        if not np.linalg.norm(turn) > 1e-6:
            raise GymMaraError(f"a quaternion must not be zero, as {turn.tolist()} is")
        turn = rotations.canonical(rotations.normalised(turn))
        poses = [like(np.tile(each, (self._num_envs, 1)), self.start) for each in (point, turn)]
        self._aim(poses, None, q)

    def _aim(self, goals: Sequence[Floats], mask: Mask | None, q: Floats) -> None:
        """Set the goals, with the configurations that the task needs there.

        Args:
            goals: positions (N, 3) and quaternions (N, 4).
            mask: the arms whose goals are new (N,); None for all.
            q: where the arms are (N, J), rad (m).
        """
        position, quaternion = goals
        chosen = self._chosen(mask)
        found = self._task.configurations(
            self._workspace, *(host(each)[chosen] for each in (position, quaternion, q))
        )
        if found is not None:
            known = np.full((self._num_envs, *found.shape[1:]), np.inf)
            if self.goal.configurations is not None:
                known[...] = host(self.goal.configurations)
            known[chosen] = found
            found = like(known, self.start)
        self.goal = Goal(position, quaternion, found)
        if mask is not None:
            q = namespace(q).where(mask[:, None], q, self._aimed_from)
        self._aimed_from = q

    def save(self) -> dict[str, Any]:
        """A snapshot of the starts and the goals, of NumPy's arrays."""
        goal = host(self.goal.position), host(self.goal.quaternion)
        return {
            "goal": goal,
            "start": host(self.start).copy(),
            "aimed_from": host(self._aimed_from).copy(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of the form of `save`; it may have other entries."""
        *goal, aimed_from = (
            like(values.copy(), self.start)
            for values in (*snapshot["goal"], snapshot["aimed_from"])
        )
        self._aim(goal, None, aimed_from)
        self.start = like(snapshot["start"].copy(), self.start)
