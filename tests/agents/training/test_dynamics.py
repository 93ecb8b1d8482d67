"""Agents on the backends with dynamics: training, resuming, and the transfer of a policy to other backends."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.agents.algorithms.base import Preset
from gym_mara.agents.inspection.transfer import transfer
from gym_mara.agents.runs import load_policy
from gym_mara.agents.runs.evaluation import evaluate_run, make_env
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.training.callbacks import OnProgress
from gym_mara.agents.training.train import resume, train
from gym_mara.backends.processes import WorkerDiedError
from gym_mara.backends.registry import backend_class
from gym_mara.backends.workers import WorkerBackend
from gym_mara.errors import GymMaraError
from tests.agents.conftest import config, silent
from tests.agents.training.test_train import assert_same_training

pytestmark = pytest.mark.slow

ROLLOUT = 16 * 32
GOAL = "MARAGoal-v0"
"""The environment with the shortest episodes."""
DENSE: dict[str, Any] = {"reward_type": "dense"}
SMALL = Preset(num_envs=16, policy="natural", arguments={"n_steps": 32, "batch_size": 128})


def _train(
    out: Path, on_progress: OnProgress = silent, updates: int = 2, backend: str = "dart"
) -> RunFolder:
    """A run with random parameters and few arms."""
    options = {"randomisation": {"mass": [0.9, 1.1], "sensor_noise": [0.0, 1e-3]}}
    about: dict[str, Any] = {"env": GOAL, "backend": backend, "env_options": DENSE | options}
    about |= {"steps": updates * ROLLOUT, "checkpoint_every": ROLLOUT}
    return train(config(**about), out, on_progress, preset=SMALL)


@pytest.fixture(scope="module")
def dynamic_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run; tests must not change it."""
    return _train(tmp_path_factory.mktemp("dynamic") / "run")


@pytest.mark.parametrize("backend", ["dart", "mujoco"])
def test_an_interrupted_run_is_resumed_with_the_same_result(
    dynamic_run: RunFolder, tmp_path: Path, backend: str
) -> None:
    whole = dynamic_run
    if backend != whole.config.backend:
        whole = _train(tmp_path / "whole", backend=backend)

    def interrupt(steps: int, shown: dict[str, float]) -> None:
        if steps > ROLLOUT:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        _train(tmp_path / "run", interrupt, backend=backend)
    assert_same_training(whole, resume(tmp_path / "run", silent))


def test_a_run_is_resumed_after_a_worker_has_died(
    dynamic_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[WorkerBackend] = []
    original = WorkerBackend.__init__

    def remember(self: WorkerBackend, *arguments: Any) -> None:
        original(self, *arguments)
        made.append(self)

    def kill(steps: int, shown: dict[str, float]) -> None:
        if steps > ROLLOUT:
            made[0].processes[0].kill()

    monkeypatch.setattr(WorkerBackend, "__init__", remember)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1}, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cores: None, raising=False)
    with pytest.raises(WorkerDiedError):
        _train(tmp_path / "run", kill, updates=3)
    run = RunFolder.open(tmp_path / "run")
    assert [int(folder.name) for folder in run.checkpoints()] == [ROLLOUT]
    assert resume(tmp_path / "run", silent).has_policy("last")


def test_warp_trains_with_stable_baselines3(tmp_path: Path) -> None:
    about: dict[str, Any] = {"env": GOAL, "backend": "warp", "steps": 64}
    options = DENSE | {"device": "cpu", "physics_step": 0.01}
    few = Preset(num_envs=4, policy="natural", arguments={"n_steps": 16, "batch_size": 64})
    run = train(config(**about, env_options=options), tmp_path / "run", silent, preset=few)
    played = evaluate_run(run, episodes=1)["position_error_mm"]
    row, _ = transfer(run, backends=["warp"], options={"device": "cpu", "physics_step": 0.01})
    np.testing.assert_allclose(row.metrics["position_error_mm"], played, rtol=1e-3)
    assert row.metrics["highest_torque"] > 0.0


def test_without_a_gpu_warp_says_so_before_a_folder_is_made(tmp_path: Path) -> None:
    try:
        backend_class("warp").require_machine()
        pytest.skip("there is a GPU")
    except GymMaraError:
        pass
    with pytest.raises(GymMaraError, match="no GPU of NVIDIA"):
        train(config(backend="warp"), tmp_path / "run", silent)
    assert not (tmp_path / "run").exists()


def test_a_policy_plays_on_another_backend(finished_run: RunFolder, dynamic_run: RunFolder) -> None:
    for run, backend in ((finished_run, "dart"), (dynamic_run, "pinocchio")):
        metrics = evaluate_run(run, backend=backend, episodes=1)
        assert all(np.isfinite(metrics[name]).all() for name in ("return", "position_error_mm"))


def test_transfer_plays_a_policy_on_every_backend(dynamic_run: RunFolder) -> None:
    options = {"randomisation": {"mass": (0.5, 1.5)}}
    rows = transfer(dynamic_run, backends=["dart", "pinocchio"], episodes=2, options=options)
    for row in rows:
        assert all(values.shape == (2,) for values in row.metrics.values())
        assert np.isfinite(row.metrics["position_error_mm"]).all()
    _, dynamic, teleport, _ = (row.metrics for row in rows)
    torque = dynamic["highest_torque"]
    assert ((torque > 0.0) & (torque <= 1.01)).all()
    assert torque[0] != torque[1]
    assert (dynamic["highest_velocity"] > 0.1).all()
    assert np.isnan(teleport["highest_torque"]).all()
    assert np.isnan(teleport["highest_velocity"]).all()
    played = evaluate_run(dynamic_run, backend="pinocchio", episodes=2)
    for name, values in played.items():
        np.testing.assert_array_equal(teleport[name], values, err_msg=name)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes": 0}, "episodes must be a whole number of at least 1"),
        ({"options": {"colour": 1}}, "unknown keyword argument 'colour' on any of"),
        ({"which": "worst"}, "unknown policy"),
    ],
)
def test_wrong_arguments_of_a_transfer_are_an_error(
    dynamic_run: RunFolder, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        transfer(dynamic_run, **({"backends": ["dart"]} | arguments))


def test_a_policy_with_other_spaces_is_refused(dynamic_run: RunFolder) -> None:
    simulation = make_env("MARAOrient-v0", "pinocchio", 1, {}).env.simulation
    with pytest.raises(GymMaraError, match="does not fit the environment"):
        load_policy(dynamic_run).check(simulation)
