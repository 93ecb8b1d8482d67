"""Observations: named parts with bounds, concatenated into one array."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from gym_mara import rotations
from gym_mara.arrays import Constants, namespace
from gym_mara.errors import GymMaraError
from gym_mara.state import SimState
from gym_mara.tasks.goal import Goal
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot import RobotModel

_ONE = 1.0 + 1e-9
"""The bound of a unit quaternion's components, with a margin for rounding."""

_ROUNDING = 1e-6
"""By how much an engine with numbers in single precision may exceed a velocity limit, relative to it."""

_NARROWEST = 1e-9
"""The least difference of two bounds."""


@dataclass(frozen=True, eq=False)
class Part:
    """A named part of an observation, with its bounds."""

    name: str
    low: Floats
    """The lower bounds (K,)."""
    high: Floats
    """The upper bounds (K,)."""
    values: Callable[[SimState, Goal], Floats]
    """Computes the values (N, K) for N arms; a module-level function, so that environments can be pickled."""
    joint_limits: bool = False
    """Whether the bounds are joint limits, which joints with dynamics may overshoot."""
    unit: str = ""
    """The unit of the values, such as "m/s"; "joint" for that of each joint, rad (m), "joint/s" for that of its
    velocity, and "" for none. Exported policies name it."""


_WAYS = Constants(0.3, 2.0)
"""The scales of a way to a configuration, rad (m)."""

PACE = "pace"
"""The name of the part, in [0, 1], by which actions that are steps are multiplied, if an observation has it."""

OF_THE_ROBOT = frozenset(
    {
        "joint_positions",
        "joint_velocities",
        "joint_cosines_and_sines",
        "tool_position",
        "tool_rotation",
        "tool_quaternion",
        "tool_velocity",
        "last_action",
    }
)
"""The names of the parts that a robot knows of itself, without the target and its surroundings."""


class Observation:
    """Concatenates parts into one flat array.

    Args:
        parts: the parts, in order.
        overshoot: by how much the bounds of parts with `joint_limits` are widened, rad (m): that of the backend.

    Raises:
        GymMaraError: two parts have the same name, or a part's bounds differ in shape.
    """

    def __init__(self, parts: Sequence[Part], overshoot: float = 0.0) -> None:
        names = [part.name for part in parts]
        if len(set(names)) < len(names):
            raise GymMaraError(f"two parts of an observation have the same name: {names}")
        for part in parts:
            if np.ndim(part.low) != 1 or np.shape(part.low) != np.shape(part.high):
                raise GymMaraError(
                    f"the bounds of {part.name!r} must be two arrays of the same shape (K,), "
                    f"not {np.shape(part.low)} and {np.shape(part.high)}"
                )
        self.parts, self._overshoot = tuple(parts), overshoot
        self._values = [part.values for part in parts]
        wider = [overshoot if part.joint_limits else 0.0 for part in parts]
        low = np.concatenate([part.low - by for part, by in zip(parts, wider, strict=True)])
        high = np.concatenate([part.high + by for part, by in zip(parts, wider, strict=True)])
        # Gymnasium warns of equal bounds, such as those of a joint that cannot move.
        self.space = Box(low, np.maximum(high, low + _NARROWEST), dtype=np.float64)
        """The space of one flat observation (O,)."""
        self._ends = np.cumsum([len(part.low) for part in parts]).tolist()

    def __call__(self, state: SimState, goal: Goal) -> Floats:
        """Compute the flat observations (N, O) of N arms, a fresh array."""
        parts = [values(state, goal) for values in self._values]
        return namespace(state.q).concat(parts, axis=-1)

    def place(self, name: str) -> slice | None:
        """Where the part with a name is in flat observations; None without such a part."""
        for part, end in zip(self.parts, self._ends, strict=True):
            if part.name == name:
                return slice(end - len(part.low), end)
        return None

    def only(self, names: Collection[str]) -> tuple[Observation, NDArray[np.int64]]:
        """The observation of the parts with these names alone, and its columns in flat observations (O,).

        Raises:
            GymMaraError: there is no such part.
        """
        chosen = [part for part in self.parts if part.name in names]
        if not chosen:
            own = ", ".join(part.name for part in self.parts)
            raise GymMaraError(
                f"the task observes nothing of {', '.join(sorted(names))}: it has {own}"
            )
        columns = np.arange(self._ends[-1])
        places = [columns[self.place(part.name)] for part in chosen]
        return Observation(chosen, self._overshoot), np.concatenate(places)

    def split(self, flat: Floats) -> dict[str, Floats]:
        """Split flat observations (…, O) into their parts by name: views of shape (…, K)."""
        starts = [0, *self._ends[:-1]]
        return {
            part.name: flat[..., start:end]
            for part, start, end in zip(self.parts, starts, self._ends, strict=True)
        }


def joint_positions(robot: RobotModel) -> Part:
    """The joint positions (J,), rad (m for a prismatic joint)."""
    return Part(
        "joint_positions",
        robot.lower,
        robot.upper,
        _joint_positions,
        joint_limits=True,
        unit="joint",
    )


def joint_cosines_and_sines(robot: RobotModel) -> Part:
    """The cosines of the joint positions (J,), then their sines."""
    bound = np.ones(2 * robot.num_joints)
    return Part("joint_cosines_and_sines", -bound, bound, _joint_cosines_and_sines)


