"""The recording of data sets: complete episodes of what acts, and whole folders or none."""

from __future__ import annotations

import errno
import itertools
import os
import subprocess
import sys
import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.agents.evaluation.baselines import evaluate_baseline
from gym_mara.agents.evaluation.episodes import episode_seeds
from gym_mara.agents.evaluation.rollout import Act
from gym_mara.datasets import formats, playing, recorder, sources
from gym_mara.datasets.contents import Contents
from gym_mara.datasets.episode import Episode, Steps
from gym_mara.datasets.formats import FORMATS
from gym_mara.datasets.playing import record, recording_seeds
from gym_mara.datasets.recorder import Recorded
from gym_mara.envs import MaraEnv, MaraGoalEnv, make_vector_env
from gym_mara.envs.simulation import Simulation
from gym_mara.envs.view import first_view
from gym_mara.errors import GymMaraError
from gym_mara.registration import ENVIRONMENTS
from gym_mara.rendering import Pictures, RenderSettings
from gym_mara.testing import COLLIDING_Q
from tests.helpers import Cli

LENGTH = 30
"""The length of an episode here, steps."""


class Kept(formats.Writer):
    """Keeps the episodes in memory."""

    contents: Contents
    episodes: list[Episode]

    def __init__(self, folder: Path, name: str, contents: Contents) -> None:
        type(self).contents, type(self).episodes = contents, []

    def add(self, episode: Episode) -> None:
        self.episodes.append(episode)

    def finish(self) -> None:
        pass


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MARA-v0", "MARAReach-v0", "MARAGoal-v0", "MARACollision-v0"):
        short = ENVIRONMENTS[name]._replace(max_episode_steps=LENGTH)
        monkeypatch.setitem(ENVIRONMENTS, name, short)
    monkeypatch.setattr(playing, "writer_class", lambda name: Kept)
    monkeypatch.setattr(recorder, "writer_class", lambda name: Kept)


def ik(env: str, **options: Any) -> sources.Source:
    return sources.baseline("ik", env, "pinocchio", options)


@pytest.mark.parametrize(
    ("name", "kind"), [("MARAReach-v0", MaraEnv), ("MARAGoal-v0", MaraGoalEnv)]
)
def test_a_recorded_episode_can_be_played_again(tmp_path: Path, name: str, kind: Any) -> None:
    limit = {} if name == "MARAReach-v0" else {"max_joint_velocity": 1.5}
    record(ik(name, **limit), "minari", tmp_path / "new", episodes=3, seed=5)
    env = kind(ENVIRONMENTS[name].task, **limit)
    for episode in Kept.episodes:
        seen, _ = env.reset(seed=episode.seed)
        for step, action in enumerate(episode.actions):
            _same(seen, episode.observations, step)
            seen, reward, terminated, _, info = env.step(action)
            assert reward == pytest.approx(episode.rewards[step], abs=1e-6)
            assert terminated == episode.terminated[step]
            assert episode.success is not None
            assert info.get("success", info.get("is_success")) == episode.success[step]
        _same(seen, episode.observations, LENGTH)
        assert episode.truncated.tolist() == [False] * (LENGTH - 1) + [True]
    env.close()


def _same(seen: Any, stored: Any, step: int) -> None:
    if isinstance(seen, dict):
        assert seen.keys() == stored.keys()
        for key, values in seen.items():
            np.testing.assert_allclose(values, stored[key][step], atol=1e-6)
    else:
        np.testing.assert_allclose(seen, stored[step], atol=1e-6)


def test_an_episode_depends_on_its_number_and_the_seed_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def starts(seed: int) -> Any:
        made = record(ik("MARAReach-v0"), "minari", tmp_path / "new", episodes=5, seed=seed)
        os.rmdir(tmp_path / "new")
        assert made == Recorded(5, 5 * LENGTH, made.successes)
        return np.array([episode.observations[0] for episode in Kept.episodes])

    side_by_side = starts(1)
    monkeypatch.setattr(playing, "_MOST_ARMS", 2)
    np.testing.assert_allclose(starts(1), side_by_side, atol=1e-12)
    assert (starts(2) != side_by_side).any(axis=1).all()


def test_no_episode_is_one_of_an_evaluation() -> None:
    seeds = recording_seeds(0, 0, 50)
    assert seeds[10:] == recording_seeds(0, 10, 40)
    assert len(set(seeds)) == 50
    assert max(seeds) < 2**63 <= min(episode_seeds(0, 0, 50))


def test_the_recorded_episodes_are_as_good_as_those_of_an_evaluation(tmp_path: Path) -> None:
    made = record(ik("MARA-v0", max_joint_velocity=1.5), "minari", tmp_path / "new", episodes=1)
    options = {"max_joint_velocity": 1.5}
    measured = evaluate_baseline("ik", "MARA-v0", backend="pinocchio", episodes=1, options=options)
    [episode] = Kept.episodes
    assert episode.rewards.sum() == pytest.approx(measured["return"][0], rel=1e-6)
    assert episode.success is None
    assert made.successes is None


def test_an_episode_ends_where_the_task_ends_it(tmp_path: Path) -> None:
    def begin(simulation: Simulation) -> Act:
        steps = itertools.count()

        def act(observation: Any) -> Any:  # the second arm collides in its third step
            return np.array([np.zeros(6), COLLIDING_Q if next(steps) == 2 else np.zeros(6)])

        return act

    options = {"on_collision": "terminate"}
    source = sources.Source("MARACollision-v0", "pinocchio", options, begin, "own", options)
    made = record(source, "minari", tmp_path / "new", episodes=2)
    first, second = Kept.episodes
    assert first.truncated.tolist() == [False] * (LENGTH - 1) + [True]
    assert not first.terminated.any()
    assert second.terminated.tolist() == [False, False, True]
    assert not second.truncated.any()
    np.testing.assert_allclose(second.observations[:, :6], [*np.zeros((3, 6)), COLLIDING_Q])
    assert made.steps == LENGTH + 3


