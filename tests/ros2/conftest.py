"""Fixtures of the tests with ROS: a domain of their own on this machine alone."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.ros2.peers import Peer

# Of each process of the tests, so that they do not hear each other.
_WORKER = int("".join(filter(str.isdigit, os.environ.get("PYTEST_XDIST_WORKER", ""))) or 0)


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """The ROS domain of this process of the tests."""
    domain = 1 + (os.getpid() + 37 * _WORKER) % 101
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    return domain


@pytest.fixture
def peer(ros_domain: int) -> Iterator[Peer]:
    """A node of the tests in that domain."""
    from tests.ros2.peers import Peer  # it imports ROS, which not every test needs

    made = Peer()
    yield made
    made.close()
