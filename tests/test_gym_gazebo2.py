"""The interface of gym-gazebo2: ids, episodes, statistics and the original observation."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
import scipy.stats
from gymnasium.spaces import Box, Dict
from gymnasium.utils.env_checker import check_env

from gym_mara.compat.gym_gazebo2 import GazeboMaraEnv
from gym_mara.errors import GymMaraError
from tests.helpers import MODULAR_ARMS, TARGET_Q, TASK_NAMES, golden, golden_q, robot_model

STILL = np.zeros(6, np.float32)
KEYS = {
    "ep_dist_max",
    "ep_dist_mean",
    "ep_dist_min",
    "ep_rew_max",
    "ep_rew_mean",
    "ep_rew_min",
    "num_coll",
    "ep_dist_std",
    "ep_dist_skew",
    "ep_rew_std",
    "ep_rew_skew",
    "target_x",
    "target_y",
    "target_z",
}
RANDOM_TARGET = "MARARandomTarget-v0"


def test_the_import_registers_the_original_ids() -> None:
    code = (
        "import gymnasium, gym_mara\n"
        "assert 'MARA-v0' not in gymnasium.registry\n"
        "import gym_mara.compat.gym_gazebo2\n"
        f"for name in {[*TASK_NAMES, RANDOM_TARGET]}: gymnasium.make(name).reset(seed=0)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", TASK_NAMES)
def test_an_episode_equals_one_of_the_registered_environment(name: str) -> None:
    env, compat = gymnasium.make(f"gym_mara/{name}"), gymnasium.make(name)
    np.testing.assert_array_equal(env.reset(seed=0)[0], compat.reset(seed=0)[0])
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-2.0, 2.0, 6).astype(np.float32)
        expected, result = env.step(action), compat.step(action)
        np.testing.assert_array_equal(result[0], expected[0])
        assert result[1:4] == expected[1:4]


@pytest.mark.parametrize("size", [3, None])
def test_set_episode_size_sets_the_length_of_episodes(size: int | None) -> None:
    env: Any = gymnasium.make("MARA-v0")
    if size is not None:
        env.set_episode_size(size)
    for _ in range(2):
        env.reset()
        steps, ended, rewards = 0, False, []
        while not ended:
            _, reward, terminated, ended, info = env.step(STILL)
            assert not terminated
            rewards.append(reward)
            steps += 1
            assert ("infos" in info) is ended
        assert steps == (size or 1024)
        assert info["infos"].keys() == KEYS
        assert info["infos"]["ep_rew_mean"] == pytest.approx(np.mean(rewards))
        assert info["infos"]["num_coll"] == 0


def test_the_statistics_of_an_episode_are_those_of_its_steps() -> None:
    env: Any = gymnasium.make("MARA-v0")
    env.set_episode_size(50)
    env.action_space.seed(0)
    for _ in range(2):  # the second episode does not count the steps of the first
        env.reset(seed=0)
        distances, rewards = [], []
        for _ in range(50):
            _, reward, *_, info = env.step(env.action_space.sample())
            distances.append(info["distance"])
            rewards.append(reward)
        infos = info["infos"]
        for name, values in {"dist": distances, "rew": rewards}.items():
            assert infos[f"ep_{name}_std"] == pytest.approx(np.std(values), rel=1e-12)
            assert infos[f"ep_{name}_skew"] == pytest.approx(scipy.stats.skew(values), rel=1e-9)
        assert [infos[f"target_{axis}"] for axis in "xyz"] == [-0.40028, 0.095615, 0.72466]


def test_the_skewness_of_equal_values_is_zero() -> None:
    env: Any = gymnasium.make("MARA-v0")
    env.set_episode_size(3)
    env.reset(seed=0)
    for _ in range(3):
        *_, info = env.step(STILL)
    assert [info["infos"][f"ep_dist_{name}"] for name in ("std", "skew")] == [0.0, 0.0]


def test_a_restored_episode_ends_with_the_same_statistics() -> None:
    env: Any = gymnasium.make(RANDOM_TARGET)
    env.set_episode_size(6)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 6)).astype(np.float32)
    for action in actions[:3]:
        env.step(action)
    snapshot = env.save_state()
    ends = []
    for _ in range(2):
        for action in actions[3:]:
            *_, info = env.step(action)
        ends.append(info["infos"])
        env.restore_state(snapshot)
    assert ends[0] == ends[1]


def test_random_target_draws_one_of_two_targets_that_the_observation_does_not_contain() -> None:
    env: Any = gymnasium.make(RANDOM_TARGET)
    env.reset(seed=0)
    kinematics, drawn = env.simulation.robot.kinematics(), []
    for _ in range(40):
        observation, _ = env.reset()
        target = env.simulation.goal.position[0]
        tool = kinematics.pose(observation[None, :6])[0][0]
        np.testing.assert_allclose(observation[6:9], tool - target, atol=1e-12)
        assert observation.shape == (12,)
        # From the arm's base, which stands at z = 0.68 m and is turned by 90°.
        drawn.append((target[1], -target[0], target[2] - 0.68))
    found = {tuple(np.round(each, 9).tolist()) for each in drawn}
    assert found == {(-0.5, 0.2, 0.25), (-0.5, -0.2, 0.25)}


def test_the_targets_of_random_target_can_be_reached_but_not_by_any_arm() -> None:
    with pytest.warns(UserWarning, match=r"\[-0.2, -0.5, 0.93\] is out of reach of"):
        GazeboMaraEnv(RANDOM_TARGET, robot=MODULAR_ARMS[3])
    with pytest.raises(GymMaraError, match="leave out target_position"):
        GazeboMaraEnv(RANDOM_TARGET, target_position=[0.0, 0.5, 0.9])


def test_original_observation_replaces_the_velocity_with_the_jacobian_times_the_position() -> None:
    env = GazeboMaraEnv("MARAOrient-v0", original_observation=True, on_collision="continue")
    robot = robot_model("mara")
    env.reset()
    step = 1e-6
    for q in [np.array(TARGET_Q), *golden_q()[:20]]:
        q = q.clip(robot.lower, robot.upper).astype(np.float32)
        observation = env.step(q)[0]
        measured = observation[:6]
        # J(q)·q by the central difference along q.
        ahead, behind = (
            robot.kinematics().pose((measured * (1.0 + s))[None])[0] for s in (step, -step)
        )
        np.testing.assert_allclose(observation[-3:], (ahead - behind)[0] / (2.0 * step), atol=1e-6)
        assert env.observation_space.contains(observation)
    plain = GazeboMaraEnv("MARAOrient-v0", on_collision="continue")
    plain.reset()
    np.testing.assert_array_equal(plain.step(q)[0][:-3], observation[:-3])
    assert golden("kinematics_golden.csv")


def test_original_observation_with_pictures_is_in_its_space() -> None:
    options: dict[str, Any] = {"observation": "state+pixels", "pixel_size": 8}
    env = GazeboMaraEnv(original_observation=True, **options)
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    plain = GazeboMaraEnv(**options).observation_space
    assert isinstance(plain, Dict)
    assert isinstance(env.observation_space, Dict)
    assert env.observation_space.keys() == plain.keys()
    assert env.observation_space["state"] != plain["state"]


@pytest.mark.filterwarnings("ignore:.*action space", "ignore:.*symmetric")
@pytest.mark.parametrize("options", [{}, {"original_observation": True}, {"real_speed": True}])
def test_gymnasiums_checker_accepts_the_environment(options: dict[str, Any]) -> None:
    check_env(gymnasium.make("MARACollisionOrient-v0", **options).unwrapped, skip_render_check=True)


def test_the_action_space_is_that_of_gym_gazebo2() -> None:
    assert gymnasium.make("MARA-v0").action_space == Box(-np.pi, np.pi, (6,), np.float32)


@pytest.mark.parametrize(("velocity", "speed"), [(None, 0.5), (0.3, 0.3)])
def test_real_speed_moves_the_joints_at_the_given_velocity(
    velocity: float | None, speed: float
) -> None:
    env = GazeboMaraEnv(real_speed=True, velocity=velocity)
    env.reset()
    q = env.step(np.full(6, 0.4, np.float32))[0][:6]
    np.testing.assert_allclose(q, speed * 0.02, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"multi_instance": True}, "'multi_instance' has no meaning here.*make as many"),
        ({"port": 11345}, "'port' has no meaning here.*no simulator"),
        ({"velocity": 0.3}, "give real_speed=True too"),
        ({"real_speed": True, "velocity": 0.0}, "velocity must be finite and positive"),
        ({"real_speed": True, "max_joint_velocity": 0.3}, "give velocity with real_speed"),
        ({"gui": True, "render_mode": "rgb_array"}, "gui shows .*not 'rgb_array'"),
        ({"original_observation": True, "observation": "pixels"}, "concerns the state: .*'pixels'"),
        ({"gzclient": True}, "unknown keyword argument 'gzclient'"),
    ],
)
def test_invalid_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        GazeboMaraEnv(**options)


@pytest.mark.parametrize("size", [0, -1, 2.5, "long"])
def test_an_invalid_episode_size_is_refused(size: Any) -> None:
    with pytest.raises(GymMaraError, match="episode_size"):
        GazeboMaraEnv().set_episode_size(size)


def test_the_real_arm_has_its_bare_id_and_the_form_of_its_commands() -> None:
    spec = gymnasium.spec("MARAReal-v0")
    assert spec.kwargs == {"task": "MARA-v0", "backend": "ros2", "profile": "mara-2019"}
