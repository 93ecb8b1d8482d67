"""The shapes that a robot's links are made of, for the engines and pictures that need more than Coal."""

from __future__ import annotations

from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError
from gym_mara.robot.collision_pairs import link_of
from gym_mara.types import Floats


@dataclass(frozen=True, eq=False)
class Box:
    """A box, centred at the origin."""

    size: Floats
    """Lengths along x, y and z (3,), m."""


@dataclass(frozen=True)
class Sphere:
    """A sphere, centred at the origin."""

    radius: float
    """m."""


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along z, centred at the origin."""

    radius: float
    """m."""
    length: float
    """m."""


@dataclass(frozen=True)
class Capsule:
    """A cylinder along z with a half sphere at each end, centred at the origin."""

    radius: float
    """m."""
    length: float
    """Of the cylinder, m."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """The triangles of a mesh file, or their convex hull."""

    path: str
    scale: Floats
    """Along x, y and z (3,)."""
    vertices: Floats
    """(V, 3), m, scaled."""
    convex: bool = False
    """Whether the shape is the convex hull."""


Shape = Box | Sphere | Cylinder | Capsule | Mesh


def shape_of(model: pin.Model, geometry_object: pin.GeometryObject) -> Shape:
    """The shape of one of a model's geometry objects, in the object's own frame.

    Raises:
        GymMaraError: it is none of `Shape`.
    """
    geometry = geometry_object.geometry
    if isinstance(geometry, coal.Box):
        return Box(2.0 * geometry.halfSide)
    if isinstance(geometry, coal.Sphere):
        return Sphere(geometry.radius)
    if isinstance(geometry, coal.Cylinder):
        return Cylinder(geometry.radius, 2.0 * geometry.halfLength)
    if isinstance(geometry, coal.Capsule):
        return Capsule(geometry.radius, 2.0 * geometry.halfLength)
    # Copies: Coal's and Pinocchio's arrays are views of memory that may be freed before them.
    path, scale = geometry_object.meshPath, np.array(geometry_object.meshScale)
    if isinstance(geometry, coal.BVHModelBase):
        return Mesh(path, scale, np.array(geometry.vertices()))
    if isinstance(geometry, coal.Convex):
        return Mesh(path, scale, np.array(geometry.points()), convex=True)
    raise GymMaraError(
        f"link {link_of(model, geometry_object)!r} has the shape {type(geometry).__name__} "
        f"({geometry_object.name!r}); supported are boxes, spheres, cylinders, capsules and meshes"
    )
