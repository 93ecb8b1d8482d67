"""ACKTR for Stable-Baselines3: actor and critic learn with natural gradients from K-FAC, within trust regions."""

from __future__ import annotations

import copy
import math
from typing import Any, ClassVar

import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.distributions import Distribution, kl_divergence
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import (
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import explained_variance
from torch import Tensor, nn
from typing_extensions import Self

from gym_mara.agents.algorithms.kfac import KFAC
from gym_mara.errors import GymMaraError

LEAST_STD = 1e-5
"""The lower bound of standard deviations. Actions are float32 of order 1, and cannot resolve much smaller ones.

`natural_gaussian` has a bound ten times smaller. Trainings with tuned presets reach either bound, so another value would
change their results.
"""
# The Fisher information of a Gaussian's log standard deviation: E[(∂ log p / ∂ log σ)²].
_FISHER_OF_LOG_STD = 2.0


class ACKTR(OnPolicyAlgorithm):
    """Actor-critic using Kronecker-factored trust region (Wu et al. 2017, arXiv 1708.05144).

    There is one update per rollout. Actor and critic are separate networks, each with its own K-FAC optimiser and trust region.
    The critic predicts a Gaussian, whose variance is the mean square of the differences between returns and values.

    Args:
        policy: "MlpPolicy", "MultiInputPolicy", or an actor-critic class with linear layers only.
        env: the environment, or its id.
        learning_rate: η, the largest factor of a step along the natural gradient; a number or a function of the remaining
            progress.
        n_steps: steps of each environment in a rollout.
        gamma: discount.
        gae_lambda: λ of generalised advantage estimation; with 1 the advantages come from the returns.
        ent_coef: weight of the policy's entropy.
        vf_coef: the critic's learning rate relative to the actor's.
        max_grad_norm: the largest norm of the gradient in the cold updates.
        target_kl: the largest KL divergence between the policies before and after an update.
        critic_kl: the same for the critic.
        damping, fisher_decay, momentum, cold_updates: of the K-FAC optimisers; see `gym_mara.agents.algorithms.kfac.KFAC`.
        normalize_advantage: whether the advantages of a rollout are scaled to mean 0 and variance 1.
        rollout_buffer_class, rollout_buffer_kwargs, stats_window_size, tensorboard_log, policy_kwargs, verbose, seed, device: as
            in all algorithms of Stable-Baselines3.

    Raises:
        GymMaraError: the policy has parameters other than those of linear layers and the log standard deviation.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": ActorCriticPolicy,
        "MultiInputPolicy": MultiInputActorCriticPolicy,
    }
    policy: ActorCriticPolicy

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 0.25,
        n_steps: int = 20,
        gamma: float = 0.99,
        gae_lambda: float = 1.0,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        target_kl: float = 1e-3,
        critic_kl: float = 0.3,
        damping: float = 1e-2,
        fisher_decay: float = 0.99,
        momentum: float = 0.9,
        cold_updates: int = 10,
        normalize_advantage: bool = True,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=False,
            sde_sample_freq=-1,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            supported_action_spaces=(spaces.Box, spaces.Discrete),
            _init_setup_model=False,
        )
        self.target_kl = target_kl
        self.critic_kl = critic_kl
        self.damping = damping
        self.fisher_decay = fisher_decay
        self.momentum = momentum
        self.cold_updates = cold_updates
        self.normalize_advantage = normalize_advantage
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        extractor = self.policy.mlp_extractor
        actor = [*_linear(extractor.policy_net), *_linear(self.policy.action_net)]
        critic = [*_linear(extractor.value_net), *_linear(self.policy.value_net)]
        exact = [
            (p, _FISHER_OF_LOG_STD) for n, p in self.policy.named_parameters() if n == "log_std"
        ]
        known = {p for layer in actor + critic for p in layer.parameters()} | {p for p, _ in exact}
        for name, parameter in self.policy.named_parameters():
            if parameter not in known:
                raise GymMaraError(
                    f"ACKTR needs a policy of linear layers only, but this one also has {name!r}: use MlpPolicy"
                )
        settings: dict[str, Any] = {
            "lr": self.lr_schedule(1.0),
            "damping": self.damping,
            "decay": self.fisher_decay,
            "momentum": self.momentum,
            "cold_updates": self.cold_updates,
            "max_grad_norm": self.max_grad_norm,
        }
        self.actor_optimizer = KFAC(actor, exact, trust_region=self.target_kl, **settings)
        self.critic_optimizer = KFAC(critic, trust_region=self.critic_kl, **settings)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "ACKTR",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for this many more steps; see Stable-Baselines3."""
        return super().learn(
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )

    def train(self) -> None:
        """Update actor and critic with the rollout."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.actor_optimizer)
        for group in self.critic_optimizer.param_groups:
            group["lr"] = self.vf_coef * self.lr_schedule(self._current_progress_remaining)
        rollout = next(self.rollout_buffer.get(batch_size=None))
        actions = rollout.actions
        if isinstance(self.action_space, spaces.Discrete):
            actions = actions.long().flatten()
        advantages = rollout.advantages
        if self.normalize_advantage and len(advantages) > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        self._update_actor(rollout.observations, actions, advantages)
        self._update_critic(rollout.observations, rollout.returns)
        self._n_updates += 1
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        buffer = self.rollout_buffer
        explained = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", explained)
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", self.policy.log_std.exp().mean().item())

    def _update_actor(self, observations: Tensor, actions: Tensor, advantages: Tensor) -> None:
        optimizer = self.actor_optimizer
        with optimizer.watch():
            # A copy, because the policy reuses one distribution object.
            distribution = copy.copy(self.policy.get_distribution(observations))
        with torch.no_grad():
            drawn = distribution.sample()
        optimizer.observe(-distribution.log_prob(drawn))
        loss = -(advantages * distribution.log_prob(actions)).mean()
        entropy = _entropy(distribution)
        optimizer.zero_grad()
        (loss - self.ent_coef * entropy.mean()).backward()  # type: ignore[no-untyped-call]

        def divergence() -> float:
            moved = kl_divergence(distribution, self.policy.get_distribution(observations))
            return float(moved.reshape(len(advantages), -1).sum(dim=1).mean())

        self.logger.record("train/kl", optimizer.step(divergence))
        if hasattr(self.policy, "log_std"):
            self.policy.log_std.data.clamp_(min=math.log(LEAST_STD))
        self.logger.record("train/policy_loss", loss.item())
        self.logger.record("train/entropy", entropy.mean().item())

    def _update_critic(self, observations: Tensor, returns: Tensor) -> None:
        optimizer = self.critic_optimizer
        with optimizer.watch():
            values = self.policy.predict_values(observations).flatten()
        old = values.detach()
        # The mean square, not the variance around the mean difference, because a constant offset is an error too.
        variance = (returns - old).square().mean() + 1e-8
        drawn = old + variance.sqrt() * torch.randn_like(old)
        optimizer.observe(0.5 * (drawn - values).square() / variance)
        loss = 0.5 * (returns - values).square() / variance
        optimizer.zero_grad()
        loss.mean().backward()  # type: ignore[no-untyped-call]

        def divergence() -> float:
            moved = self.policy.predict_values(observations).flatten() - old
            return float(0.5 * (moved.square() / variance).mean())

        self.logger.record("train/critic_kl", optimizer.step(divergence))
        self.logger.record("train/value_loss", float(0.5 * (returns - old).square().mean()))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor_optimizer", "critic_optimizer"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor_optimizer", "critic_optimizer"], []


def _linear(module: nn.Module) -> list[nn.Linear]:
    """The linear layers of a module, in order."""
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


def _entropy(distribution: Distribution) -> Tensor:
    entropy = distribution.entropy()
    assert entropy is not None  # it exists for Gaussian and categorical distributions
    return entropy
