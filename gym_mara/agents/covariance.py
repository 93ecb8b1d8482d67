"""A Gaussian policy whose joints explore together: a full covariance where Stable-Baselines3's has a diagonal.

Many joint configurations put the tool in one place. Moving along them, to better the orientation, takes several joints
at once; noise that is drawn for each joint apart leaves them at the first step, and drowns what is to be learnt there.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule


class FullCovarianceGaussian(DiagGaussianDistribution):
    """A Gaussian given by the factor P of its precision, PᵀP, a lower triangular matrix with a positive diagonal."""

    mean: torch.Tensor
    factor: torch.Tensor

    def of(self, mean: torch.Tensor, log_std: torch.Tensor, mixing: torch.Tensor) -> Distribution:
        """The Gaussian of means (B, A) with P = (I + the strict lower triangle of mixing (A, A)) / std."""
        identity = torch.eye(len(log_std))
        self.mean = mean
        self.log_std = log_std
        self.factor = (identity + torch.tril(mixing, -1)) * torch.exp(-log_std)
        return self

    def log_prob(self, actions: torch.Tensor) -> torch.Tensor:
        """The logarithm of the density at actions (B, A): (B,)."""
        white = (actions - self.mean) @ self.factor.T
        normalisation = self.log_std.sum() + 0.5 * len(self.log_std) * math.log(2.0 * math.pi)
        return -0.5 * (white * white).sum(dim=1) - normalisation

    def entropy(self) -> torch.Tensor:
        """The entropy (B,), the same for every mean."""
        one = self.log_std.sum() + 0.5 * len(self.log_std) * (1.0 + math.log(2.0 * math.pi))
        return one.expand(len(self.mean))

    def sample(self) -> torch.Tensor:
        """An action for every mean (B, A)."""
        white = torch.randn_like(self.mean)
        return self.mean + torch.linalg.solve_triangular(self.factor, white.T, upper=False).T

    def mode(self) -> torch.Tensor:
        """The means (B, A)."""
        return self.mean


class FullCovariancePolicy(ActorCriticPolicy):
    """Stable-Baselines3's actor and critic with a full covariance, the same in every state, which is learnt."""

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        size = len(self.log_std)
        self.mixing = torch.nn.Parameter(torch.zeros(size, size))
        self.action_dist = FullCovarianceGaussian(size)
        # Anew, for the parameter to be among those that it moves.
        arguments: dict[str, Any] = self.optimizer_kwargs
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **arguments)

    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Distribution:
        assert isinstance(self.action_dist, FullCovarianceGaussian)
        return self.action_dist.of(self.action_net(latent_pi), self.log_std, self.mixing)
