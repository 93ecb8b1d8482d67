"""The environments: one arm, a batch of arms, and one arm with goals for hindsight replay."""

from gym_mara.envs.goal import MaraGoalEnv
from gym_mara.envs.single import MaraEnv
from gym_mara.envs.vector import MaraVectorEnv

__all__ = ["MaraEnv", "MaraGoalEnv", "MaraVectorEnv"]
