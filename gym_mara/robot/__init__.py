"""The robot: what the arm is, where its links are at a configuration, and whether they collide there."""

from gym_mara.robot.model import RobotModel

__all__ = ["RobotModel"]
