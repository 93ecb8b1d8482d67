"""Inertias of moving bodies that have none in the URDF, made of their shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from gym_mara.robot.description.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere
from gym_mara.types import Floats

NO_MASS = 1e-9
"""A body with less has no mass, kg."""
NO_INERTIA = 1e-15
"""A body with less about any axis through its centre of mass has no inertia, kg·m²; MuJoCo has the same limit."""
_BALL = 0.05
"""The radius of the ball that stands for a body without shapes, m."""
_THINNEST = 1e-3
"""A flat mesh is taken as a box of at least this thickness, m."""


def moments(inertia: pin.Inertia) -> Floats:
    """The principal moments of inertia about the centre of mass (3,), kg·m², in ascending order."""
    return np.asarray(np.linalg.eigvalsh(inertia.inertia))


def lacks_mass(inertia: pin.Inertia) -> bool:
    """Whether a body has no mass."""
    return bool(inertia.mass < NO_MASS)


def lacks_inertia(inertia: pin.Inertia) -> bool:
    """Whether a body cannot be turned about some axis through its centre of mass."""
    return bool(moments(inertia)[0] < NO_INERTIA)


def add_inertias(
    model: pin.Model, geometry: pin.GeometryModel, shapes: Sequence[Shape], mass: float
) -> None:
    """Give each moving body of a model that lacks mass or inertia those of its shapes, of uniform density.

    Args:
        model: Pinocchio's model, which is changed.
        geometry: its collision geometry.
        shapes: the shapes of the geometry.
        mass: of a body without mass, kg. A body that has a mass keeps it, and its centre of mass.
    """
    for body in range(1, model.njoints):
        own = model.inertias[body]
        if not (lacks_mass(own) or lacks_inertia(own)):
            continue
        objects = zip(geometry.geometryObjects, shapes, strict=True)
        placed = [(each.placement, shape) for each, shape in objects if each.parentJoint == body]
        of_shapes = _uniform(placed, mass if lacks_mass(own) else own.mass)
        if not lacks_mass(own):
            of_shapes = pin.Inertia(own.mass, own.lever, of_shapes.inertia)
        model.inertias[body] = of_shapes


def _uniform(placed: Sequence[tuple[pin.SE3, Shape]], mass: float) -> pin.Inertia:
    """The inertia of shapes of one density that have this mass together; of a ball if they have no volume."""
    density = [(placement, _of_density_one(shape)) for placement, shape in placed]
    whole = pin.Inertia.Zero()
    for placement, inertia in density:
        whole += placement.act(inertia)
    if lacks_inertia(whole) or whole.mass <= 0.0:
        return pin.Inertia.FromSphere(mass, _BALL)
    scale = mass / whole.mass
    return pin.Inertia(mass, whole.lever, scale * whole.inertia)


def _of_density_one(shape: Shape) -> pin.Inertia:
    """The inertia of a shape of 1 kg/m³ in its own frame."""
    match shape:
        case Box(size):
            return pin.Inertia.FromBox(float(np.prod(size)), *size)
        case Sphere(radius):
            return pin.Inertia.FromSphere(4.0 / 3.0 * np.pi * radius**3, radius)
        case Cylinder(radius, length):
            return pin.Inertia.FromCylinder(np.pi * radius**2 * length, radius, length)
        case Capsule(radius, length):
            volume = np.pi * radius**2 * (length + 4.0 / 3.0 * radius)
            return pin.Inertia.FromCapsule(volume, radius, length)
        case Mesh() as mesh:
            return _of_mesh(mesh)


def _of_mesh(mesh: Mesh) -> pin.Inertia:
    """The inertia of a mesh of 1 kg/m³: of its parts where they are closed, else of their convex hulls."""
    whole = pin.Inertia.Zero()
    for part in mesh.parts:
        solid = part
        if not part.is_volume:
            thickness = part.bounding_box.primitive.extents.min()
            solid = part.convex_hull if thickness >= _THINNEST else None
        if solid is None:
            size = np.maximum(np.ptp(part.vertices, axis=0), _THINNEST)
            box = pin.Inertia.FromBox(float(np.prod(size)), *size)
            whole += pin.SE3(np.eye(3), part.vertices.mean(axis=0)).act(box)
        else:
            found = solid.mass_properties
            whole += pin.Inertia(found.mass, found.center_mass, found.inertia)
    return whole
