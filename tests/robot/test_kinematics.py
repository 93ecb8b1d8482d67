"""Forward kinematics in NumPy: golden values, and Pinocchio as referee on every robot."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import torch

from gym_mara.robot import RobotModel
from gym_mara.robot.catalog import robot_names
from gym_mara.robot.kinematics import Kinematics
from gym_mara.testing import COPIES, uniform_q
from tests.helpers import Floats, golden, golden_q, joint_xml, robot_model, urdf_xml, write


def _assert_agrees_with_pinocchio(robot: RobotModel, count: int) -> None:
    q = uniform_q(robot, count, 0)
    qd = np.random.default_rng(1).normal(size=q.shape)
    kinematics = robot.kinematics()
    position, quaternion = kinematics.pose(q)
    velocity = kinematics.velocity(q, qd)
    assert position.shape == velocity.shape == (count, 3)
    assert quaternion.shape == (count, 4)
    data = robot.model.createData()
    frame = robot.model.getFrameId(robot.ee_frame, pin.FrameType.BODY)
    for row in range(count):
        pin.forwardKinematics(robot.model, data, q[row], qd[row])
        pose = pin.updateFramePlacement(robot.model, data, frame)
        motion = pin.getFrameVelocity(robot.model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        w, x, y, z = quaternion[row]
        np.testing.assert_allclose(position[row], pose.translation, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(
            pin.Quaternion(w, x, y, z).matrix(), pose.rotation, rtol=0.0, atol=1e-12
        )
        np.testing.assert_allclose(velocity[row], motion.linear, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, rtol=0.0, atol=1e-12)
    assert (quaternion[:, 0] >= 0.0).all()


def test_mara_stands_where_the_published_figures_put_it(mara: RobotModel) -> None:
    expected = golden("kinematics_golden.csv")
    position, quaternion = mara.kinematics().pose(golden_q())
    np.testing.assert_allclose(
        position, np.stack([expected[f"ee_{axis}"] for axis in "xyz"], axis=-1), rtol=0, atol=1e-7
    )
    wanted = np.stack([expected[f"ee_q{axis}"] for axis in "wxyz"], axis=-1)
    wanted *= np.where(wanted[:, :1] < 0.0, -1.0, 1.0)
    np.testing.assert_allclose(quaternion, wanted, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", robot_names())
def test_pose_and_velocity_are_pinocchios(name: str) -> None:
    for count in (1, 50):
        _assert_agrees_with_pinocchio(robot_model(name), count)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_pose_and_velocity_are_pinocchios_with_sliding_and_slanting_joints(
    tmp_path: Path, count: int
) -> None:
    kinds = [
        joint_xml(0, "prismatic", "0 1 0"),
        joint_xml(1, "revolute", "1 2 -0.5"),
        joint_xml(2, "continuous", "0 -1 0"),
        joint_xml(3, "prismatic", "1 0 1"),
        joint_xml(4, "revolute", "0 0 -1"),
    ]
    urdf = write(tmp_path / "stick.urdf", urdf_xml(*kinds[:count]))
    robot = RobotModel.load(urdf, f"link{count}")
    assert robot.num_joints == count
    for batch in (1, 20):
        _assert_agrees_with_pinocchio(robot, batch)


def test_velocity_is_the_change_of_position(mara: RobotModel) -> None:
    kinematics = mara.kinematics()
    q, qd = uniform_q(mara, 20, 2), uniform_q(mara, 20, 3)
    ahead, behind = kinematics.pose(q + 1e-6 * qd)[0], kinematics.pose(q - 1e-6 * qd)[0]
    np.testing.assert_allclose(kinematics.velocity(q, qd), (ahead - behind) / 2e-6, atol=1e-7)


# The engine of the computation changes between few and many configurations.
@pytest.mark.parametrize("count", [2, 3, 7, 8, 40, 300])
def test_a_row_does_not_depend_on_its_batch(mara: RobotModel, count: int) -> None:
    q, qd = uniform_q(mara, count, 5), uniform_q(mara, count, 6)
    kinematics = mara.kinematics()
    position, quaternion = kinematics.pose(q)
    velocity = kinematics.velocity(q, qd)
    for row in range(count):
        one = slice(row, row + 1)
        alone = kinematics.pose(q[one])
        np.testing.assert_allclose(position[one], alone[0], rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(quaternion[one], alone[1], rtol=0.0, atol=1e-12)
        alone_velocity = kinematics.velocity(q[one], qd[one])
        np.testing.assert_allclose(velocity[one], alone_velocity, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("count", [1, 4, 40])
def test_results_are_never_changed_by_later_calls(mara: RobotModel, count: int) -> None:
    kinematics = mara.kinematics()

    def results(seed: int) -> list[Floats]:
        q = uniform_q(mara, count, seed)
        return [*kinematics.pose(q), kinematics.velocity(q, q)]

    first = results(7)
    kept = copy.deepcopy(first)
    results(8)
    for array, copied in zip(first, kept, strict=True):
        np.testing.assert_array_equal(array, copied)


def test_many_batch_sizes_in_turn_give_what_a_fresh_instance_gives(mara: RobotModel) -> None:
    used = mara.kinematics()
    for count in [*range(1, 15), 3, 1, 200, 2]:
        q = uniform_q(mara, count, count)
        for mine, fresh in zip(used.pose(q), mara.kinematics().pose(q), strict=True):
            np.testing.assert_array_equal(mine, fresh)


@pytest.mark.parametrize("duplicate", COPIES)
def test_a_copy_computes_the_same(
    mara: RobotModel, duplicate: Callable[[Kinematics], Kinematics]
) -> None:
    kinematics = mara.kinematics()
    other = duplicate(kinematics)
    q = uniform_q(mara, 3, 9)
    np.testing.assert_array_equal(other.pose(q)[0], kinematics.pose(q)[0])


@pytest.mark.parametrize("name", ["mara", "panda", "rail"])
def test_points_are_where_pinocchio_places_them(name: str, tmp_path: Path) -> None:
    if name == "rail":
        joints = joint_xml(0, kind="prismatic"), *(joint_xml(number) for number in range(1, 4))
        robot = RobotModel.load(write(tmp_path / "rail.urdf", urdf_xml(*joints)), "link4")
    else:
        robot = robot_model(name)
    rng = np.random.default_rng(0)
    q = uniform_q(robot, 40, seed=0)
    bodies = sorted(rng.integers(robot.num_joints, size=6).tolist(), reverse=True)
    points = rng.normal(size=(6, 3))
    placed = robot.kinematics().points(q, bodies, points)
    assert placed.shape == (6, 40, 3)
    data = robot.model.createData()
    for row, configuration in enumerate(q):
        pin.forwardKinematics(robot.model, data, configuration)
        expected = [data.oMi[b + 1].act(p) for b, p in zip(bodies, points, strict=True)]
        np.testing.assert_allclose(placed[:, row], expected, rtol=0.0, atol=1e-12)


def _assert_frames_are_pinocchios(robot: RobotModel, count: int) -> None:
    q = uniform_q(robot, count, 0)
    kinematics = robot.kinematics()
    frames = kinematics.joint_frames(q)
    data, chain = robot.model.createData(), range(1, 1 + robot.num_joints)
    for row, configuration in enumerate(q):
        expected = pin.computeFrameJacobian(
            robot.model, data, configuration, robot.ee_frame_id, pin.LOCAL_WORLD_ALIGNED
        )[:, : robot.num_joints]
        np.testing.assert_allclose(frames.jacobian[row], expected, rtol=0.0, atol=1e-12)
        pose = pin.updateFramePlacement(robot.model, data, robot.ee_frame_id)
        np.testing.assert_allclose(frames.position[row], pose.translation, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(frames.rotation[row], pose.rotation, rtol=0.0, atol=1e-12)
        for joint, slides in zip(chain, kinematics.prismatic, strict=True):
            world, moves = data.oMi[joint], robot.motion(joint)
            axis = world.rotation @ (moves[:3] if slides else moves[3:])
            np.testing.assert_allclose(frames.axes[row, joint - 1], axis, rtol=0.0, atol=1e-12)
            away = world.translation - frames.origins[row, joint - 1]
            # A joint that slides has moved its own frame along its axis.
            away = away - (away @ axis) * axis if slides else away
            np.testing.assert_allclose(away, 0.0, atol=1e-12)
    tensor_q: Any = torch.tensor(q)
    tensors: Any = kinematics.joint_frames(tensor_q)
    for tensor, array in zip(tensors, frames, strict=True):
        np.testing.assert_allclose(tensor.numpy(), array, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["mara", "ur5", "panda"])
def test_joint_frames_and_jacobian_are_pinocchios(name: str) -> None:
    for count in (1, 50):
        _assert_frames_are_pinocchios(robot_model(name), count)


def test_joint_frames_of_sliding_and_slanting_joints_are_pinocchios(tmp_path: Path) -> None:
    kinds = [
        joint_xml(0, "prismatic", "0 1 0"),
        joint_xml(1, "revolute", "1 2 -0.5"),
        joint_xml(2, "continuous", "0 0 -1"),
        joint_xml(3, "prismatic", "1 0 1"),
        joint_xml(4, "revolute", "0 0 1"),
    ]
    robot = RobotModel.load(write(tmp_path / "stick.urdf", urdf_xml(*kinds)), "link5")
    for batch in (1, 20):
        _assert_frames_are_pinocchios(robot, batch)
