"""What every action mode shares, and the simplest one: joint targets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from gym_mara.arrays import host, namespace
from gym_mara.backends import Backend
from gym_mara.envs.actions.checks import action_array, action_tensor
from gym_mara.envs.actions.settings import ActionSettings
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.joint_ranges import action_range
from gym_mara.types import Array, Floats, Mask


class Actions(ABC):
    """Turns the actions of N arms into joint targets, and remembers the last ones.

    The arrays are the backend's, except for `space`, `steps`, `target_low` and `target_high`, which are NumPy's.

    Args:
        settings: the mode and its scale.
        robot: the arm.
        backend: it moves the arms.

    Raises:
        GymMaraError: a setting does not fit the mode or the robot.
    """

    mode: ClassVar[str]
    """The name of the mode."""
    meaning: ClassVar[str]
    """What the numbers of an action are, for messages."""
    stepping: ClassVar[bool] = False
    """Whether the mode needs `see`, and its actions are in [-1, 1]."""
    space: Box[np.float32]
    """The space of one arm's actions (A,)."""
    steps: Floats
    """What the action 1 means in each entry (A,); empty for absolute actions."""

    def __init__(self, settings: ActionSettings, robot: RobotModel, backend: Backend) -> None:
        self.settings = settings
        self._robot, self._asarray = robot, backend.asarray
        low, high = action_range(robot)
        self._joints = Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        # The range of joint targets: the intersection of the action range and the joint limits, rad (m).
        self.target_low = np.maximum(self._joints.low.astype(np.float64), robot.lower)
        self.target_high = np.minimum(self._joints.high.astype(np.float64), robot.upper)
        self._targets_range = self._asarray(self.target_low), self._asarray(self.target_high)
        self.steps = np.zeros(0)
        self._like = self._asarray(np.zeros((backend.num_envs, robot.num_joints)))
        self._tensors = backend.arrays != "numpy"
        self._prepare(backend)
        zeros = self._asarray(np.zeros((backend.num_envs, *self.space.shape)))
        self.action: Floats = zeros
        """The last action of each arm (N, A), clipped to the action space and slowed down by its pace; zero at the start of an
        episode."""
        self.last_action: Floats = zeros
        """The action before it (N, A)."""
        self.pace: Floats = self._asarray(np.ones((backend.num_envs, 1)))
        """What the next actions are multiplied by (N, 1), in [0, 1], where they are steps: the observation's part `pace`."""

    @abstractmethod
    def _prepare(self, backend: Backend) -> None:
        """Set `space`, `steps` and what the mode needs.

        Raises:
            GymMaraError: a setting does not fit the mode or the robot.
        """

    def of_one_arm(self, action: Any) -> NDArray[Any]:
        """An action (A,) as an array of NumPy for a batch of one arm (1, A).

        Raises:
            GymMaraError: it has another shape, or as in `gym_mara.envs.actions.checks.action_array`.
        """
        array = action_array(action, self.meaning, units=self.stepping)
        self._check_shape(array, "action", self.action.shape[1:])
        return array[None]

    @abstractmethod
    def targets(self, action: Any) -> Floats:
        """The joint targets (N, J), rad (m), of actions (N, A), within the range of joint targets.

        Raises:
            GymMaraError: the actions have another type or shape, or are not finite. Nothing has changed then.
        """

    def override(self, q_target: Any) -> Floats:
        """Joint targets (N, J), rad (m), that take the place of those of an action, in the range of joint targets.

        Raises:
            GymMaraError: the targets have another type or shape, or are not finite. Nothing has changed then.
        """
        target = self._clipped(self._checked(q_target, "joint target", self._like.shape))
        self.last_action, self.action = self.action, namespace(target).zeros_like(self.action)
        return target

    def see(self, q: Floats) -> None:  # noqa: B027 - joint targets do not depend on it
        """Note where the joints are after a step (N, J), rad (m), as the sensors see them."""

    def begin(self, q: Floats, mask: Mask | None) -> None:
        """Note that all arms, or those of the mask (N,), rest at their rows of q (N, J), and have not acted yet."""
        acting = 0.0 if mask is None else ~mask[:, None]
        self.action, self.last_action = self.action * acting, self.last_action * acting

    def save(self) -> dict[str, Any]:
        """A snapshot of the last actions, in NumPy's arrays."""
        names = "action", "last_action", "pace"
        return {name: np.array(host(getattr(self, name))) for name in names}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Restore a snapshot of the same form."""
        for name, values in snapshot.items():
            setattr(self, name, self._asarray(values.copy()))

    def _clipped(self, target: Floats) -> Floats:
        """Joint targets (N, J) in their range; in half the time of target.clip for one arm."""
        xp, (low, high) = namespace(target), self._targets_range
        return xp.minimum(xp.maximum(target, low), high)

    def _check_shape(self, array: Array, what: str, shape: tuple[int, ...]) -> None:
        if array.shape != shape:
            found, needed = tuple(array.shape), tuple(shape)
            raise GymMaraError(f"the {what} has shape {found}; {self._robot.name} needs {needed}")

    def _checked(self, values: Any, what: str, shape: tuple[int, ...]) -> Floats:
        if self._tensors:
            array: Array = action_tensor(values, self.meaning, self._like)
        else:
            array = action_array(values, self.meaning, units=self.stepping)
            array = array.astype(np.float64, copy=False)
        self._check_shape(array, what, shape)
        xp = namespace(array)
        if xp.count_nonzero(xp.isfinite(array)) < shape[0] * shape[1]:
            raise GymMaraError(
                f"the {what} contains NaN or infinity; give finite numbers ({self.meaning})"
            )
        return array


class AbsoluteActions(Actions):
    """Joint targets (J,), rad (m for a prismatic joint), in the range of `gym_mara.robot.joint_ranges.action_range`."""

    mode = "absolute"
    meaning = "joint targets, rad"

    def _prepare(self, backend: Backend) -> None:
        settings = self.settings
        for name, value, default in (
            ("action_scale", settings.action_scale, None),
            ("action_from", settings.action_from, "position"),
        ):
            if value != default:
                raise GymMaraError(
                    f"{name} has no meaning with absolute actions: leave it out, or give action='relative' or "
                    "action='cartesian'"
                )
        self.space = self._joints

    def targets(self, action: Any) -> Floats:
        target = self._clipped(self._checked(action, "action", self.action.shape))
        self.last_action, self.action = self.action, target
        return target

    def override(self, q_target: Any) -> Floats:
        return self.targets(q_target)
