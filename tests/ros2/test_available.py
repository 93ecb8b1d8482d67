"""The tests with ROS are skipped where rclpy has no wheels, and only there."""

from __future__ import annotations

import platform
import sys

import pytest


@pytest.mark.skipif(
    (sys.platform, platform.machine()) != ("linux", "x86_64"), reason="rclpy has no wheels here"
)
def test_rclpy_is_installed_where_it_has_wheels() -> None:
    import rclpy

    assert rclpy.__file__
