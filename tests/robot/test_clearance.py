"""Clearance: negative where an arm collides, and a repulsion that is the gradient of its potential."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from gym_mara.collision import make_checker
from gym_mara.robot import RobotModel
from gym_mara.robot.clearance import FAR, WIDTH, Clearance
from gym_mara.testing import pickled, uniform_q
from gym_mara.types import Floats
from tests.helpers import robot_model, upright_arm, write

ROBOTS = ("mara", "ur5", "panda")


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_clearance_tells_most_collisions_from_free_configurations(robot: str) -> None:
    arm = robot_model(robot)
    q = uniform_q(arm, 1000, seed=0)
    bodies, _ = Clearance(arm)(arm.kinematics().joint_frames(q))
    distance = bodies.min(axis=1)
    collided = make_checker("coal", arm).check(q)
    assert (distance <= FAR).all()
    # The spheres of MARA, made of cylinders and boxes, follow it more closely than those of meshes.
    found, wrong = {"mara": (0.93, 0.01), "ur5": (0.95, 0.08), "panda": (0.93, 0.12)}[robot]
    assert (distance[collided] < 0.0).mean() > found
    assert (distance[~collided] < 0.0).mean() < wrong


def test_two_bodies_that_are_nearest_have_the_same_distance_and_others_a_larger_one() -> None:
    arm = robot_model("mara")
    distance, _ = Clearance(arm)(arm.kinematics().joint_frames(uniform_q(arm, 300, seed=4)))
    assert distance.shape == (300, 6)
    ascending = np.sort(distance, axis=1)
    against_a_fixed_shape = ascending[:, 1] > ascending[:, 0]
    assert 0.05 < against_a_fixed_shape.mean() < 0.95
    assert (ascending[:, -1] > ascending[:, 1]).mean() > 0.9


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_repulsion_is_the_gradient_of_the_potential(robot: str) -> None:
    arm = robot_model(robot)
    clearance, kinematics = Clearance(arm), arm.kinematics()
    q, step = uniform_q(arm, 40, seed=1), 1e-6

    def potential(q: Floats) -> Floats:
        centres = clearance._placed(kinematics.joint_frames(q))
        groups = clearance._groups(np, centres)
        return sum(WIDTH * np.exp(-distance / WIDTH).sum(axis=0) for *_, distance in groups)  # type: ignore[return-value]

    _, repulsion = clearance(kinematics.joint_frames(q))
    for joint in range(arm.num_joints):
        shift = step * np.eye(arm.num_joints)[joint]
        slope = (potential(q + shift) - potential(q - shift)) / (2 * step)
        np.testing.assert_allclose(repulsion[:, joint], -slope, rtol=1e-4, atol=1e-6)


def test_a_copy_gives_the_same_numbers() -> None:
    arm = robot_model("ur5")
    frames = arm.kinematics().joint_frames(uniform_q(arm, 5, seed=2))
    clearance = Clearance(arm)
    for one, other in zip(clearance(frames), pickled(clearance)(frames), strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_arm_without_collision_shapes_is_far_from_everything(tmp_path: Path) -> None:
    text = re.sub("<collision>.*?</collision>", "", upright_arm(), flags=re.S)
    arm = RobotModel.inspect(write(tmp_path / "arm.urdf", text), "tool")
    distance, repulsion = Clearance(arm)(arm.kinematics().joint_frames(uniform_q(arm, 5, seed=0)))
    assert (distance == np.full((5, 3), FAR)).all()
    assert not repulsion.any()
