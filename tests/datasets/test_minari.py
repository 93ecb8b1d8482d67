"""Data sets of Minari, read by Minari."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest

from gym_mara.agents.runs.folder import RunConfig
from gym_mara.agents.training.train import train
from gym_mara.datasets.playing import record
from gym_mara.datasets.sources import baseline
from gym_mara.errors import GymMaraError
from gym_mara.registration import ENVIRONMENTS
from tests.helpers import Cli

LENGTH = 4


@pytest.fixture(autouse=True)
def _prepared(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    for name in ("MARA-v0", "MARAReach-v0", "MARAGoal-v0"):
        short = ENVIRONMENTS[name]._replace(max_episode_steps=LENGTH)
        monkeypatch.setitem(ENVIRONMENTS, name, short)


def test_minari_loads_what_the_command_has_recorded(gym_mara: Cli, tmp_path: Path) -> None:
    call = "record --policy ik --env MARAReach-v0 --set guide=true --episodes 2 --format minari"
    code, printed, error = gym_mara(*call.split(), "--out", str(tmp_path / "reach-v0"))
    assert (code, error) == (0, "")
    assert f"reach-v0: 2 episodes of MARAReach-v0, {2 * LENGTH} steps" in " ".join(printed.split())
    data = minari.load_dataset("reach-v0")
    assert list(minari.list_local_datasets()) == ["reach-v0"]
    assert (data.total_episodes, data.total_steps) == (2, 2 * LENGTH)
    env = data.recover_environment()
    assert env.observation_space == data.observation_space
    assert env.action_space == data.action_space
    [episode, _] = data.iterate_episodes()
    [about, _] = data.storage.get_episode_metadata([0, 1])
    seen, _ = env.reset(seed=about["seed"])
    for step in range(LENGTH):
        np.testing.assert_allclose(seen, episode.observations[step], atol=1e-4)
        seen, reward, terminated, truncated, info = env.step(episode.actions[step])
        assert reward == pytest.approx(episode.rewards[step], abs=1e-4)
        assert (terminated, truncated) == (
            episode.terminations[step],
            episode.truncations[step],
        )
        assert info["success"] == episode.infos["success"][step + 1]
    env.close()


@pytest.mark.parametrize("name", ["MARA-v0", "MARAGoal-v0"])
def test_pictures_are_a_key_of_the_observation(tmp_path: Path, name: str) -> None:
    source = baseline("ik", name, "pinocchio", {"max_joint_velocity": 1.5})
    record(source, "minari", tmp_path / "pictures-v0", episodes=1, pixels=64)
    data = minari.load_dataset("pictures-v0")
    env = data.recover_environment()
    assert env.observation_space == data.observation_space
    [episode] = data.iterate_episodes()
    [about] = data.storage.get_episode_metadata([0])
    seen, _ = env.reset(seed=about["seed"])
    env.close()
    assert seen.keys() == episode.observations.keys()
    for key, values in seen.items():
        stored = episode.observations[key][0]
        if key == "pixels":  # Minari stores them as JPEG
            assert np.abs(values.astype(float) - stored).mean() < 8.0
        else:
            np.testing.assert_allclose(values, stored, atol=1e-9)


def test_a_run_is_recorded_with_its_own_environment(gym_mara: Cli, tmp_path: Path) -> None:
    options = {"max_joint_velocity": 1.5}
    config = RunConfig("MARA-v0", "ppo", "pinocchio", 512, 0, env_options=options)
    train(config, tmp_path / "run", lambda *_: None)
    call = ["record", "--policy", str(tmp_path / "run"), "--episodes", "1"]
    assert gym_mara(*call, "--out", str(tmp_path / "mine-v3"))[0] == 0
    data: Any = minari.load_dataset("mine-v3")
    assert data.env_spec.id == "gym_mara/MARA-v0"
    assert data.env_spec.kwargs["max_joint_velocity"] == 1.5
    assert data.storage.metadata["algorithm_name"] == "ppo of a run"
    other = "--out", str(tmp_path / "ur5-v0"), "--set", "robot=ur5"
    assert gym_mara(*call, *other)[0] == 0
    assert (
        minari.load_dataset("ur5-v0").recover_environment().unwrapped.simulation.robot.name == "ur5"
    )


def test_an_exported_policy_is_recorded(gym_mara: Cli, tmp_path: Path) -> None:
    call = "record --policy pretrained --env MARAReach-v0 --episodes 1"
    assert gym_mara(*call.split(), "--out", str(tmp_path / "pretrained-v0"))[0] == 0
    data: Any = minari.load_dataset("pretrained-v0")
    assert data.env_spec.kwargs["guide"] is True
    assert data.storage.metadata["algorithm_name"] == "MARAReach-v0.onnx"


@pytest.mark.parametrize("name", ["reach", "reach.v0", "reach-v", "re ach-v0", "-v0"])
def test_a_folder_that_minari_cannot_name_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(GymMaraError, match=r"no name for one: .*such as reach-v0"):
        record(baseline("ik", "MARA-v0", "pinocchio", {}), "minari", tmp_path / name, episodes=1)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_up_leaves_nothing(tmp_path: Path, small_files: None) -> None:
    source = baseline("ik", "MARA-v0", "pinocchio", {})
    with pytest.raises(GymMaraError, match=r"cannot write .*reach-v0'"):
        record(source, "minari", tmp_path / "reach-v0", episodes=1)
    assert list(tmp_path.iterdir()) == []
