"""The registry of algorithms: what each entry must hold, and that one more entry is all that a new algorithm needs."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.spaces import Box
from stable_baselines3 import A2C
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from torch import nn

from gym_mara.agents.algorithms.base import (
    POLICY_FORMS,
    Algorithm,
    LogRange,
    Preset,
    Presets,
    SearchSpace,
    is_schedule,
    policy_class,
)
from gym_mara.agents.algorithms.registry import (
    ALGORITHMS,
    DEFAULT_ALGORITHM,
    DEFAULT_PRESET,
    algorithm,
    preset_names,
)
from gym_mara.agents.experiments.figures import plot_grid
from gym_mara.agents.experiments.grid import Grid, open_grid, run_one
from gym_mara.agents.experiments.search import Search, best_trial, open_study, run_trials
from gym_mara.agents.runs.evaluation import evaluate_run, make_env
from gym_mara.agents.runs.folder import RunConfig, RunFolder
from gym_mara.agents.runs.policy import make_network
from gym_mara.agents.scaling import unit_box
from gym_mara.agents.training.train import new_agent, preset_of, train
from gym_mara.errors import GymMaraError
from gym_mara.tasks import TASKS, ReachTask
from tests.agents.conftest import silent

A2C_ENTRY = Algorithm(
    name="a2c",
    summary="advantage actor-critic, from Stable-Baselines3",
    target="stable_baselines3:A2C",
    presets={
        "tuned": Presets(
            teleporting=Preset(
                num_envs=16,
                arguments={"n_steps": 4, "gamma": 0.0, "learning_rate": ((0.0, 1e-3), (1.0, 0.0))},
            ),
            travelling=Preset(num_envs=8, arguments={"n_steps": 8}),
        )
    },
    search_space=SearchSpace(
        arguments={"n_steps": [2, 4], "learning_rate": LogRange(1e-4, 1e-2)},
        policy_kwargs={"log_std_init": [-2.0, -1.0]},
    ),
)


@pytest.fixture
def a2c(monkeypatch: pytest.MonkeyPatch) -> Algorithm:
    """An algorithm that is registered for one test."""
    monkeypatch.setitem(ALGORITHMS, "a2c", A2C_ENTRY)
    return A2C_ENTRY


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_entry_is_complete(name: str) -> None:
    entry = algorithm(name)
    assert entry.name == name
    assert entry.summary
    assert DEFAULT_PRESET in entry.presets
    assert issubclass(entry.load_class(), (OnPolicyAlgorithm, OffPolicyAlgorithm))


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_range_of_a_search_space_contains_the_tuned_value(name: str) -> None:
    entry = algorithm(name)
    preset = entry.preset("tuned", teleports=True)
    given = {**preset.arguments, **preset.arguments["policy_kwargs"]}
    space = entry.search_space
    for key, values in {**space.arguments, **space.policy_kwargs}.items():
        if key in given:
            value = given[key][0][1] if is_schedule(given[key]) else given[key]
            inside = (
                values.low <= value <= values.high
                if isinstance(values, LogRange)
                else value in values
            )
            assert inside, key


@pytest.mark.parametrize("form", POLICY_FORMS)
def test_a_policy_form_names_a_class(form: str) -> None:
    assert policy_class(form).__name__ == POLICY_FORMS[form].partition(":")[2]


def test_unknown_names_are_errors_that_list_the_known_ones() -> None:
    with pytest.raises(GymMaraError, match=r"unknown algorithm 'pop'\. Did you mean 'ppo'"):
        algorithm("pop")
    with pytest.raises(
        GymMaraError, match=r"unknown preset 'papers' of the algorithm 'ppo'.*tuned"
    ):
        algorithm("ppo").preset("papers", teleports=True)
    with pytest.raises(GymMaraError, match="unknown policy 'mpl'"):
        policy_class("mpl")


def test_the_defaults_are_registered() -> None:
    assert DEFAULT_PRESET in algorithm(DEFAULT_ALGORITHM).presets
    assert preset_names() == ["tuned", "paper", "robust"]


def test_there_is_a_preset_for_each_way_of_moving(a2c: Algorithm) -> None:
    assert a2c.preset("tuned", teleports=True).num_envs == 16
    assert a2c.preset("tuned", teleports=False).num_envs == 8


@pytest.mark.parametrize("family", ["", "any_target"])
def test_a_policy_of_the_preset_tuned_is_trained_further_with_the_preset_robust(
    family: str,
) -> None:
    for teleports in (False, True):
        tuned, robust = (
            algorithm("ppo").preset(name, teleports=teleports, family=family)
            for name in ("tuned", "robust")
        )
        assert robust.arguments["policy_kwargs"] == tuned.arguments["policy_kwargs"]
        assert robust.arguments["learning_rate"][0][1] == pytest.approx(
            0.1 * tuned.arguments["learning_rate"][0][1]
        )


@dataclass(frozen=True)
class TouchTask(ReachTask):
    """A task of a family that has presets of its own."""

    preset_family: ClassVar[str] = "touch"


@pytest.mark.parametrize("options", [{}, {"max_joint_velocity": 1.0}])
def test_a_family_of_tasks_has_its_own_preset_on_every_backend(
    monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]
) -> None:
    presets = A2C_ENTRY.presets["tuned"]
    own = Preset(num_envs=4)
    entry = replace(A2C_ENTRY, presets={"tuned": presets._replace(families={"touch": own})})
    monkeypatch.setitem(ALGORITHMS, "a2c", entry)
    monkeypatch.setitem(TASKS, "MARATouch-v0", TouchTask())
    assert preset_of(config(env="MARATouch-v0", env_options=options)) is own
    assert preset_of(config(env_options=options)) in presets[:2]


@pytest.mark.parametrize("action", ["absolute", "relative", "cartesian"])
def test_only_joint_targets_get_the_preset_of_joints_that_teleport(action: str) -> None:
    teleporting, travelling, _ = algorithm("ppo").presets["tuned"]
    chosen = preset_of(config(algo="ppo", env_options={"action": action}))
    assert chosen is (teleporting if action == "absolute" else travelling)
    assert preset_of(config(algo="ppo", env="MARAReach-v0")).arguments["gamma"] > 0.0


@pytest.mark.usefixtures("a2c")
def test_a_family_without_its_own_preset_has_that_of_the_backend(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(TASKS, "MARATouch-v0", TouchTask())
    assert preset_of(config(env="MARATouch-v0")) is A2C_ENTRY.presets["tuned"].teleporting


def test_a_changed_preset_of_a_family_is_another_grid(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    grid = Grid(envs=("MARA-v0",), algos=("a2c",), seeds=1, steps=256)
    for arms in (4, 8):
        presets = A2C_ENTRY.presets["tuned"]._replace(families={"touch": Preset(num_envs=arms)})
        monkeypatch.setitem(ALGORITHMS, "a2c", replace(A2C_ENTRY, presets={"tuned": presets}))
        if arms == 4:
            open_grid(tmp_path / "grid", grid)
    with pytest.raises(GymMaraError, match="the 'tuned' presets have changed"):
        open_grid(tmp_path / "grid", grid)


@pytest.mark.parametrize(("given", "gamma"), [({"gamma": 0.0}, 0.0), ({}, 0.99)])
def test_rewards_are_normalised_with_the_discount_factor_of_the_preset(
    given: dict[str, float], gamma: float
) -> None:
    preset = Preset(num_envs=2, normalise_reward=True, arguments={"n_steps": 32, **given})
    model = new_agent("ppo", preset, make_env("MARA-v0", "pinocchio", 2, {}), seed=0)
    wrapped = model.get_vec_normalize_env()
    assert wrapped is not None
    assert wrapped.gamma == model.gamma == gamma  # type: ignore[attr-defined]


@pytest.mark.parametrize("form", ["mlp", "natural"])
def test_a_preset_names_the_activation_function(form: str) -> None:
    arguments = {"policy_kwargs": {"activation_fn": "ELU"}}
    preset = Preset(num_envs=1, policy=form, arguments=arguments)
    network = make_network(preset, Box(-1.0, 1.0, (3,)), unit_box(2))
    kinds = {type(module) for module in network.modules()}
    assert nn.ELU in kinds
    assert nn.Tanh not in kinds
    with pytest.raises(GymMaraError, match=r"unknown activation function 'Elu'.*ELU"):
        Preset(num_envs=1, arguments={"policy_kwargs": {"activation_fn": "Elu"}})


def ignore(message: Any) -> None:
    """Messages of a job go nowhere."""


def config(**changes: Any) -> RunConfig:
    values = {"env": "MARA-v0", "algo": "a2c", "backend": "pinocchio", "steps": 256, "seed": 0}
    return RunConfig(**{**values, **changes})


@pytest.mark.slow
@pytest.mark.usefixtures("a2c")
def test_a_registered_algorithm_trains_and_is_evaluated(tmp_path: Path) -> None:
    run = train(config(), tmp_path / "run", silent)
    again = RunFolder.open(run.path)
    assert again.config.preset["arguments"]["n_steps"] == 4
    assert np.isfinite(evaluate_run(again, episodes=1)["return"]).all()
    travelling = {"max_joint_velocity": 1.0}
    run = train(config(env_options=travelling), tmp_path / "travelling", silent)
    assert run.config.preset["arguments"]["n_steps"] == 8


@pytest.mark.slow
@pytest.mark.usefixtures("a2c")
def test_a_registered_algorithm_has_its_place_in_a_grid(tmp_path: Path) -> None:
    grid = Grid(envs=("MARA-v0",), algos=("a2c",), seeds=1, steps=256, checkpoint_every=128)
    open_grid(tmp_path / "grid", grid)
    for name, run in grid.runs().items():
        run_one(tmp_path / "grid" / name, run, ignore)
    plot_grid(tmp_path / "grid")
    assert "| MARA-v0 | A2C | 1 |" in (tmp_path / "grid" / "table.md").read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("a2c")
def test_a_registered_algorithm_is_searched(tmp_path: Path) -> None:
    search = Search(env="MARA-v0", algo="a2c", steps=128, trials=2, seeds=1)
    run_trials(search, tmp_path, ignore)
    study = open_study(search, tmp_path)
    first = study.trials[0].params
    assert first.keys() == {"n_steps", "learning_rate", "log_std_init"}
    assert (first["n_steps"], first["learning_rate"]) == (4, 1e-3)
    assert best_trial(study) is not None


def test_the_registry_and_the_command_line_import_no_torch() -> None:
    code = "import sys, gym_mara.agents.algorithms.registry, gym_mara.cli; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_a2c_is_loaded_from_its_module(a2c: Algorithm) -> None:
    assert a2c.load_class() is A2C
