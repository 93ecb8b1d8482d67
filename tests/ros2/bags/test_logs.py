"""Logs and episodes from bags and back: exact, by names in any order, and every refusal."""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys.stores import ros2_jazzy as types

from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError
from gym_mara.identification import Log
from gym_mara.robot import RobotModel
from gym_mara.ros2.bags.bag import Recorder
from gym_mara.ros2.bags.logs import COMMANDS, STATES, episode, read_log, write_episode
from gym_mara.types import Floats
from tests.helpers import Cli, robot_model
from tests.ros2.bags.test_bag import some_log

NONE = np.zeros(0)
PERIOD = 20_000_000


def joint_state(names: list[str], q: Floats, qd: Floats = NONE) -> Any:
    header = types.std_msgs__msg__Header(types.builtin_interfaces__msg__Time(0, 0), "")
    return types.sensor_msgs__msg__JointState(header, names, q, qd, NONE)


def trajectory(names: list[str], *points: Floats) -> Any:
    header = types.std_msgs__msg__Header(types.builtin_interfaces__msg__Time(0, 0), "")
    ahead = types.builtin_interfaces__msg__Duration(0, PERIOD)
    made = [
        types.trajectory_msgs__msg__JointTrajectoryPoint(q, NONE, NONE, NONE, ahead) for q in points
    ]
    return types.trajectory_msgs__msg__JointTrajectory(header, names, made)


def test_a_log_survives_a_bag(tmp_path: Path, mara: RobotModel) -> None:
    log = some_log(mara)
    write_episode(tmp_path / "bag", log, mara)
    back = read_log(tmp_path / "bag", mara)
    for name in ("targets", "q", "qd"):
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name))
    np.testing.assert_allclose(back.times, log.times, rtol=0.0, atol=1e-12)
    assert back.joint_names == mara.joint_names


@settings(max_examples=12)
@given(st.permutations([*robot_model("mara").joint_names, "gripper"]), st.integers(0, 2**32 - 1))
def test_names_in_any_order(names: list[str], seed: int) -> None:
    mara = robot_model("mara")
    generator = np.random.default_rng(seed)
    own = [names.index(name) for name in mara.joint_names]
    with tempfile.TemporaryDirectory() as folder:
        states = generator.standard_normal((110, 7))
        with Recorder(Path(folder) / "bag") as recorder:
            for tick, q in enumerate(states):
                recorder.add_value(STATES, joint_state(names, q, -q), tick * PERIOD)
                recorder.add_value(COMMANDS, trajectory(names, 0.0 * q, 2.0 * q), tick * PERIOD)
        log = read_log(Path(folder) / "bag", mara)
    np.testing.assert_array_equal(log.q, states[:, own])
    np.testing.assert_array_equal(log.qd, -states[:, own])
    np.testing.assert_array_equal(log.targets, 2.0 * states[:, own])


def test_the_last_value_counts_and_bad_messages_do_not(tmp_path: Path, mara: RobotModel) -> None:
    names = list(mara.joint_names)
    with Recorder(tmp_path / "bag") as recorder:
        for tick in range(150):
            now = 7 + tick * PERIOD
            recorder.add_value(STATES, joint_state(names, np.full(6, tick * 1.0)), now)
            if tick == 10:
                array = types.std_msgs__msg__Float64MultiArray
                layout = types.std_msgs__msg__MultiArrayLayout([], 0)
                recorder.add_value("/c/commands", array(layout, np.full(6, 0.5)), now + 1)
                for bad in (np.full(6, np.nan), np.zeros(5)):
                    recorder.add_value("/c/commands", array(layout, bad), now + 2)
            for broken in (np.full(6, np.nan), np.zeros(5), NONE):
                recorder.add_value(
                    STATES, joint_state(names[: len(broken)] or names, broken), now + 3
                )
    log = read_log(tmp_path / "bag", mara)
    assert log.q[:, 0].tolist() == [float(tick) for tick in range(10, 149)]
    assert (log.targets == 0.5).all()
    np.testing.assert_allclose(log.qd, 50.0)


def test_what_a_bag_lacks(tmp_path: Path, mara: RobotModel, gym_mara: Cli) -> None:
    names = list(mara.joint_names)
    number = itertools.count()

    def refused(match: str, *messages: tuple[str, Any], **options: Any) -> Path:
        path = tmp_path / str(next(number))
        with Recorder(path) as recorder:
            for tick, (topic, value) in enumerate(messages):
                recorder.add_value(topic, value, tick * PERIOD)
        with pytest.raises(GymMaraError, match=match):
            read_log(path, mara, **options)
        return path

    state, command = (
        (STATES, joint_state(names, np.zeros(6))),
        (COMMANDS, trajectory(names, np.zeros(6))),
    )
    empty = refused(r"no joint states on /joint_states; its topics are: none")
    refused(
        r"no joint states on /joint_states; its topics are: /joint_t.*JointTrajectory\)", command
    )
    refused("no joint states on /joint_states", (STATES, command[1]), command)
    refused(
        "no commands, JointTrajectory or Float64MultiArray; its topics are: /joint_states", state
    )
    refused("no commands on /other", state, command, commands="/other")
    refused(
        "several topics of commands: name one of /b, /joint_t", state, command, ("/b", command[1])
    )
    refused("too short", state, command)
    other = (STATES, joint_state(["a", "b"], np.zeros(2)))
    refused("values of motor1, .*; its messages have a, b", other, command)
    refused("no complete message on /joint_t", state, (COMMANDS, trajectory(names)))
    refused("period must be", state, command, period=-1.0)
    code, _, error = gym_mara("identify", empty)
    assert code == 2
    assert "has no joint states" in error
    assert "Traceback" not in error


@pytest.mark.parametrize("task", ["MARA-v0", "MARACollisionOrient-v0"])
def test_an_episode_survives_a_bag(task: str, tmp_path: Path, mara: RobotModel) -> None:
    env = gymnasium.make(f"gym_mara/{task}").unwrapped
    assert isinstance(env, MaraEnv)
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    observations, rewards, actions, states = [observation], [], [], [env.simulation.backend.state]
    for _ in range(110):
        actions.append(0.3 * env.action_space.sample())
        observation, reward, *_ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(reward)
        states.append(env.simulation.observed(0))
    targets = np.array([*actions, actions[-1]], np.float64)
    q, qd = (np.concatenate([getattr(s, name) for s in states]) for name in ("q", "qd"))
    log = Log(np.arange(111) * np.float64(0.02), targets, q, qd, mara.joint_names)
    write_episode(tmp_path / "bag", log, mara)
    back = episode(read_log(tmp_path / "bag", mara), env)
    free = np.array([not state.collided[0] for state in states])
    assert free.sum() > 20
    np.testing.assert_array_equal(back.observation, np.array(observations))
    np.testing.assert_array_equal(back.reward, np.array(rewards))
    np.testing.assert_allclose(back.action, np.array(actions), rtol=0.0, atol=1e-7)
    env.close()


def test_episodes_of_other_arms_and_actions(mara: RobotModel) -> None:
    relative = MaraEnv(action="relative")
    with pytest.raises(GymMaraError, match="actions of this environment are relative"):
        episode(some_log(mara), relative)
    relative.close()
    ur5 = MaraEnv(robot="ur5")
    with pytest.raises(GymMaraError, match="the log has the joints motor1"):
        episode(some_log(mara), ur5)
    ur5.close()
