"""What an environment tells an exported policy, and when the policy refuses an environment."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from gym_mara.deploy import About, OnnxPolicy
from gym_mara.deploy.about import FORMAT, Action
from gym_mara.deploy.environment import interface
from gym_mara.envs import MaraEnv, MaraGoalEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from tests.deploy.models import about, model, write_model
from tests.helpers import joint_xml, urdf_xml, write


def fitting(env: Any) -> About:
    """The metadata of a policy for an environment."""
    return dataclasses.replace(about(), format=FORMAT, **interface(env.simulation)._asdict())


def policy(folder: Path, metadata: About) -> OnnxPolicy:
    return OnnxPolicy(write_model(folder / "policy.onnx", model(metadata)))


def test_limits_are_those_of_joint_targets() -> None:
    env = MaraEnv(max_joint_velocity=1.0)
    there = interface(env.simulation)
    assert there.control_period == 0.02
    assert there.robot.name == "mara"
    assert there.robot.ee_frame == env.simulation.robot.ee_frame
    assert [joint.name for joint in there.robot.joints] == [*env.simulation.robot.joint_names]
    assert {joint.unit for joint in there.robot.joints} == {"rad"}
    np.testing.assert_array_equal(
        [(joint.lower, joint.upper) for joint in there.robot.joints],
        np.stack([env.simulation.target_low, env.simulation.target_high], axis=1),
    )
    assert {joint.velocity for joint in there.robot.joints} == {1.0}
    assert [joint.travel for joint in there.robot.joints] == pytest.approx([0.02] * 6)


def test_teleporting_joints_have_the_velocity_of_the_robot() -> None:
    env = MaraEnv()
    velocities = [joint.velocity for joint in interface(env.simulation).robot.joints]
    assert velocities == env.simulation.robot.velocity_limit.tolist()


def test_a_servo_is_at_its_limit_from_farther_away() -> None:
    env = MaraEnv(backend="dart", max_joint_velocity=1.0, servo_gain=5.0)
    (joint, *_) = interface(env.simulation).robot.joints
    assert joint.travel == pytest.approx(1.0 * (0.02 + 1.0 / 5.0))
    env.close()


def test_a_target_at_the_end_of_the_travel_moves_a_joint_as_fast_as_a_far_one() -> None:
    moved = []
    for fraction in (1.0, 10.0, 0.5):
        env = MaraEnv(backend="dart", max_joint_velocity=1.0)
        env.reset(seed=0)
        (joint, *_) = interface(env.simulation).robot.joints
        assert joint.travel is not None
        target = np.zeros(6)
        target[0] = fraction * joint.travel
        env.step(target.astype(np.float32))
        moved.append(float(env.simulation.backend.state.q[0, 0]))
        env.close()
    assert moved[0] == pytest.approx(moved[1], rel=1e-6)
    assert moved[2] < 0.9 * moved[0]


def test_a_prismatic_joint_is_in_metres_and_may_have_no_limit_of_velocity(tmp_path: Path) -> None:
    unlimited = '<limit lower="0" upper="0.5" effort="10" velocity="0"/>'
    arm = urdf_xml(joint_xml(0), joint_xml(1, "prismatic", limit=unlimited), joint_xml(2))
    env = MaraEnv(robot=str(write(tmp_path / "arm.urdf", arm)), ee_frame="link3")
    turn, slide, _ = interface(env.simulation).robot.joints
    assert (turn.unit, turn.velocity) == ("rad", 2.0)
    assert (slide.unit, slide.velocity, slide.travel) == ("m", None, None)
    assert (slide.lower, slide.upper) == (0.0, 0.5)


def test_the_parts_of_an_array() -> None:
    parts = interface(MaraEnv("MARAOrient-v0").simulation).observation
    assert [(part.name, part.size, part.unit, part.input) for part in parts] == [
        ("joint_positions", 6, "joint", "observation"),
        ("position_error", 3, "m", "observation"),
        ("orientation_error", 4, "", "observation"),
        ("tool_velocity", 3, "m/s", "observation"),
    ]


def test_the_parts_of_a_dictionary() -> None:
    env = MaraGoalEnv()
    parts = interface(env.simulation).observation
    assert [(part.name, part.input) for part in parts] == [
        ("joint_positions", "observation"),
        ("tool_velocity", "observation"),
        ("tool_position", "achieved_goal"),
        ("target_position", "desired_goal"),
    ]
    sizes = {name: space.shape[0] for name, space in env.observation_space.items()}  # type: ignore[attr-defined]
    assert fitting(env).inputs == sizes


def test_a_policy_fits_its_environment_in_every_form(tmp_path: Path) -> None:
    own = policy(tmp_path, fitting(MaraEnv()))
    for env in (
        MaraEnv(),
        MaraVectorEnv(3),
        gymnasium.make("gym_mara/MARA-v0"),
        gymnasium.make_vec("gym_mara/MARA-v0", num_envs=2),
    ):
        own.check(env)


OTHERS: list[tuple[dict[str, Any], str]] = [
    ({"robot": "ur5"}, "it moves the joints motor1, .*, and the environment has shoulder_pan"),
    (
        {"task": "MARAOrient-v0"},
        r"it observes .*, and the environment has .*orientation_error \(4\)",
    ),
    ({"control_period": 0.01}, r"it acts every 0\.02 s, and the environment has 0\.01 s"),
    ({"ee_frame": "motor6_link"}, "trained for another robot, 'mara'"),
]


@pytest.mark.parametrize(("options", "message"), OTHERS)
def test_another_environment_is_refused(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    own = policy(tmp_path, fitting(MaraEnv()))
    with pytest.raises(GymMaraError, match=f"does not fit the environment: .*{message}"):
        own.check(MaraEnv(**options))


def test_a_dictionary_is_no_array(tmp_path: Path) -> None:
    own = policy(tmp_path, fitting(MaraEnv("MARARandomTarget-v0")))
    with pytest.raises(GymMaraError, match="it observes observation: joint_positions"):
        own.check(MaraGoalEnv())


def test_other_actions_are_refused(tmp_path: Path) -> None:
    env = MaraEnv()
    relative = Action("relative", (-1.0,) * 6, (1.0,) * 6, (0.03,) * 6, "position")
    own = policy(tmp_path, dataclasses.replace(fitting(env), action=relative))
    with pytest.raises(GymMaraError, match="it acts with relative actions from the position, low"):
        own.check(env)


@pytest.mark.parametrize("env", [None, 3, gymnasium.make("CartPole-v1")])
def test_an_environment_of_another_package_is_refused(tmp_path: Path, env: Any) -> None:
    with pytest.raises(GymMaraError, match="an environment of gym_mara is needed"):
        policy(tmp_path, about()).check(env)
