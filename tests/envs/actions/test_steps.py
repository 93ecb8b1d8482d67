"""Actions that are steps of the joints or of the tool: how far they go, where they begin, and what is remembered of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pinocchio as pin
import pytest
from gymnasium.spaces import Box

from gym_mara.arrays import host
from gym_mara.envs import MaraEnv, MaraGoalVectorEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.tasks import ReachTask
from gym_mara.testing import COLLIDING_Q
from gym_mara.types import UnitActions
from tests.helpers import Floats, joint_xml, robot_model, urdf_xml, write

PERIOD, GAIN = 0.02, 10.0
START = (0.2, -0.5, 0.9, 0.1, 0.8, 0.2)
LIMIT = robot_model("mara").velocity_limit
ONE = np.ones((1, 6), np.float32)


def _env(num_envs: int = 1, **options: Any) -> MaraVectorEnv:
    """Arms at START."""
    env = MaraVectorEnv(num_envs, **({"start_q": START, "action": "relative"} | options))
    env.reset(seed=0)
    return env


def _q(env: MaraVectorEnv) -> Floats:
    return env.simulation.backend.state.q


def _state(env: Any) -> Any:
    """The state that the task judged in the last step."""
    return env.simulation.outcome.state


@pytest.mark.parametrize(
    ("options", "time"),
    [
        ({}, PERIOD),
        ({"max_joint_velocity": 100.0}, PERIOD),
        ({"servo_gain": GAIN}, PERIOD + 1.0 / GAIN),
        ({"backend": "mujoco"}, PERIOD + 1.0 / GAIN),
        ({"backend": "dart", "servo_gain": 5.0}, PERIOD + 1.0 / 5.0),
        ({"backend": "mujoco", "action_from": "target"}, PERIOD),
        ({"control_period": 0.1}, 0.1),
    ],
    ids=str,
)
def test_by_default_a_step_is_the_way_that_a_joint_can_travel(
    options: dict[str, Any], time: float
) -> None:
    env = _env(**options)
    assert env.single_action_space == Box(-1.0, 1.0, (6,), np.float32)
    np.testing.assert_allclose(env.simulation.actions.steps, LIMIT * time, rtol=1e-12)
    env.close()


def test_processes_have_the_steps_of_one_process() -> None:
    env = MaraVectorEnv(2, backend="dart", workers=2, action="relative", servo_gain=5.0)
    np.testing.assert_allclose(env.simulation.actions.steps, LIMIT * (PERIOD + 0.2), rtol=1e-12)
    env.close()


@pytest.mark.parametrize(
    "options", [{}, {"max_joint_velocity": 100.0}, {"servo_gain": GAIN}], ids=str
)
def test_the_action_1_moves_a_joint_as_far_as_its_limit_allows_and_not_further(
    options: dict[str, Any],
) -> None:
    env = _env(**options)
    env.step(ONE)
    np.testing.assert_allclose(_q(env)[0] - START, LIMIT * PERIOD, rtol=1e-12)
    env.reset(seed=0)
    env.step(0.99 * ONE)
    assert (_q(env)[0] - START < LIMIT * PERIOD * (1.0 - 1e-5)).all()


def test_a_scale_is_for_all_joints_or_for_each() -> None:
    env = _env(action_scale=0.03)
    env.step(np.linspace(-1.0, 1.0, 6)[None])
    np.testing.assert_allclose(_q(env)[0] - START, 0.03 * np.linspace(-1.0, 1.0, 6), atol=1e-12)
    scale = [0.01, 0.02, 0.0, 0.04, 0.05, 0.06]
    env = _env(action_scale=scale)
    env.step(ONE)
    np.testing.assert_allclose(_q(env)[0] - START, scale, atol=1e-12)


def test_actions_and_targets_are_clipped() -> None:
    high = _env().simulation.target_high
    env = _env(action_scale=0.03, start_q=high - 0.02, collision="none")
    env.step(np.array([[7.0, -9.0, 1.0, 0.0, 0.5, -1.0]]))
    expected = high - 0.02 + 0.03 * np.array([1.0, -1.0, 1.0, 0.0, 0.5, -1.0])
    np.testing.assert_allclose(_q(env)[0], np.minimum(expected, high), atol=1e-12)


@pytest.mark.parametrize(("start", "reached"), [("position", 0.05), ("target", 0.5)])
def test_steps_begin_at_the_position_or_at_the_last_target(start: str, reached: float) -> None:
    env = _env(action_scale=0.05, action_from=start, max_joint_velocity=0.05)
    for _ in range(10):
        env.step(ONE)
    before = _q(env)[0]
    np.testing.assert_allclose(before - START, 10 * 0.05 * PERIOD, atol=1e-12)
    for _ in range(600):
        env.step(0.0 * ONE)
    moved = 0.0 if start == "position" else reached - 10 * 0.05 * PERIOD
    np.testing.assert_allclose(_q(env)[0] - before, moved, atol=1e-9)


def test_an_arm_that_collided_begins_at_its_start_pose_again() -> None:
    env = _env(2, action_scale=3.0, action_from="target", start_q=None)
    away = np.array([COLLIDING_Q, np.zeros(6)]) / 3.0
    assert env.step(away)[4]["collided"].tolist() == [True, False]
    np.testing.assert_allclose(_state(env).action, away)
    env.step(np.tile(0.01 * ONE, (2, 1)))
    state = _state(env)
    np.testing.assert_allclose(state.q, 0.03, atol=1e-7)
    np.testing.assert_array_equal(state.last_action, np.zeros((2, 6)))


def test_a_new_episode_begins_at_its_start_pose_without_a_last_action() -> None:
    env = _env(2, action_scale=0.1, action_from="target", autoreset_mode="Disabled")
    for _ in range(3):
        env.step(np.tile(ONE, (2, 1)))
    env.reset(options={"reset_mask": np.array([True, False])})
    actions = env.simulation.actions
    np.testing.assert_array_equal(actions.action, [[0.0] * 6, [1.0] * 6])
    env.step(np.zeros((2, 6)))
    np.testing.assert_allclose(_q(env) - START, [[0.0] * 6, [0.3] * 6], atol=1e-12)


@pytest.mark.parametrize("mode", ["absolute", "relative", "cartesian"])
def test_a_state_has_the_last_two_actions_in_the_units_of_the_action_space(mode: str) -> None:
    env = _env(2, action=mode)
    first, second = (np.full((2, 6), value) for value in (0.25, 2.0))
    env.step(first)
    env.step(second)
    state = _state(env)
    np.testing.assert_allclose(state.last_action, first)
    np.testing.assert_allclose(state.action, second if mode == "absolute" else 1.0 + 0.0 * second)


def test_steps_begin_where_noisy_sensors_see_the_joints() -> None:
    noise = {"sensor_noise": (0.01, 0.02)}
    env = _env(3, backend="mujoco", randomisation=noise)
    actions: Any = env.simulation.actions
    observation, _ = env.reset(seed=1)
    for _ in range(3):
        np.testing.assert_array_equal(actions.origin, observation[:, :6])
        assert (np.abs(actions.origin - _q(env)) > 1e-6).any()
        observation = env.step(np.zeros((3, 6)))[0]
    env.close()


@dataclass(frozen=True)
class SteppingTask(ReachTask):
    """A task whose actions are steps."""

    default_action: ClassVar[str] = "relative"


def test_a_task_chooses_the_mode_unless_the_keyword_does() -> None:
    assert MaraEnv(SteppingTask()).simulation.actions.mode == "relative"
    assert MaraEnv(SteppingTask(), action="absolute").simulation.actions.mode == "absolute"
    assert MaraEnv().simulation.actions.mode == "absolute"


@dataclass(frozen=True)
class WrongTask(ReachTask):
    """A task whose mode does not exist."""

    default_action: ClassVar[str] = "sideways"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"action": "relativ"}, "unknown action 'relativ'.*Did you mean 'relative'"),
        ({"action": 1}, "unknown action 1"),
        ({"action_from": "here"}, "unknown action_from 'here'"),
        ({"action_scale": 0.0}, "action_scale must be finite and positive"),
        ({"action_scale": -0.1}, "action_scale must be finite and positive"),
        ({"action_scale": np.nan}, "action_scale must be finite and positive"),
        ({"action_scale": "0.1"}, "action_scale must be finite and positive"),
        ({"action_scale": True}, "action_scale must be finite and positive"),
        ({"action_scale": 1e3}, "action_scale must be at most 100"),
        ({"action_scale": 10.0}, r"action_scale must be at most 6.28, .*mara can move further; not 10"),
        ({"action_scale": [0.1] * 5}, "action_scale has 5 numbers, and an action of mara has 6"),
        ({"action_scale": [0.1] * 5 + [-1.0]}, "action_scale must be finite and not negative"),
        ({"action_scale": [0.0] * 6}, "action_scale must have a number that is not zero"),
        ({"action_scale": [[0.1]]}, "action_scale must be a list of finite numbers"),
        ({"action": "absolute", "action_scale": 0.1}, "action_scale has no meaning with absolute"),
        ({"action": "absolute", "action_from": "target"}, "action_from has no meaning with absolute"),
        ({"task": WrongTask(), "action": None}, "unknown default_action of the task 'sideways'"),
    ],
)  # fmt: skip
def test_settings_that_do_not_fit_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        MaraVectorEnv(1, **({"action": "relative"} | options))


@pytest.mark.parametrize("mode", ["relative", "cartesian"])
@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.full((1, 6), np.nan), r"the action contains NaN or infinity; .*in \[-1, 1\]"),
        (np.zeros((1, 5)), r"the action has shape \(1, 5\); mara needs \(1, 6\)"),
        (np.full((1, 6), "a"), "integers or floats .*not of <U1"),
    ],
)
def test_a_wrong_action_changes_nothing(mode: str, action: Any, message: str) -> None:
    env = _env(action=mode, action_from="target")
    env.step(0.5 * ONE)
    parts = ("backend", "actions")
    before = [repr(env.save_state()[part]) for part in parts]
    with pytest.raises(GymMaraError, match=message):
        env.step(action)
    assert [repr(env.save_state()[part]) for part in parts] == before


def test_a_policys_actions_are_accepted_as_steps() -> None:
    env = _env(action_scale=0.03)
    env.step(ONE.view(UnitActions))
    np.testing.assert_allclose(_q(env)[0] - START, 0.03, atol=1e-12)


def test_joint_targets_can_take_the_place_of_an_action() -> None:
    env = _env(action_scale=0.03, action_from="target")
    target = np.array([START]) + 0.2
    env.simulation.step_towards(target)
    np.testing.assert_array_equal(_q(env), target)
    env.step(ONE)
    np.testing.assert_allclose(_q(env), target + 0.03, atol=1e-12)
    with pytest.raises(GymMaraError, match="the joint target contains NaN"):
        env.simulation.step_towards(np.full((1, 6), np.nan))


def test_a_switch_of_the_backend_gives_steps_that_fit_it() -> None:
    env = MaraEnv(action="relative", action_from="target", start_q=START)
    env.reset(seed=0)
    env.step(ONE[0])
    q = env.simulation.backend.state.q
    env.simulation.switch_backend("mujoco")
    actions: Any = env.simulation.actions
    np.testing.assert_allclose(actions.origin, q)
    assert not actions.action.any()
    env.close()


# Cartesian actions.


def _moved(env: MaraVectorEnv, action: Floats, steps: int) -> tuple[Floats, Floats]:
    """How far the tools have moved (N, 3), m, and turned (N, 3), rad, after some steps."""
    kinematics = env.simulation.robot.kinematics()
    before = kinematics.joint_frames(_q(env))
    for _ in range(steps):
        env.step(action)
    after = kinematics.joint_frames(_q(env))
    turned = [pin.log3(b @ a.T) for a, b in zip(before.rotation, after.rotation, strict=True)]
    return after.position - before.position, np.array(turned)


@pytest.mark.parametrize(
    "options",
    [{}, {"max_joint_velocity": 100.0}, {"servo_gain": GAIN}, {"action_from": "target"}],
    ids=str,
)
def test_a_twist_moves_and_turns_the_tool_in_the_world(options: dict[str, Any]) -> None:
    env = _env(6, action="cartesian", **options)
    moved, turned = _moved(env, 0.25 * np.eye(6), 10)
    time = 10 * PERIOD
    expected = 0.25 * np.diag([0.4, 0.4, 0.4, 0.8, 0.8, 0.8]) * time
    np.testing.assert_allclose(moved, expected[:, :3], atol=4e-4)
    np.testing.assert_allclose(turned, expected[:, 3:], atol=1e-3)


def test_the_velocity_of_the_tool_is_a_keyword() -> None:
    env = _env(6, action="cartesian", action_scale=0.05)
    moved, turned = _moved(env, np.eye(6), 10)
    expected = 0.05 * 10 * PERIOD * np.eye(6)
    np.testing.assert_allclose(moved, expected[:, :3], atol=1e-4)
    np.testing.assert_allclose(turned, expected[:, 3:], atol=1e-4)


def test_a_twist_that_is_too_fast_keeps_its_direction_and_the_limits_of_the_joints() -> None:
    env = _env(6, action="cartesian", action_scale=20.0)
    moved, _ = _moved(env, np.eye(6), 1)
    ways = np.abs(_q(env) - START) / (LIMIT * PERIOD)
    np.testing.assert_allclose(ways.max(axis=1), 1.0, rtol=1e-9)
    along = moved[:3] / np.linalg.norm(moved[:3], axis=1, keepdims=True)
    np.testing.assert_allclose(along, np.eye(3), atol=0.05)


def test_at_a_singular_pose_the_steps_stay_within_their_limits() -> None:
    env = _env(12, action="cartesian", start_q=None, on_collision="continue")  # the arm is straight
    for _ in range(50):
        before = _q(env)
        env.step(np.vstack([np.eye(6), -np.eye(6)]))
        assert np.isfinite(_q(env)).all()
        assert (np.abs(_q(env) - before) <= LIMIT * PERIOD + 1e-9).all()


@pytest.mark.filterwarnings("ignore:.*the lower limit equals the upper limit")
def test_arms_with_fewer_joints_and_with_joints_that_cannot_move(tmp_path: Any) -> None:
    still = joint_xml(1, axis="0 1 0", limit='<limit effort="10" velocity="1"/>')
    joints = joint_xml(0, "prismatic", "1 0 0"), still, joint_xml(2, axis="0 1 0")
    file = write(tmp_path / "arm.urdf", urdf_xml(*joints))
    env = MaraVectorEnv(1, robot=str(file), ee_frame="link3", action="cartesian", collision="none")
    env.reset(seed=0)
    moved, _ = _moved(env, np.array([[0.1, 0.0, 0.0, 0.0, 0.0, 0.0]]), 5)
    assert _q(env)[0, 1] == 0.0
    assert moved[0, 0] > 0.5 * 0.1 * 0.4 * 5 * PERIOD


@pytest.mark.parametrize("kind", [MaraVectorEnv, MaraGoalVectorEnv])
@pytest.mark.parametrize("mode", ["relative", "cartesian"])
@pytest.mark.parametrize("start", ["position", "target"])
def test_many_arms_and_one_arm_and_tensors_give_the_same(
    kind: Callable[..., Any], mode: str, start: str, tensor_backend: str
) -> None:
    options: dict[str, Any] = {"backend": tensor_backend, "action": mode, "action_from": start}
    options |= {"max_joint_velocity": 1.0, "start_q": START, "action_scale": 0.3}
    forms: dict[str, Any] = {
        name: kind(3, "MARACollision-v0", arrays=name, **options) for name in ("numpy", "torch")
    }
    alone = kind(1, "MARACollision-v0", arrays="numpy", **options)
    for env in (*forms.values(), alone):
        env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(60):
        action = rng.uniform(-0.4, 1.2, (3, 6))
        forms["numpy"].step(action)
        forms["torch"].step(forms["torch"].simulation.backend.asarray(action))
        alone.step(action[:1])
        mine, theirs, one = map(_state, (*forms.values(), alone))
        for name in ("q", "action", "last_action"):
            expected = getattr(mine, name)
            np.testing.assert_allclose(host(getattr(theirs, name)), expected, atol=1e-9)
            np.testing.assert_allclose(getattr(one, name), expected[:1], atol=1e-9)


@pytest.mark.parametrize("mode", ["relative", "cartesian"])
@pytest.mark.parametrize("start", ["position", "target"])
def test_a_snapshot_has_the_last_targets_and_actions(mode: str, start: str) -> None:
    options = {"action": mode, "action_from": start, "max_joint_velocity": 0.3}
    env, other = _env(2, **options), _env(2, **options)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (10, 2, 6))
    for action in actions[:5]:
        env.step(action)
    snapshot = env.save_state()
    expected = [env.step(action)[0] for action in actions[5:]]
    last = _state(env).last_action
    for each in (other, env):
        each.restore_state(snapshot)
        again = [each.step(action)[0] for action in actions[5:]]
        np.testing.assert_array_equal(again, expected)
        np.testing.assert_array_equal(_state(each).last_action, last)
    with pytest.raises(GymMaraError, match=r"the snapshot is of .*action"):
        _env(2, action="absolute", max_joint_velocity=0.3).restore_state(snapshot)
