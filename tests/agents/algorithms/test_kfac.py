"""K-FAC: compared with curvlinops and with the exact Fisher matrix; its trust region; each part of an update."""

from __future__ import annotations

import copy
import itertools
import math

import pytest
import torch
from curvlinops import KFACInverseLinearOperator, KFACLinearOperator
from torch import Tensor, nn

from gym_mara.agents.algorithms.kfac import KFAC
from gym_mara.errors import TrainingDivergedError

EXAMPLES = 50


@pytest.fixture(autouse=True)
def _double_precision() -> object:
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def network(*sizes: int, linear: bool = False) -> nn.Sequential:
    """A network with tanh between its layers, or a linear one."""
    layers: list[nn.Module] = []
    for one, other in itertools.pairwise(sizes):
        layers += [nn.Linear(one, other), nn.Identity() if linear else nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def linear_layers(net: nn.Module) -> list[nn.Linear]:
    return [layer for layer in net.modules() if isinstance(layer, nn.Linear)]


def observe(kfac: KFAC, net: nn.Module, x: Tensor, y: Tensor) -> None:
    """Update the factors with a Gaussian output of variance 1 whose sample is y."""
    with kfac.watch():
        out = net(x)
    kfac.observe(0.5 * (out - y).square().sum(dim=1))


def as_matrices(tensors: list[Tensor]) -> list[Tensor]:
    """Alternating weights and biases as one matrix for each layer."""
    pairs = zip(tensors[::2], tensors[1::2], strict=True)
    return [torch.cat([weight, bias[:, None]], dim=1) for weight, bias in pairs]


def test_factors_and_natural_gradient_are_those_of_curvlinops() -> None:
    net = network(4, 5, 3)
    x, y = torch.randn(EXAMPLES, 4), torch.randn(EXAMPLES, 3)
    kfac = KFAC(linear_layers(net), damping=1e-2)
    observe(kfac, net, x, y)
    # The squared error of curvlinops has no factor ½, so its G is four times ours; and it sums over the examples.
    scale = 4.0 * EXAMPLES
    parameters = list(net.parameters())
    theirs = KFACLinearOperator(
        net,
        nn.MSELoss(reduction="sum"),
        parameters,
        [(x, y)],
        fisher_type="empirical",
        separate_weight_and_bias=False,
    )
    vector = [torch.randn_like(p) for p in parameters]
    inverse = KFACInverseLinearOperator(theirs, damping=1e-2 * scale, use_heuristic_damping=True)
    products, preconditioned = as_matrices(theirs @ vector), as_matrices(inverse @ vector)
    for group, v, product, natural in zip(
        kfac.param_groups, as_matrices(vector), products, preconditioned, strict=True
    ):
        state = kfac.state[group["params"][0]]
        torch.testing.assert_close(scale * state["G"] @ v @ state["A"], product)
        torch.testing.assert_close(kfac.natural_gradient(group, v), scale * natural)


def exact_fisher(net: nn.Sequential, x: Tensor) -> Tensor:
    """E[JᵀJ] for a Gaussian output of variance 1, with a row and a column for each parameter, in order."""
    parameters = dict(net.named_parameters())

    def output(values: dict[str, Tensor]) -> Tensor:
        return torch.func.functional_call(net, values, (x,))  # type: ignore[no-any-return]

    jacobian = torch.func.jacrev(output)(parameters)
    columns = [part.reshape(*part.shape[:2], -1) for part in jacobian.values()]
    j = torch.cat(columns, dim=2)
    return torch.einsum("nop,noq->pq", j, j) / len(x)


def kronecker(kfac: KFAC, layer: int) -> Tensor:
    """A layer's block of the Fisher matrix, in the order of its parameters: the weights row by row, then the biases."""
    state = kfac.state[kfac.param_groups[layer]["params"][0]]
    a, g = state["A"], state["G"]
    rows, columns = len(g), len(a)
    block = torch.kron(g, a).reshape(rows, columns, rows, columns)
    order = [(i, j) for i in range(rows) for j in range(columns - 1)]
    order += [(i, columns - 1) for i in range(rows)]
    i, j = torch.tensor(order).T
    return block[i, j][:, i, j]


def test_the_fisher_matrix_of_a_linear_network_is_exact() -> None:
    # For a linear network with a Gaussian output, the Kronecker factors of a layer are exact.
    net = network(3, 4, 2, linear=True)
    x = torch.randn(64, 3)
    kfac = KFAC(linear_layers(net))
    repeated = x.repeat(3000, 1)
    with torch.no_grad():
        drawn = net(repeated) + torch.randn(len(repeated), 2)
    observe(kfac, net, repeated, drawn)
    fisher = exact_fisher(net, x)
    first = 3 * 4 + 4
    for layer, block in enumerate((fisher[:first, :first], fisher[first:, first:])):
        error = (kronecker(kfac, layer) - block).norm() / block.norm()
        assert error < 0.01


def test_the_natural_gradient_of_one_layer_solves_its_regression() -> None:
    net = network(3, 2)
    x, target = torch.randn(200, 3), torch.randn(200, 2)
    with torch.no_grad():
        best = torch.linalg.lstsq(torch.cat([x, torch.ones(200, 1)], dim=1), target).solution.T
    kfac = KFAC(
        linear_layers(net), lr=1.0, damping=1e-12, momentum=0.0, trust_region=1e9, cold_updates=0
    )
    for _ in range(300):  # to estimate the factors well
        kfac.param_groups[0]["updates"] += 1
        with torch.no_grad():
            drawn = net(x) + torch.randn(200, 2)
        kfac.decay = 1.0 - 1.0 / kfac.param_groups[0]["updates"]
        observe(kfac, net, x, drawn)
    net.zero_grad()
    (0.5 * (net(x) - target).square().sum(dim=1)).mean().backward()
    kfac.step()
    torch.testing.assert_close(as_matrices(list(net.parameters()))[0], best, atol=0.05, rtol=0.0)


@pytest.mark.parametrize("cold_updates", [0, 100])
@pytest.mark.parametrize("lr", [0.1, 10.0, 1e4])
def test_a_step_stays_within_the_trust_region(cold_updates: int, lr: float) -> None:
    net = network(4, 16, 3)
    x, target = torch.randn(100, 4), 10.0 * torch.randn(100, 3)
    kfac = KFAC(linear_layers(net), lr=lr, trust_region=1e-3, cold_updates=cold_updates)
    for _ in range(20):
        with torch.no_grad():
            old = net(x)
        observe(kfac, net, x, old + torch.randn(100, 3))
        net.zero_grad()
        (0.5 * (net(x) - target).square().sum(dim=1)).mean().backward()

        def divergence(old: Tensor = old) -> float:
            with torch.no_grad():
                return float(0.5 * (net(x) - old).square().sum(dim=1).mean())

        reported = kfac.step(divergence)
        assert 0.0 < divergence() <= 1e-3
        assert reported == divergence()


def test_without_a_measured_divergence_the_estimate_bounds_the_step() -> None:
    net = network(4, 3)
    x = torch.randn(100, 4)
    kfac = KFAC(linear_layers(net), lr=1e3, trust_region=1e-3, cold_updates=0)
    observe(kfac, net, x, net(x).detach() + torch.randn(100, 3))
    net(x).square().mean().backward()
    assert kfac.step() == pytest.approx(1e-3)


def test_a_parameter_with_a_known_fisher_matrix_uses_it() -> None:
    log_std = nn.Parameter(torch.zeros(2))
    kfac = KFAC(
        [], [(log_std, 2.0)], lr=0.5, damping=0.0, momentum=0.0, trust_region=1e3, cold_updates=0
    )
    log_std.grad = torch.tensor([1.0, -3.0])
    assert kfac.step() == pytest.approx(0.5 * 2.0 * (0.25**2 + 0.75**2))
    torch.testing.assert_close(log_std.data, torch.tensor([-0.25, 0.75]))


def test_a_gradient_that_is_not_finite_is_an_error_and_changes_no_parameter() -> None:
    log_std = nn.Parameter(torch.zeros(2))
    kfac = KFAC([], [(log_std, 2.0)])
    log_std.grad = torch.tensor([math.nan, 0.0])
    with pytest.raises(TrainingDivergedError, match="not finite"):
        kfac.step()
    assert not log_std.any()


def test_dead_units_keep_their_parameters() -> None:
    dead = nn.Linear(3, 4)
    net = nn.Sequential(dead, nn.ReLU(), nn.Linear(4, 2))
    with torch.no_grad():
        dead.bias.fill_(-100.0)
    before = [parameter.clone() for parameter in dead.parameters()]
    kfac = KFAC(linear_layers(net), lr=0.1, cold_updates=0)
    x, y = torch.randn(EXAMPLES, 3), torch.randn(EXAMPLES, 2)
    for _ in range(3):
        observe(kfac, net, x, y)
        kfac.zero_grad()
        (net(x) - y).square().mean().backward()  # type: ignore[no-untyped-call]
        kfac.step()
    for parameter, start in zip(dead.parameters(), before, strict=True):
        assert torch.equal(parameter, start)
    assert all(parameter.isfinite().all() for parameter in net.parameters())


def test_factors_that_are_not_finite_are_an_error_and_change_no_parameter() -> None:
    net = network(2, 3, 1)
    before = [parameter.clone() for parameter in net.parameters()]
    kfac = KFAC(linear_layers(net), cold_updates=0)
    x = torch.full((EXAMPLES, 2), 1e200)  # the units are saturated, so the outputs are finite
    observe(kfac, net, x, torch.zeros(EXAMPLES, 1))
    net(x).square().mean().backward()  # type: ignore[no-untyped-call]
    with pytest.raises(TrainingDivergedError, match="factors are not finite"):
        kfac.step()
    assert all(torch.equal(*pair) for pair in zip(net.parameters(), before, strict=True))


def test_a_step_that_is_not_finite_is_an_error_and_changes_no_parameter() -> None:
    log_std = nn.Parameter(torch.zeros(2))
    kfac = KFAC([], [(log_std, 2.0)], lr=1e300)
    log_std.grad = torch.full((2,), 1.0)
    with pytest.raises(TrainingDivergedError, match="step is not finite"):
        kfac.step()
    assert not log_std.any()


def test_predictions_that_are_not_finite_do_not_change_the_factors() -> None:
    net = network(2, 1)
    kfac = KFAC(linear_layers(net))
    x = torch.ones(10, 2)
    observe(kfac, net, x, torch.zeros(10, 1))
    x[0, 0] = math.nan
    with pytest.raises(TrainingDivergedError, match="not finite"):
        observe(kfac, net, x, torch.zeros(10, 1))
    assert all(f.isfinite().all() for f in kfac.state[linear_layers(net)[0].weight].values())


@pytest.mark.parametrize("moved", [math.nan, math.inf, 1.0])
def test_a_step_that_stays_outside_the_trust_region_is_not_made(moved: float) -> None:
    log_std = nn.Parameter(torch.tensor([0.1, 0.2]))
    before = log_std.detach().clone()
    kfac = KFAC([], [(log_std, 2.0)], trust_region=1e-3)
    log_std.grad = torch.ones(2)
    assert kfac.step(lambda: moved) == 0.0
    assert torch.equal(log_std, before)


def test_an_error_during_a_step_undoes_it() -> None:
    log_std = nn.Parameter(torch.tensor([0.1, 0.2]))
    before = log_std.detach().clone()
    kfac = KFAC([], [(log_std, 2.0)])
    log_std.grad = torch.ones(2)

    def interrupted() -> float:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        kfac.step(interrupted)
    assert torch.equal(log_std, before)


def test_a_copy_continues_like_the_original() -> None:
    net = network(2, 1)
    kfac = KFAC(linear_layers(net), damping=0.3, trust_region=0.02)
    net_copy, kfac_copy = copy.deepcopy((net, kfac))
    ends = []
    for each, optimizer in ((net, kfac), (net_copy, kfac_copy)):
        for _ in range(12):
            observe(optimizer, each, torch.ones(10, 2), torch.zeros(10, 1))
            each.zero_grad()
            each(torch.ones(10, 2)).square().mean().backward()
            optimizer.step()
        ends.append(torch.cat([p.detach().flatten() for p in each.parameters()]))
    assert torch.equal(*ends)


def test_factors_are_running_averages() -> None:
    net = network(2, 1)
    kfac = KFAC(linear_layers(net), decay=0.75)
    means = []
    for value in (1.0, 2.0, 3.0, 4.0, 5.0):
        observe(kfac, net, torch.full((10, 2), value), torch.zeros(10, 1))
        kfac.param_groups[0]["updates"] += 1
        means.append(float(kfac.state[linear_layers(net)[0].weight]["A"][0, 0]))
    # A plain mean of the first four, which is the memory of this decay; then the decay.
    assert means[:4] == pytest.approx([1.0, 2.5, 14 / 3, 7.5])
    assert means[4] == pytest.approx(0.75 * 7.5 + 0.25 * 25.0)


def test_its_state_is_saved_and_loaded_with_a_state_dict() -> None:
    net = network(4, 3)
    x = torch.randn(20, 4)

    def update(kfac: KFAC) -> None:
        observe(kfac, net, x, torch.ones(20, 3))
        net.zero_grad()
        net(x).square().mean().backward()
        kfac.step()

    kfac = KFAC(linear_layers(net), cold_updates=1)
    for _ in range(3):
        update(kfac)
    weights = {name: value.clone() for name, value in net.state_dict().items()}
    other = KFAC(linear_layers(net), cold_updates=1)
    other.load_state_dict(kfac.state_dict())
    update(kfac)
    expected = {name: value.clone() for name, value in net.state_dict().items()}
    net.load_state_dict(weights)
    update(other)
    assert all(torch.equal(expected[name], value) for name, value in net.state_dict().items())
