"""Training on a real arm, here one without ROS and with a clock that runs as fast as it can."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import PPO

from gym_mara.backends import registry
from tests.ros2.fake import FakeRos2Backend


def test_stable_baselines_trains_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry._BACKENDS, "ros2", "tests.ros2.fake:FakeRos2Backend")
    env = gymnasium.make("gym_mara/MARAReal-v0", live=True, command_age=5.0, max_episode_steps=50)
    env = gymnasium.wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1, seed=0, device="cpu")
    model.learn(128)
    backend = env.unwrapped.simulation.backend  # type: ignore[attr-defined]
    assert isinstance(backend, FakeRos2Backend)
    assert len(backend.arm.sent) >= 2 * 128, "two set-points for an action"
    assert backend.driver.safety.mode == "moving"
    env.close()
