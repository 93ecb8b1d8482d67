"""The parameters that are identified: where they may lie, and as vectors of numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gym_mara.backends.randomisation import PARAMETERS
from gym_mara.errors import GymMaraError, unknown
from gym_mara.robot import RobotModel
from gym_mara.types import Floats

PRIORS = {
    "latency": (0.0, 0.2),
    "servo_gain": (0.1, 10.0),
    "effort_limit": (0.02, 2.0),
    "joint_friction": (0.0, 0.3),
    "mass": (0.3, 3.0),
}
"""Where each parameter may lie, as in `randomisation`; joint friction as parts of the joint's effort limit."""
_BY_LOGARITHM = ("servo_gain", "mass")
"""Parameters that are searched by their logarithms. Effort limits are not: what counts most is their difference to the
friction, and where it stays the same the search should move on a straight line."""
DEFAULT = ("latency", "servo_gain", "effort_limit", "joint_friction")


class Space:
    """Parameters of an arm as a vector (P,): each that is identified, for each joint where every joint has its own.

    Args:
        robot: the arm.
        names: the parameters.
        joints: the joints, by number, whose parameters are identified; the others keep the robot's.

    Raises:
        GymMaraError: a name is unknown or given twice, or there is none.
    """

    def __init__(self, robot: RobotModel, names: Sequence[str], joints: Sequence[int]) -> None:
        for name in names:
            if name not in PRIORS:
                raise unknown("parameter", name, PRIORS, " to identify")
        if not names or len(set(names)) < len(names):
            raise GymMaraError(f"give each parameter to identify once, not {', '.join(names)!r}")
        self.names, self.robot = tuple(names), robot
        self.entries: list[tuple[str, int | None]] = []
        """The name of each entry of the vector, and its joint by number; None for a parameter of the arm."""
        for name in names:
            own = joints if PARAMETERS[name].per_joint else (None,)
            self.entries += [(name, joint) for joint in own]
        bounds = np.array([self._bounds(*entry) for entry in self.entries])
        self.low, self.high = bounds.T
        """The prior ranges (P,)."""
        self.by_logarithm = np.array([name in _BY_LOGARITHM for name, _ in self.entries])
        """Which entries (P,) are searched by their logarithms."""
        nominal = [self._nominal(name)[joint or 0] for name, joint in self.entries]
        self.nominal = np.clip(nominal, self.low, self.high)
        """The robot's own values (P,)."""

    def _bounds(self, name: str, joint: int | None) -> tuple[float, float]:
        low, high = PRIORS[name]
        if name == "joint_friction" and joint is not None:
            high *= self.robot.effort_limit[joint]
        return low, high

    def _nominal(self, name: str) -> Floats:
        if name == "joint_friction":
            return np.asarray(self.robot.model.friction)
        return np.full(self.robot.num_joints, PARAMETERS[name].nominal)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The ranges that make a backend take these parameters, for each name."""
        return {
            name: (float(self.low[own].min()), float(self.high[own].max()))
            for name in self.names
            for own in [self.of(name)]
        }

    def of(self, name: str) -> list[int]:
        """The entries of a parameter, by number; none if it is not identified."""
        return [index for index, entry in enumerate(self.entries) if entry[0] == name]

    def stretched(self, vectors: Floats) -> Floats:
        """Vectors (…, P) in the coordinates of the search, in which prior ranges have the length 1, or some for a logarithm."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.by_logarithm, np.log(vectors), vectors / self.high)

    def natural(self, coordinates: Floats) -> Floats:
        """The vectors (…, P) with these coordinates."""
        return np.where(self.by_logarithm, np.exp(coordinates), coordinates * self.high)

    def slope(self, vector: Floats) -> Floats:
        """How much the entries of a vector (P,) change with their coordinates."""
        return np.where(self.by_logarithm, vector, self.high)

    def inside(self, vector: Floats) -> Floats:
        """A vector (…, P) moved to a little within the prior ranges."""
        room = 0.01 * (self.high - self.low)
        low, high = np.where(self.by_logarithm, 1.01 * self.low, self.low + room), self.high - room
        return np.clip(vector, low, high)

    def effort_limit(self, index: int) -> float:
        """The robot's effort limit, Nm (N), of the joint of an entry."""
        return float(self.robot.effort_limit[self.entries[index][1] or 0])

    def values(self, vectors: Floats) -> dict[str, Floats]:
        """Parameter vectors (M, P) as the values of M arms: name → (M, J), or (M,) for a parameter of the arm."""
        values = {}
        for name in self.names:
            if PARAMETERS[name].per_joint:
                values[name] = np.tile(self._nominal(name), (len(vectors), 1))
                for index in self.of(name):
                    values[name][:, self.entries[index][1]] = vectors[:, index]
            else:
                values[name] = vectors[:, self.of(name)[0]]
        return values

    def label(self, index: int) -> str:
        """The name of an entry, with its joint."""
        name, joint = self.entries[index]
        return name if joint is None else f"{name} of {self.robot.joint_names[joint]}"
