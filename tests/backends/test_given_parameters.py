"""Given parameters and a start in motion: an arm continues as the one whose state and parameters it was given."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gym_mara.backends import make_backend
from gym_mara.backends.servo import ServoBackend
from gym_mara.robot import RobotModel

OPTIONS: dict[str, dict[str, Any]] = {"dart": {"workers": 1}, "mujoco": {}}


@pytest.mark.parametrize("name", ["dart", "mujoco"])
def test_an_arm_continues_as_another_one(name: str, mara: RobotModel) -> None:
    ranges = {"latency": (0.0, 0.1), "servo_gain": (0.1, 2.0), "joint_friction": (0.0, 5.0)}
    options = {"randomisation": ranges, **OPTIONS[name]}
    one, other = make_backend(name, mara, 1, options), make_backend(name, mara, 2, options)
    assert isinstance(one, ServoBackend)
    assert isinstance(other, ServoBackend)
    given = {
        "latency": np.array([0.03, 0.0]),
        "servo_gain": np.full((2, 6), 0.5),
        "joint_friction": np.full((2, 6), 1.0),
    }
    one.set_parameters({key: values[:1] for key, values in given.items()})
    other.set_parameters(given)
    targets = np.random.default_rng(0).uniform(-0.3, 0.3, (6, 1, 6))
    for target in targets[:4]:
        state = one.step(target)
    other.continue_from(state.q, state.qd, targets[:4, 0])
    for target in targets[4:]:
        state, states = one.step(target), other.step(np.repeat(target, 2, axis=0))
    np.testing.assert_allclose(states.q[0], state.q[0], rtol=0.0, atol=1e-6)
    assert np.abs(states.q[1] - state.q[0]).max() > 1e-3  # without its delay
    assert state.parameters is not None
    assert state.parameters["latency"].tolist() == [0.03]
    one.close()
    other.close()
