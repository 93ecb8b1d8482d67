"""The tests with ROS and with bags are skipped where libraries have no wheels, and only there."""

from __future__ import annotations

import importlib
import platform
import sys

import pytest

ELSEWHERE = (sys.platform, platform.machine()) != ("linux", "x86_64")


@pytest.mark.parametrize(
    "library",
    [
        pytest.param("rclpy", marks=pytest.mark.skipif(ELSEWHERE, reason="no wheels")),
        "rosbags",
        "ruckig",
    ],
)
def test_what_the_extra_has_is_installed(library: str) -> None:
    assert importlib.import_module(library)
