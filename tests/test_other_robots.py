"""Other arms: every task on every backend, and a picture."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gym_mara.backends import simulated_backends
from gym_mara.envs import MaraEnv
from gym_mara.robot import RobotLike, RobotModel
from gym_mara.tasks import TASKS
from tests.helpers import DEVICES, MODULAR_ARMS

ARMS: dict[str, RobotLike] = {
    **{name: name for name in ("ur5", "ur10", "panda", "so100", "talos_arm")},
    **{f"modular {joints}": arm for joints, arm in MODULAR_ARMS.items()},
}


# Warp compiles its kernels for each arm, which takes seconds: CI has an arm with a gripper, a small one, and few and many joints.
IN_CI = ("panda", "so100", "modular 3", "modular 7")
NIGHTLY = [pytest.param(arm, "warp", marks=pytest.mark.nightly) for arm in ARMS if arm not in IN_CI]
WARP = [pytest.param(arm, "warp", marks=pytest.mark.slow) for arm in IN_CI]


@pytest.mark.parametrize(
    ("arm", "backend"),
    [*itertools.product(ARMS, sorted({*simulated_backends()} - {*DEVICES})), *WARP, *NIGHTLY],
)
def test_an_arm_runs_every_task_and_can_be_drawn(arm: str, backend: str) -> None:
    rng, source = np.random.default_rng(0), ARMS[arm]
    hulls = backend == "warp"  # which knows only convex shapes
    robot = RobotModel.load(source, convex_hulls=hulls)
    for task in TASKS:
        draws = task == "MARACollisionOrient-v0"
        env = MaraEnv(
            task,
            robot=robot,
            backend=backend,
            render_mode="rgb_array" if draws else None,
            renderer="raycast",
            width=160,
            height=120,
            **DEVICES.get(backend, {}),
        )
        env.reset(seed=0)
        for _ in range(5):
            action = rng.uniform(-1.0, 1.0, env.action_space.shape or ()).astype(np.float32)
            observation, reward, *_ = env.step(action)
            assert env.observation_space.contains(observation)
            assert np.isfinite(reward)
        if draws:
            picture = env.render()
            assert picture is not None
            off_background = np.abs(picture.astype(int) - picture[0, 0]).max(axis=-1) > 60
            assert off_background.mean() > 0.01, "the arm is visible"
        env.close()
