"""The graph of a policy acts as the policy does."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from gymnasium.spaces import Box, Dict, Space
from numpy.typing import NDArray
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from gym_mara.agents.algorithms.natural_gaussian import NaturalGaussianPolicy
from gym_mara.agents.algorithms.unit_policy import MlpPolicy
from gym_mara.agents.export.graph import to_onnx
from gym_mara.agents.runs.description import (
    ABSOLUTE,
    Normalisation,
    ObservationPart,
    PolicyDescription,
)
from gym_mara.agents.runs.policy import Policy
from gym_mara.agents.scaling import unit_box
from gym_mara.errors import GymMaraError

FLAT, JOINTS, COUNT = 9, 4, 500
GROUPS = {"achieved_goal": 3, "desired_goal": 3, "observation": 9}
LOW, HIGH = [-3.0, -1.0, 0.0, 0.1], [3.0, 2.0, 0.5, 0.1]
TIGHT = Normalisation(
    # One value never changed in the training: its rounding is multiplied by 10,000.
    mean=[0.5] * FLAT,
    var=[*np.linspace(0.01, 4.0, FLAT - 1), 0.0],
    epsilon=1e-8,
    clip=10.0,
)


def described(
    groups: dict[str, int] | None = None, normalisation: Normalisation | None = None
) -> PolicyDescription:
    size = sum(groups.values()) if groups else FLAT
    part = ObservationPart("all", size)
    joints = [f"joint{number}" for number in range(JOINTS)]
    return PolicyDescription(
        2, joints, LOW, HIGH, [part], groups, normalisation, "0", {}, ABSOLUTE, 0.02
    )


def box(size: int) -> Box:
    return Box(-np.inf, np.inf, (size,), np.float64)


def made(form: Any, groups: dict[str, int] | None = None, **arguments: Any) -> Any:
    """A network with random weights of ordinary size."""
    torch.manual_seed(3)
    space: Space[Any] = box(FLAT)
    if groups is not None:
        space = Dict({name: box(size) for name, size in groups.items()})
        arguments["features_extractor_class"] = CombinedExtractor
    network = form(space, unit_box(JOINTS), lambda _: 0.0, **arguments)
    with torch.no_grad():
        for weights in network.parameters():
            spread = weights.shape[-1] ** -0.5 if weights.ndim == 2 else 0.1
            weights.copy_(spread * torch.randn_like(weights))
    network.set_training_mode(False)
    return network


def run(network: BasePolicy, about: PolicyDescription, inputs: dict[str, Any]) -> NDArray[Any]:
    session = onnxruntime.InferenceSession(to_onnx(network, about).SerializeToString())
    return session.run(None, inputs)[0]


def check(network: BasePolicy, about: PolicyDescription, scale: float = 1.0) -> None:
    """Compare with Policy."""
    draw = np.random.default_rng(1).normal
    if about.groups is None:
        observed: Any = draw(0.5, scale, (COUNT, FLAT))
        inputs = {"observation": observed}
    else:
        observed = inputs = {
            name: draw(0.0, scale, (COUNT, size)) for name, size in about.groups.items()
        }
    wanted, _ = Policy(network, about).predict(observed)  # type: ignore[arg-type]
    found = run(network, about, inputs)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-5)
    assert np.ptp(wanted, axis=0)[:3].min() > 0.1  # the actions differ


NETWORKS = {
    "mlp": (MlpPolicy, {}),
    "natural": (NaturalGaussianPolicy, {"bias_rate": 3.0, "covariance_rate": 1.3}),
    "no hidden layer": (MlpPolicy, {"net_arch": []}),
    "squashed": (MlpPolicy, {"use_sde": True, "squash_output": True}),
    "sac": (SACPolicy, {"net_arch": [32, 16]}),
    "tqc": (TQCPolicy, {"net_arch": [32]}),
}


@pytest.mark.parametrize(("form", "arguments"), NETWORKS.values(), ids=NETWORKS)
@pytest.mark.parametrize("groups", [None, GROUPS], ids=["array", "dictionary"])
def test_the_graph_acts_as_the_policy(
    form: Any, arguments: dict[str, Any], groups: dict[str, int] | None
) -> None:
    check(made(form, groups, **arguments), described(groups))


@pytest.mark.parametrize("form", [MlpPolicy, NaturalGaussianPolicy, SACPolicy])
@pytest.mark.parametrize("scale", [1e-4, 1.0, 100.0])
def test_observations_are_normalised_in_double_precision(form: Any, scale: float) -> None:
    check(made(form), described(normalisation=TIGHT), scale)


@pytest.mark.parametrize("activation", [nn.ReLU, nn.Tanh, nn.ELU, nn.SiLU, nn.GELU, nn.LeakyReLU])
def test_every_activation_function_of_a_preset(activation: type[nn.Module]) -> None:
    check(made(MlpPolicy, activation_fn=activation), described())


class Halved(BaseFeaturesExtractor):
    """Changes the observation."""

    def __init__(self, observation_space: Space[Any]) -> None:
        super().__init__(observation_space, FLAT)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return 0.5 * observations


@pytest.mark.parametrize(
    ("form", "arguments", "message"),
    [
        (MlpPolicy, {"activation_fn": nn.Softplus}, "a layer Softplus"),
        (MlpPolicy, {"features_extractor_class": Halved}, "a features extractor Halved"),
        (TD3Policy, {}, "a policy of the class TD3Policy"),
        (SACPolicy, {"use_sde": True}, "a layer Sequential"),
    ],
)
def test_another_network_is_refused(form: Any, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=f"cannot export .*{message}"):
        to_onnx(made(form, **arguments), described())


def test_actions_are_clipped() -> None:
    network = made(MlpPolicy)
    with torch.no_grad():
        network.action_net.bias.copy_(torch.tensor([9.0, -9.0, 9.0, -9.0]))
    actions = run(network, described(), {"observation": np.zeros((2, FLAT))})
    assert actions.tolist() == [[HIGH[0], LOW[1], HIGH[2], LOW[3]]] * 2


def test_the_random_numbers_of_torch_stay() -> None:
    network = made(NaturalGaussianPolicy)
    before = torch.random.get_rng_state()
    to_onnx(network, described())
    assert torch.equal(torch.random.get_rng_state(), before)
