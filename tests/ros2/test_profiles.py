"""Profiles: topics, names, durations."""

from __future__ import annotations

import pytest

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2.profiles import PROFILES, make_profile

MARA_JOINTS = tuple(f"motor{number}" for number in range(1, 7))


def test_the_usual_topics() -> None:
    topics = {
        name: (p.command_topic, p.state_topic) for name in PROFILES for p in [make_profile(name)]
    }
    assert topics == {
        "trajectory": ("/joint_trajectory_controller/joint_trajectory", "/joint_states"),
        "forward": ("/forward_position_controller/commands", "/joint_states"),
        "action": ("/joint_trajectory_controller/follow_joint_trajectory", "/joint_states"),
        "mara-2019": ("/mara_controller/command", "/mara_controller/state"),
    }


def test_a_controller_and_a_namespace_are_parts_of_the_topics() -> None:
    ur = make_profile(controller="scaled_joint_trajectory_controller", namespace="/left/")
    assert ur.command_topic == "/left/scaled_joint_trajectory_controller/joint_trajectory"
    assert ur.state_topic == "/left/joint_states"
    mara = make_profile("mara-2019", controller="arm", namespace="cell/one")
    assert (mara.command_topic, mara.state_topic) == (
        "/cell/one/arm/command",
        "/cell/one/arm/state",
    )


def test_a_topic_can_be_given_as_it_is() -> None:
    own = make_profile(namespace="left", command_topic="/other/commands", state_topic="states")
    assert (own.command_topic, own.state_topic) == ("/other/commands", "/states")


@pytest.mark.parametrize(
    "name", ["a b", "1arm", "a__b", "arm/", "/", "//a", "ärm", "a-b", "~/x", "a\n", "{x}", ""]
)
def test_a_name_that_is_none_of_ros_is_refused(name: str) -> None:
    with pytest.raises(GymMaraError, match="no name of ROS"):
        make_profile(command_topic=name)


def test_a_topic_that_is_too_long_is_refused() -> None:
    assert len(make_profile(command_topic="/" + "n" * 199).command_topic) == 200
    with pytest.raises(GymMaraError, match=r"has 201 characters.* may have 200"):
        make_profile(command_topic="/" + "n" * 200)
    with pytest.raises(GymMaraError, match="with controller and namespace"):
        make_profile(namespace="n" * 3000)


def test_a_bad_namespace_is_refused() -> None:
    with pytest.raises(GymMaraError, match="namespace"):
        make_profile(namespace="left arm")


def test_an_unknown_profile_suggests_one() -> None:
    with pytest.raises(GymMaraError, match="Did you mean 'trajectory'"):
        make_profile("trajectories")


def test_a_point_takes_two_periods_and_that_of_2019_a_millisecond() -> None:
    assert make_profile().duration(0.02) == 0.04
    assert make_profile("mara-2019").duration(0.02) == 0.001


def test_only_the_profile_of_2019_has_a_velocity_of_its_own() -> None:
    assert make_profile("mara-2019").velocity == 0.5
    assert make_profile("mara-2019", velocity=1.57).velocity == 1.57
    with pytest.raises(GymMaraError, match="leave out velocity"):
        make_profile("forward", velocity=0.5)
    with pytest.raises(GymMaraError, match="velocity must be"):
        make_profile("mara-2019", velocity=-0.5)


def test_the_profile_of_2019_is_for_mara(mara: RobotModel) -> None:
    profile = make_profile("mara-2019")
    profile.check(mara.joint_names)
    assert mara.joint_names == MARA_JOINTS
    with pytest.raises(GymMaraError, match="motor1"):
        profile.check(("shoulder", "elbow"))


def test_without_control_msgs_the_states_are_joint_states() -> None:
    replaced = make_profile("mara-2019", namespace="left").with_joint_states()
    assert (replaced.states, replaced.state_topic) == ("joint_states", "/left/joint_states")
    assert replaced.command_topic == "/left/mara_controller/command"
    forward = make_profile("forward")
    assert forward.with_joint_states() is forward
