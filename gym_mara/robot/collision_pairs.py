"""Which links of an arm may collide: all pairs, except neighbours, those that the SRDF disables and those that touch at home."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from typing import NamedTuple

import pinocchio as pin

from gym_mara.robot.description.srdf import Semantics
from gym_mara.types import Floats

Pair = frozenset[str]
"""The names of two links."""

DISABLED, NEIGHBOURS, AT_HOME = "disabled by the SRDF", "joined by a joint", "touch at home"
"""Why a pair of links is never checked."""


class Pairs(NamedTuple):
    """The pairs of links on different bodies."""

    checked: frozenset[Pair]
    """Those that may collide."""
    excluded: dict[Pair, str]
    """Those that are never checked, and why."""


def set_collision_pairs(
    root: ElementTree.Element,
    semantics: Semantics,
    model: pin.Model,
    geometry: pin.GeometryModel,
    home: Floats,
) -> Pairs:
    """Set the collision pairs of a geometry.

    Links joined by one joint never collide. Links that touch at home do not collide either, unless an SRDF disables pairs
    of this robot.

    Args:
        root: the URDF.
        semantics: the SRDF.
        model: Pinocchio's model.
        geometry: its collision geometry.
        home: the start pose (J,), rad.
    """
    geometry.addAllCollisionPairs()  # all but the pairs of shapes on the same joint
    neighbours, excluded = joined(root), {}
    for pair in linked(model, geometry):
        if semantics.disables(pair):
            excluded[pair] = DISABLED
        elif pair in neighbours:
            excluded[pair] = NEIGHBOURS
    keep_pairs(model, geometry, set(linked(model, geometry)) - excluded.keys())
    if not semantics.disables_any(root):
        touching = touching_pairs(model, geometry, home)
        excluded |= dict.fromkeys(touching, AT_HOME)
        keep_pairs(model, geometry, set(linked(model, geometry)) - touching)
    return Pairs(frozenset(linked(model, geometry)), excluded)


def joined(root: ElementTree.Element) -> set[Pair]:
    """The pairs of links of a URDF that one joint joins."""
    ends = ((joint.find("parent"), joint.find("child")) for joint in root.findall("joint"))
    return {frozenset(e.get("link", "") for e in pair if e is not None) for pair in ends}


def linked(model: pin.Model, geometry: pin.GeometryModel) -> list[Pair]:
    """The links of each collision pair of a geometry."""
    links = [link_of(model, each) for each in geometry.geometryObjects]
    return [frozenset((links[pair.first], links[pair.second])) for pair in geometry.collisionPairs]


def keep_pairs(model: pin.Model, geometry: pin.GeometryModel, wanted: Iterable[Pair]) -> None:
    """Remove the collision pairs of a geometry that are not of these links."""
    wanted, of_links = frozenset(wanted), linked(model, geometry)
    shapes = [(pair.first, pair.second) for pair in geometry.collisionPairs]
    geometry.removeAllCollisionPairs()
    for pair, ends in zip(of_links, shapes, strict=True):
        if pair in wanted:
            geometry.addCollisionPair(pin.CollisionPair(*ends))


def touching_pairs(model: pin.Model, geometry: pin.GeometryModel, q: Floats) -> set[Pair]:
    """The links of a geometry's collision pairs that touch at a configuration q (J,), rad."""
    data = geometry.createData()
    if len(geometry.collisionPairs):
        pin.computeCollisions(model, model.createData(), geometry, data, q, False)
    checked = zip(linked(model, geometry), data.collisionResults, strict=True)
    return {pair for pair, result in checked if result.isCollision()}


def link_of(model: pin.Model, geometry_object: pin.GeometryObject) -> str:
    """The name of the link that a shape belongs to."""
    return str(model.frames[geometry_object.parentFrame].name)
