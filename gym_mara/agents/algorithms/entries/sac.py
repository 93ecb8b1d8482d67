"""SAC."""

from gym_mara.agents.algorithms.base import Algorithm
from gym_mara.agents.algorithms.entries.off_policy import SEARCH_SPACE, tuned

ALGORITHM = Algorithm(
    name="sac",
    summary="soft actor-critic, from Stable-Baselines3",
    target="gym_mara.agents.algorithms.off_policy:SAC",
    presets={"tuned": tuned("sac")},
    search_space=SEARCH_SPACE,
)
