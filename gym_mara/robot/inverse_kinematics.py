"""Which poses an arm can reach: how far off a pose is, and one that is certainly within reach."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from gym_mara.collision import make_checker
from gym_mara.collision.coal import CoalChecker
from gym_mara.errors import GymMaraError
from gym_mara.robot.model import RobotModel

Floats = NDArray[np.float64]
_TRIES = 10_000


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


class FreePoses:
    """Draws end-effector poses that the arm has at collision-free configurations.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._checker = CoalChecker(robot)
        self._kinematics = robot.kinematics()
        self._low = np.maximum(robot.lower, -np.pi)
        self._high = np.minimum(robot.upper, np.pi)

    def draw(self, generator: np.random.Generator) -> tuple[Floats, Floats]:
        """Position (3,), m, and quaternion (4,), [w, x, y, z], at a configuration drawn evenly from all that are free.

        Raises:
            GymMaraError: nearly every configuration of the robot collides.
        """
        for _ in range(_TRIES):
            q = generator.uniform(self._low, self._high)[None]
            if not self._checker.check(q)[0]:
                position, quaternion = self._kinematics.pose(q)
                return position[0], quaternion[0]
        raise GymMaraError(
            f"{self._robot.name} collides at {_TRIES} random configurations of as many"
        )


def reachable_pose(robot: RobotModel) -> tuple[Floats, Floats]:
    """The end-effector pose, position (3,) m and quaternion (4,), of a collision-free configuration.

    Always the same for a robot: the first of a fixed sequence, in the middle of the joints' ranges, that moves the
    tool away from home.
    """
    checker = make_checker("coal", robot)
    kinematics = robot.kinematics()
    low, high = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    rng = np.random.default_rng(0)
    candidates = rng.uniform(0.75 * low + 0.25 * high, 0.25 * low + 0.75 * high, (256, len(low)))
    candidates = np.vstack([candidates, robot.home])  # where all else collides
    position, quaternion = kinematics.pose(candidates)
    away = np.linalg.norm(position - position[-1], axis=1)
    good = ~checker.check(candidates) & (away > 0.25 * away.max())
    chosen = int(good.argmax()) if good.any() else len(candidates) - 1
    return position[chosen], quaternion[chosen]
