"""The form of gym-gazebo2: its ids, its episodes, its statistics, its observation to the letter."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from gym_mara.compat.gym_gazebo2 import GazeboMaraEnv
from gym_mara.errors import GymMaraError
from tests.helpers import TARGET_Q, TASK_NAMES, golden, golden_q, robot_model

STILL = np.zeros(6, np.float32)
KEYS = {
    "ep_dist_max",
    "ep_dist_mean",
    "ep_dist_min",
    "ep_rew_max",
    "ep_rew_mean",
    "ep_rew_min",
    "num_coll",
}


def test_the_bare_ids_come_with_the_import_alone() -> None:
    code = (
        "import gymnasium, gym_mara\n"
        "assert 'MARA-v0' not in gymnasium.registry\n"
        "import gym_mara.compat.gym_gazebo2\n"
        f"for name in {TASK_NAMES}: gymnasium.make(name).reset(seed=0)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", TASK_NAMES)
def test_an_episode_is_that_of_the_package(name: str) -> None:
    ours, theirs = gymnasium.make(f"gym_mara/{name}"), gymnasium.make(name)
    np.testing.assert_array_equal(ours.reset(seed=0)[0], theirs.reset(seed=0)[0])
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-2.0, 2.0, 6).astype(np.float32)
        mine, other = ours.step(action), theirs.step(action)
        np.testing.assert_array_equal(mine[0], other[0])
        assert mine[1:4] == other[1:4]


@pytest.mark.parametrize("size", [3, None])
def test_the_episode_has_the_size_that_is_set(size: int | None) -> None:
    env = GazeboMaraEnv()
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
        assert steps == (size or 2048)
        assert info["infos"].keys() == KEYS
        assert info["infos"]["ep_rew_mean"] == pytest.approx(np.mean(rewards))
        assert info["infos"]["num_coll"] == 0


def test_the_velocity_is_the_originals_slip_by_keyword() -> None:
    env = GazeboMaraEnv("MARAOrient-v0", original_observation=True, on_collision="continue")
    robot = robot_model("mara")
    env.reset()
    step = 1e-6
    for q in [np.array(TARGET_Q), *golden_q()[:20]]:
        q = q.clip(robot.lower, robot.upper).astype(np.float32)
        observation = env.step(q)[0]
        at = observation[:6]
        # J(q)·q, by the difference along q.
        ahead, behind = (robot.kinematics().pose((at * (1.0 + s))[None])[0] for s in (step, -step))
        np.testing.assert_allclose(observation[-3:], (ahead - behind)[0] / (2.0 * step), atol=1e-6)
        assert env.observation_space.contains(observation)
    plain = GazeboMaraEnv("MARAOrient-v0", on_collision="continue")
    plain.reset()
    np.testing.assert_array_equal(plain.step(q)[0][:-3], observation[:-3])
    assert golden("kinematics_golden.csv")


@pytest.mark.filterwarnings("ignore:.*action space", "ignore:.*symmetric")
@pytest.mark.parametrize("options", [{}, {"original_observation": True}, {"real_speed": True}])
def test_the_checker_accepts_it(options: dict[str, Any]) -> None:
    check_env(gymnasium.make("MARACollisionOrient-v0", **options).unwrapped, skip_render_check=True)


@pytest.mark.parametrize(("velocity", "speed"), [(None, 0.5), (0.3, 0.3)])
def test_the_run_mode_moves_the_joints_at_its_velocity(
    velocity: float | None, speed: float
) -> None:
    env = GazeboMaraEnv(real_speed=True, velocity=velocity)
    env.reset()
    q = env.step(np.full(6, 0.4, np.float32))[0][:6]
    np.testing.assert_allclose(q, speed * 0.02, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"multi_instance": True}, "'multi_instance' has no meaning here.*make as many"),
        ({"port": 11345}, "'port' has no meaning here.*no simulator"),
        ({"velocity": 0.3}, "give real_speed=True too"),
        ({"real_speed": True, "velocity": 0.0}, "velocity must be finite and positive"),
        ({"gzclient": True}, "unknown keyword argument 'gzclient'"),
    ],
)
def test_a_flag_without_a_meaning_is_told(options: dict[str, Any], told: str) -> None:
    with pytest.raises(GymMaraError, match=told):
        GazeboMaraEnv(**options)


@pytest.mark.parametrize("size", [0, -1, 2.5, "long"])
def test_an_episode_of_nonsense_is_refused(size: Any) -> None:
    with pytest.raises(GymMaraError, match="episode_size"):
        GazeboMaraEnv().set_episode_size(size)
