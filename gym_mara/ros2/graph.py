"""Who publishes and who subscribes to a topic, whether they fit together, and which joints a controller has."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from gym_mara.ros2.node import needs_ros

with needs_ros("ROS 2"):
    from rcl_interfaces.srv import GetParameters
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

BEST_EFFORT, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
VOLATILE, TRANSIENT_LOCAL = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL

_PATIENCE = 1.0
"""How long the answer of a controller is waited for, s."""
_POLL = 0.01


class Endpoint(NamedTuple):
    """A publisher or a subscriber."""

    node: str
    """The full name of its node."""
    type: str
    """The type of its messages, such as "sensor_msgs/msg/JointState"."""
    qos: Any


def publishers(node: Any, topic: str) -> list[Endpoint]:
    """The publishers of a topic, those of the node itself among them."""
    return [_endpoint(info) for info in node.get_publishers_info_by_topic(topic)]


def subscribers(node: Any, topic: str) -> list[Endpoint]:
    """The subscribers of a topic, those of the node itself among them."""
    return [_endpoint(info) for info in node.get_subscriptions_info_by_topic(topic)]


def _endpoint(info: Any) -> Endpoint:
    name = f"{info.node_namespace.rstrip('/')}/{info.node_name}"
    return Endpoint(name, info.topic_type, info.qos_profile)


def others(endpoints: Sequence[Endpoint], node: Any, own: int) -> list[Endpoint]:
    """The endpoints without a number of those of the node itself, of which another node may have the name."""
    left = []
    for endpoint in endpoints:
        if own and endpoint.node == node.get_fully_qualified_name():
            own -= 1
        else:
            left.append(endpoint)
    return left


def names(endpoints: Sequence[Endpoint]) -> str:
    """The nodes of endpoints, for messages."""
    return ", ".join(sorted(endpoint.node for endpoint in endpoints))


def described(endpoints: Sequence[Endpoint]) -> str:
    """The nodes of endpoints with their qualities of service, for messages."""
    texts = []
    for endpoint in sorted(endpoints, key=lambda each: each.node):
        qualities = endpoint.qos.reliability.name, endpoint.qos.durability.name
        texts.append(f"{endpoint.node} ({', '.join(qualities).lower().replace('_', ' ')})")
    return ", ".join(texts)


def type_name(message: Any) -> str:
    """The name of a message's type as the graph has it."""
    package = message.__module__.split(".")[0]
    return f"{package}/msg/{message.__name__}"


def qos_problem(publisher: Any, subscriber: Any) -> str | None:
    """Why nothing arrives from a publisher with this quality of service at a subscriber with that one; None if it does.

    Deadlines and leases are not compared: an endpoint that was discovered has others than one that was made without.
    """
    if publisher.reliability == BEST_EFFORT and subscriber.reliability == RELIABLE:
        return "the publisher is best effort, and the subscriber wants reliable"
    if publisher.durability == VOLATILE and subscriber.durability == TRANSIENT_LOCAL:
        return "the publisher is volatile, and the subscriber wants transient local"
    return None


def joints_of(node: Any, controller: str) -> tuple[str, ...] | None:
    """The joints of a controller in its order, of its parameter `joints`; None if it does not tell them.

    Not for the thread of the node, which gets the answer.

    Args:
        node: the ROS node that asks.
        controller: the full name of the controller's node.
    """
    service = f"{controller}/get_parameters"
    if not node.count_services(service):
        return None
    client = node.create_client(GetParameters, service)
    try:
        if not client.wait_for_service(_PATIENCE):
            return None
        answer = client.call_async(GetParameters.Request(names=["joints"]))
        end = time.monotonic() + _PATIENCE
        while not answer.done():
            if time.monotonic() > end:
                return None
            time.sleep(_POLL)
        values = answer.result().values
    finally:
        node.destroy_client(client)
    return tuple(values[0].string_array_value) or None if values else None
