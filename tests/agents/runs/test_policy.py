"""A trained policy in Python: it is right wherever it is played, or it is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import RescaleAction
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from gym_mara.agents.algorithms.registry import algorithm
from gym_mara.agents.runs import load_policy
from gym_mara.agents.runs.config import DamagedRunError
from gym_mara.agents.runs.evaluation import Player, evaluate_run, make_env, options_on
from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.agents.training.train import new_agent, resume, train
from gym_mara.envs import MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.types import UnitActions
from tests.agents.conftest import ROLLOUT, config, silent
from tests.helpers import joint_xml, urdf_xml, write

ID = "gym_mara/MARACollisionOrient-v0"
STEPS = 20


@pytest.fixture(scope="module")
def expected(finished_run: RunFolder) -> tuple[float, float]:
    """The return and the final position error, mm, of the first STEPS steps as `transfer` and `report` play them."""
    with Player(finished_run, "pinocchio", finished_run.config.env_options) as player:
        outcomes = [player.step() for _ in range(STEPS)]
    total = sum(float(outcome.reward[0]) for outcome in outcomes)
    return total, 1000.0 * float(outcomes[-1].info["position_error"][0])


def make() -> gymnasium.Env[Any, Any]:
    """An environment like that of the training, with short episodes."""
    return gymnasium.make(ID, max_episode_steps=STEPS)


def played(env: gymnasium.Env[Any, Any], predict: Any) -> tuple[float, float]:
    """The return and the final position error, mm, of an episode."""
    observation, _ = env.reset(seed=0)
    total, ended = 0.0, False
    while not ended:
        action, _ = predict(observation, deterministic=True)
        observation, reward, terminated, truncated, info = env.step(action)
        total, ended = total + float(reward), terminated or truncated
    return total, 1000.0 * info["position_error"]


def test_it_is_right_on_gymnasium_make(
    finished_run: RunFolder, expected: tuple[float, float]
) -> None:
    policy = load_policy(finished_run.path)
    assert played(make(), policy.predict) == pytest.approx(expected, rel=1e-5)


def test_evaluate_policy_of_stable_baselines3_takes_it(
    finished_run: RunFolder, expected: tuple[float, float]
) -> None:
    policy: Any = load_policy(str(finished_run.path))
    mean, _ = evaluate_policy(policy, Monitor(make()), 1)
    assert mean == pytest.approx(expected[0], rel=1e-5)


def test_the_model_of_stable_baselines3_is_right_with_rescaled_actions(
    finished_run: RunFolder, expected: tuple[float, float]
) -> None:
    model = PPO.load(finished_run.path / "last" / "model.zip", device="cpu")

    def rescaled() -> gymnasium.Env[Any, Any]:
        return RescaleAction(make(), np.float32(-1.0), np.float32(1.0))

    # RescaleAction computes in float32.
    assert played(rescaled(), model.predict) == pytest.approx(expected, rel=1e-3)
    batch = make_env(ID[9:], "pinocchio", 1, {}, max_episode_steps=STEPS)
    for env in (DummyVecEnv([lambda: Monitor(rescaled())]), batch):
        assert evaluate_policy(model, env, 1)[0] == pytest.approx(expected[0], rel=1e-3)


@pytest.mark.parametrize("preset", ["tuned", "paper"])
def test_the_model_of_stable_baselines3_is_refused_by_joint_targets(preset: str) -> None:
    made = algorithm("ppo").preset(preset, teleports=True)
    model = new_agent("ppo", made, make_env("MARA-v0", "pinocchio", made.num_envs, {}), seed=0)
    env = gymnasium.make("gym_mara/MARA-v0")
    arms = MaraVectorEnv(2, autoreset_mode="SameStep")
    batch = MaraVecEnv(arms)
    dummy = DummyVecEnv([lambda: gymnasium.make("gym_mara/MARA-v0")])
    observation, _ = env.reset()
    assert type(model.predict(observation)[0]) is UnitActions
    with pytest.raises(GymMaraError, match="load_policy"):
        env.step(model.predict(observation)[0])
    for each in (batch, dummy):
        observations: Any = each.reset()
        with pytest.raises(GymMaraError, match="load_policy"):
            each.step(model.predict(observations)[0])
    batch.close()


def test_a_batch_of_observations_gives_the_actions_of_each(finished_run: RunFolder) -> None:
    policy = load_policy(finished_run, "best")
    observations = np.random.default_rng(0).normal(size=(5, policy.about.size))
    batch, state = policy.predict(observations)
    assert state is None
    assert batch.shape == (5, 6)
    for row, action in zip(observations, batch, strict=True):
        np.testing.assert_allclose(policy.predict(row)[0], action, rtol=0.0, atol=1e-5)


def test_an_action_is_random_if_asked_for(finished_run: RunFolder) -> None:
    policy = load_policy(finished_run)
    observation = np.zeros(policy.about.size)
    one, other = (policy.predict(observation, deterministic=False)[0] for _ in range(2))
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(
    "observation",
    [
        np.full(16, np.nan),
        np.full((2, 16), np.inf),
        np.zeros(15),
        np.zeros((0, 16)),
        np.zeros((1, 1, 16)),
        np.float64(1.0),
        ["a"] * 16,
        [[0.0], [0.0, 1.0]],
        {"observation": np.zeros(16)},
        (np.zeros(16), {}),
        None,
    ],
)
def test_a_wrong_observation_is_an_error(finished_run: RunFolder, observation: Any) -> None:
    with pytest.raises(GymMaraError, match="observation"):
        load_policy(finished_run).predict(observation)


@pytest.mark.slow
def test_normalised_observations_are_normalised_inside(tmp_path: Path) -> None:
    preset = algorithm("ppo").preset("tuned", teleports=True)
    normalising = type(preset)(**{**vars(preset), "normalise_observation": True})
    run = train(config(steps=ROLLOUT), tmp_path / "run", silent, preset=normalising)
    # In the training, VecNormalize of Stable-Baselines3 has normalised.
    (evaluated,) = (
        row["eval/reward_per_step"]
        for row in read_progress(run.progress_file)
        if "eval/reward_per_step" in row
    )
    assert evaluate_run(run, episodes=1)["reward_per_step"][0] == pytest.approx(evaluated, rel=1e-9)
    about = load_policy(run).about.normalisation
    assert about is not None
    assert len(about.mean) == 16


def changed(run: RunFolder, path: Path, **changes: Any) -> RunFolder:
    """A copy of a run with another policy.json."""
    shutil.copytree(run.path, path)
    file = path / "last" / "policy.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    return RunFolder.open(path)


NUMBERS = {"mean": [0.0] * 16, "var": [1.0] * 16, "epsilon": 1e-8, "clip": 10.0}


@pytest.mark.parametrize(
    "changes",
    [
        {"format": 3},
        {"format": 1},
        {"action": {"mode": "relative", "steps": [], "reference": "position"}},
        {"action": {"mode": "absolute", "steps": [0.1] * 6, "reference": "position"}},
        {"action": {"mode": "cartesian", "steps": [-0.1] * 6, "reference": "position"}},
        {"action": {"mode": "sideways", "steps": [], "reference": "position"}},
        {"control_period": 0.0},
        {"joints": []},
        {"joints": ["a"]},
        {"low": [0.0] * 5},
        {"low": [9.0] * 6},
        {"high": [float("inf")] * 6},
        {"observation": []},
        {"observation": [{"name": "q", "size": 10**9}]},
        {"observation": [{"name": "q", "size": 3}]},
        {"normalisation": {}},
        {"normalisation": NUMBERS | {"mean": [0.0] * 3}},
        {"normalisation": NUMBERS | {"var": [-1.0] * 16}},
        {"normalisation": NUMBERS | {"var": [float("nan")] * 16}},
        {"normalisation": NUMBERS | {"clip": 0.0}},
        {"normalisation": NUMBERS | {"more": 1}},
        {"robot": None},
        {"colour": "red"},
    ],
)
def test_a_wrong_value_in_a_description_is_an_error(
    finished_run: RunFolder, tmp_path: Path, changes: dict[str, Any]
) -> None:
    with pytest.raises(DamagedRunError, match="is damaged"):
        load_policy(changed(finished_run, tmp_path / "run", **changes))


def test_an_action_that_is_not_finite_is_an_error(finished_run: RunFolder) -> None:
    policy = load_policy(finished_run)
    with torch.no_grad():
        for weights in policy._network.parameters():
            weights.fill_(1e38)  # finite, so the file of the weights is read
    with pytest.raises(DamagedRunError, match=r"action is not finite: its weights are damaged"):
        policy.predict(np.ones(policy.about.size))


def test_a_policy_of_an_older_version_is_refused_in_plain_words(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    run = changed(finished_run, tmp_path / "run")
    (run.path / "last" / "policy.json").rename(run.path / "last" / "normalisation.json")
    with pytest.raises(DamagedRunError, match=r"older version.*train it again"):
        load_policy(run)


# The robot.


@pytest.fixture(scope="module")
def own_robot(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run on a robot from a file of its own, with a checkpoint; tests copy it."""
    folder = tmp_path_factory.mktemp("own")
    robot = write(folder / "arm.urdf", urdf_xml(*map(joint_xml, range(3))))
    options = {"robot": str(robot), "ee_frame": "link3"}
    asked = config(env="MARA-v0", env_options=options, steps=2 * ROLLOUT)
    return train(asked, folder / "run", silent)


