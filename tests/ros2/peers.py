"""Peers of the tests with ROS: a node that publishes and listens, and waiting with an end."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from gym_mara.ros2.node import RosNode


def eventually(condition: Callable[[], Any], timeout: float = 8.0) -> Any:
    """Wait until a condition holds; returns what it returns.

    Raises:
        AssertionError: it does not in time.
    """
    end = time.monotonic() + timeout
    while not (value := condition()):
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.01)
    return value


class Peer:
    """A node that publishes, and keeps what it hears."""

    def __init__(self, name: str = "peer") -> None:
        self.ros = RosNode(name)

    def publisher(self, kind: Any, topic: str, qos: Any = 10) -> Any:
        return self.ros.node.create_publisher(kind, topic, qos)

    def heard(self, kind: Any, topic: str, qos: Any = 10) -> list[Any]:
        """What is heard on a topic, from now on."""
        messages: list[Any] = []
        self.ros.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def call(self, kind: Any, name: str) -> Any:
        """The response of a service without arguments."""
        client = self.ros.node.create_client(kind, name)
        assert client.wait_for_service(timeout_sec=8.0)
        future = client.call_async(kind.Request())
        try:
            eventually(future.done)
        finally:
            self.ros.node.destroy_client(client)
        return future.result()

    def close(self) -> None:
        self.ros.close()
