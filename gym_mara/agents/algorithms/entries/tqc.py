"""TQC."""

from gym_mara.agents.algorithms.base import Algorithm
from gym_mara.agents.algorithms.entries.off_policy import SEARCH_SPACE, tuned

ALGORITHM = Algorithm(
    name="tqc",
    summary="truncated quantile critics, from sb3-contrib",
    target="gym_mara.agents.algorithms.off_policy:TQC",
    presets={"tuned": tuned("tqc")},
    search_space=SEARCH_SPACE,
)
