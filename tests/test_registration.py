"""Registration with Gymnasium, and what importing gym_mara brings along."""

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

import gym_mara
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from tests.helpers import ENV_IDS, TASK_NAMES

NOT_NEEDED = ("torch", "stable_baselines3", "matplotlib", "tensorboard", "dartpy", "fcl", "trimesh")


def _run(code: str, folder: Path) -> str:
    """The output of a Python of its own, away from the checkout; warnings are errors there too."""
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_ids_are_registered() -> None:
    registered = {name for name in gymnasium.registry if name.startswith("gym_mara/")}
    assert registered == {*ENV_IDS, "gym_mara/MARARandomTarget-v0", "gym_mara/MARAGoal-v0"}


@pytest.mark.parametrize("name", TASK_NAMES)
def test_make_gives_the_task_of_the_id_and_2048_steps(name: str) -> None:
    env = gymnasium.make(f"gym_mara/{name}")
    assert isinstance(env.unwrapped, MaraEnv)
    assert env.spec is not None
    assert env.spec.max_episode_steps == 2048
    assert env.unwrapped.simulation.task == MaraEnv(name).simulation.task


@pytest.mark.parametrize("name", ENV_IDS)
def test_make_vec_gives_the_native_vector_env(name: str) -> None:
    env = gymnasium.make_vec(name, num_envs=4)
    assert type(env) is MaraVectorEnv
    assert env.num_envs == 4
    assert env.max_episode_steps == 2048
    assert env.reset()[0].shape[0] == 4
    assert gymnasium.make_vec(name, num_envs=1, max_episode_steps=5).max_episode_steps == 5  # type: ignore[attr-defined]


def test_gymnasiums_own_vectorisations_work() -> None:
    for mode in ("sync", "async"):
        env = gymnasium.make_vec(ENV_IDS[3], num_envs=2, vectorization_mode=mode)
        env.reset(seed=0)
        observation = env.step(np.full((2, 6), 0.1))[0]
        np.testing.assert_allclose(observation[:, :6], 0.1)
        env.close()


def test_every_id_is_made_by_its_prefix_without_an_import_and_without_what_it_does_not_need(
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


def test_importing_the_package_costs_at_most_30_ms_more_than_gymnasium(tmp_path: Path) -> None:
    # Of processor time, the least of several: other processes are at work here.
    code = "import gymnasium, time; t = time.process_time(); import gym_mara; print(time.process_time() - t)"
    assert min(float(_run(code, tmp_path)) for _ in range(5)) <= 0.030


@pytest.mark.parametrize("name", ENV_IDS)
def test_a_spec_goes_through_json_with_its_options(name: str) -> None:
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
    again = gymnasium.make(spec)
    assert again.spec is not None
    assert again.spec.max_episode_steps == 9
    np.testing.assert_array_equal(env.reset()[0], again.reset()[0])
    action = np.full(6, 0.5)
    mine, other = env.step(action), again.step(action)
    np.testing.assert_array_equal(mine[0], other[0])
    assert mine[1:] == other[1:]


def test_an_unknown_id_is_gymnasiums_own_error_with_the_nearest_one() -> None:
    with pytest.raises(
        NameNotFound, match=r"`MARRA` doesn't exist in namespace gym_mara. Did you mean"
    ):
        gymnasium.make("gym_mara/MARRA-v0")


def test_wrong_options_come_through_make() -> None:
    with pytest.raises(GymMaraError, match="unknown backend 'gazebo'"):
        gymnasium.make(ENV_IDS[0], backend="gazebo")
    with pytest.raises(GymMaraError, match="num_envs must be a whole number of at least 1, not 0"):
        gymnasium.make_vec(ENV_IDS[0], num_envs=0)


def test_the_package_says_its_version() -> None:
    assert gym_mara.__version__.count(".") == 2