def play_a_step(run: RunFolder, options: dict[str, Any]) -> None:
    """Play one step."""
    with Player(run, "pinocchio", options) as player:
        player.step()


def test_a_robot_that_has_changed_is_refused(own_robot: RunFolder, tmp_path: Path) -> None:
    file = Path(own_robot.config.env_options["robot"])
    text = file.read_text()
    run = RunFolder(shutil.copytree(own_robot.path, tmp_path / "run"), own_robot.config)
    try:
        file.write_text(text.replace("<robot", "<!-- a comment --><robot"))
        play_a_step(run, run.config.env_options)
        file.write_text(text.replace('xyz="0.3 0 0.2"', 'xyz="0.4 0 0.2"'))
        changed_robot = pytest.raises(GymMaraError, match=r"has changed since.*--set robot=")
        with changed_robot:
            evaluate_run(run, episodes=1)
        with changed_robot:
            Player(run, "pinocchio", run.config.env_options)
        shutil.rmtree(run.path / "last")
        shutil.rmtree(run.checkpoints()[-1])
        with changed_robot:
            resume(run.path, silent)
        given = {"robot": str(file)}
        play_a_step(own_robot, options_on("pinocchio", run.config, given))
    finally:
        file.write_text(text)


def test_a_robot_with_other_joints_is_refused_even_if_it_is_given(own_robot: RunFolder) -> None:
    with pytest.raises(GymMaraError, match="it moves 3 joints, and ur5 has 6"):
        evaluate_run(own_robot, options={"robot": "ur5", "ee_frame": "tool0"})


# Options.


@pytest.mark.slow
def test_an_evaluation_takes_options(finished_run: RunFolder) -> None:
    near, far = (
        evaluate_run(finished_run, episodes=1, options={"target_position": [x, 0.1, 0.6]})
        for x in (0.3, -0.3)
    )
    assert near["position_error_mm"] != far["position_error_mm"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"colour": 1}, "unknown keyword argument 'colour'"),
        ({"num_envs": 2}, "'num_envs' cannot be an option"),
        ({"task": "MARA-v0"}, "'task' cannot be an option"),
        ({"self": 1}, "'self' cannot be an option"),
    ],
)
def test_an_evaluation_refuses_wrong_options(
    finished_run: RunFolder, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        evaluate_run(finished_run, episodes=1, options=options)


@pytest.mark.parametrize("episodes", [0, -1, 10**23])
def test_an_evaluation_has_a_sensible_number_of_episodes(
    finished_run: RunFolder, episodes: int
) -> None:
    with pytest.raises(GymMaraError, match="episodes must be a"):
        evaluate_run(finished_run, episodes=episodes)
