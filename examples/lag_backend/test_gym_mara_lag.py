"""The lag backend: the contract of every backend, and the lag."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gym_mara_lag import LagBackend

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import BackendContract, Make

THREE_JOINTS = ["base", "motor_large", "motor_medium", "tool"]


class TestContract(BackendContract):
    @pytest.fixture(params=["mara", THREE_JOINTS], ids=["mara", "3 joints"])
    def make(self, request: pytest.FixtureRequest) -> Make:
        robot = RobotModel.load(request.param)
        return lambda num_envs: LagBackend(robot, num_envs)


def test_after_the_time_constant_37_percent_of_the_distance_are_left() -> None:
    robot = RobotModel.load("mara")
    backend = LagBackend(robot, 1, control_period=0.02, time_constant=0.1)
    backend.reset(np.zeros((1, 6)))
    for _ in range(5):
        state = backend.step(np.full((1, 6), 0.5))
    left = 0.5 - state.q
    np.testing.assert_allclose(left, 0.5 * np.exp(-1.0))
    np.testing.assert_allclose(state.qd, left / 0.1)


def test_a_time_constant_out_of_its_range_is_an_error() -> None:
    with pytest.raises(GymMaraError, match="time_constant must be finite and positive"):
        gymnasium.make("gym_mara:gym_mara/MARA-v0", backend="lag", time_constant=0.0)
