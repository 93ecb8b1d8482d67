"""Parts of an observation that need the arm's geometry: which way each joint leads to the target, and which into a collision.

They take forward kinematics and the Jacobian, which a real arm knows as well. `joint_steps` is one step of differential inverse
kinematics; no configuration for the target is known.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gym_mara import rotations
from gym_mara.arrays import Constants
from gym_mara.errors import SMALLEST
from gym_mara.robot.clearance import FAR, Clearance
from gym_mara.robot.kinematics import JointFrames
from gym_mara.state import SimState
from gym_mara.tasks.goal import Goal
from gym_mara.tasks.observation import PACE, Part
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot import RobotModel

DAMPING = 0.05
"""Of the least squares, m: it keeps a joint's step small near a singularity."""
STEP_TIME = 0.02
"""A step of the least squares is relative to how far a joint travels in this time, s."""
_SCALES, _ANGLE_SCALES, _JOINT_SCALES = (1.0, 0.1, 0.03), (3.0, 0.3, 0.03), (1.0, 0.1)
"""At each of these scales k (m, rad, and rad or m of a joint) a value v is observed as v / (|v| + k)."""
_FAR_STEP = 0.3
"""The scale of a step of the least squares, rad (m)."""
_LEVER = 0.01
"""With levers of this length, m, a joint's way to the target counts a quarter; it is undefined with none."""
_CLOSE, _OVERLAP = 0.03, 0.1
"""The scale of a small clearance, and the largest overlap of spheres that counts, m."""
_PUSH, _STRONG = 0.05, 1.0
"""The scales of the direction and of the strength of a repulsion, m/rad."""
_SMALL = 1e-9
_AT_LIMIT = 0.01
"""A joint so near to its limit does not move towards it, rad (m)."""


