"""The robot: its model, forward and inverse kinematics, shapes and collision pairs."""

from gym_mara.robot.model import RobotLike, RobotModel
from gym_mara.robot.options import RobotOptions

__all__ = ["RobotLike", "RobotModel", "RobotOptions"]
