"""DART's collision shapes: each detector sees the shapes of the URDF, or refuses them."""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gym_mara.backends.dart.arm import DartArm
from gym_mara.backends.dart.shapes import DETECTORS
from gym_mara.collision import make_checker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from tests.helpers import Floats, Mask
from tests.shape_pairs import CONTACT, PRIMITIVES, held, wrong

PAIRS = list(itertools.combinations_with_replacement(PRIMITIVES, 2))
BULLET = 0.01
"""Bullet misses overlaps of up to 8 mm between a box and a cylinder."""


def _touches(arm: DartArm, q: Floats) -> Mask:
    flags = []
    for row in q:
        arm.reset(row)
        flags.append(bool(arm.contacts()))
    return np.array(flags)


def _mesh_pair(folder: Path, **options: bool) -> RobotModel:
    trimesh.creation.torus(0.2, 0.05, major_sections=96, minor_sections=48).export(
        folder / "torus.stl"
    )
    mesh = f'<mesh filename="{folder}/torus.stl"/>'
    return held(folder, mesh, mesh, **options)


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize(("one", "other"), PAIRS, ids=map("-".join, PAIRS))
def test_primitives_touch_where_coal_says(
    tmp_path: Path, detector: str, one: str, other: str
) -> None:
    robot = held(tmp_path, PRIMITIVES[one], PRIMITIVES[other])
    arm = DartArm(robot, detector=detector)
    contact = BULLET if detector == "bullet" else CONTACT
    assert (
        wrong(robot, make_checker("coal", robot).check, lambda q: _touches(arm, q), 100, contact)
        == {}
    )


@pytest.mark.parametrize("detector", ["bullet", "ode"])
@pytest.mark.parametrize("convex_hulls", [False, True])
def test_a_detector_refuses_meshes_that_it_cannot_do(
    tmp_path: Path, detector: str, convex_hulls: bool
) -> None:
    robot = _mesh_pair(tmp_path, convex_hulls=convex_hulls)
    with pytest.raises(GymMaraError, match=r"link 'fixed'.*use one of 'fcl', 'dart'"):
        DartArm(robot, detector=detector)


@pytest.mark.parametrize("detector", ["fcl", "dart"])
def test_meshes_are_kept_between_looks_and_shared_by_arms(tmp_path: Path, detector: str) -> None:
    robot = _mesh_pair(tmp_path)
    start = time.process_time()
    arm = DartArm(robot, detector=detector)
    built = time.process_time()
    other = DartArm(robot, detector=detector, like=arm)
    looks = 5
    for one in (arm, other) * looks:
        one.contacts()
    assert (time.process_time() - built) / (2 * looks) < 0.2 * (built - start)


def test_what_was_looked_at_before_changes_no_bit(tmp_path: Path) -> None:
    """The fresh arm and the old one find the same contacts, and move alike."""
    robot = _mesh_pair(tmp_path)
    start, velocities = np.array([0.35, 0.0, 0.0, 0.0, 0.0, 0.0]), np.full((40, 6), -1.0)
    ends = []
    old = DartArm(robot)
    for looks in (0, 3):
        for _ in range(looks):
            old.reset(np.full(6, 0.1))
            old.contacts()
        old.reset(start)
        contacts = old.run(velocities)
        ends.append((old.q.tobytes(), contacts))
    fresh = DartArm(robot, like=old)
    fresh.reset(start)
    contacts = fresh.run(velocities)
    assert contacts
    assert ends == [(fresh.q.tobytes(), contacts)] * 2
