"""Forward kinematics of a chain for many configurations at once, in NumPy.

Pinocchio computes one configuration a call; from Python the calls cost more than the arithmetic. Its model gives the
constants here, and is the referee in the tests.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from gym_mara import rotations

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Kinematics:
    """The chain of J joints as constants; frames are homogeneous transforms to the world, 4 × 4.

    Every operation is done per configuration in a fixed order: a result does not depend on the batch it is in.
    An instance reuses its work space: it belongs to one thread.
    """

    terms: Floats
    """(J, 3, 16): the transform of a joint in its parent's frame is terms[0] + c·terms[1] + s·terms[2], flattened,
    with c, s the cosine and sine of its angle; for a prismatic joint c is its displacement and s zero."""
    axes: Floats
    """(J, 3), each joint's axis in its own frame."""
    prismatic: NDArray[np.bool_]
    """(J,)."""
    tool: Floats
    """(4, 4), the end-effector frame in the last joint's."""
    _buffers: dict[int, tuple[Floats, Floats]] = field(default_factory=dict, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.terms, self.axes, self.prismatic, self.tool)

    @classmethod
    def of(cls, model: pin.Model, ee_frame_id: int) -> Kinematics:
        """The kinematics of a Pinocchio model that is one chain of revolute and prismatic joints."""
        terms, axes, prismatic = [], [], []
        for joint in model.joints[1:]:
            data = joint.createData()
            axis = _motion_axis(joint, data)
            is_prismatic = bool(np.allclose(axis[3:], 0.0))
            direction = axis[:3] if is_prismatic else axis[3:]
            along = np.outer(direction, direction)
            local = np.zeros((3, 4, 4))
            if is_prismatic:
                local[0] = np.eye(4)
                local[1, :3, 3] = direction
            else:  # Rodrigues' formula
                local[0, :3, :3], local[0, 3, 3] = along, 1.0
                local[1, :3, :3] = np.eye(3) - along
                local[2, :3, :3] = pin.skew(direction)
            placement = model.jointPlacements[joint.id].homogeneous
            terms.append((placement @ local).reshape(3, 16))
            axes.append(direction)
            prismatic.append(is_prismatic)
        tool = model.frames[ee_frame_id].placement.homogeneous
        return cls(np.array(terms), np.array(axes), np.array(prismatic), np.array(tool))

    def frames(self, q: Floats) -> Floats:
        """The joints' frames (J, N, 4, 4) in the world at configurations q (N, J); overwritten by the next call."""
        count = len(q)
        coefficients, transforms = self._buffer(count)
        np.cos(q.T, out=coefficients[:, :, 0, 1])
        np.sin(q.T, out=coefficients[:, :, 0, 2])
        if self.prismatic.any():
            coefficients[self.prismatic, :, 0, 1] = q.T[self.prismatic]
            coefficients[self.prismatic, :, 0, 2] = 0.0
        np.matmul(coefficients, self.terms[:, None], out=transforms[:, :, None, :])
        frames = transforms.reshape(-1, count, 4, 4)
        for joint in range(1, len(frames)):
            frames[joint] = frames[joint - 1] @ frames[joint]
        return frames

    def pose(self, frames: Floats) -> tuple[Floats, Floats]:
        """Position (N, 3) m and quaternion (N, 4) of the end-effector frame, from the joints' frames."""
        tool = frames[-1] @ self.tool
        return tool[:, :3, 3].copy(), rotations.from_matrix(tool[:, :3, :3])

    def velocity(self, frames: Floats, position: Floats, qd: Floats) -> Floats:
        """The linear velocity J(q) q̇ (N, 3) m/s of the end-effector frame's origin at `position` (N, 3)."""
        axes = (frames[:, :, :3, :3] @ self.axes[:, None, :, None])[..., 0]
        arms = np.where(
            self.prismatic[:, None, None], axes, np.cross(axes, position - frames[:, :, :3, 3])
        )
        return (arms * qd.T[:, :, None]).sum(axis=0)

    def _buffer(self, count: int) -> tuple[Floats, Floats]:
        # Arrays of this size come fresh from the system at every call, which costs more than the arithmetic on them.
        if count not in self._buffers:
            joints = len(self.axes)
            if len(self._buffers) > 8:
                self._buffers.clear()
            coefficients = np.ones((joints, count, 1, 3))
            self._buffers[count] = coefficients, np.empty((joints, count, 16))
        return self._buffers[count]


def _motion_axis(joint: pin.JointModel, data: pin.JointData) -> Floats:
    """The motion subspace (6,) of a one-dimensional joint in its own frame: linear part, then angular."""
    q = np.zeros(joint.idx_q + joint.nq)
    joint.calc(data, q)
    return np.array(data.S).reshape(6)
