"""MuJoCo's model of a robot in the form that MuJoCo Warp takes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from gym_mara.backends.mujoco.model import build_model, link_of_geoms, link_pairs
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.robot import RobotModel
from gym_mara.robot.description.shapes import Mesh

with needs("the backend 'warp'", "warp"):
    import mujoco

_MOST_HOLLOW = 1e-3
"""How far triangles of a mesh may be inside its convex hull, m."""


def warp_model(robot: RobotModel, physics_step: float) -> mujoco.MjModel:
    """MuJoCo's model of a robot without the shafts of its motors.

    Raises:
        GymMaraError: a mesh is not convex, or MuJoCo cannot load the robot.
    """
    for index, shape in enumerate(robot.shapes):
        if isinstance(shape, Mesh) and not _is_convex(shape):
            raise GymMaraError(
                f"the mesh of link {robot.link_of(index)} of {robot.name} is not convex, and MuJoCo Warp knows only convex "
                "shapes: give convex_hulls=True to fill its hollows, or take the backend 'mujoco'"
            )
    model = build_model(robot, physics_step, shafts=False)
    bits = mujoco.mjtDisableBit
    # MuJoCo Warp never resets an arm, and does not know this flag. It reads the contacts, not the sensor of them.
    model.opt.disableflags &= ~bits.mjDSBL_AUTORESET.value
    model.opt.disableflags |= bits.mjDSBL_SENSOR.value
    return model


def _is_convex(mesh: Mesh) -> bool:
    """Whether each triangle of a mesh is on its convex hull."""
    if mesh.convex:
        return True
    try:
        planes = ConvexHull(mesh.vertices).equations
    except QhullError:  # it is flat
        return False
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    inside = np.full(len(centres), -np.inf)
    for *normal, offset in planes:  # one by one, because the table of all would be large
        np.maximum(inside, centres @ np.array(normal) + offset, out=inside)
    return bool((inside > -_MOST_HOLLOW).all())


def pairs_of_geoms(
    robot: RobotModel, model: mujoco.MjModel
) -> tuple[list[tuple[str, str]], NDArray[np.int32]]:
    """The pairs of links that may collide, and the number of the pair of each two shapes (G, G), -1 for no pair."""
    pairs = link_pairs(robot)
    number = {pair: index for index, pair in enumerate(pairs)}
    links = link_of_geoms(robot, model)
    table = [[number.get((min(a, b), max(a, b)), -1) for a in links] for b in links]
    return pairs, np.array(table, np.int32).reshape(len(links), len(links))
