"""The contacts of a control period, made of the distances that MuJoCo's sensors measure."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from gym_mara.backends.mujoco.model import link_pairs
from gym_mara.robot import RobotModel
from gym_mara.robot.description.shapes import Mesh
from gym_mara.state import Contact
from gym_mara.types import Floats


class ContactFinder:
    """Makes contacts of distances; of links with meshes only where the meshes touch.

    MuJoCo replaces a mesh by its convex hull, which is never further away than the mesh. So Coal needs to check only pairs
    of links that MuJoCo has in contact.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot, self._pairs = robot, link_pairs(robot)
        self._data, self._geometry_data = robot.model.createData(), robot.geometry.createData()
        hollow = {
            robot.link_of(index)
            for index, shape in enumerate(robot.shapes)
            if isinstance(shape, Mesh) and not shape.convex
        }
        # For each pair of links the pairs of shapes that Coal checks.
        self._to_check: dict[int, list[int]] = {
            index: [] for index, pair in enumerate(self._pairs) if hollow & set(pair)
        }
        numbers = {pair: index for index, pair in enumerate(self._pairs)}
        for index, pair in enumerate(robot.geometry.collisionPairs):
            one, other = sorted((robot.link_of(pair.first), robot.link_of(pair.second)))
            if numbers[one, other] in self._to_check:
                self._to_check[numbers[one, other]].append(index)

    def find(self, q: Floats, distances: Floats) -> list[tuple[Contact, ...]]:
        """The contacts of N arms, each with the pair's largest depth.

        Args:
            q: joint positions in each physics step (N, K, J), rad.
            distances: of each of `link_pairs` (N, K, P), m; negative in contact.
        """
        if self._to_check and np.count_nonzero(distances):
            distances = self._of_meshes(q, distances)
        nearest = distances.min(axis=1)
        contacts: list[tuple[Contact, ...]] = [()] * len(q)
        touching = nearest < 0.0
        for arm in np.flatnonzero(touching.any(axis=1)).tolist():
            contacts[arm] = tuple(
                Contact(self._pairs[pair], -float(nearest[arm, pair]))
                for pair in np.flatnonzero(touching[arm]).tolist()
            )
        return contacts

    def _of_meshes(self, q: Floats, distances: Floats) -> Floats:
        """The distances, with 0 where hulls touch but meshes do not."""
        robot, shapes, data = self._robot, self._robot.geometry, self._geometry_data
        hulls = np.zeros_like(distances, np.bool_)
        checked = list(self._to_check)
        hulls[..., checked] = distances[..., checked] < 0.0
        distances = distances.copy()
        for arm, step in np.argwhere(hulls.any(axis=2)).tolist():
            pin.updateGeometryPlacements(robot.model, self._data, shapes, data, q[arm, step])
            for pair in np.flatnonzero(hulls[arm, step]).tolist():
                if not any(pin.computeCollision(shapes, data, i) for i in self._to_check[pair]):
                    distances[arm, step, pair] = 0.0
        return distances
