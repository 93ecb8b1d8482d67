"""What an environment tells an exported policy, and when the policy refuses an environment."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from gym_mara.backends.dart import DartBackend
from gym_mara.deploy import About, OnnxPolicy
from gym_mara.deploy.about import Action
from gym_mara.deploy.environment import interface
from gym_mara.envs import MaraEnv, MaraGoalEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from tests.deploy.models import about, fitting, model, solving, write_model
from tests.helpers import joint_xml, urdf_xml, write


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


@pytest.mark.filterwarnings("ignore:.*velocity limit 0")
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


# And back: the environment of a policy.


REACH: dict[str, Any] = {"start": "home", "max_joint_velocity": 1.0, "servo_gain": 5.0}


def test_the_environment_of_the_training_is_made_again(tmp_path: Path) -> None:
    own = OnnxPolicy(solving(tmp_path / "policy.onnx", "MARAReach-v0", action_scale=0.02, **REACH))
    env = gymnasium.make(f"gym_mara/{own.about.env}", **own.keywords())
    own.check(env)
    simulation = env.unwrapped.simulation  # type: ignore[attr-defined]
    assert simulation.task.start == "home"
    assert simulation.backend.servo_gain == 5.0
    np.testing.assert_array_equal(simulation.backend.joint_velocity, np.ones(6))
    np.testing.assert_array_equal(simulation.actions.steps, np.full(6, 0.02))
    env.close()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"action": "relative", "action_scale": 0.01, "action_from": "target"},
        {"action": "cartesian"},
        {"control_period": 0.01},
        {"robot": ["base", "motor_large", "motor_medium", "tool"]},
    ],
    ids=str,
)
def test_it_has_the_actions_the_period_and_the_robot_of_the_policy(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    own = policy(tmp_path, fitting(MaraEnv(**options), **options))
    own.check(MaraEnv(**own.keywords()))


def test_what_is_given_replaces_the_keyword_arguments_of_the_training(tmp_path: Path) -> None:
    own = OnnxPolicy(solving(tmp_path / "policy.onnx", "MARAReach-v0", **REACH))
    there = own.keywords(start="random", position_tolerance=0.01)
    assert (there["start"], there["position_tolerance"]) == ("random", 0.01)
    with pytest.raises(GymMaraError, match="it acts with relative actions"):
        own.check(MaraEnv("MARAReach-v0", **own.keywords(action="absolute")))


def test_another_backend_gets_the_settings_that_it_knows(tmp_path: Path) -> None:
    own = OnnxPolicy(
        solving(tmp_path / "policy.onnx", "MARAReach-v0", path_resolution=0.01, **REACH)
    )
    env = MaraEnv("MARAReach-v0", **own.keywords(backend="dart"))
    own.check(env)
    assert env.simulation.backend.servo_gain == 5.0
    env.close()


def test_another_environment_gets_the_keyword_arguments_that_it_knows(tmp_path: Path) -> None:
    own = policy(tmp_path, fitting(MaraEnv(kappa=0.5), kappa=0.5, max_joint_velocity=1.0))
    assert own.keywords()["kappa"] == 0.5
    there = own.keywords("MARAReach-v0")
    assert "kappa" not in there
    assert there["max_joint_velocity"] == 1.0


def test_what_was_set_for_the_machine_of_the_training_is_left_out(tmp_path: Path) -> None:
    options: dict[str, Any] = {"collision_threads": 2, "workers": 16, "package_dirs": ["robots"]}
    own = policy(tmp_path, fitting(MaraEnv(), **options))
    assert own.keywords() == {"backend": "pinocchio", "action": "absolute", "control_period": 0.02}


@pytest.mark.parametrize("name", ["viewer_host", "render_mode", "num_envs", "colour"])
def test_a_file_cannot_set_anything_else(tmp_path: Path, name: str) -> None:
    own = policy(tmp_path, fitting(MaraEnv(), **{name: "0.0.0.0"}))
    with pytest.raises(GymMaraError, match=f"unknown keyword argument '{name}' in the metadata"):
        own.keywords()
    assert name not in own.keywords(backend="mujoco")


@pytest.mark.parametrize("missing", ["dart", "of another package"])
def test_where_the_backend_of_the_training_is_missing_the_policy_plays_on_the_default_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    monkeypatch.setattr(DartBackend, "require_machine", refuse)
    metadata = fitting(MaraEnv("MARAReach-v0"), "MARAReach-v0", physics_step=0.001)
    training = dataclasses.replace(metadata.training, backend=missing)
    own = policy(tmp_path, dataclasses.replace(metadata, training=training))
    with pytest.warns(match=f"was trained on '{missing}' and plays on 'pinocchio' here: "):
        there = own.keywords()
    assert there["backend"] == "pinocchio"
    own.check(MaraEnv("MARAReach-v0", **there))
    assert own.keywords(backend="mujoco")["backend"] == "mujoco"


def refuse() -> None:
    raise GymMaraError("there is no such machine")
