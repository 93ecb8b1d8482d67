"""A program that steps an environment with a viewer."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from gym_mara.envs import MaraEnv

ACTION = np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0], np.float32)


def wait_until(condition: Callable[[], bool], description: str, seconds: float = 30.0) -> None:
    """Wait until a condition is true, or fail."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"not true within {seconds:g} s: {description}"
        time.sleep(0.02)


class Loop(threading.Thread):
    """Steps an environment with a viewer in a thread, as a user's program would."""

    def __init__(self, **options: Any) -> None:
        super().__init__(daemon=True)
        self.env = MaraEnv(render_mode="human", **{"max_joint_velocity": 1.5, **options})
        self.env.reset(seed=0)
        self.steps = 0
        self.observation, self.info = self.env.step(ACTION)[0::4]
        self._stopped = threading.Event()
        assert self.env.viewer is not None
        self.viewer = self.env.viewer

    def run(self) -> None:
        while not self._stopped.is_set():
            self.observation, self.info = self.env.step(ACTION)[0::4]
            self.steps += 1

    @property
    def q(self) -> Any:
        return self.observation[:6]

    def stop(self) -> None:
        """Stop the thread, even if it is paused, and close the environment."""
        self._stopped.set()
        self.viewer.set_playing(True)
        self.join(timeout=20)
        assert not self.is_alive()
        self.env.close()
