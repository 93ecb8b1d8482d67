"""Findings about the collisions of an arm: what can never be found, and what is found in most poses."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

from gym_mara.robot.collision_pairs import AT_HOME, Pair, touching_pairs
from gym_mara.robot.diagnosis.finding import Finding, listed
from gym_mara.robot.diagnosis.sampling import ALWAYS, moving_links, often_touching, shares

if TYPE_CHECKING:
    from gym_mara.robot.model import RobotModel

_SHOWN = 4
"""The number of pairs that a finding lists; `gym-mara robot --json` lists all."""


def collision_findings(robot: RobotModel) -> list[Finding]:
    """The findings about the shapes of an arm and its pairs of links."""
    return [*_nothing_to_check(robot), *_touching(robot)]


def _nothing_to_check(robot: RobotModel) -> Iterator[Finding]:
    effect = "no collision is ever found"
    if not robot.shapes:
        message = "no link has a collision shape"
    elif not moving_links(robot):
        message = "no link that moves has a collision shape"
    elif not robot.collision_pairs:
        yield Finding(
            "note",
            "robot",
            "no pair of links is checked for collision",
            effect,
            "Enable pairs in the SRDF, unless no links can touch",
        )
        return
    else:
        return
    yield Finding(
        "warning",
        "robot",
        message,
        effect,
        "Add <collision> to the links that can touch something",
    )


def _touching(robot: RobotModel) -> Iterator[Finding]:
    at_home = frozenset(pair for pair, why in robot.excluded_pairs.items() if why == AT_HOME)
    share = shares(robot, at_home) if at_home else {}
    always = {pair for pair in at_home if share[pair] >= ALWAYS}
    never_checked = "these pairs are never checked for collision"
    if always:
        yield Finding(
            "note",
            f"links {pair_names(always)}",
            "they touch in the start pose and in almost all others",
            never_checked,
            "Nothing is to do, unless they should not touch",
        )
    if sometimes := at_home - always:
        yield Finding(
            "warning",
            f"links {pair_names(sometimes)}",
            "they touch in the start pose, but not in all poses",
            never_checked,
            _remedy(robot),
        )
    often = often_touching(robot)
    if colliding := touching_pairs(robot.model, robot.geometry, robot.home) - often.keys():
        yield Finding(
            "warning",
            f"links {pair_names(colliding)}",
            "they touch in the start pose, and are checked for collision",
            "every episode begins in a collision",
            f"Put another pose first in the SRDF. {_remedy(robot)}",
        )
    if often:
        lowest, highest = (f"{100 * of(often.values()):.0f} %" for of in (min, max))
        span = lowest if lowest == highest else f"{lowest} to {highest}"
        yield Finding(
            "warning",
            f"links {pair_names(sorted(often, key=lambda pair: -often[pair]))}",
            f"they touch in {span} of random poses",
            "most poses of the arm count as collisions",
            _remedy(robot),
        )


def _remedy(robot: RobotModel) -> str:
    new = "new.srdf" if robot.srdf else f"{robot.urdf.stem}.srdf"
    return (
        "Correct the shapes, or write an SRDF: "
        f"gym-mara robot {robot.urdf.name} --ee-frame {robot.ee_frame} --write-srdf {new}"
    )


def pair_names(pairs: Collection[Pair]) -> str:
    """Pairs of links for a message: in alphabetical order, unless they are in a list."""
    names = [" and ".join(sorted(pair)) for pair in pairs]
    return listed(names if isinstance(pairs, list) else sorted(names), _SHOWN)
