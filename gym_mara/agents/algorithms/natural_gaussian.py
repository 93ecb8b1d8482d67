"""A Gaussian policy with a full covariance, learnt in its own natural coordinates.

Near a target some directions of joint space move the tool and others only turn it: the reward tells a tenth of a
millimetre of the first, and hardly a degree of the second. Independent noise on each joint cannot be narrow in the
first and wide in the second; a full covariance can. But an optimiser such as Adam, which weighs joint against joint,
then loses what little it hears from the wide directions in the noise of the narrow ones. So everything is learnt
relative to the present distribution, where all directions look alike (natural coordinates; Glasmachers et al. 2010,
"Exponential natural evolution strategies").
"""

from __future__ import annotations

import math
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn
from torch.distributions import MultivariateNormal

from gym_mara.errors import GymMaraError

# Standard deviations stay above this: much below it actions, which are float32 of order 1, no longer tell them apart.
# ACKTR stops at ten times that. Tuned trainings come down to either, so that another value is another result.
LEAST_STD = 1e-6
# The widening makes none wider than this, five times an action's range. It is there against overflow: where the reward
# says nothing, as of the last joint without orientation, tuned trainings reach some four.
WIDEST_STD = 10.0


class NaturalGaussian(Distribution):
    """a = c + F e^S (m + ε), ε ~ N(0, 1): a Gaussian with mean c + F e^S m and covariance F e^2S Fᵀ.

    The mean m (N, A) and the symmetric S (A, A) are relative to the centre c (A,) and the factor F (A, A).
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]

    def proba_distribution_net(self, *args: Any, **kwargs: Any) -> nn.Module:
        raise NotImplementedError("the policy holds the parameters")

    def proba_distribution(
        self, mean: Tensor, log_scale: Tensor, centre: Tensor, factor: Tensor
    ) -> NaturalGaussian:
        self.mean, self.log_scale, self.centre, self.factor = mean, log_scale, centre, factor
        self.scale = factor @ torch.matrix_exp(log_scale)
        self.inverse_scale = torch.matrix_exp(-log_scale) @ torch.linalg.inv(factor)
        self.log_volume = torch.linalg.slogdet(factor).logabsdet + log_scale.trace()
        return self

    def log_prob(self, actions: Tensor) -> Tensor:
        noise = (actions - self.centre) @ self.inverse_scale.T - self.mean
        constant = 0.5 * noise.shape[1] * math.log(2.0 * math.pi)
        return -0.5 * noise.square().sum(dim=1) - self.log_volume - constant

    @property
    def distribution(self) -> MultivariateNormal:  # type: ignore[override]
        """The same as torch has it, of F⁻¹(a - c): divergences from others with this c and F are alike in both."""
        return MultivariateNormal(
            self.mean @ torch.matrix_exp(self.log_scale).T,
            torch.matrix_exp(2.0 * self.log_scale),
            validate_args=False,
        )

    def entropy(self) -> Tensor:
        count, size = self.mean.shape
        return (self.log_volume + 0.5 * size * math.log(2.0 * math.pi * math.e)).expand(count)

    def sample(self) -> Tensor:
        return self.centre + (self.mean + torch.randn_like(self.mean)) @ self.scale.T

    def mode(self) -> Tensor:
        return self.centre + self.mean @ self.scale.T

    def actions_from_params(self, *args: Tensor, deterministic: bool = False) -> Tensor:
        return self.proba_distribution(*args).get_actions(deterministic)

    def log_prob_from_params(self, *args: Tensor) -> tuple[Tensor, Tensor]:
        actions = self.actions_from_params(*args)
        return actions, self.log_prob(actions)


class NaturalGaussianPolicy(ActorCriticPolicy):
    """Stable-Baselines3's actor and critic with a NaturalGaussian, for box actions.

    Before each update the centre moves to the mean of the rollout's means and the factor takes up what was learnt of the
    covariance. Without `widening` this does not change the policy. With it the policy, means and spread, is also scaled
    about its old centre, so that the rollout was drawn from a narrower one, and the first ratios of an update differ from
    one by some hundredths.

    The optimiser is plain gradient descent, torch's SGD: in these coordinates the plain gradient is the natural one. It
    wants learning rates of 0.005 to 0.1. An optimiser that gives every parameter steps of one size, such as Adam, makes
    noise of the gradient.

    Args:
        *args, **kwargs: as of ActorCriticPolicy.
        covariance_rate: how fast the covariance is learnt, relative to the mean.
        bias_rate: how fast what is common to the means of all states is learnt, relative to how they differ.
        widening: an entropy bonus, for algorithms that have none as well. Where an update has narrowed the distribution
            by e^-x in the direction that it narrowed most, the distribution is widened by e^(widening x) in all. So
            directions of which the reward says little stay wide. None becomes wider by it than a standard deviation of 10.

    Raises:
        GymMaraError: the actions are no box, or gSDE is asked for.
    """

    centre: Tensor
    factor: Tensor
    _mean_sum: Tensor
    action_net: nn.Linear
    action_dist: NaturalGaussian

    def __init__(
        self,
        *args: Any,
        covariance_rate: float = 1.0,
        bias_rate: float = 1.0,
        widening: float = 0.0,
        **kwargs: Any,
    ) -> None:
        self.covariance_rate, self.bias_rate, self.widening = covariance_rate, bias_rate, widening
        super().__init__(*args, **{"optimizer_class": torch.optim.SGD, **kwargs})

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {
            "covariance_rate": self.covariance_rate,
            "bias_rate": self.bias_rate,
            "widening": self.widening,
        }

    def _build(self, lr_schedule: Schedule) -> None:
        if not isinstance(self.action_space, spaces.Box) or self.use_sde:
            raise GymMaraError("NaturalGaussianPolicy wants box actions, and use_sde=False")
        super()._build(lr_schedule)
        size = self.action_net.out_features
        del self.log_std
        self.action_dist = NaturalGaussian()
        self.log_scale = nn.Parameter(torch.zeros(size, size))
        self.register_buffer("centre", torch.zeros(size))
        self.register_buffer("factor", torch.eye(size) * math.exp(self.log_std_init))
        # The means of the rollout's states; of no use once it has ended.
        self.register_buffer("_mean_sum", torch.zeros(size), persistent=False)
        self._count = 0
        self.optimizer = self.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def _get_action_dist_from_latent(self, latent_pi: Tensor) -> Distribution:
        mean = self.action_net(latent_pi) + (self.bias_rate - 1.0) * self.action_net.bias
        return self.action_dist.proba_distribution(
            mean, self._symmetric_log_scale(), self.centre, self.factor
        )

    def _symmetric_log_scale(self) -> Tensor:
        return 0.5 * self.covariance_rate * (self.log_scale + self.log_scale.T)

    def forward(self, obs: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Act in a rollout: actions, values and log-probabilities."""
        result = super().forward(obs, deterministic)
        mean = self.action_dist.mean.detach()
        self._mean_sum, self._count = self._mean_sum + mean.sum(dim=0), self._count + len(mean)
        return result

    def set_training_mode(self, mode: bool) -> None:
        """Called before an update (True) and whenever the policy is only to act (False)."""
        if mode and self._count:
            self.recentre()
        super().set_training_mode(mode)

    @torch.no_grad()
    def recentre(self) -> None:
        """Make the present distribution the one that everything is relative to."""
        mean = self._mean_sum / self._count
        learnt = self._symmetric_log_scale()
        narrowed = -torch.linalg.eigvalsh(learnt).min().clamp(max=0.0)
        left, sizes, right = torch.linalg.svd(self.factor @ torch.matrix_exp(learnt))
        # Estimates that are noise narrow something at every update: what widens must end somewhere.
        widened = (sizes * torch.exp(self.widening * narrowed)).clamp(max=WIDEST_STD)
        sizes = torch.maximum(sizes, widened).clamp(min=LEAST_STD)
        self.factor.copy_(left @ torch.diag(sizes) @ right)
        self.log_scale.zero_()
        self.centre += self.factor @ mean
        self.action_net.bias.sub_(mean / self.bias_rate)
        self._mean_sum, self._count = torch.zeros_like(mean), 0
