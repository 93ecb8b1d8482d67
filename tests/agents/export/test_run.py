"""`gym-mara export` writes a run's policy, with all that a robot's program must know, or nothing."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector.utils import batch_space
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from gym_mara import __version__
from gym_mara.agents.export.run import export
from gym_mara.agents.runs import load_policy
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.training.train import train
from gym_mara.deploy import OnnxPolicy
from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError
from tests.agents.conftest import ROLLOUT, config, silent
from tests.helpers import Cli, joint_xml, urdf_xml, write


@pytest.fixture(scope="module")
def exported(finished_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> OnnxPolicy:
    """The policy of the finished run; tests must not change it."""
    file = tmp_path_factory.mktemp("exported") / "policy.onnx"
    export(finished_run, file)
    return OnnxPolicy(file)


def check_parity(run: RunFolder, file: Path, count: int) -> None:
    """Compare an exported policy with that of the run, on random observations from everywhere in the space."""
    about = export(run, file)
    own, policy = OnnxPolicy(file), load_policy(run)
    assert own.about == about
    options = run.config.env_options
    env = gymnasium.make(f"gym_mara/{run.config.env}", backend=run.config.backend, **options)
    own.check(env)
    space = batch_space(env.observation_space, count)
    space.seed(0)
    observed = space.sample()
    action, wanted = own.predict(observed)[0], policy.predict(observed)[0]  # type: ignore[arg-type]
    np.testing.assert_allclose(action, wanted, rtol=0.0, atol=1e-5)
    assert action.dtype == wanted.dtype
    one, _ = env.reset(seed=0)
    np.testing.assert_allclose(own.predict(one)[0], policy.predict(one)[0], rtol=0.0, atol=1e-5)
    env.close()


TRAVELLING: dict[str, Any] = {"env_options": {"max_joint_velocity": 1.57}}


@pytest.mark.parametrize(
    "changes",
    [
        {"env": "MARAGoal-v0"},
        {"algo": "trpo"},
        {"algo": "acktr", "env": "MARARandomTarget-v0", **TRAVELLING},
        {"preset_name": "paper"},
    ],
    ids=lambda changes: "-".join(str(v) for v in changes.values() if isinstance(v, str)),
)
def test_it_acts_as_the_policy(tmp_path: Path, changes: dict[str, Any]) -> None:
    run = train(config(steps=ROLLOUT, **changes), tmp_path / "run", silent)
    check_parity(run, tmp_path / "policy.onnx", 500)


def test_it_acts_as_the_policy_on_10_000_observations(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    check_parity(finished_run, tmp_path / "policy.onnx", 10_000)


def test_a_policy_of_joint_steps_gives_the_targets_of_the_environment(tmp_path: Path) -> None:
    options: dict[str, Any] = {"max_joint_velocity": 1.57, "start": "home"}
    changes: dict[str, Any] = {"env": "MARAReach-v0", "env_options": options}
    run = train(config(steps=ROLLOUT, **changes), tmp_path / "run", silent)
    check_parity(run, tmp_path / "policy.onnx", 500)
    policy = OnnxPolicy(tmp_path / "policy.onnx")
    env = MaraEnv("MARAReach-v0", **options)
    observation, _ = env.reset(seed=0)
    for _ in range(30):
        action, q = policy.predict(observation)[0], env.simulation.backend.state.q[0]
        pace = env.simulation.observation.split(observation)["pace"]
        targets = policy.targets(action, q, pace=pace)
        np.testing.assert_allclose(targets, env.simulation.actions.targets(action[None])[0])
        observation, *_ = env.step(action.astype(np.float32))
        # Joints reach the targets of their steps within the period.
        np.testing.assert_allclose(env.simulation.backend.state.q[0], targets, atol=1e-7)


def test_evaluate_policy_of_stable_baselines3_takes_it(
    finished_run: RunFolder, exported: OnnxPolicy
) -> None:
    env = Monitor(gymnasium.make("gym_mara/MARACollisionOrient-v0", max_episode_steps=20))
    both = (
        evaluate_policy(policy, env, n_eval_episodes=1)[0]  # type: ignore[arg-type]
        for policy in (exported, load_policy(finished_run))
    )
    assert next(both) == pytest.approx(next(both), rel=1e-6)


def test_the_metadata_tell_where_the_policy_comes_from(exported: OnnxPolicy) -> None:
    about = exported.about
    assert (about.env, about.target, about.gym_mara) == (
        "MARACollisionOrient-v0",
        "pose",
        __version__,
    )
    training = about.training
    assert (training.algorithm, training.preset, training.backend, training.policy) == (
        "ppo",
        "tuned",
        "pinocchio",
        "last",
    )
    assert (training.steps, training.seed) == (3 * ROLLOUT, 5)
    assert about.action.mode == "absolute"
    assert about.action.high == pytest.approx((np.pi,) * 6)
    assert about.layout == (
        "joint_positions (6), position_error (3), orientation_error (4), tool_velocity (3)"
    )


def test_the_best_policy_is_another_file(finished_run: RunFolder, tmp_path: Path) -> None:
    run = RunFolder(shutil.copytree(finished_run.path, tmp_path / "run"), finished_run.config)
    text = run.progress_file.read_text()
    titles = text.splitlines()[0].split(",")
    row = {"time/total_timesteps": ROLLOUT, "eval/reward_per_step": 10.0}
    added = ",".join(str(row.get(title, "")) for title in titles)
    run.progress_file.write_text(f"{text}{added}\n")
    about = export(run, tmp_path / "best.onnx", which="best")
    assert (about.training.policy, about.training.steps) == ("best", ROLLOUT)
    assert RunFolder(run.path, run.config).policy_steps("last") == 3 * ROLLOUT


def test_paths_of_the_machine_are_not_exported(tmp_path: Path) -> None:
    robot = write(tmp_path / "arm.urdf", urdf_xml(*map(joint_xml, range(3))))
    options = {"robot": str(robot), "ee_frame": "link3", "package_dirs": [str(tmp_path)]}
    asked = config(env="MARA-v0", env_options=options, steps=ROLLOUT)
    run = train(asked, tmp_path / "run", silent)
    about = export(run, tmp_path / "policy.onnx")
    assert about.training.env_options["robot"] == "arm.urdf"
    assert str(tmp_path).encode() not in (tmp_path / "policy.onnx").read_bytes()


# What is refused.


@pytest.mark.parametrize("name", ["policy", "policy.pt", "policy.ONNX"])
def test_another_ending_is_refused(finished_run: RunFolder, tmp_path: Path, name: str) -> None:
    with pytest.raises(GymMaraError, match=r"the name must end in \.onnx"):
        export(finished_run, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_an_existing_file_is_not_overwritten(finished_run: RunFolder, tmp_path: Path) -> None:
    file = write(tmp_path / "policy.onnx", "old")
    with pytest.raises(GymMaraError, match="exists and is not overwritten"):
        export(finished_run, file)
    assert file.read_text() == "old"


@pytest.mark.usefixtures("small_files")
def test_a_file_that_cannot_be_written_leaves_nothing(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    with pytest.raises(GymMaraError, match="cannot write"):
        export(finished_run, tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def changed(run: RunFolder, path: Path, **changes: Any) -> RunFolder:
    """A copy of a run with another policy.json."""
    shutil.copytree(run.path, path)
    file = path / "last" / "policy.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    return RunFolder.open(path)


def test_a_robot_that_has_changed_is_refused(finished_run: RunFolder, tmp_path: Path) -> None:
    run = changed(finished_run, tmp_path / "run", robot="0")
    with pytest.raises(GymMaraError, match="has changed since the training"):
        export(run, tmp_path / "policy.onnx")
    assert not (tmp_path / "policy.onnx").exists()


def test_a_policy_that_acts_otherwise_is_refused(
    finished_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gym_mara.agents.algorithms.natural_gaussian import NaturalGaussian

    monkeypatch.setattr(NaturalGaussian, "mode", lambda own: own.centre + own.mean)
    with pytest.raises(GymMaraError, match="does not act as its layers do"):
        export(finished_run, tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def test_the_command(finished_run: RunFolder, tmp_path: Path, gym_mara: Cli) -> None:
    file = tmp_path / "policy.onnx"
    code, out, _ = gym_mara("export", finished_run.path, file, "--policy", "best")
    assert (code, out) == (0, f"{file}: absolute actions for mara\n")
    assert OnnxPolicy(file).about.training.policy == "best"
    code, _, error = gym_mara("export", finished_run.path, file)
    assert code == 2
    assert "exists and is not overwritten" in error
    code, _, error = gym_mara("export", tmp_path, tmp_path / "other.onnx")
    assert code == 2
    assert "is not a run folder" in error


def test_a_policy_is_exported_where_onnxruntime_is_not_installed_and_played_nowhere_without_it(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    program = f"""
import sys
from pathlib import Path

sys.modules["onnxruntime"] = None
from gym_mara.agents.export.run import export
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.deploy import OnnxPolicy

export(RunFolder.open(Path({str(finished_run.path)!r})), Path("policy.onnx"))
OnnxPolicy("policy.onnx")
"""
    result = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True
    )
    assert (tmp_path / "policy.onnx").is_file(), result.stderr
    assert "MissingExtraError: an exported policy needs onnxruntime" in result.stderr
