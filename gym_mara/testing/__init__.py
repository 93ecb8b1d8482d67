"""For authors of backends: the contract as a suite of tests.

Every backend of this package passes it. A test of yours::

    from gym_mara.testing import BackendContract, Make

    class TestMyBackend(BackendContract):
        @pytest.fixture
        def make(self) -> Make:
            robot = RobotModel.load("mara")
            return lambda num_envs: MyBackend(robot, num_envs)
"""

from gym_mara.testing.contract import BackendContract, Make
from gym_mara.testing.states import (
    COLLIDING_Q,
    COPIES,
    arms_of,
    arrays_of,
    assert_same_arrays,
    assert_same_state,
    colliding_q,
    pickled,
    uniform_q,
)

__all__ = [
    "COLLIDING_Q",
    "COPIES",
    "BackendContract",
    "Make",
    "arms_of",
    "arrays_of",
    "assert_same_arrays",
    "assert_same_state",
    "colliding_q",
    "pickled",
    "uniform_q",
]
