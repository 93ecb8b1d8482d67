"""Registration with Gymnasium, and the imports of gym_mara."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import NameNotFound
from gymnasium.spaces import Box

import gym_mara
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from tests.helpers import ENV_IDS, TASK_NAMES

NOT_NEEDED = (
    "torch",
    "array_api_compat.torch",
    "stable_baselines3",
    "matplotlib",
    "tensorboard",
    "dartpy",
    "fcl",
    "trimesh",
)


def _run(code: str, folder: Path) -> str:
    """Run code in a new Python process outside the repository, with warnings as errors, and return its output."""
    command = [sys.executable, "-W", "error", "-c", code]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_the_ids_are_registered() -> None:
    registered = {name for name in gymnasium.registry if name.startswith("gym_mara/")}
    others = (
        "MARARandomTarget-v0",
        "MARAGoal-v0",
        "MARAReach-v0",
        "MARAPose-v0",
        "MARAReal-v0",
        "MARACamera-v0",
    )
    assert registered == {*ENV_IDS, *(f"gym_mara/{name}" for name in others)}


@pytest.mark.parametrize("name", TASK_NAMES)
def test_make_creates_the_named_task_with_2048_steps(name: str) -> None:
    env = gymnasium.make(f"gym_mara/{name}")
    assert isinstance(env.unwrapped, MaraEnv)
    assert env.spec is not None
    assert env.spec.max_episode_steps == 2048
    assert env.unwrapped.simulation.task == MaraEnv(name).simulation.task


@pytest.mark.parametrize("name", ENV_IDS)
def test_make_vec_creates_the_native_vector_env(name: str) -> None:
    env = gymnasium.make_vec(name, num_envs=4)
    assert type(env) is MaraVectorEnv
    assert env.num_envs == 4
    assert env.max_episode_steps == 2048
    assert env.reset()[0].shape[0] == 4
    assert gymnasium.make_vec(name, num_envs=1, max_episode_steps=5).max_episode_steps == 5  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["MARAReach-v0", "MARAPose-v0"])
def test_the_tasks_for_any_target_have_short_episodes_of_relative_actions(name: str) -> None:
    env, envs = gymnasium.make(f"gym_mara/{name}"), gymnasium.make_vec(f"gym_mara/{name}", 2)
    assert env.spec is not None
    assert env.spec.max_episode_steps == 200
    assert envs.max_episode_steps == 200  # type: ignore[attr-defined]
    assert env.action_space == Box(-1.0, 1.0, (6,), np.float32)


def test_gymnasiums_sync_and_async_vector_envs_work() -> None:
    for mode in ("sync", "async"):
        env = gymnasium.make_vec(ENV_IDS[3], num_envs=2, vectorization_mode=mode)
        env.reset(seed=0)
        observation = env.step(np.full((2, 6), 0.1))[0]
        np.testing.assert_allclose(observation[:, :6], 0.1)
        env.close()


def test_make_with_a_module_prefix_imports_no_unneeded_library(
    tmp_path: Path,
) -> None:
    code = f"""
import json, sys, gymnasium
shapes = []
for name in {ENV_IDS!r}:
    env = gymnasium.make("gym_mara:" + name)
    env.reset()
    shapes.append(env.step(env.action_space.sample())[0].shape[0])
    vector = gymnasium.make_vec("gym_mara:" + name, num_envs=2)
    vector.reset()
    vector.step(vector.action_space.sample())
print(json.dumps([shapes, [m for m in {NOT_NEEDED!r} if m in sys.modules]]))
"""
    assert json.loads(_run(code, tmp_path)) == [[12, 16, 12, 16], []]


def test_importing_the_package_imports_no_environment_code(tmp_path: Path) -> None:
    code = f"""
import json, sys, gym_mara
unneeded = {NOT_NEEDED!r} + ("gym_mara.envs", "gym_mara.agents", "gym_mara.backends.pinocchio")
unneeded += ("pinocchio", "coal", "scipy")
print(json.dumps([m for m in unneeded if m in sys.modules]))
"""
    assert json.loads(_run(code, tmp_path)) == []


def test_importing_the_package_takes_at_most_30_ms_more_than_gymnasium(tmp_path: Path) -> None:
    # The least processor time of several runs, because other processes share the processor.
    code = "import gymnasium, time; t = time.process_time(); import gym_mara; print(time.process_time() - t)"
    assert min(float(_run(code, tmp_path)) for _ in range(5)) <= 0.030


@pytest.mark.parametrize("name", ENV_IDS)
def test_a_spec_keeps_its_options_in_json(name: str) -> None:
    options: dict[str, Any] = {
        "target_position": [-0.4, 0.1, 0.8],
        "start_q": [0.1] * 6,
        "on_collision": "terminate",
        "max_joint_velocity": 1.0,
        "collision": "fcl",
        "robot": "mara",
    }
    env = gymnasium.make(name, max_episode_steps=9, **options)
    assert env.spec is not None
    spec = EnvSpec.from_json(env.spec.to_json())
    assert spec.kwargs | options == spec.kwargs
    restored = gymnasium.make(spec)
    assert restored.spec is not None
    assert restored.spec.max_episode_steps == 9
    np.testing.assert_array_equal(env.reset()[0], restored.reset()[0])
    action = np.full(6, 0.5)
    expected, result = env.step(action), restored.step(action)
    np.testing.assert_array_equal(result[0], expected[0])
    assert result[1:] == expected[1:]


def test_an_unknown_id_raises_gymnasiums_error_with_a_suggestion() -> None:
    with pytest.raises(
        NameNotFound, match=r"`MARRA` doesn't exist in namespace gym_mara. Did you mean"
    ):
        gymnasium.make("gym_mara/MARRA-v0")


def test_make_raises_the_errors_of_invalid_options() -> None:
    with pytest.raises(GymMaraError, match="unknown backend 'gazebo'"):
        gymnasium.make(ENV_IDS[0], backend="gazebo")
    with pytest.raises(GymMaraError, match="num_envs must be a whole number of at least 1, not 0"):
        gymnasium.make_vec(ENV_IDS[0], num_envs=0)


def test_the_package_has_a_version() -> None:
    assert gym_mara.__version__.count(".") == 2
