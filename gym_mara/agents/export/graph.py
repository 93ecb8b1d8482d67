"""A policy as an ONNX graph: from the observation of the environment to the action of the environment.

The graph is made of the layers' weights, not by `torch.onnx.export`. It has a dozen nodes. PyTorch's exporters make another graph
with every version, the newer one needs onnxscript, and neither sees what Stable-Baselines3 and `Policy` do in NumPy: the
normalisation, the clipping and the scaling.

Precision is that of `Policy`: inputs, normalisation, scaling and output in float64, the network in float32. Normalisation in
float32 would multiply the rounding of an observation by one over its standard deviation, which may be 1e4.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from torch import nn

from gym_mara.agents.algorithms.natural_gaussian import NaturalGaussianPolicy
from gym_mara.agents.runs.description import PolicyDescription
from gym_mara.deploy.about import ACTION, OBSERVATION
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs

with needs("the export of a policy", "train", "onnx"):
    import onnx
    from onnx import TensorProto, helper, numpy_helper

_OPSET, _IR_VERSION = 17, 8
"""Old enough for every supported onnxruntime, and for the converters of other runtimes."""


def to_onnx(network: BasePolicy, about: PolicyDescription) -> onnx.ModelProto:
    """The deterministic policy of a network of Stable-Baselines3 with actions in [-1, 1].

    The inputs (N, size), float64, are the entries of the observation by name, or `observation`. The output `action` (N, A),
    float64, is the action of the environment.

    Raises:
        GymMaraError: the network has a layer that this function does not know.
    """
    graph = _Graph()
    groups = about.groups or {OBSERVATION: about.size}
    order, layers = _layers(network, groups)
    inputs = {name: _normalised(graph, name, about) for name in order}
    value = graph.add("Concat", *inputs.values(), axis=1) if len(order) > 1 else inputs[order[0]]
    for layer in layers:
        value = _added(graph, layer, value)
    low, high = np.array(about.low), np.array(about.high)
    limits = (graph.constant(np.array(v, np.float32)) for v in (-1.0, 1.0))
    value = graph.add("Cast", graph.add("Clip", value, *limits), to=TensorProto.DOUBLE)
    scaled = graph.add("Mul", value, graph.constant(0.5 * (high - low)))
    graph.add("Add", scaled, graph.constant(0.5 * (low + high)), output=ACTION)
    return graph.model(groups, len(low))


def _layers(network: BasePolicy, groups: dict[str, int]) -> tuple[list[str], list[nn.Module]]:
    """The order in which a network concatenates its inputs, and its layers up to the most probable action."""
    if isinstance(network, RecurrentActorCriticPolicy):
        raise GymMaraError(
            "cannot export a recurrent policy: an exported policy has no memory. Train with an algorithm without one, such as ppo"
        )
    if isinstance(network, NaturalGaussianPolicy):
        actor: Any = network
        layers = [*network.mlp_extractor.policy_net, network.action_layer()]
    elif isinstance(network, ActorCriticPolicy):
        actor = network
        layers = [*network.mlp_extractor.policy_net, network.action_net]
    else:  # the actors of SAC and TQC
        actor = getattr(network, "actor", None)
        if not hasattr(actor, "latent_pi"):
            raise GymMaraError(f"cannot export a policy of the class {type(network).__name__}")
        layers = [*actor.latent_pi, actor.mu]
    if network.squash_output:
        layers.append(nn.Tanh())
    extractor = actor.features_extractor
    if type(extractor) is FlattenExtractor and len(groups) == 1:
        return [*groups], layers
    if type(extractor) is CombinedExtractor and all(
        isinstance(each, nn.Flatten) for each in extractor.extractors.values()
    ):
        return [*extractor.extractors], layers
    raise GymMaraError(
        f"cannot export a policy with a features extractor {type(extractor).__name__}: it may not change the observation"
    )


def _added(graph: _Graph, layer: nn.Module, value: str) -> str:
    """The output of a layer."""
    match layer:
        case nn.Linear():
            weight, bias = (p.detach().cpu().numpy() for p in (layer.weight, layer.bias))
            return graph.add("Gemm", value, graph.constant(weight), graph.constant(bias), transB=1)
        case nn.Tanh():
            return graph.add("Tanh", value)
        case nn.ReLU():
            return graph.add("Relu", value)
        case nn.ELU():
            return graph.add("Elu", value, alpha=layer.alpha)
        case nn.LeakyReLU():
            return graph.add("LeakyRelu", value, alpha=layer.negative_slope)
        case nn.SiLU():
            return graph.add("Mul", value, graph.add("Sigmoid", value))
        case nn.GELU(approximate="none"):  # x · (1 + erf(x/√2)) / 2
            half, one, root = (
                graph.constant(np.array(v, np.float32)) for v in (0.5, 1.0, math.sqrt(0.5))
            )
            error = graph.add("Erf", graph.add("Mul", value, root))
            return graph.add("Mul", graph.add("Mul", value, half), graph.add("Add", error, one))
    raise GymMaraError(
        f"cannot export a policy with a layer {type(layer).__name__}: linear layers, and the activation functions of presets, "
        "can be exported"
    )


def _normalised(graph: _Graph, name: str, about: PolicyDescription) -> str:
    """An input, normalised if the policy wants it, as float32."""
    value, numbers = name, about.normalisation
    if numbers is not None:
        deviation = np.sqrt(np.array(numbers.var) + numbers.epsilon)
        centred = graph.add("Sub", name, graph.constant(np.array(numbers.mean)))
        scaled = graph.add("Div", centred, graph.constant(deviation))
        limits = (graph.constant(np.array(limit)) for limit in (-numbers.clip, numbers.clip))
        value = graph.add("Clip", scaled, *limits)
    return graph.add("Cast", value, to=TensorProto.FLOAT)


class _Graph:
    """Nodes and constants, each with a name of its own."""

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []

    def constant(self, values: NDArray[Any]) -> str:
        name = f"constant_{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def add(self, kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        """Add a node, and return the name of its output."""
        name = output or f"{kind.lower()}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def model(self, inputs: dict[str, int], actions: int) -> onnx.ModelProto:
        """The model with these inputs, and the output ACTION."""

        def described(name: str, size: int) -> onnx.ValueInfoProto:
            return helper.make_tensor_value_info(name, TensorProto.DOUBLE, ["N", size])

        graph = helper.make_graph(
            self._nodes,
            "policy",
            [described(name, size) for name, size in inputs.items()],
            [described(ACTION, actions)],
            self._constants,
        )
        opset = helper.make_opsetid("", _OPSET)
        return helper.make_model(graph, opset_imports=[opset], ir_version=_IR_VERSION)
