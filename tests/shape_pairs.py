"""Robots that hold one shape against another, and Coal's distance between them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from gym_mara.robot import RobotModel
from gym_mara.testing import uniform_q
from tests.helpers import Floats, Mask, write

PRIMITIVES = {
    "box": '<box size="0.2 0.15 0.4"/>',
    "sphere": '<sphere radius="0.1"/>',
    "cylinder": '<cylinder radius="0.1" length="0.4"/>',
    "capsule": '<capsule radius="0.08" length="0.3"/>',
}
CONTACT = 1e-3
"""Nearer to contact than this, m, engines may differ."""


def held(folder: Path, one: str, other: str, **options: Any) -> RobotModel:
    """A fixed shape, and another that slides around it along three axes and turns about three; both are XML of a URDF."""
    joints = [("prismatic", axis, 0.35) for axis in ("1 0 0", "0 1 0", "0 0 1")]
    joints += [("revolute", axis, 3.0) for axis in ("1 0 0", "0 1 0", "0 0 1")]
    text = f'<link name="fixed"><collision><geometry>{one}</geometry></collision></link>'
    parent = "fixed"
    for number, (kind, axis, limit) in enumerate(joints):
        child = "held" if number == 5 else f"link{number}"
        shape = f"<collision><geometry>{other}</geometry></collision>" if child == "held" else ""
        text += (
            f'<joint name="j{number}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<axis xyz="{axis}"/><limit lower="{-limit}" upper="{limit}" effort="99" velocity="1"/></joint>'
            f'<link name="{child}"><inertial><mass value="1"/>'
            f'<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>{shape}</link>'
        )
        parent = child
    # The SRDF keeps the pair, which touches at home.
    srdf = '<robot name="pair"><disable_collisions link1="fixed" link2="link0"/></robot>'
    write(folder / "pair.srdf", srdf)
    path = write(folder / "pair.urdf", f'<robot name="pair" version="1.2">{text}</robot>')
    return RobotModel.inspect(
        path, "held", **options
    )  # which touches in many poses, and does not warn of it


def clearance(robot: RobotModel, q: Floats) -> float:
    """The smallest distance of any pair, m, by Coal; negative where they overlap."""
    data = robot.geometry.createData()
    pin.computeDistances(robot.model, robot.model.createData(), robot.geometry, data, q)
    return min(float(result.min_distance) for result in data.distanceResults)


def wrong(
    robot: RobotModel,
    exact: Callable[[Floats], Mask],
    other: Callable[[Floats], Mask],
    count: int,
    contact: float = CONTACT,
) -> dict[int, float]:
    """The random configurations at which two engines differ beyond contact, with Coal's distance, m."""
    q = uniform_q(robot, count, seed=0)
    expected, found = exact(q), other(q)
    assert expected.any()
    assert not expected.all()
    apart = {int(row): clearance(robot, q[row]) for row in np.flatnonzero(expected != found)}
    return {row: distance for row, distance in apart.items() if abs(distance) > contact}
