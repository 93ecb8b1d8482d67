"""The contract of a backend, over every backend there is, and over FakeBackend."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest

from gym_mara.backends import backend_names, make_backend
from gym_mara.robot import RobotModel
from gym_mara.testing import BackendContract, Make


class Case(NamedTuple):
    """A backend and its settings."""

    name: str
    settings: dict[str, Any]


CASES = [
    *(pytest.param(Case(name, {}), id=name) for name in backend_names()),
    pytest.param(Case("fake", {}), id="fake"),
    pytest.param(Case("pinocchio", {"max_joint_velocity": 1.0}), id="pinocchio, travelling"),
    pytest.param(Case("pinocchio", {"collision": "fcl"}), id="pinocchio, fcl"),
    pytest.param(Case("pinocchio", {"collision_threads": 2}), id="pinocchio, threads"),
]


@pytest.fixture(params=CASES)
def make(request: pytest.FixtureRequest, mara: RobotModel, fake_backend: str) -> Make:
    """Makes the backend for N arms of MARA."""
    case: Case = request.param
    return lambda num_envs: make_backend(case.name, mara, num_envs, case.settings)


class TestContract(BackendContract):
    """The suite that authors of other backends use."""
