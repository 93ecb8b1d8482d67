"""Actions that are steps: of the joints, or of the tool by damped least squares."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from gym_mara.arrays import Constants, host, namespace
from gym_mara.backends import Backend
from gym_mara.envs.actions.base import Actions
from gym_mara.errors import GymMaraError
from gym_mara.types import Floats, Mask

LINEAR, ANGULAR = 0.4, 0.8
"""The velocities of the tool that the action 1 means, m/s and rad/s: those of a joystick in MoveIt Servo's configuration of
the Panda (moveit_servo/config/panda_simulated_config.yaml)."""
DAMPING = 0.01
"""λ of the damped least squares: the default of Isaac Lab's DifferentialIKController."""
_ONE = Constants(1.0)
_DAMPING = Constants(DAMPING**2 * np.eye(6), 1.0)


class SteppingActions(Actions):
    """Actions in [-1, 1] that move each joint by a step, from where it is or from its last target."""

    stepping = True

    def _prepare(self, backend: Backend) -> None:
        self._from_target = self.settings.action_from == "target"
        self.origin: Floats = self._like
        """Where the next steps begin (N, J), rad (m)."""
        self.steps = self._steps(backend)
        self._scale = self._asarray(self.steps)
        self.space = Box(-1.0, 1.0, self.steps.shape, np.float32)

    @abstractmethod
    def _steps(self, backend: Backend) -> Floats:
        """What the action 1 means in each entry (A,).

        Raises:
            GymMaraError: a setting does not fit the robot.
        """

    @abstractmethod
    def _way(self, scaled: Floats) -> Floats:
        """The steps of the joints (N, J), rad (m), for actions (N, A) times `steps`."""

    def _given(self, default: Floats) -> Floats:
        """The scale of the settings for each entry of an action (A,); the default (A,) if they have none.

        Raises:
            GymMaraError: they have another number of entries.
        """
        given = (
            default if self.settings.action_scale is None else np.array(self.settings.action_scale)
        )
        if given.ndim and len(given) != len(default):
            raise GymMaraError(
                f"action_scale has {len(given)} numbers, and an action of {self._robot.name} has {len(default)}: give one "
                "number, or one for each"
            )
        return np.broadcast_to(given, default.shape).astype(np.float64)

    def _longest(self, backend: Backend) -> Floats:
        """The smallest step of each joint (J,) with which it travels as far in a control period as it can, rad (m).

        With the velocity limit v and the period T this is v T. A servo of gain k slows down within v / k of its target, so from
        the position of the joint it is v (T + 1 / k). From the last target it is v T: that target keeps ahead by itself.
        """
        time = backend.control_period
        if backend.servo_gain is not None and not self._from_target:
            time += 1.0 / backend.servo_gain
        # A joint without a velocity limit cannot step further than its range.
        return np.minimum(backend.joint_velocity * time, self.target_high - self.target_low)

    def targets(self, action: Any) -> Floats:
        given = self._checked(action, "action", self.action.shape)
        xp, one = _ONE.like(given)
        clipped = xp.minimum(xp.maximum(given, -one), one)
        self.last_action, self.action = self.action, clipped * self.pace
        return self._aimed(self._clipped(self.origin + self._way(self.action * self._scale)))

    def override(self, q_target: Any) -> Floats:
        return self._aimed(super().override(q_target))

    def _aimed(self, target: Floats) -> Floats:
        if self._from_target:
            self.origin = target
        return target

    def see(self, q: Floats) -> None:
        if not self._from_target:
            self.origin = namespace(q).asarray(q, copy=True)

    def begin(self, q: Floats, mask: Mask | None) -> None:
        super().begin(q, mask)
        xp = namespace(q)
        if mask is None:
            self.origin = xp.asarray(q, copy=True)
        else:
            self.origin = xp.where(mask[:, None], q, self.origin)

    def save(self) -> dict[str, Any]:
        return super().save() | {"origin": np.array(host(self.origin))}


class RelativeActions(SteppingActions):
    """Steps of the joints (J,)."""

    mode = "relative"
    meaning = "steps of the joints, in [-1, 1]"

    def _steps(self, backend: Backend) -> Floats:
        steps = self._given(self._longest(backend))
        widest = float((self.target_high - self.target_low).max())
        if steps.max() > widest:
            raise GymMaraError(
                f"action_scale must be at most {widest:.3g}, because no joint of {self._robot.name} can move further; "
                f"not {steps.max():g}"
            )
        return steps

    def _way(self, scaled: Floats) -> Floats:
        return scaled


class CartesianActions(SteppingActions):
    """A twist of the end-effector frame in the world (6,): the velocity of its origin, m/s, and its angular velocity, rad/s.

    The joint velocities are Jᵀ (J Jᵀ + λ² I)⁻¹ twist (Nakamura and Hanafusa 1986; Wampler 1986), with the Jacobian where the
    steps begin. If they ask more of a joint than it can travel in a control period, all steps of the arm are shortened by the
    same factor.
    """

    mode = "cartesian"
    meaning = "a twist of the tool, in [-1, 1]"

    def _steps(self, backend: Backend) -> Floats:
        self._kinematics = self._robot.kinematics()
        longest = self._longest(backend)
        movable = longest > 0.0
        self._movable = self._asarray(movable.astype(np.float64))
        self._limit = self._asarray(np.where(movable, longest, 1.0))
        self._time = self._lead(backend)
        return self._given(np.repeat([LINEAR, ANGULAR], 3))

    def _lead(self, backend: Backend) -> float:
        """The ratio of a step to the velocity that a joint has after it, s.

        That is the control period T; and with a servo of gain k, which moves by the part 1 - exp(-k T) of the way to its
        target, T / (1 - exp(-k T)).
        """
        period, gain = backend.control_period, backend.servo_gain
        if gain is None or self._from_target:
            return period
        return period / -math.expm1(-gain * period)

    def _way(self, scaled: Floats) -> Floats:
        jacobian = self._kinematics.joint_frames(self.origin).jacobian * self._movable
        xp, damping, one = _DAMPING.like(jacobian)
        across = xp.matrix_transpose(jacobian)
        solved = xp.linalg.solve(jacobian @ across + damping, scaled[..., None])
        way = (across @ solved)[..., 0] * self._time
        excess = xp.max(xp.abs(way) / self._limit, axis=-1, keepdims=True)
        return way / xp.maximum(excess, one)
