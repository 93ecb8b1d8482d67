"""The safety filter, which every command to an arm passes. It needs no ROS."""

from gym_mara.ros2.safety.filter import NO_EMERGENCY_STOP, Mode, SafetyFilter
from gym_mara.ros2.safety.motion import MotionLimits
from gym_mara.ros2.safety.watchdogs import Watchdogs

__all__ = ["NO_EMERGENCY_STOP", "Mode", "MotionLimits", "SafetyFilter", "Watchdogs"]
