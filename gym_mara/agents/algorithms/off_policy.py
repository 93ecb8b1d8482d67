"""SAC and TQC as in Stable-Baselines3 and sb3-contrib, except for how a run that starts with a trained policy begins."""

from __future__ import annotations

from typing import Any

import sb3_contrib
import stable_baselines3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


class WarmUp(OffPolicyAlgorithm):
    """An off-policy algorithm that first fills its replay buffer with random actions, or with those of its policy."""

    policy_is_trained = False
    """Whether the policy acts from the first step on, because another run has trained it."""

    def _sample_action(self, learning_starts: int, *args: Any, **kwargs: Any) -> Any:
        starts = 0 if self.policy_is_trained else learning_starts
        return super()._sample_action(starts, *args, **kwargs)


class SAC(WarmUp, stable_baselines3.SAC):
    """SAC with this warm-up."""


class TQC(WarmUp, sb3_contrib.TQC):  # type: ignore[misc]
    """TQC with this warm-up."""
