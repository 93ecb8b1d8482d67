"""The node of its own: domains, failures in callbacks, its end; and the errors without ROS."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import pytest

pytest.importorskip("rclpy")

from std_msgs.msg import String

from gym_mara.errors import GymMaraError, MissingExtraError
from gym_mara.ros2.node import OtherRosError, RosNode, import_error
from tests.ros2.peers import Peer, eventually


def test_domains_are_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    for domain in (-1, 233, 10**30, True):
        with pytest.raises(GymMaraError, match="from 0 to 232"):
            RosNode("x", domain=domain)
    for text in ("x", "-1", "500", "1.5"):
        monkeypatch.setenv("ROS_DOMAIN_ID", text)
        with pytest.raises(GymMaraError, match="ROS_DOMAIN_ID"):
            RosNode("x")


def test_a_bad_name_is_an_error_and_leaves_no_thread(ros_domain: int) -> None:
    before = threading.active_count()
    with pytest.raises(GymMaraError, match="cannot make the ROS node"):
        RosNode("a b")
    assert threading.active_count() == before


def test_a_failing_callback_does_not_end_the_node(ros_domain: int) -> None:
    node, peer = RosNode("fails"), Peer()
    try:
        heard: list[str] = []

        def callback(message: String) -> None:
            heard.append(message.data)
            raise RuntimeError("on purpose")

        node.node.create_subscription(String, "/words", callback, 10)
        words = peer.publisher(String, "/words")
        eventually(lambda: words.publish(String(data="x")) or len(heard) >= 3)
        eventually(lambda: node.failures >= 3)
    finally:
        node.close()
        peer.close()


def test_closing_ends_the_thread_and_domains_are_apart(ros_domain: int) -> None:
    here, there = RosNode("here", domain=ros_domain), RosNode("there", domain=ros_domain + 101)
    assert (here.domain, there.domain) == (ros_domain, ros_domain + 101)
    for node in (here, there):
        node.close()
        node.close()
        assert not node._thread.is_alive()


def test_a_callback_that_does_not_end_does_not_hold_the_end(ros_domain: int) -> None:
    node, peer, ending = RosNode("hangs"), Peer(), threading.Event()
    try:
        entered = threading.Event()

        def hang(_: String) -> None:
            entered.set()
            ending.wait(10.0)

        node.node.create_subscription(String, "/words", hang, 10)
        words = peer.publisher(String, "/words")
        eventually(lambda: words.publish(String()) or entered.is_set())
        before = time.monotonic()
        node.close(timeout=0.2)
        assert time.monotonic() - before < 2.0
    finally:
        ending.set()
        node._thread.join(5.0)
        peer.close()


@pytest.mark.parametrize(
    ("distribution", "python", "numpy"), [("humble", "3.10", "1.21"), ("jazzy", "3.12", "1.26")]
)
def test_a_sourced_ros_of_another_python_is_told(
    distribution: str, python: str, numpy: str
) -> None:
    missing = ImportError("No module named '_rclpy_pybind11'", name="_rclpy_pybind11")
    error = import_error("a test", missing, distribution)
    assert isinstance(error, OtherRosError)
    for words in (distribution, f"Python {python}", f"NumPy {numpy}", "gym_mara[ros2]"):
        assert words in str(error)


def test_a_missing_ros_names_the_extra() -> None:
    error = import_error("a test", ImportError("No module", name="no_such_rclpy"), None)
    assert isinstance(error, MissingExtraError)
    assert "no_such_rclpy, which is not installed" in str(error)
    assert "gym_mara[ros2]" in str(error)


_WITHOUT = """
import sys
for name in ("rclpy", "sensor_msgs"):
    sys.modules[name] = None
import gym_mara, gym_mara.cli.app
import gym_mara.ros2.profiles, gym_mara.ros2.joints, gym_mara.ros2.sim.arm
try:
    import gym_mara.ros2.link
except ImportError as error:
    print(type(error).__name__, error)
"""


def test_without_ros_only_what_needs_it_fails() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", _WITHOUT], capture_output=True, text=True, timeout=60, check=True
    )
    assert ended.stdout.startswith("MissingExtraError ROS 2 needs rclpy")


_NOT_CLOSED = """
from gym_mara.ros2.node import RosNode
RosNode("forgotten")
print("end", flush=True)
"""


def test_a_node_that_is_not_closed_ends_with_the_process(ros_domain: int) -> None:
    ended = subprocess.run([sys.executable, "-c", _NOT_CLOSED], capture_output=True, timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"end\n", b"")
