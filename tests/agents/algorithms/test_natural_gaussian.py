"""The Gaussian policy in natural coordinates: compared with torch's Gaussian, and unchanged when its coordinates move."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from sb3_contrib import TRPO
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import kl_divergence
from torch.distributions import MultivariateNormal

from gym_mara.agents.algorithms.natural_gaussian import (
    LEAST_STD,
    WIDEST_STD,
    NaturalGaussian,
    NaturalGaussianPolicy,
)
from gym_mara.agents.runs.evaluation import make_env
from gym_mara.errors import GymMaraError


@pytest.fixture
def distribution() -> NaturalGaussian:
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    log_scale = 0.3 * normal(3, 3)
    return NaturalGaussian().proba_distribution(
        normal(5, 3), log_scale + log_scale.T, normal(3), normal(3, 3)
    )


def _referee(distribution: NaturalGaussian) -> MultivariateNormal:
    scale = distribution.scale
    return MultivariateNormal(
        distribution.centre + distribution.mean @ scale.T, covariance_matrix=scale @ scale.T
    )


def test_it_is_the_gaussian_with_its_mean_and_covariance(distribution: NaturalGaussian) -> None:
    referee = _referee(distribution)
    actions = referee.sample()
    expected: torch.Tensor = referee.log_prob(actions)  # type: ignore[no-untyped-call]
    torch.testing.assert_close(distribution.log_prob(actions), expected)
    expected = referee.entropy()  # type: ignore[no-untyped-call]
    torch.testing.assert_close(distribution.entropy(), expected)
    torch.testing.assert_close(distribution.mode(), referee.mean)


def test_without_gradients_it_follows_its_parameters(distribution: NaturalGaussian) -> None:
    again, mean, centre = NaturalGaussian(), distribution.mean, distribution.centre
    log_scale, factor = distribution.log_scale.clone(), distribution.factor.clone()
    for change in (lambda: log_scale.mul_(0.5), lambda: factor.mul_(2.0), lambda: None):
        change()
        expected = NaturalGaussian().proba_distribution(mean, log_scale, centre, factor)
        with torch.no_grad():
            again.proba_distribution(mean, log_scale, centre, factor)
        for name in ("scale", "inverse_scale", "log_volume"):
            assert torch.equal(getattr(again, name), getattr(expected, name))


def test_its_divergence_is_that_of_torch_s_gaussians(distribution: NaturalGaussian) -> None:
    generator = torch.Generator().manual_seed(2)
    noise = 0.1 * torch.randn(3, 3, generator=generator, dtype=torch.float64)
    other = NaturalGaussian().proba_distribution(
        distribution.mean + 0.1,
        distribution.log_scale + noise + noise.T,
        distribution.centre,
        distribution.factor,
    )
    expected = torch.distributions.kl_divergence(_referee(distribution), _referee(other))
    torch.testing.assert_close(kl_divergence(distribution, other), expected)


def test_trpo_moves_it_within_its_trust_region() -> None:
    env = make_env("MARAOrient-v0", "pinocchio", 16, {})
    model = TRPO(NaturalGaussianPolicy, env, n_steps=16, target_kl=0.02, seed=0, device="cpu")
    for _ in range(3):
        model.learn(16 * 16, reset_num_timesteps=False)
        assert 1e-3 < model.logger.name_to_value["train/kl_divergence_loss"] <= 0.02


def test_samples_have_its_mean_and_covariance(distribution: NaturalGaussian) -> None:
    torch.manual_seed(0)
    one = NaturalGaussian().proba_distribution(
        distribution.mean[:1].expand(200_000, 3),
        torch.zeros(3, 3, dtype=torch.float64),
        distribution.centre,
        distribution.scale,
    )
    samples = one.sample()
    referee = _referee(one)
    covariance = referee.covariance_matrix[0]
    torch.testing.assert_close(samples.mean(dim=0), referee.mean[0], rtol=0.0, atol=0.03)
    torch.testing.assert_close(torch.cov(samples.T), covariance, rtol=0.0, atol=0.1)


@pytest.fixture
def model() -> PPO:
    env = make_env("MARAOrient-v0", "pinocchio", 16, {})
    ppo = PPO(
        NaturalGaussianPolicy,
        env,
        n_steps=16,
        batch_size=64,
        policy_kwargs={"bias_rate": 3.0},
        seed=0,
        device="cpu",
    )
    return ppo.learn(16 * 16 * 3)


def test_training_shapes_the_covariance_and_moves_the_centre(model: PPO) -> None:
    policy = model.policy
    assert isinstance(policy, NaturalGaussianPolicy)
    assert torch.count_nonzero(policy.centre) == 6
    assert torch.count_nonzero(policy.factor) == 36


def test_moving_the_coordinates_does_not_change_the_policy(model: PPO) -> None:
    policy = model.policy
    assert isinstance(policy, NaturalGaussianPolicy)
    observation = torch.as_tensor(model.env.reset())  # type: ignore[union-attr]
    with torch.no_grad():
        policy.log_scale.normal_(std=0.2)
        actions = policy(observation)[0]
        before = policy.get_distribution(observation)
        log_prob, mode = before.log_prob(actions), before.mode()
        policy.recentre()
        after = policy.get_distribution(observation)
    assert torch.count_nonzero(policy.log_scale) == 0
    torch.testing.assert_close(after.log_prob(actions), log_prob, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(after.mode(), mode, rtol=1e-4, atol=1e-5)


def test_the_standard_deviations_have_a_lower_bound(model: PPO) -> None:
    policy = model.policy
    assert isinstance(policy, NaturalGaussianPolicy)
    policy(torch.as_tensor(model.env.reset()))  # type: ignore[union-attr]
    with torch.no_grad():
        policy.log_scale.copy_(-40.0 * torch.eye(6))
    policy.set_training_mode(True)
    sizes = torch.linalg.svdvals(policy.factor)
    torch.testing.assert_close(sizes, torch.full((6,), LEAST_STD))


def _widening_policy(widening: float) -> tuple[NaturalGaussianPolicy, torch.Tensor]:
    """A policy, and observations for it."""
    env = make_env("MARAOrient-v0", "pinocchio", 4, {})
    kwargs = {"widening": widening, "log_std_init": -1.0}
    policy = PPO(NaturalGaussianPolicy, env, policy_kwargs=kwargs, seed=0, device="cpu").policy
    assert isinstance(policy, NaturalGaussianPolicy)
    return policy, torch.as_tensor(env.reset())


def test_the_widening_has_an_upper_bound() -> None:
    policy, observation = _widening_policy(1.0)
    for update in range(60):  # each narrows one direction, and so widens all
        policy(observation)
        with torch.no_grad():
            policy.log_scale[update % 6, update % 6] = -1.0
        policy.set_training_mode(True)
    sizes = torch.linalg.svdvals(policy.factor)
    assert sizes.max() <= WIDEST_STD * (1.0 + 1e-5)
    assert sizes.min() > 0.3 * WIDEST_STD


def test_the_widening_scales_the_policy_about_its_centre() -> None:
    policy, observation = _widening_policy(0.1)
    with torch.no_grad():
        policy.action_net.bias.normal_()
        policy.log_scale[0, 0] = -0.5
        before, centre = policy.get_distribution(observation).mode(), policy.centre.clone()
        policy(observation)
        policy.recentre()
        after = policy.get_distribution(observation).mode()
    scale = torch.full((), 0.05).exp()
    torch.testing.assert_close(after - centre, scale * (before - centre), rtol=1e-4, atol=1e-5)


def test_the_sum_of_means_moves_with_the_policy_but_is_not_saved() -> None:
    policy, observation = _widening_policy(0.1)
    policy(observation)
    policy.double()
    assert policy._mean_sum.dtype == torch.float64
    assert {"centre", "factor", "log_scale"} <= policy.state_dict().keys()
    assert "_mean_sum" not in policy.state_dict()


@pytest.mark.parametrize(
    ("env_id", "arguments"), [("CartPole-v1", {}), ("Pendulum-v1", {"use_sde": True})]
)
def test_unsupported_arguments_are_refused(env_id: str, arguments: dict[str, Any]) -> None:
    with pytest.raises(GymMaraError, match="box actions"):
        PPO(NaturalGaussianPolicy, env_id, device="cpu", **arguments)


def test_directions_that_do_not_affect_the_reward_stay_wide() -> None:
    env = make_env("MARAOrient-v0", "pinocchio", 4, {})
    kwargs = {"widening": 0.1, "log_std_init": -2.0}
    ppo = PPO(NaturalGaussianPolicy, env, n_steps=4, batch_size=16, policy_kwargs=kwargs)
    policy = ppo.policy
    assert isinstance(policy, NaturalGaussianPolicy)
    before = torch.linalg.svdvals(policy.factor)
    policy(torch.as_tensor(ppo.env.reset()))  # type: ignore[union-attr]
    policy.set_training_mode(True)
    torch.testing.assert_close(torch.linalg.svdvals(policy.factor), before)  # nothing was learnt
    with torch.no_grad():
        policy.log_scale[0, 0] = -0.5
    policy(torch.as_tensor(ppo.env.reset()))  # type: ignore[union-attr]
    policy.set_training_mode(True)
    changes = torch.log(torch.linalg.svdvals(policy.factor) / before)
    torch.testing.assert_close(changes, torch.tensor([0.05] * 5 + [-0.45]), atol=1e-3, rtol=0.0)


def test_it_is_saved_and_loaded(model: PPO, tmp_path: Path) -> None:
    model.save(tmp_path / "model.zip")
    again = PPO.load(tmp_path / "model.zip", device="cpu")
    observation: Any = model.env.reset()  # type: ignore[union-attr]
    expected = model.predict(observation, deterministic=True)[0]
    assert (again.predict(observation, deterministic=True)[0] == expected).all()