def test_pictures_show_the_observations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = ik("MARA-v0", max_joint_velocity=1.5, camera="side")
    short = ENVIRONMENTS["MARA-v0"]._replace(max_episode_steps=3)
    monkeypatch.setitem(ENVIRONMENTS, "MARA-v0", short)
    record(source, "minari", tmp_path / "new", episodes=1, pixels=48)
    [episode] = Kept.episodes
    pictures = episode.observations["pixels"]
    assert pictures.shape == (4, 48, 48, 3)
    env = MaraEnv(
        max_joint_velocity=1.5, render_mode="rgb_array", width=48, height=48, camera="side"
    )
    env.reset()
    np.testing.assert_array_equal(env.render(), pictures[0])
    for action in episode.actions:
        env.step(action)
    np.testing.assert_array_equal(env.render(), pictures[-1])
    env.close()
    assert (pictures[0] != pictures[-1]).any()


def test_the_pictures_of_an_episode_are_held_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(make_vector_env("MARA-v0", 1, backend="pinocchio")) as arms:
        simulation = arms.simulation
        observation, _ = arms.reset(seed=0)
        settings = RenderSettings(width=64, height=64)
        pictures = Pictures(simulation.robot, settings, first_view(simulation))
        monkeypatch.setattr(pictures, "of", lambda view: np.full((64, 64, 3), 7, np.uint8))
        steps, action = Steps(simulation, observation, pictures), np.zeros((1, 6), np.float32)
        for _ in range(LENGTH):
            arms.step(action)
            assert simulation.outcome is not None
            steps.add(observation, action, simulation.outcome, np.zeros(1, np.bool_))
        tracemalloc.start()
        try:
            episode = steps.episode(0, LENGTH, None)
            most = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    assert episode.pixels is not None
    assert episode.pixels.shape == (LENGTH + 1, 64, 64, 3)
    assert (episode.pixels == 7).all()
    assert most < 1.5 * episode.pixels.nbytes


@pytest.mark.parametrize("pixels", [33, 30, 514])
def test_pictures_of_another_size_are_refused(tmp_path: Path, pixels: int) -> None:
    with pytest.raises(GymMaraError, match="an even number from 32 to 512"):
        record(ik("MARA-v0"), "minari", tmp_path / "new", episodes=1, pixels=pixels)
    assert list(tmp_path.iterdir()) == []


def full(*_: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("method", ["__init__", "add", "finish"])
def test_a_full_disk_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    monkeypatch.setattr(Kept, method, full)
    with pytest.raises(GymMaraError, match=r"cannot write '.*new': No space left"):
        record(ik("MARA-v0"), "minari", tmp_path / "new", episodes=1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", FORMATS)
def test_a_library_that_cannot_write_ends_with_a_clear_error(tmp_path: Path, form: str) -> None:
    """HDF5 would end the process with a segmentation fault."""
    code = (
        "import resource, sys\n"
        "from gym_mara.cli import main\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        f"sys.argv[1:] = 'record --policy ik --env MARAReach-v0 --episodes 9 --format {form} --out full-v0'.split()\n"
        "main()\n"
    )
    answer = subprocess.run(
        [sys.executable, "-B", "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert answer.returncode == 2, answer.stderr
    assert answer.stderr.startswith("error: cannot write 'full-v0': ")
    assert len(answer.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Kept, "add", interrupt)
    with pytest.raises(KeyboardInterrupt):
        record(ik("MARA-v0"), "minari", tmp_path / "new", episodes=1)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_appears_meanwhile_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Kept, "finish", lambda _: (tmp_path / "new").mkdir())
    with pytest.raises(GymMaraError, match="not overwritten"):
        record(ik("MARA-v0"), "minari", tmp_path / "new", episodes=1)
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


@pytest.mark.parametrize("form", ["minari", "lerobot"])
def test_the_folder_may_be_a_relative_path(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gym_mara: Cli
) -> None:
    monkeypatch.chdir(tmp_path)
    options = ["--env", "MARA-v0", "--set", "max_joint_velocity=1.5", "--format", form]
    code, _, err = gym_mara(
        "record", "--policy", "ik", "--episodes", 1, "--out", "new-v0", *options
    )
    assert code == 0, err
    assert [path.name for path in tmp_path.iterdir()] == ["new-v0"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            "--policy ik --out new-v0 --format rosbag",
            "unknown format 'rosbag'. Valid: lerobot, minari",
        ),
        ("--policy ik --out there", "exists and is not overwritten"),
        ("--policy ik --out none/new-v0", "make it first"),
        ("--policy nothing --out new-v0", "is no run folder, and neither ik, hand, pretrained nor"),
        ("--policy there --out new-v0", "config.json"),
        ("--policy ik --out new-v0 --pixels 64 --set width=64", "leave out --set width"),
        ("--policy ik --out new-v0 --set camera=top", "no picture is drawn"),
        ("--policy ik --out new-v0 --pixels 33", "an even number"),
        ("--policy ik --out new-v0 --env MARA-v0 --set action=cartesian", "no cartesian actions"),
    ],
)
def test_a_call_that_cannot_work_says_why(
    gym_mara: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    code, _, error = gym_mara("record", *arguments.split())
    assert code == 2
    assert message in error
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
