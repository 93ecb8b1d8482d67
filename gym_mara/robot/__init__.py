"""The robot: what the arm is, where its links are at a configuration, and whether they collide there."""

from gym_mara.robot.model import RobotLike, RobotModel

__all__ = ["RobotLike", "RobotModel"]