class ArmParts:
    """Parts that are computed once for a state and its goal, whichever of them an observation has.

    Args:
        robot: the arm.
        joint_velocity: the largest speed of each joint (J,), rad/s.
        orientation: whether the target has an orientation.
        length_per_angle: how much an angle of the tool counts, m/rad.
        slow_within: the error of both together from which actions are smaller, m.
    """

    def __init__(
        self,
        robot: RobotModel,
        joint_velocity: Floats,
        orientation: bool,
        length_per_angle: float,
        slow_within: float,
    ) -> None:
        self._made_of = robot, joint_velocity, orientation, length_per_angle, slow_within
        self._joints = robot.num_joints
        self._kinematics, self._clearance = robot.kinematics(), Clearance(robot)
        self._orientation = orientation
        slides = self._kinematics.prismatic.astype(np.float64)
        rows = np.array([1.0] * 3 + [length_per_angle] * 3)[: 6 if orientation else 3]
        damping = DAMPING**2 * np.eye(len(rows))
        step = STEP_TIME * np.maximum(joint_velocity, SMALLEST)  # it divides
        self._constants = Constants(slides, rows[:, None], damping, step, _SMALL, _LEVER)
        self._limits = Constants(robot.lower + _AT_LIMIT, robot.upper - _AT_LIMIT)
        self._pace = Constants(length_per_angle, slow_within, 1.0)
        self._scales = Constants(_SCALES, _ANGLE_SCALES, _JOINT_SCALES, _FAR_STEP)
        self._overlap = Constants(-1.0, 0.0)
        self._seen: tuple[Any, ...] = (None, None)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._made_of

    def parts(self) -> list[Part]:
        """All parts, in order."""
        joints = self._joints
        at_scales = len(_JOINT_SCALES) * joints
        parts = [
            _part("position_error_at_scales", 3 * len(_SCALES), self.position_error_at_scales),
            _part("joint_ways", at_scales, self.joint_ways_at_scales),
        ]
        if self._orientation:
            parts += [
                _part("angle_error_at_scales", 3 * len(_ANGLE_SCALES), self.angle_error_at_scales),
                _part("joint_turns", at_scales, self.joint_turns_at_scales),
            ]
        return [
            *parts,
            _part("joint_steps", 2 * joints, self.joint_steps),
            _part("clearance", 2 * joints, self.clearance),
            _part("joint_repulsions", 2 * joints, self.joint_repulsions),
            Part(PACE, np.zeros(1), np.ones(1), self.pace),
        ]

    def position_error_at_scales(self, state: SimState, goal: Goal) -> Floats:
        """The way from the tool to the target e (N, 3), m, as e / (|e| + k) for each scale k."""
        _, way, _, _ = self._look(state, goal)
        xp, scales, *_ = self._scales.like(way)
        size = xp.sqrt(xp.sum(way * way, axis=-1, keepdims=True))
        return _at_scales(xp, way, size, scales)

    def angle_error_at_scales(self, state: SimState, goal: Goal) -> Floats:
        """The rotation vector from the tool to the target θ (N, 3), rad, as θ / (|θ| + k) for each scale k."""
        _, _, turn, _ = self._look(state, goal)
        xp, _, scales, *_ = self._scales.like(turn)
        size = xp.sqrt(xp.sum(turn * turn, axis=-1, keepdims=True))
        return _at_scales(xp, turn, size, scales)

    def joint_ways_at_scales(self, state: SimState, goal: Goal) -> Floats:
        """How far each joint alone must move to bring the tool nearest to the target, x, as x / (|x| + k) for each scale k (N, S J)."""
        ways = self.joint_ways(state, goal)
        xp, _, _, scales, _ = self._scales.like(ways)
        return _at_scales(xp, ways, xp.abs(ways), scales)

    def joint_turns_at_scales(self, state: SimState, goal: Goal) -> Floats:
        """How far each joint alone must turn to align the tool best with the target, x, as x / (|x| + k) for each scale k (N, S J)."""
        turns = self.joint_turns(state, goal)
        xp, _, _, scales, _ = self._scales.like(turns)
        return _at_scales(xp, turns, xp.abs(turns), scales)

    def joint_ways(self, state: SimState, goal: Goal) -> Floats:
        """How far each joint alone must move to bring the tool nearest to the target (N, J), rad (m for a prismatic joint).

        The step of cyclic coordinate descent (Wang and Chen 1991, doi 10.1109/70.86079). It fades where the axis goes through
        the tool or the target.
        """
        frames, way, _, _ = self._look(state, goal)
        xp, slides, _, _, _, _, lever = self._constants.like(way)
        axes = frames.axes
        tool = state.ee_position[:, None] - frames.origins
        target = tool + way[:, None]
        tool_along, target_along = (xp.sum(each * axes, axis=-1) for each in (tool, target))
        sine = xp.sum(xp.linalg.cross(tool, target) * axes, axis=-1)
        cosine = xp.sum(tool * target, axis=-1) - tool_along * target_along
        levers = xp.sqrt(sine * sine + cosine * cosine)  # the product of both
        angle = xp.atan2(sine, cosine) * (levers / (levers + lever**2)) ** 2
        return angle + slides * (target_along - tool_along - angle)

    def joint_turns(self, state: SimState, goal: Goal) -> Floats:
        """How far each joint alone must turn to align the tool best with the target's orientation (N, J), rad; 0 if prismatic.

        The angle β about the axis a that makes |w| of the remaining rotation largest: tan(β/2) = -a·v / w for the rotation
        [w, v] from the target to the tool.
        """
        frames, way, _, error = self._look(state, goal)
        xp, slides, _, _, _, _, lever = self._constants.like(way)
        along = xp.sum(frames.axes * error[:, None, 1:], axis=-1)
        w = error[:, :1]
        size = xp.sqrt(along * along + w * w)
        angle = -2.0 * xp.atan2(along, w) * (size / (size + lever))
        return angle - slides * angle

    def pace(self, state: SimState, goal: Goal) -> Floats:
        """E / slow_within, at most 1, for the error E of position and angle together (N, 1)."""
        _, way, turn, _ = self._look(state, goal)
        xp, length, slow, one = self._pace.like(way)
        error = xp.sqrt(xp.sum(way * way, axis=-1, keepdims=True))
        if self._orientation:
            error = error + length * xp.sqrt(xp.sum(turn * turn, axis=-1, keepdims=True))
        return xp.minimum(error / slow, one)

    def joint_steps(self, state: SimState, goal: Goal) -> Floats:
        """The step of all joints by damped least squares, near and far from the target (N, 2 J).

        δ = Jᵀ (J Jᵀ + λ² I)⁻¹ e (Wampler 1986, doi 10.1109/TSMC.1986.289285), without the joints that it would push against
        their limits. First relative to how far joints travel in STEP_TIME at the `pace`, where a step beyond 1 is shortened as a
        whole; then δ / (max |δ| + 0.3 rad).
        """
        frames, way, turn, _ = self._look(state, goal)
        xp, _, rows, damping, step, small, _ = self._constants.like(way)
        error = xp.concat([way, turn], axis=-1) if self._orientation else way
        jacobian = frames.jacobian[:, : error.shape[-1]] * rows
        error = (error * rows[:, 0])[..., None]
        whole = _least_squares(xp, jacobian, error, damping)
        _, lowest, highest = self._limits.like(way)
        blocked = ((state.q < lowest) & (whole < 0.0)) | ((state.q > highest) & (whole > 0.0))
        whole = _least_squares(xp, jacobian * ~blocked[:, None], error, damping)
        far = whole / (xp.max(xp.abs(whole), axis=-1, keepdims=True) + self._scales.like(whole)[4])
        near = whole / (step * xp.maximum(self.pace(state, goal), small))
        longest = xp.max(xp.abs(near), axis=-1, keepdims=True)
        near = near / xp.where(longest > 1.0, longest, xp.ones_like(longest))
        return xp.concat([near, far], axis=-1)

    def clearance(self, state: SimState, goal: Goal) -> Floats:
        """The least distance d of each body from those that it may touch, by `gym_mara.robot.clearance` (N, 2 J).

        As d / FAR from -1 on, and e^(-(d + 0.1)/0.03) up to 1, which only spheres of thick links go beyond.
        """
        least, _ = self._nearness(state, goal)
        xp, lowest, highest = self._overlap.like(least)
        far = xp.maximum(least / FAR, lowest)
        close = xp.exp(xp.minimum(-(least + _OVERLAP) / _CLOSE, highest))
        return xp.concat([far, close], axis=-1)

    def joint_repulsions(self, state: SimState, goal: Goal) -> Floats:
        """Which way each joint leads away from collisions, and how strongly (N, 2 J), from -1 to 1.

        The repulsion r as r / (max |r| + 0.05 m/rad), and as r / (|r| + 1 m/rad).
        """
        _, repulsion = self._nearness(state, goal)
        xp = self._constants.like(repulsion)[0]
        largest = xp.max(xp.abs(repulsion), axis=-1, keepdims=True)
        return xp.concat(
            [repulsion / (largest + _PUSH), repulsion / (xp.abs(repulsion) + _STRONG)], axis=-1
        )

    def _look(self, state: SimState, goal: Goal) -> tuple[JointFrames, Floats, Floats, Floats]:
        """The frames of the joints; the way (N, 3), m, and the rotation vector (N, 3), rad, from the tool to the target; and
        the rotation from the target to the tool (N, 4)."""
        if self._seen[0] is not state or self._seen[1] is not goal:
            frames = self._kinematics.joint_frames(state.q)
            error = goal.orientation_error(state.ee_quaternion)
            turn = -rotations.to_vector(error)
            looked = frames, goal.position - state.ee_position, turn, error
            self._seen = state, goal, looked, self._clearance(frames)
        return self._seen[2]  # type: ignore[no-any-return]

    def _nearness(self, state: SimState, goal: Goal) -> tuple[Floats, Floats]:
        """The least distances of the bodies (N, J), m, and the repulsion (N, J)."""
        self._look(state, goal)
        return self._seen[3]  # type: ignore[no-any-return]


def _least_squares(xp: Any, jacobian: Floats, error: Floats, damping: Floats) -> Floats:
    """The damped step (N, J) for errors (N, K, 1) with Jacobians (N, K, J) and the damping (K, K)."""
    across = xp.permute_dims(jacobian, (0, 2, 1))
    return (across @ xp.linalg.solve(jacobian @ across + damping, error))[..., 0]  # type: ignore[no-any-return]


def _at_scales(xp: Any, values: Floats, size: Floats, scales: Floats) -> Floats:
    """Values v (N, K) of a size |v|, (N, K) or (N, 1), as v / (|v| + k) for each scale k (N, S K)."""
    return xp.reshape(values[:, None] / (size[:, None] + scales[:, None]), (len(values), -1))


def _part(name: str, size: int, values: Any) -> Part:
    return Part(name, np.full(size, -1.0), np.full(size, 1.0), values)
