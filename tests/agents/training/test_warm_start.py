"""A training starts with the policy of another run, and says what differs if that policy does not fit."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gym_mara.agents.algorithms.base import Preset
from gym_mara.agents.runs import load_policy
from gym_mara.agents.runs.config import DamagedRunError, RunConfig
from gym_mara.agents.runs.evaluation import evaluate_run
from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.agents.runs.policy import normalisation, policy_of
from gym_mara.agents.training.train import new_model, preset_of, resume, train
from gym_mara.agents.training.warm_start import begin_with, started_from
from gym_mara.cli.app import run as gym_mara
from gym_mara.errors import GymMaraError
from gym_mara.registration import ENVIRONMENTS, Environment
from gym_mara.tasks import TASKS, ReachTask
from tests.agents.conftest import silent
from tests.agents.training.test_train import assert_same_training

SHORT = "MARAShort-v0"
ARMS, ROLLOUT = 4, 64
TRAVELLING = {"max_joint_velocity": 1.5}
ARGUMENTS: dict[str, dict[str, Any]] = {
    "ppo": {"n_steps": 16, "batch_size": 32},
    "sac": {"learning_starts": 20, "batch_size": 16, "buffer_size": 1000},
}


@pytest.fixture(scope="module", autouse=True)
def _short_episodes() -> Iterator[None]:
    """An environment whose episodes have 30 steps, so that evaluations take little time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TASKS, SHORT, ReachTask())
        patch.setitem(ENVIRONMENTS, SHORT, Environment(SHORT, 30))
        yield


def small(algo: str = "ppo", form: str = "mlp", **changes: Any) -> Preset:
    """A preset with short rollouts; `changes` are arguments of the network."""
    network = {"net_arch": [8], **changes}
    return Preset(ARMS, form, {**ARGUMENTS[algo], "policy_kwargs": network})


