"""The environments: one arm or a batch of arms, and the same with goals for hindsight replay."""

from gym_mara.envs.goal import MaraGoalEnv, MaraGoalVectorEnv
from gym_mara.envs.single import MaraEnv
from gym_mara.envs.vector import MaraVectorEnv

__all__ = ["MaraEnv", "MaraGoalEnv", "MaraGoalVectorEnv", "MaraVectorEnv"]
