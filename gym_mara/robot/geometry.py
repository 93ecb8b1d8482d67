"""Pinocchio's geometry of a robot's links, made of the shapes that every engine gets.

Pinocchio places the shapes and makes the primitives. It does not read mesh files: Coal joins the parts of a file wrongly, and
Assimp ignores the unit of a Collada file.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError
from gym_mara.robot.description.meshes.files import mesh_file
from gym_mara.robot.description.parser import parsing
from gym_mara.robot.description.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere

_KEPT = 256
"""The number of Coal's meshes that are kept for the next robot."""
_THIN = 1e-9
"""What a flat mesh is thought to be thick, m."""


class Geometry(NamedTuple):
    """The collision shapes of a robot's links, or the shapes of their pictures."""

    model: pin.GeometryModel
    """Which link each shape belongs to, where it is, and its colour."""
    shapes: tuple[Shape, ...]
    """Those of `model.geometryObjects`, in the same order."""


def read_geometry(
    urdf: Path,
    xml: str,
    model: pin.Model,
    kind: str,
    package_dirs: Sequence[str] = (),
    *,
    convex_hulls: bool = False,
) -> Geometry:
    """The shapes of a model's links.

    Args:
        urdf: the file, for errors and to find meshes.
        xml: the URDF as text.
        model: Pinocchio's model of it.
        kind: "collision" or "visual".
        package_dirs: folders in which packages are looked for, too.
        convex_hulls: whether every mesh is replaced by its convex hull.

    Raises:
        GymMaraError: a mesh is not found or cannot be read.
    """
    root = ElementTree.fromstring(xml)
    meshes = {}
    for link in root.findall("link"):
        hulls = {hull.get("name") for hull in link.findall("collision_checking/convex")}
        for index, element in enumerate(link.findall(kind)):
            geometry = element.find("geometry")
            if geometry is not None and (mesh := geometry.find("mesh")) is not None:
                convex = convex_hulls or (kind == "collision" and element.get("name") in hulls)
                meshes[f"{link.get('name')}_{index}"] = (mesh, convex)
                # Pinocchio places a sphere where the mesh comes.
                geometry.remove(mesh)
                ElementTree.SubElement(geometry, "sphere", radius="1")
        for checking in link.findall("collision_checking"):
            for hull in checking.findall("convex"):
                checking.remove(hull)
    text = ElementTree.tostring(root, encoding="unicode")
    of_kind = pin.GeometryType.COLLISION if kind == "collision" else pin.GeometryType.VISUAL
    with parsing(urdf):
        geometry_model = pin.GeometryModel()  # else Pinocchio 4.1 leaves an object of Python behind
        pin.buildGeomFromUrdfString(model, text, of_kind, geometry_model)
    shapes: list[Shape] = []
    for geometry_object in geometry_model.geometryObjects:
        if geometry_object.name in meshes:
            read = _mesh(urdf, *meshes[geometry_object.name], package_dirs)
            geometry_object.geometry = coal_mesh(read)
            geometry_object.meshPath = read.path
            shapes.append(read)
        else:
            shapes.append(_primitive(geometry_object))
    return Geometry(geometry_model, tuple(shapes))


def _mesh(
    urdf: Path, element: ElementTree.Element, convex: bool, package_dirs: Sequence[str]
) -> Mesh:
    from gym_mara.robot.description.meshes.reader import (
        read_mesh,
    )  # most robots here have no meshes

    x, y, z = map(float, element.get("scale", "1 1 1").split())
    path = mesh_file(urdf, element.get("filename", ""), package_dirs)
    return read_mesh(path, (x, y, z), convex=convex)


@lru_cache(maxsize=_KEPT)
def coal_mesh(mesh: Mesh) -> coal.CollisionGeometry:
    """Coal's form of a mesh; robots with the same mesh share it."""
    triangles = coal.BVHModelOBBRSS()
    vertices = mesh.vertices
    if not np.ptp(vertices, axis=0).all():
        # Pinocchio's broad phase skips shapes whose bounding box has no volume. No triangle has this vertex.
        vertices = np.vstack([vertices, vertices.min(axis=0) - _THIN])
    triangles.beginModel(len(mesh.faces), len(vertices))
    triangles.addVertices(vertices)
    triangles.addTriangles(mesh.faces)
    triangles.endModel()
    if mesh.convex:
        triangles.buildConvexHull(True, "Qt")
        return triangles.convex
    return triangles


def _primitive(geometry_object: pin.GeometryObject) -> Shape:
    geometry = geometry_object.geometry
    if isinstance(geometry, coal.Box):
        return Box(2.0 * geometry.halfSide)
    if isinstance(geometry, coal.Sphere):
        return Sphere(geometry.radius)
    if isinstance(geometry, coal.Cylinder):
        return Cylinder(geometry.radius, 2.0 * geometry.halfLength)
    if isinstance(geometry, coal.Capsule):
        return Capsule(geometry.radius, 2.0 * geometry.halfLength)
    raise GymMaraError(
        f"{geometry_object.name!r} has the shape {type(geometry).__name__}; "
        "supported are boxes, spheres, cylinders, capsules and meshes"
    )
