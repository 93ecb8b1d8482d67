"""The environments: one arm, many arms in one batch, an arm with goals."""

from gym_mara.envs.goal import MaraGoalEnv
from gym_mara.envs.single import MaraEnv
from gym_mara.envs.vector import MaraVectorEnv

__all__ = ["MaraEnv", "MaraGoalEnv", "MaraVectorEnv"]
