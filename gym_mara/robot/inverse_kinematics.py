"""Inverse kinematics: the configuration at which the end effector comes closest to a pose."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from gym_mara.robot.model import RobotModel
from gym_mara.types import Floats


def solve_ik(robot: RobotModel, position: Floats, quaternion: Floats | None) -> Floats:
    """The configuration (J,), rad, within the limits, that comes closest to a pose; collisions do not count.

    Levenberg and Marquardt's method, projected onto the limits, from the home pose and fixed random configurations.

    Args:
        robot: the arm.
        position: of the end-effector frame in the world (3,), m.
        quaternion: its orientation [w, x, y, z]; None where any will do.
    """
    w, x, y, z = (1.0, 0.0, 0.0, 0.0) if quaternion is None else quaternion
    target = pin.SE3(pin.Quaternion(w, x, y, z).normalized().matrix(), np.asarray(position))
    rng = np.random.default_rng(0)
    low, high = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    data = robot.model.createData()
    rows = slice(0, 3 if quaternion is None else 6)

    def error(q: Floats) -> Floats:
        pin.forwardKinematics(robot.model, data, q)
        here = pin.updateFramePlacement(robot.model, data, robot.ee_frame_id)
        turn = pin.log3(target.rotation @ here.rotation.T)
        return np.concatenate([target.translation - here.translation, turn])[rows]

    def step(q: Floats, off: Floats, damping: float) -> Floats:
        jacobian = pin.computeFrameJacobian(
            robot.model, data, q, robot.ee_frame_id, pin.LOCAL_WORLD_ALIGNED
        )[rows]
        normal = jacobian.T @ jacobian + damping * np.eye(robot.num_joints)
        return np.clip(q + np.linalg.solve(normal, jacobian.T @ off), robot.lower, robot.upper)

    best, best_error = robot.home.copy(), np.inf
    for start in [robot.home, *rng.uniform(low, high, (20, robot.num_joints))]:
        q, damping = np.array(start), 1e-2
        off = error(q)
        for _ in range(60):
            candidate = step(q, off, damping)
            there = error(candidate)
            if there @ there < off @ off:
                q, off, damping = candidate, there, max(damping / 4.0, 1e-12)
            else:
                damping *= 8.0
        if np.linalg.norm(off) < best_error:
            best, best_error = q, float(np.linalg.norm(off))
        if best_error < 1e-9:
            break
    return best


def miss(robot: RobotModel, position: Floats, quaternion: Floats | None) -> tuple[float, float]:
    """How near the arm can come to a pose: the distance, m, and the angle, rad (0 where any orientation will do)."""
    q = solve_ik(robot, position, quaternion)
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    here = pin.updateFramePlacement(robot.model, data, robot.ee_frame_id)
    distance = float(np.linalg.norm(here.translation - position))
    if quaternion is None:
        return distance, 0.0
    w, x, y, z = quaternion
    turn = pin.Quaternion(w, x, y, z).normalized().matrix() @ here.rotation.T
    return distance, float(np.linalg.norm(pin.log3(turn)))
