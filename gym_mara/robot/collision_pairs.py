"""Which shapes of an arm may collide: all pairs, except those that the SRDF disables and those that always touch."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import pinocchio as pin

from gym_mara.robot.description.srdf import Semantics
from gym_mara.types import Floats


def set_collision_pairs(
    root: ElementTree.Element,
    semantics: Semantics,
    model: pin.Model,
    geometry: pin.GeometryModel,
    home: Floats,
) -> frozenset[frozenset[str]]:
    """Set the collision pairs of a geometry; return them as pairs of link names.

    Links joined by one joint never collide. Links that touch at home do not collide either, unless an SRDF disables pairs.

    Args:
        root: the URDF.
        semantics: the SRDF.
        model: Pinocchio's model.
        geometry: its collision geometry.
        home: the start pose (J,), rad.
    """

    def links(pair: pin.CollisionPair) -> frozenset[str]:
        ends = pair.first, pair.second
        return frozenset(link_of(model, geometry.geometryObjects[end]) for end in ends)

    def remove(unwanted: set[frozenset[str]]) -> None:
        kept = [(p.first, p.second) for p in geometry.collisionPairs if links(p) not in unwanted]
        geometry.removeAllCollisionPairs()
        for pair in kept:
            geometry.addCollisionPair(pin.CollisionPair(*pair))

    geometry.addAllCollisionPairs()  # all but the pairs of shapes on the same joint
    semantics.remove_disabled_pairs(model, geometry)
    joined = ((joint.find("parent"), joint.find("child")) for joint in root.findall("joint"))
    remove({frozenset(e.get("link", "") for e in ends if e is not None) for ends in joined})
    if not semantics.disabled_links and len(geometry.collisionPairs):
        data = geometry.createData()
        pin.computeCollisions(model, model.createData(), geometry, data, home, False)
        checked = zip(geometry.collisionPairs, data.collisionResults, strict=True)
        remove({links(pair) for pair, result in checked if result.isCollision()})
    return frozenset(map(links, geometry.collisionPairs))


def link_of(model: pin.Model, geometry_object: pin.GeometryObject) -> str:
    """The name of the link that a shape belongs to."""
    return str(model.frames[geometry_object.parentFrame].name)