def joint_velocities(joint_velocity: Floats) -> Part:
    """The joint velocities (J,), rad/s (m/s for a prismatic joint).

    Args:
        joint_velocity: the largest speed of each joint (J,), rad/s.
    """
    bound = np.maximum((1.0 + _ROUNDING) * joint_velocity, _NARROWEST)
    return Part("joint_velocities", -bound, bound, _joint_velocities, unit="joint/s")


def last_action(space: Box) -> Part:
    """The last action (A,), in the units of the action space; zero at the start of an episode."""
    return Part(
        "last_action", space.low.astype(np.float64), space.high.astype(np.float64), _last_action
    )


def position_error(robot: RobotModel, farthest: float) -> Part:
    """The position of the end effector minus the position of the target (3,), m.

    Args:
        robot: the arm.
        farthest: the largest possible distance of a target from the world's origin, m.
    """
    return _symmetric("position_error", robot.extent + farthest, _position_error, "m")


def orientation_error() -> Part:
    """The rotation from the target to the end effector, q_ee ⊗ conj(q_target) (4,), [w, x, y, z], w >= 0."""
    return _quaternion("orientation_error", _orientation_error)


def tool_velocity(robot: RobotModel, joint_velocity: Floats) -> Part:
    """The linear velocity of the end effector (3,), m/s.

    Args:
        robot: the arm.
        joint_velocity: the largest speed of each joint (J,), rad/s.
    """
    fastest = float((robot.reach * joint_velocity).sum())
    return _symmetric("tool_velocity", fastest, _tool_velocity, "m/s")


def tool_position(robot: RobotModel) -> Part:
    """The position of the end effector in the world frame (3,), m."""
    return _symmetric("tool_position", robot.extent, _tool_position, "m")


def tool_quaternion() -> Part:
    """The orientation of the end effector in the world frame (4,), [w, x, y, z], w >= 0."""
    return _quaternion("tool_quaternion", _tool_quaternion)


def tool_rotation() -> Part:
    """The orientation of the end effector in the world frame as a rotation matrix, row by row (9,)."""
    return _rotation("tool_rotation", _tool_rotation)


def target_position(robot: RobotModel) -> Part:
    """The position of the target in the world frame (3,), m, for targets within reach."""
    return _symmetric("target_position", robot.extent, _target_position, "m")


def target_quaternion() -> Part:
    """The orientation of the target in the world frame (4,), [w, x, y, z], w >= 0."""
    return _quaternion("target_quaternion", _target_quaternion)


def target_rotation() -> Part:
    """The orientation of the target in the world frame as a rotation matrix, row by row (9,).

    Points of the tool at the target are linear in it, and quadratic in a quaternion: a network learns more easily from it.
    """
    return _rotation("target_rotation", _target_rotation)


def joint_ways_to_configuration(robot: RobotModel) -> Part:
    """The way δ to the nearest known configuration at the target, as δ / max(max |δ|, 0.3) and δ / (max |δ| + 2) (2 J)."""
    bound = np.ones(2 * robot.num_joints)
    return Part("joint_ways_to_configuration", -bound, bound, _joint_ways_to_configuration)


def _symmetric(
    name: str, bound: float, values: Callable[[SimState, Goal], Floats], unit: str
) -> Part:
    return Part(name, np.full(3, -bound), np.full(3, bound), values, unit=unit)


def _quaternion(name: str, values: Callable[[SimState, Goal], Floats]) -> Part:
    return Part(name, np.array([0.0, -_ONE, -_ONE, -_ONE]), np.full(4, _ONE), values)


def _rotation(name: str, values: Callable[[SimState, Goal], Floats]) -> Part:
    return Part(name, np.full(9, -_ONE), np.full(9, _ONE), values)


def _joint_positions(state: SimState, goal: Goal) -> Floats:
    return state.q


def _joint_cosines_and_sines(state: SimState, goal: Goal) -> Floats:
    xp = namespace(state.q)
    return xp.concat([xp.cos(state.q), xp.sin(state.q)], axis=-1)


def _joint_velocities(state: SimState, goal: Goal) -> Floats:
    return state.qd


def _joint_ways_to_configuration(state: SimState, goal: Goal) -> Floats:
    way = goal.ways(state.q)
    xp, near, far = _WAYS.like(way)
    longest = xp.max(xp.abs(way), axis=-1, keepdims=True)
    return xp.concat([way / xp.maximum(longest, near), way / (longest + far)], axis=-1)


def _last_action(state: SimState, goal: Goal) -> Floats:
    assert state.action is not None
    return state.action


def _position_error(state: SimState, goal: Goal) -> Floats:
    return state.ee_position - goal.position


def _orientation_error(state: SimState, goal: Goal) -> Floats:
    return goal.orientation_error(state.ee_quaternion)


def _tool_velocity(state: SimState, goal: Goal) -> Floats:
    return state.ee_velocity


def _tool_position(state: SimState, goal: Goal) -> Floats:
    return state.ee_position


def _tool_quaternion(state: SimState, goal: Goal) -> Floats:
    return state.ee_quaternion


def _tool_rotation(state: SimState, goal: Goal) -> Floats:
    return rotations.to_matrix(state.ee_quaternion).reshape(-1, 9)


def _target_rotation(state: SimState, goal: Goal) -> Floats:
    return rotations.to_matrix(goal.quaternion).reshape(-1, 9)


def _target_position(state: SimState, goal: Goal) -> Floats:
    return goal.position


def _target_quaternion(state: SimState, goal: Goal) -> Floats:
    return goal.quaternion
