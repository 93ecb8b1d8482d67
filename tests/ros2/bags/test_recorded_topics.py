"""Which topics `gym-mara ros2 record` records, those of one arm with a profile, and which `replay` cannot publish."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys.stores import ros2_jazzy as types
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from gym_mara.errors import GymMaraError
from gym_mara.ros2 import messages
from gym_mara.ros2.bags import recording
from gym_mara.ros2.bags.bag import Bag, Recorder
from gym_mara.ros2.profiles import make_profile
from tests.helpers import Cli
from tests.ros2.peers import Peer

CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
OF_A_POLICY = ("/gym_mara/target", "/diagnostics")


def arm(peer: Peer, namespace: str, prefix: str = "") -> None:
    """Publish the states and the description of an arm."""
    states = peer.publisher(JointState, f"{namespace}/joint_states")
    state = JointState(name=[f"{prefix}motor{n}" for n in range(1, 7)], position=[0.0] * 6)
    peer.ros.node.create_timer(0.02, lambda: states.publish(state))
    description = peer.publisher(String, f"{namespace}/robot_description", messages.LATCHED)
    description.publish(String(data=f"that of {namespace}"))


def test_a_profile_records_the_topics_of_its_arm_alone(
    peer: Peer, tmp_path: Path, gym_mara: Cli
) -> None:
    arm(peer, "/left")
    arm(peer, "/right")
    bag = tmp_path / "bag"
    arguments = ["--profile", "forward", "--namespace", "left", "--seconds", "0.5"]
    code, output, error = gym_mara("ros2", "record", bag, *arguments)
    assert (code, error.count("note")) == (0, 0)
    missing = "/left/forward_position_controller/commands, /left/gym_mara/target, /diagnostics"
    assert f"not found: {missing}\n" in output
    assert "lack" not in output
    with Bag(bag) as read:
        assert set(read.topics) == {"/left/joint_states", "/left/robot_description"}
        (description,) = read.messages(["/left/robot_description"])
        assert description.value.data == "that of /left"
        assert len(list(read.messages(["/left/joint_states"]))) > 10


def test_states_of_another_robot_are_told_and_other_topics_are_recorded_too(
    peer: Peer, tmp_path: Path, gym_mara: Cli
) -> None:
    arm(peer, "/left", "left_")
    arguments = ["--profile", "trajectory", "--namespace", "left", "--robot", "mara"]
    more = ["--topic", "/more", "--topic", "/right/joint_states", "--seconds", "0.3"]
    peer.publisher(String, "/more")
    code, output, _ = gym_mara("ros2", "record", tmp_path / "bag", *arguments, *more)
    assert code == 0
    assert "lack motor1, motor2, " in output
    assert "/diagnostics, /right/joint_states\n" in output
    (row,) = (line for line in output.splitlines() if "/more" in line)
    assert row.split()[-2] == "0"


def test_a_topic_needs_no_slash_and_those_that_are_not_there_are_noted(
    peer: Peer, tmp_path: Path, gym_mara: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "ABSENT", 0.5)
    arm(peer, "/left")
    arguments = ["--topic", "left/joint_states", "--topic", "missing", "--seconds", "1"]
    code, output, error = gym_mara("ros2", "record", tmp_path / "bag", *arguments)
    assert code == 0
    assert error.count("note: not there yet: /missing.") == 1
    assert "not found: /missing\n" in output
    with Bag(tmp_path / "bag") as read:
        assert len(list(read.messages(["/left/joint_states"]))) > 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--namespace", "left", "--robot", "ur5"], "leave out --robot, --namespace"),
        (["--profile", "mara-2019", "--robot", "ur5"], "choose another profile"),
        (["--profile", "forward", "--controller", "a b"], "no name of ROS"),
        (["--profile", "forwards"], "Did you mean 'forward'"),
    ],
)
def test_wrong_options_record_nothing(
    arguments: list[str], message: str, tmp_path: Path, gym_mara: Cli
) -> None:
    code, _, error = gym_mara("ros2", "record", tmp_path / "bag", *arguments)
    assert code == 2
    assert message in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("there", [False, True])
def test_states_of_control_msgs_are_recorded_where_they_are_installed(
    there: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(messages, "control_msgs_installed", lambda: there)
    topics, notes = recording.topics_of(make_profile("mara-2019"))
    states = "/mara_controller/state" if there else "/joint_states"
    assert topics == (states, "/mara_controller/command", "/robot_description", *OF_A_POLICY)
    assert [("control_msgs is not installed" in note) for note in notes] == [True] * (not there)


def test_the_goals_of_an_action_are_not_recorded() -> None:
    topics, notes = recording.topics_of(make_profile("action", namespace="left"))
    policy = ("/left/gym_mara/target", "/diagnostics")
    assert topics == ("/left/joint_states", "/left/robot_description", *policy)
    assert "follow_joint_trajectory are on no topic" in notes[0]


def test_a_type_that_only_a_sourced_ros_has_is_recorded_by_its_definition(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    share = tmp_path / "ros" / "share"
    index = share / "ament_index" / "resource_index" / "packages" / "control_msgs"
    definition = share / "control_msgs" / "msg" / "JointTrajectoryControllerState.msg"
    for file, text in (
        (index, ""),
        (definition, "std_msgs/Header header\ntrajectory_msgs/JointTrajectoryPoint feedback\n"),
        (definition.with_name("Strange.msg"), "no_such_msgs/Thing thing\n"),
        (definition.with_name("Damaged.msg"), "float64[\n"),
    ):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ros"))
    with Recorder(tmp_path / "bag") as recorder:
        assert not recorder.knows(CONTROLLER_STATE)
        assert recording._define(recorder, CONTROLLER_STATE)
        recorder.add("/mara_controller/state", CONTROLLER_STATE, b"\x00\x01\x00\x00", 1)
        for kind in ("control_msgs/msg/Strange", "control_msgs/msg/Damaged", "no_msgs/msg/A"):
            assert not recording._define(recorder, kind)
            assert not recorder.knows(kind)
    with Bag(tmp_path / "bag") as bag:
        assert bag.topics == {"/mara_controller/state": CONTROLLER_STATE}
        (found,) = bag.raw(["/mara_controller/state"])
        assert "trajectory_msgs/JointTrajectoryPoint feedback" in str(found[0].msgdef.data)


def test_a_bag_with_a_topic_that_is_none_of_ros_is_not_replayed(
    tmp_path: Path, ros_domain: int
) -> None:
    with Recorder(tmp_path / "bag") as recorder:
        layout = types.std_msgs__msg__MultiArrayLayout([], 0)
        values = types.std_msgs__msg__Float64MultiArray(layout, np.zeros(1))
        recorder.add_value("/joint_st!tes", values, 1)
    with pytest.raises(GymMaraError, match=r"'/joint_st!tes' on /replay/…: .*topic name must"):
        recording.replay(tmp_path / "bag")
