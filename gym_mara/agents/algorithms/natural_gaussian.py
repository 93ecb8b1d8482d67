"""A Gaussian policy with a full covariance, learnt in natural coordinates.

Near a target some directions in joint space move the tool, and others only rotate it. The reward changes with a tenth of a
millimetre in the former, but hardly with a degree in the latter. So the policy's noise should be narrow in the former and
wide in the latter. Independent noise for each joint cannot be; noise with a full covariance can. But then an optimiser
such as Adam, which scales the gradient joint by joint, mixes the two: the weak signal of the wide directions disappears
in the noise of the narrow ones. Therefore everything is learnt relative to the current distribution, in which all
directions have the same width (natural coordinates; Glasmachers et al. 2010, "Exponential natural evolution strategies").
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

from gym_mara.agents.algorithms.unit_policy import MarksUnitActions
from gym_mara.errors import GymMaraError

# The lower bound of standard deviations. Actions are float32 of order 1, and cannot resolve much smaller ones. The bound in
# `acktr` is ten times larger. Trainings with tuned presets reach either bound, so another value would change their results.
LEAST_STD = 1e-6
# `widening` makes no standard deviation larger than this, five times the range of an action. It prevents an overflow. If the
# reward does not depend on a joint, such as the last one in tasks without orientation, tuned trainings reach about 4.
WIDEST_STD = 10.0


class NaturalGaussian(Distribution):
    """a = c + F e^S (m + ε) with ε ~ N(0, 1): a Gaussian with mean c + F e^S m and covariance F e^2S Fᵀ.

    The mean m (N, A) and the symmetric S (A, A) are relative to the centre c (A,) and the factor F (A, A).
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        # S and F without gradients, and what `_measures` made of them.
        self._known: tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]] | None = None

    def proba_distribution_net(self, *args: Any, **kwargs: Any) -> nn.Module:
        raise NotImplementedError("the policy holds the parameters")

    def proba_distribution(
        self, mean: Tensor, log_scale: Tensor, centre: Tensor, factor: Tensor
    ) -> NaturalGaussian:
        self.mean, self.log_scale, self.centre, self.factor = mean, log_scale, centre, factor
        self.scale, self.inverse_scale, self.log_volume = self._measures(log_scale, factor)
        return self

    def _measures(self, log_scale: Tensor, factor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """F e^S, its inverse, and the logarithm of its determinant.

        Without gradients, as in a rollout, S and F are mostly those of the last call. To compute this took half of the time
        of an action.
        """
        without = not torch.is_grad_enabled()
        if without and self._known is not None:
            known_scale, known_factor, measures = self._known
            if torch.equal(log_scale, known_scale) and torch.equal(factor, known_factor):
                return measures
        measures = (
            factor @ torch.matrix_exp(log_scale),
            torch.matrix_exp(-log_scale) @ torch.linalg.inv(factor),
            torch.linalg.slogdet(factor).logabsdet + log_scale.trace(),
        )
        if without:
            self._known = log_scale.clone(), factor.clone(), measures
        return measures

    def log_prob(self, actions: Tensor) -> Tensor:
        noise = (actions - self.centre) @ self.inverse_scale.T - self.mean
        constant = 0.5 * noise.shape[1] * math.log(2.0 * math.pi)
        return -0.5 * noise.square().sum(dim=1) - self.log_volume - constant

    @property
    def distribution(self) -> MultivariateNormal:  # type: ignore[override]
        """The distribution of F⁻¹(a - c) in torch's form; its divergence from others with the same c and F is that of a."""
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


class NaturalGaussianPolicy(MarksUnitActions, ActorCriticPolicy):
    """The ActorCriticPolicy of Stable-Baselines3 with a NaturalGaussian, for box actions.

    Before each update, the centre moves to the average of the rollout's means, and the factor absorbs the learnt change of the
    covariance. Without `widening` this does not change the policy. With it, the policy's means and spread are also scaled
    about the old centre. The rollout then comes from a narrower distribution, and the first probability ratios of an
    update differ from 1 by a few hundredths.

    The optimiser is plain gradient descent, torch's SGD, because in these coordinates the plain gradient is the natural
    gradient. It needs learning rates of 0.005 to 0.1. An optimiser with steps of the same size for all parameters, such as
    Adam, amplifies the noise of the gradient.

    Args:
        *args, **kwargs: as for ActorCriticPolicy.
        covariance_rate: how fast the covariance is learnt, relative to the mean.
        bias_rate: how fast the part of the mean that all states share is learnt, relative to the part that differs.
        widening: an entropy bonus that works with every algorithm. If an update narrowed the distribution by e^-x in the
            direction that it narrowed most, the distribution is widened by e^(widening x) in all directions. Thus
            directions that hardly affect the reward stay wide. It widens no standard deviation beyond 10.

    Raises:
        GymMaraError: the actions are not a box, or gSDE is requested.
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
            raise GymMaraError("NaturalGaussianPolicy needs box actions and use_sde=False")
        super()._build(lr_schedule)
        size = self.action_net.out_features
        del self.log_std
        self.action_dist = NaturalGaussian()
        self.log_scale = nn.Parameter(torch.zeros(size, size))
        self.register_buffer("centre", torch.zeros(size))
        self.register_buffer("factor", torch.eye(size) * math.exp(self.log_std_init))
        # The sum of the means in the rollout; not needed after the update, so not stored.
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

    @torch.no_grad()
    def action_layer(self) -> nn.Linear:
        """The linear layer from the last hidden layer to the most probable action, a = c + F e^S m, computed in float64."""
        weight, bias, learnt, centre, factor = (
            value.double()
            for value in (
                self.action_net.weight,
                self.action_net.bias,
                self._symmetric_log_scale(),
                self.centre,
                self.factor,
            )
        )
        scale = factor @ torch.matrix_exp(learnt)
        layer: nn.Linear = nn.utils.skip_init(  # type: ignore[no-untyped-call]
            nn.Linear, weight.shape[1], weight.shape[0]
        )
        layer.weight.copy_(scale @ weight)
        layer.bias.copy_(centre + scale @ (self.bias_rate * bias))
        return layer

    def forward(self, obs: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Actions, values and log-probabilities for the states of a rollout."""
        result = super().forward(obs, deterministic)
        mean = self.action_dist.mean.detach()
        self._mean_sum, self._count = self._mean_sum + mean.sum(dim=0), self._count + len(mean)
        return result

    @torch.no_grad()
    def take_over(self, other: NaturalGaussianPolicy) -> None:  # type: ignore[override]
        """Become the policy of another network of the same size, whatever its rates are."""
        super().take_over(other)
        self.factor.copy_(self.factor @ torch.matrix_exp(other._symmetric_log_scale()))
        self.log_scale.zero_()
        self.action_net.bias.mul_(other.bias_rate / self.bias_rate)

    def set_training_mode(self, mode: bool) -> None:
        """Stable-Baselines3 calls it with True before an update, and with False before the policy only acts."""
        if mode and self._count:
            self.recentre()
        super().set_training_mode(mode)

    @torch.no_grad()
    def recentre(self) -> None:
        """Make the current distribution the reference of the coordinates."""
        mean = self._mean_sum / self._count
        learnt = self._symmetric_log_scale()
        narrowed = -torch.linalg.eigvalsh(learnt).min().clamp(max=0.0)
        left, sizes, right = torch.linalg.svd(self.factor @ torch.matrix_exp(learnt))
        # Noise in the estimates narrows some direction in every update, so the widening needs an upper bound.
        widened = (sizes * torch.exp(self.widening * narrowed)).clamp(max=WIDEST_STD)
        sizes = torch.maximum(sizes, widened).clamp(min=LEAST_STD)
        self.factor.copy_(left @ torch.diag(sizes) @ right)
        self.log_scale.zero_()
        self.centre += self.factor @ mean
        self.action_net.bias.sub_(mean / self.bias_rate)
        self._mean_sum, self._count = torch.zeros_like(mean), 0