def config(**changes: Any) -> RunConfig:
    values: dict[str, Any] = {
        "env": SHORT,
        "algo": "ppo",
        "backend": "pinocchio",
        "steps": 2 * ROLLOUT,
        "seed": 1,
        "checkpoint_every": ROLLOUT,
    }
    return RunConfig(**{**values, **changes})


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run; tests must not change it."""
    return train(config(), tmp_path_factory.mktemp("source") / "run", silent, preset=small())


def observations(count: int) -> Any:
    return np.random.default_rng(0).normal(scale=0.5, size=(count, 12))


# Without changes: the tuned presets for joints that teleport, and then for joints that travel.
@pytest.mark.parametrize("algo", ["ppo", "trpo", "acktr"])
def test_a_tuned_policy_acts_the_same_in_a_run_on_travelling_joints(
    tmp_path: Path, algo: str
) -> None:
    run = train(config(algo=algo, steps=1500, checkpoint_every=1500), tmp_path / "run", silent)
    asked = started_from(run, env_options=TRAVELLING)
    asked = replace(asked, preset=asdict(preset_of(asked)))
    assert asked.preset != run.config.preset
    model = new_model(asked)
    begin_with(model, asked)
    policy, other = policy_of(model), load_policy(run)
    seen = observations(50)
    np.testing.assert_allclose(policy.predict(seen)[0], other.predict(seen)[0], atol=1e-5)
    random = []
    for each in (policy, other):
        torch.manual_seed(0)
        random.append(each.predict(seen, deterministic=False)[0])
    np.testing.assert_allclose(random[0], random[1], atol=1e-5)


@pytest.mark.parametrize("algo", ["sac", "tqc"])
def test_an_off_policy_run_starts_with_the_policy_and_its_entropy_coefficient(
    tmp_path: Path, algo: str
) -> None:
    preset = small("sac", algo)
    run = train(config(algo=algo), tmp_path / "run", silent, preset=preset)
    asked = replace(started_from(run), preset=asdict(preset), seed=7)
    model: Any = new_model(asked)
    untrained = model.log_ent_coef.item()
    begin_with(model, asked)
    seen = observations(50)
    expected = load_policy(run).predict(seen)[0]
    np.testing.assert_array_equal(policy_of(model).predict(seen)[0], expected)
    assert model.log_ent_coef.item() < untrained
    # The replay buffer is filled with its actions, not with random ones.
    model._last_obs = np.zeros((ARMS, 12))
    torch.manual_seed(0)
    chosen, _ = model._sample_action(model.learning_starts, n_envs=ARMS)
    torch.manual_seed(0)
    np.testing.assert_allclose(chosen, model.predict(model._last_obs)[0], atol=1e-6)
    fresh: Any = new_model(replace(asked, start=None))
    assert not fresh.policy_is_trained


def test_a_run_records_where_it_started_and_evaluates_the_policy_first(
    source: RunFolder, tmp_path: Path
) -> None:
    run = train(started_from(source, "best", seed=3), tmp_path / "run", silent, preset=small())
    start = RunFolder.open(run.path).config.start
    assert start is not None
    assert (start.run, start.policy, start.steps) == (str(source.path), "best", 2 * ROLLOUT)
    first = read_progress(run.progress_file)[0]
    assert first["time/total_timesteps"] == 0
    own = evaluate_run(source, episodes=1, which="best")
    assert first["eval/return"] == pytest.approx(own["return"].mean(), rel=1e-6)
    assert [int(p.name) for p in run.checkpoints()] == [0, ROLLOUT, 2 * ROLLOUT]


def test_another_policy_trains_on_from_the_source(source: RunFolder, tmp_path: Path) -> None:
    warm = train(started_from(source), tmp_path / "warm", silent, preset=small())
    cold = train(config(), tmp_path / "cold", silent, preset=small())
    seen = observations(20)
    targets = [load_policy(run).predict(seen)[0] for run in (warm, cold)]
    assert np.abs(targets[0] - targets[1]).max() > 1e-3


@pytest.mark.parametrize("stop", [0, ROLLOUT])
def test_an_interrupted_run_is_resumed_without_the_folder_of_the_source(
    source: RunFolder, tmp_path: Path, stop: int
) -> None:
    shutil.copytree(source.path, tmp_path / "source")
    asked = started_from(RunFolder.open(tmp_path / "source"))
    whole = train(asked, tmp_path / "whole", silent, preset=small())

    class Stop(Exception):  # noqa: N818
        pass

    def interrupt(steps: int, shown: dict[str, float]) -> None:
        if steps > stop:
            raise Stop

    with pytest.raises(Stop):
        train(asked, tmp_path / "run", interrupt, preset=small())
    shutil.rmtree(tmp_path / "source")
    assert_same_training(whole, resume(tmp_path / "run", silent))


def test_a_run_that_ended_before_it_had_stored_its_start_is_not_resumed(
    source: RunFolder, tmp_path: Path
) -> None:
    asked = replace(started_from(source), preset=asdict(small()))
    run = RunFolder.create(tmp_path / "run", asked)
    with pytest.raises(DamagedRunError, match=r"start a new run with --from .*run"):
        resume(run.path, silent)


def test_the_statistics_of_the_observations_are_taken_over(tmp_path: Path) -> None:
    preset = replace(small(), normalise_observation=True)
    run = train(config(), tmp_path / "run", silent, preset=preset)
    asked = replace(started_from(run), preset=asdict(preset))
    model = new_model(asked)
    begin_with(model, asked)
    about = load_policy(run).about.normalisation
    statistics: Any = normalisation(model).obs_rms
    assert about is not None
    np.testing.assert_array_equal(statistics.mean, about.mean)
    assert statistics.count == 2 * ROLLOUT
    seen = observations(20)
    np.testing.assert_array_equal(
        policy_of(model).predict(seen)[0], load_policy(run).predict(seen)[0]
    )


def test_the_options_of_the_source_are_the_defaults(source: RunFolder, tmp_path: Path) -> None:
    options = {**TRAVELLING, "kappa": 0.05}
    run = train(config(env_options=options), tmp_path / "run", silent, preset=small())
    same = started_from(run)
    assert (same.env, same.algo, same.backend) == (SHORT, "ppo", "pinocchio")
    assert options.items() <= same.env_options.items()
    changed = started_from(run, env_options={"kappa": 0.1}, steps=5)
    assert (changed.steps, changed.env_options["kappa"]) == (5, 0.1)
    # A setting of the backend does not follow to another one.
    other = started_from(run, backend="dart")
    assert other.env_options["kappa"] == 0.05
    assert "max_joint_velocity" not in other.env_options


@pytest.mark.parametrize(
    ("changes", "preset", "message"),
    [
        ({"env": "MARAOrient-v0"}, small(), "observes joint_positions.*and the environment has"),
        ({"env": "MARAGoal-v0"}, small(), "observes"),
        ({}, small(form="natural"), "the network is mlp there, natural here"),
        ({}, small(net_arch=[16]), r"net_arch is \[8\] there, \[16\] here"),
        ({}, small(activation_fn="ELU"), "activation_fn is None there, ELU here"),
        ({"algo": "sac"}, small("sac", "sac"), "the network is mlp there, sac here"),
        (
            {},
            replace(small(), normalise_observation=True),
            "normalise_observation is False there, True here",
        ),
        ({"env_options": {"robot": "ur5"}}, small(), r"joints is \['motor1.* here"),
        ({"env_options": {"robot": "panda"}}, small(), "moves 6 joints, and panda has"),
        ({"env_options": {"action": "relative"}}, small(), "its actions are absolute"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused_and_leaves_no_folder(
    source: RunFolder, tmp_path: Path, changes: dict[str, Any], preset: Preset, message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        train(started_from(source, **changes), tmp_path / "run", silent, preset=preset)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("file", ["config.json", "last/model.zip", "last/policy.json"])
def test_a_damaged_source_is_an_error(source: RunFolder, tmp_path: Path, file: str) -> None:
    shutil.copytree(source.path, tmp_path / "source")
    asked = started_from(RunFolder.open(tmp_path / "source"))
    (tmp_path / "source" / file).write_bytes(b"{}")
    with pytest.raises(DamagedRunError, match="damaged"):
        train(asked, tmp_path / "run", silent, preset=small())
    assert not (tmp_path / "run").exists()


def test_an_unfinished_source_has_its_best_policy(source: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(source.path, tmp_path / "source")
    shutil.rmtree(tmp_path / "source" / "last")
    unfinished = RunFolder.open(tmp_path / "source")
    with pytest.raises(GymMaraError, match=r"has no 'last' policy.*--policy best"):
        started_from(unfinished)
    assert started_from(unfinished, "best").start is not None


@pytest.mark.slow
def test_the_command_starts_with_the_policy_of_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = str(tmp_path / "first"), str(tmp_path / "second")
    steps = ["--steps", "512", "--checkpoint-every", "512"]
    options = ["--algo", "trpo", "--env", SHORT, "--set", "kappa=0.05"]
    assert gym_mara(["train", *options, *steps, "--out", first]) == 0
    changes = ["--from", first, "--from-policy", "best", "--set", "max_joint_velocity=1.5"]
    assert gym_mara(["train", *changes, "--steps", "4096", "--out", second]) == 0
    about = RunFolder.open(Path(second)).config
    assert (about.algo, about.env, about.seed) == ("trpo", SHORT, 0)
    assert about.env_options["kappa"] == 0.05
    assert about.start is not None
    assert about.start.policy == "best"
    capsys.readouterr()
    assert gym_mara(["train", "--from", first, "--preset", "paper"]) == 2
    assert "the network is natural there, mlp here" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--from", "nowhere"], "not a run folder"),
        (["--from-policy", "best"], "without --from it has no effect: leave out --from-policy"),
        (["--resume", "a", "--from", "b"], "--resume uses the options of the run.* --from"),
    ],
)
def test_wrong_options_are_an_error(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert gym_mara(["train", *arguments]) == 2
    text = " ".join(capsys.readouterr().err.split())
    assert message.split(".*")[0] in text
