"""MaraEnv: one arm with Gymnasium's interface."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RescaleAction
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.tasks import ReachTask
from gym_mara.testing import COLLIDING_Q, COPIES, pickled
from tests.backends.fake import FakeBackend
from tests.helpers import (
    ENV_IDS,
    PATH_ENDS,
    TARGET_Q,
    TASK_NAMES,
    joint_xml,
    robot_model,
    urdf_xml,
    write,
)


def _steps(
    env: gymnasium.Env[Any, Any], count: int, seed: int | np.random.Generator = 0
) -> list[Any]:
    """The results of random actions."""
    rng = np.random.default_rng(seed)
    return [env.step(rng.uniform(-2.3, 2.3, 6)) for _ in range(count)]


def _assert_same_steps(actual: list[Any], expected: list[Any]) -> None:
    for one, other in zip(actual, expected, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1:] == other[1:]


def _messages(warned: pytest.WarningsRecorder) -> list[str]:
    return [str(warning.message) for warning in warned]


# The checkers of other packages.


@pytest.mark.filterwarnings("always")
@pytest.mark.parametrize("name", ENV_IDS)
@pytest.mark.parametrize("check", [check_env, sb3_check_env], ids=["gymnasium", "sb3"])
def test_the_checkers_only_warn_of_the_action_space(
    name: str, check: Callable[[Any], None], recwarn: pytest.WarningsRecorder
) -> None:
    check(gymnasium.make(name).unwrapped)
    assert all("symmetric and normalized" in message for message in _messages(recwarn))
    assert len(recwarn) == 1, "the only warning is that the actions are joint targets"


@pytest.mark.filterwarnings("always")
@pytest.mark.parametrize("name", ENV_IDS)
@pytest.mark.parametrize("check", [check_env, sb3_check_env], ids=["gymnasium", "sb3"])
def test_the_checkers_accept_rescaled_actions_without_a_warning(
    name: str, check: Callable[[Any], None], recwarn: pytest.WarningsRecorder
) -> None:
    check(RescaleAction(gymnasium.make(name), np.float32(-1.0), np.float32(1.0)))
    # Gymnasium's checker warns of every wrapper.
    assert [m for m in _messages(recwarn) if "has a wrapper applied" not in m] == []


@pytest.mark.parametrize("name", ENV_IDS)
def test_an_episode_in_the_default_wrappers_gives_no_warning(name: str) -> None:
    env = gymnasium.make(name, max_episode_steps=20)
    env.reset(seed=0)
    results = _steps(env, 20)
    assert results[-1][3]
    env.close()


# Spaces.


@pytest.mark.parametrize(
    ("robot", "turns"), [("mara", [1, 1, 1, 1, 1, 1]), ("ur5", [2, 2, 1, 2, 2, 2])]
)
def test_the_action_space_is_that_of_the_paper_or_longer_ranges(
    robot: str, turns: list[int]
) -> None:
    ends = (np.pi * np.array(turns)).astype(np.float32)
    assert MaraEnv(robot=robot_model(robot)).action_space == gymnasium.spaces.Box(-ends, ends)


def test_the_action_space_spans_the_whole_travel_of_a_prismatic_joint(tmp_path: Path) -> None:
    rail = joint_xml(0, "prismatic", limit='<limit lower="-1" upper="5" effort="9" velocity="1"/>')
    path = write(tmp_path / "rail.urdf", urdf_xml(rail, joint_xml(1), joint_xml(2)))
    env = MaraEnv(robot=str(path), ee_frame="link3", on_collision="continue")
    assert env.simulation.action_space.high[0] == 5.0
    env.reset()
    assert env.step(np.array([4.5, 0.0, 0.0], np.float32))[0][0] == 4.5


@pytest.mark.parametrize("robot", ["mara", "ur5", "panda", "so100"])
def test_rescaled_actions_give_the_targets_of_the_batch_for_stable_baselines3(robot: str) -> None:
    env = MaraEnv(robot=robot_model(robot), on_collision="continue")
    rescaled = RescaleAction(env, np.float32(-1.0), np.float32(1.0))
    arms = MaraVectorEnv(1, robot=robot_model(robot), autoreset_mode="SameStep")
    batch: Any = MaraVecEnv(arms, rescaled.action_space)  # type: ignore[arg-type]
    rescaled.reset()
    joints, rng = env.simulation.robot.num_joints, np.random.default_rng(0)
    for action in [*rng.uniform(-1.0, 1.0, (20, joints)), np.ones(joints), -np.ones(joints)]:
        action = action.astype(np.float32)
        q = rescaled.step(action)[0][:joints]
        simulation = env.simulation
        target = batch.targets(action[None])[0].clip(simulation.target_low, simulation.target_high)
        np.testing.assert_allclose(q, target, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", TASK_NAMES)
def test_the_observation_has_the_prescribed_length(name: str) -> None:
    env = MaraEnv(name)
    observation, _ = env.reset()
    assert observation.shape == env.observation_space.shape == (16 if "Orient" in name else 12,)
    assert observation.dtype == np.float64
    np.testing.assert_array_equal(observation[:6], np.zeros(6))


any_action = arrays(
    np.float32, 7, elements=st.floats(allow_nan=False, allow_infinity=False, width=32)
)


@given(st.lists(any_action, min_size=1, max_size=5), st.sampled_from([None, 1.5, 100.0]))
@pytest.mark.parametrize("robot", ["mara", "ur5", "panda"])
def test_any_finite_action_keeps_the_observation_in_its_space(
    robot: str, actions: list[Any], velocity: float | None
) -> None:
    env = MaraEnv(
        "MARACollisionOrient-v0",
        robot=robot_model(robot),
        max_joint_velocity=velocity,
        on_collision="continue",
    )
    assert env.observation_space.contains(env.reset()[0])
    for action in actions:
        observation, reward, _, _, info = env.step(action[: env.simulation.robot.num_joints])
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward)
        assert reward <= 10.0
        statistics = info.pop("statistics")
        assert np.isfinite([*info.values(), *statistics.values()]).all()


@given(arrays(np.float64, 6, elements=st.floats(-1e300, 1e300)))
def test_an_action_is_clipped_to_the_joint_limits_within_one_turn(action: Any) -> None:
    env = MaraEnv(on_collision="continue")
    env.reset()
    limit = np.minimum([3.1416, 2.35, 2.61, 3.14, 2.56, 3.14], np.float32(np.pi))
    np.testing.assert_array_equal(env.step(action)[0][:6], np.clip(action, -limit, limit))


def test_an_action_can_be_a_list_and_is_not_modified() -> None:
    env = MaraEnv()
    env.reset()
    assert env.step([0.1, 0.2, 0.3, 0.1, 0.2, 9.0])[0][:3].tolist() == [0.1, 0.2, 0.3]  # type: ignore[arg-type]
    action = np.full(6, 9.0, np.float32)
    env.step(action)
    assert (action == 9.0).all()


# The episode.


def test_the_reward_at_the_target_is_nearly_10() -> None:
    for name in TASK_NAMES:
        env = MaraEnv(name)
        env.reset()
        _, reward, _, _, info = env.step(np.array(TARGET_Q))
        assert reward == pytest.approx(9.97, abs=0.01)
        assert info["position_error"] < 3e-5
        assert not info["collided"]


def test_an_episode_is_truncated_after_the_registered_length() -> None:
    env = gymnasium.make("gym_mara/MARA-v0")
    env.reset()
    ends = [env.step(np.zeros(6))[2:4] for _ in range(2048)]
    assert ends[:-1] == [(False, False)] * 2047
    assert ends[-1] == (False, True)


def test_reset_moves_the_arm_to_the_start_configuration() -> None:
    start = (0.1, -0.2, 0.3, -0.4, 0.5, -0.6)
    env = MaraEnv(start_q=start)
    first, info = env.reset()
    assert info == {}
    np.testing.assert_array_equal(first[:6], start)
    env.step(np.zeros(6, np.float32))
    np.testing.assert_array_equal(env.reset()[0], first)


def test_info_has_the_terms_of_the_reward_as_plain_values() -> None:
    env = MaraEnv("MARACollisionOrient-v0")
    env.reset()
    _, reward, _, _, info = env.step(np.array(COLLIDING_Q))
    assert {name: type(value) for name, value in info.items()} == {
        "distance": float,
        "position_error": float,
        "angle_error": float,
        "reward_distance": float,
        "reward_orientation": float,
        "reward_collision": float,
        "collided": bool,
        "statistics": dict,
    }
    assert type(reward) is float
    assert reward == pytest.approx(
        info["reward_distance"] * info["reward_orientation"] - 1.0 - info["reward_collision"]
    )


# Collisions.


def _collide(on_collision: str, **options: Any) -> tuple[MaraEnv, Any]:
    """An arm that has just collided in motion, and the result of that step."""
    env = MaraEnv("MARACollision-v0", on_collision=on_collision, start_q=PATH_ENDS[0], **options)
    env.reset()
    for _ in range(2000):
        step = env.step(np.array(PATH_ENDS[1]))
        if step[4]["collided"]:
            return env, step
    raise AssertionError("the arm never collided")


@pytest.mark.parametrize("on_collision", ["reset", "terminate", "continue"])
def test_observation_and_reward_of_a_collision_show_the_colliding_configuration(
    on_collision: str,
) -> None:
    env, (observation, reward, terminated, truncated, info) = _collide(
        on_collision, max_joint_velocity=1.0
    )
    assert -1.3 < observation[3] < -1.1, "motor4 is where the links touch"
    position = env.simulation.robot.kinematics().pose(observation[None, :6])[0][0]
    error = position - env.simulation.goal.position[0]
    np.testing.assert_allclose(observation[6:9], error, rtol=0.0, atol=1e-12)
    distance = np.sqrt(np.mean(error**2))
    assert info["distance"] == pytest.approx(distance)
    assert info["reward_collision"] == pytest.approx(3.0 * min(2 * distance, 1.0) ** 0.03)
    assert reward == pytest.approx(info["reward_distance"] - 1.0 - info["reward_collision"])
    assert terminated == (on_collision == "terminate")
    assert not truncated


def test_with_reset_a_collision_moves_the_arm_to_its_start_and_the_episode_continues() -> None:
    env, _ = _collide("reset", max_joint_velocity=1.0)
    observation, _, terminated, _, info = env.step(np.add(PATH_ENDS[0], 0.5))
    np.testing.assert_allclose(observation[:6], np.array(PATH_ENDS[0]) + 0.02, atol=1e-12)
    assert not terminated
    assert not info["collided"]
    assert env.simulation.statistics.summary()["num_coll"][0] == 1


def test_with_continue_the_arm_moves_on_from_the_collision() -> None:
    env, (colliding, *_) = _collide("continue", max_joint_velocity=1.0)
    observation = env.step(np.array(PATH_ENDS[0]))[0]
    assert np.abs(observation[:6] - colliding[:6]).max() == pytest.approx(0.02)


@pytest.mark.parametrize("on_collision", ["reset", "terminate", "continue"])
def test_a_teleport_into_a_collision(fake_backend: str, on_collision: str) -> None:
    env = MaraEnv(backend=fake_backend, on_collision=on_collision)
    env.reset()
    backend = env.simulation.backend
    observation, _, terminated, _, info = env.step(np.full(6, 1.5))
    assert info["collided"]
    np.testing.assert_array_equal(observation[:6], np.full(6, 1.5))
    expected = np.zeros(6) if on_collision == "reset" else np.full(6, 1.5)
    np.testing.assert_array_equal(backend.state.q[0], expected)
    assert terminated == (on_collision == "terminate")
    assert env.step(np.full(6, 0.5))[4]["collided"] is False


def test_only_the_collision_tasks_penalise_a_collision() -> None:
    rewards = {}
    for name in TASK_NAMES:
        env = MaraEnv(name)
        env.reset()
        rewards[name] = env.step(np.array(COLLIDING_Q))[1]
    assert rewards["MARA-v0"] - rewards["MARACollision-v0"] > 2.5
    assert rewards["MARAOrient-v0"] - rewards["MARACollisionOrient-v0"] > 2.5


# Copies, snapshots, seeds.


@pytest.mark.parametrize("duplicate", COPIES)
@pytest.mark.parametrize("options", [{}, {"max_joint_velocity": 1.0}, {"collision": "fcl"}])
def test_a_copy_in_mid_episode_continues_identically(
    duplicate: Callable[[Any], Any], options: dict[str, Any]
) -> None:
    env = gymnasium.make("gym_mara/MARACollisionOrient-v0", max_episode_steps=15, **options)
    env.reset(seed=3)
    _steps(env, 5)
    other = duplicate(env)
    _assert_same_steps(_steps(env, 10, seed=1), _steps(other, 10, seed=1))
    assert env.unwrapped.np_random.random() == other.unwrapped.np_random.random()


def test_a_copy_is_independent_of_its_original(fake_backend: str) -> None:
    env = MaraEnv(backend=fake_backend)
    env.reset()
    other = copy.deepcopy(env)
    other.step(np.full(6, 0.5))
    other.close()
    np.testing.assert_array_equal(env.simulation.backend.state.q[0], np.zeros(6))
    env.step(np.zeros(6, np.float32))


@pytest.mark.parametrize("velocity", [None, 1.0])
def test_restore_state_returns_to_a_snapshot(velocity: float | None) -> None:
    env = MaraEnv("MARACollision-v0", max_joint_velocity=velocity)
    env.reset(seed=3)
    _steps(env, 5)
    snapshot = pickled(env.save_state())
    expected, drawn = _steps(env, 10, seed=1), env.np_random.random()
    other = MaraEnv("MARACollision-v0", max_joint_velocity=velocity)
    for each in (env, other, env):
        each.restore_state(snapshot)
        _assert_same_steps(_steps(each, 10, seed=1), expected)
        assert each.np_random.random() == drawn
        assert each.simulation.statistics.summary()["ep_steps"].tolist() == [15]


@pytest.mark.parametrize("name", ENV_IDS)
def test_the_same_seed_gives_the_same_results(name: str) -> None:
    runs = []
    for _ in range(2):
        env = gymnasium.make(name)
        env.action_space.seed(7)
        observation, _ = env.reset(seed=7)
        steps = [env.step(env.action_space.sample()) for _ in range(20)]
        runs.append([(observation, 0.0, env.unwrapped.np_random.random()), *steps])
    _assert_same_steps(*runs)


def test_two_envs_in_one_process_are_independent() -> None:
    alone = MaraEnv("MARACollision-v0")
    alone.reset(seed=0)
    expected = _steps(alone, 20)
    env, other = MaraEnv("MARACollision-v0"), MaraEnv("MARACollision-v0")
    env.reset(seed=0)
    other.reset(seed=1)
    rng = np.random.default_rng(0)
    results: list[Any] = []
    for _ in range(20):
        results += _steps(env, 1, rng)
        _steps(other, 1, seed=5)
    _assert_same_steps(results, expected)


def test_later_steps_do_not_change_earlier_results() -> None:
    env = MaraEnv("MARAOrient-v0")
    first, _ = env.reset()
    kept = first.copy()
    results = _steps(env, 3)
    copied = copy.deepcopy(results)
    _steps(env, 5, seed=1)
    env.reset()
    np.testing.assert_array_equal(first, kept)
    _assert_same_steps(results, copied)


# Other robots and tasks.


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_a_robot_can_be_given_by_its_name(name: str) -> None:
    env = gymnasium.make("gym_mara/MARACollisionOrient-v0", robot=name)
    joints = robot_model(name).num_joints
    observation, _ = env.reset()
    assert observation.shape == (joints + 10,)
    assert env.action_space.shape == (joints,)
    assert env.observation_space.contains(env.step(env.action_space.sample())[0])


def test_a_robot_can_be_given_by_its_urdf(tmp_path: Path) -> None:
    urdf = write(tmp_path / "stick.urdf", urdf_xml(*map(joint_xml, range(4))))
    env = gymnasium.make("gym_mara/MARA-v0", robot=str(urdf), ee_frame="link4")
    env.reset()
    observation = env.step(np.full(4, 0.1))[0]
    np.testing.assert_allclose(observation[:4], 0.1)


def test_a_task_can_be_given_as_a_value(mara: RobotModel) -> None:
    env = MaraEnv(ReachTask(orientation=True, alpha=3.0), robot=mara, alpha=4.0)
    assert env.simulation.task == ReachTask(orientation=True, alpha=4.0)
    assert env.reset()[0].shape == (16,)


def test_constants_of_the_reward_are_keyword_arguments() -> None:
    env = MaraEnv("MARACollision-v0", delta=0.0)
    env.reset()
    _, reward, _, _, info = env.step(np.array(COLLIDING_Q))
    assert info["collided"]
    assert reward == pytest.approx(info["reward_distance"] - 1.0)


# Wrong use.


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(5), r"the action has shape \(5,\); mara needs \(6,\)"),
        (np.zeros((1, 6)), r"the action has shape \(1, 6\); mara needs \(6,\)"),
        (0.0, r"the action has shape \(\); mara needs \(6,\)"),
        (
            np.array([0.1] * 5 + [np.nan]),
            r"the action contains NaN or infinity; .*\(joint targets, rad\)",
        ),
        (np.array([0.1] * 5 + [np.inf]), "the action contains NaN or infinity"),
        (np.array([0.1] * 5 + [-np.inf]), "the action contains NaN or infinity"),
        (["a"] * 6, "an action must be an array of integers or floats"),
        (None, r"the action has shape \(\)|an action must be"),
    ],
)
def test_an_invalid_action_moves_no_joint_and_is_not_counted(action: Any, message: str) -> None:
    env = MaraEnv(max_joint_velocity=1.0)
    env.reset()
    env.step(np.full(6, 0.5))
    before = env.simulation.backend.state
    with pytest.raises(GymMaraError, match=message):
        env.step(action)
    after = env.simulation.backend.state
    np.testing.assert_array_equal(after.q, before.q)
    np.testing.assert_array_equal(after.time, before.time)
    assert env.simulation.statistics.summary()["ep_steps"].tolist() == [1]
    env.step(np.full(6, 0.5))


@pytest.mark.parametrize("make", [MaraEnv, MaraVectorEnv])
def test_a_step_before_the_first_reset_is_an_error(
    make: Callable[[], MaraEnv | MaraVectorEnv],
) -> None:
    env = make()
    action = env.action_space.sample()
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before the first step\(\)"):
        env.step(action)
    env.reset()
    env.step(action)


@pytest.mark.parametrize("make", [MaraEnv, MaraVectorEnv])
def test_use_after_close_is_an_error(make: Callable[[], MaraEnv | MaraVectorEnv]) -> None:
    env = make()
    env.reset()
    snapshot = env.save_state()
    env.close()
    env.close()
    with pytest.raises(ClosedEnvironmentError, match="closed; make a new one"):
        env.step(env.action_space.sample())
    with pytest.raises(ClosedEnvironmentError, match="closed; make a new one"):
        env.reset()
    with pytest.raises(ClosedEnvironmentError, match="closed; make a new one"):
        env.restore_state(snapshot)


@pytest.mark.parametrize("make", [MaraEnv, MaraVectorEnv])
def test_close_closes_the_backend(
    fake_backend: str, make: Callable[..., MaraEnv | MaraVectorEnv]
) -> None:
    env = make(backend=fake_backend)
    backend = env.simulation.backend
    assert isinstance(backend, FakeBackend)
    assert not backend.closed
    env.close()
    assert backend.closed


@pytest.mark.parametrize("make", [MaraEnv, MaraVectorEnv])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "MARA-v1"}, r"unknown task 'MARA-v1'\. Did you mean 'MARA-v0'\?.*MARAOrient-v0"),
        ({"backend": "gazebo"}, r"unknown backend 'gazebo'\..*Valid: .*pinocchio"),
        ({"robot": "mira"}, r"unknown robot 'mira'\. Did you mean 'mara'\?.*ur5"),
        ({"robot": 7}, "robot"),
        ({"on_collision": "stop"}, r"unknown on_collision 'stop'.*continue, reset, terminate"),
        ({"collision": "bullet"}, r"unknown collision engine 'bullet'.*coal, fcl"),
        ({"colision": "fcl"}, r"unknown keyword argument 'colision'.*collision, .*control_period"),
        (
            {"on_colision": "x"},
            r"'on_colision' with backend 'pinocchio'\. Did you mean 'on_collision'\?",
        ),
        ({"orientation": "no"}, "orientation must be True or False, not 'no'"),
        ({"collision_penalty": 3}, "collision_penalty must be True or False, not 3"),
        (
            {"ee_frame": "hand"},
            r"has no link 'hand' for the end-effector frame; it has: .*ee_link",
        ),
        ({"robot": "none.urdf"}, r"cannot read .*none\.urdf"),
        ({"start_q": [0.0] * 5}, r"start_q has shape \(5,\); mara needs \(6,\)"),
        ({"start_q": [0, 3, 0, 0, 0, 0]}, r"start_q: joint motor2 cannot be at 3\.0; its limits"),
        ({"target_quaternion": [1, 1, 0, 0]}, "give a unit quaternion"),
        ({"target_position": [1, 1]}, "target_position must be a list of 3 finite numbers"),
        ({"max_joint_velocity": 0}, "max_joint_velocity must be finite and positive"),
        ({"max_joint_velocity": "fast"}, "max_joint_velocity must be finite and positive"),
        ({"control_period": -1}, "control_period must be finite and positive"),
        ({"control_period": "long"}, "control_period must be finite and positive"),
        ({"path_resolution": 0}, "path_resolution must be finite and positive"),
    ],
)
def test_invalid_options_are_refused(
    make: Callable[..., MaraEnv | MaraVectorEnv], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        make(**options)


@pytest.mark.parametrize("make", [MaraEnv, MaraVectorEnv])
def test_a_start_in_collision_gives_a_warning_once(make: Callable[..., Any]) -> None:
    env = make(max_joint_velocity=1.57, start_q=COLLIDING_Q)
    with pytest.warns(
        UserWarning, match="start_q .* in collision.*: motor4_link, motor5_link, table"
    ):
        env.reset(seed=0)
    env.reset()
    make(collision="none", start_q=COLLIDING_Q).reset()


@pytest.mark.parametrize("make", [MaraEnv, MaraVectorEnv])
def test_a_target_out_of_reach_gives_a_warning_and_works(
    make: Callable[..., MaraEnv | MaraVectorEnv],
) -> None:
    with pytest.warns(UserWarning, match=r"out of reach of mara's 'ee_link'.* 208\.3 mm"):
        env = make(target_position=[0.0, 0.0, 2.0])
    observation, _ = env.reset()
    assert env.observation_space.contains(observation)
