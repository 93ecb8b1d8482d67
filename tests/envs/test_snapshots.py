"""Snapshots: after a restore, the future is the one that the snapshot's own had."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TimeLimit
from hypothesis import given
from hypothesis import strategies as st

import gym_mara.compat.gym_gazebo2  # noqa: F401 - registers its ids
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.envs.goal import MaraGoalEnv
from gym_mara.errors import GymMaraError
from gym_mara.testing import COPIES, pickled

STILL = np.zeros(6, np.float32)
DYNAMIC: dict[str, Any] = {
    "backend": "dart",
    "randomisation": {"mass": (0.5, 1.5), "sensor_noise": (0.01, 0.05), "latency": (0.0, 0.05)},
    "velocity_filter": 0.05,
}
CASES: dict[str, dict[str, Any]] = {
    "teleport": {},
    "travel": {"max_joint_velocity": 2.0, "control_period": 0.2},
    "noise": {**DYNAMIC, "control_period": 0.05, "physics_step": 0.005},
    "noise, mujoco": {
        **DYNAMIC,
        "backend": "mujoco",
        "control_period": 0.05,
        "physics_step": 0.005,
    },
}
IDS = ("gym_mara/MARARandomTarget-v0", "gym_mara/MARACollisionOrient-v0", "gym_mara/MARAGoal-v0")


def _future(env: Any, seed: int, steps: int) -> list[str]:
    """What random actions give, with a reset of the single environment when its episode ends."""
    rng, results = np.random.default_rng(seed), []
    shape = env.action_space.shape
    for _ in range(steps):
        result = env.step(rng.uniform(-2.5, 2.5, shape).astype(np.float32))
        results.append(repr(result))
        ended = np.asarray(result[2]) | np.asarray(result[3])
        if ended.ndim == 0 and ended:
            results.append(repr(env.reset()))
        elif ended.any() and env.metadata.get("autoreset_mode") is AutoresetMode.DISABLED:
            results.append(repr(env.reset(options={"reset_mask": ended})))
    return results


def _assert_the_future_is_restored(env: Any, other: Any, moments: tuple[int, int]) -> None:
    """Restores a snapshot in the same environment and in another one."""
    before, after = moments
    _future(env, 0, before)
    snapshot = pickled(env.unwrapped.save_state())
    expected = _future(env, 1, after)
    for each in (env, other, env):
        each.unwrapped.restore_state(snapshot)
        assert _future(each, 1, after) == expected
    env.close()
    other.close()


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("env_id", IDS)
def test_a_single_environment_repeats_its_future(env_id: str, case: str) -> None:
    env, other = (gymnasium.make(env_id, max_episode_steps=7, **CASES[case]) for _ in range(2))
    env.reset(seed=1)
    other.reset(seed=2)
    _assert_the_future_is_restored(env, other, (10, 12))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("env_id", IDS)
def test_a_vector_environment_repeats_its_future(env_id: str, case: str, mode: str) -> None:
    options = {"max_episode_steps": 5, "autoreset_mode": mode, **CASES[case]}
    if case == "noise":
        options["workers"] = 1
    env, other = (gymnasium.make_vec(env_id, num_envs=3, **options) for _ in range(2))
    env.reset(seed=1)
    env.step(np.zeros((3, 6)))
    env.reset(options={"reset_mask": np.array([True, False, False])})  # now the episodes differ
    other.reset(seed=2)
    _assert_the_future_is_restored(env, other, (8, 9))


# The step count of Gymnasium's TimeLimit.


def _length(env: Any) -> int:
    """The number of steps until the episode is truncated."""
    for step in range(1, 100):
        if env.step(STILL)[3]:
            return step
    raise AssertionError("the episode does not end")


def _added(env_id: str) -> Any:
    return TimeLimit(gymnasium.make(env_id, max_episode_steps=-1).unwrapped, 9)


WRAPPED: dict[str, Callable[[], Any]] = {
    "by make": lambda: gymnasium.make("gym_mara/MARA-v0", max_episode_steps=9),
    "by the user": lambda: _added("gym_mara/MARA-v0"),
    "twice": lambda: TimeLimit(gymnasium.make("gym_mara/MARA-v0", max_episode_steps=20), 9),
    "goals": lambda: gymnasium.make("gym_mara/MARAGoal-v0", max_episode_steps=9),
    "gym-gazebo2": lambda: TimeLimit(gymnasium.make("MARA-v0"), 9),
}


@pytest.mark.parametrize("make", WRAPPED.values(), ids=WRAPPED)
@given(before=st.integers(0, 8), planned=st.lists(st.integers(0, 8), max_size=4))
def test_episodes_do_not_end_early_in_a_tree_search(
    make: Callable[[], Any], before: int, planned: list[int]
) -> None:
    env = make()
    env.reset()
    for _ in range(before):
        env.step(STILL)
    snapshot = env.unwrapped.save_state()
    for steps in planned:
        for _ in range(steps):
            env.step(STILL)
        env.unwrapped.restore_state(snapshot)
    assert _length(env) == 9 - before
    env.reset()
    assert _length(env) == 9


def test_the_count_of_a_wrapper_that_repeats_actions_is_restored() -> None:
    class Twice(gymnasium.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            self.env.step(action)
            return self.env.step(action)

    env = TimeLimit(Twice(gymnasium.make("gym_mara/MARA-v0")), 9)
    env.reset()
    env.step(STILL)
    snapshot = env.unwrapped.save_state()  # type: ignore[attr-defined]
    env.step(STILL)
    env.unwrapped.restore_state(snapshot)  # type: ignore[attr-defined]
    assert _length(env) == 8


def test_a_snapshot_of_an_environment_without_a_time_limit_restores_the_steps_of_its_episode() -> (
    None
):
    bare, env = gymnasium.make("gym_mara/MARA-v0").unwrapped, WRAPPED["by make"]()
    bare.reset()
    for _ in range(4):
        bare.step(STILL)
    env.reset()
    env.unwrapped.restore_state(bare.save_state())  # type: ignore[attr-defined]
    assert _length(env) == 5


@pytest.mark.parametrize("copy", COPIES)
def test_a_copy_restores_the_count_of_its_own_time_limit(copy: Callable[[Any], Any]) -> None:
    env = WRAPPED["by make"]()
    env.reset()
    snapshot = env.unwrapped.save_state()
    env.step(STILL)
    copied = copy(env)
    copied.unwrapped.restore_state(snapshot)
    assert _length(copied) == 9
    assert _length(env) == 8


def test_an_environment_does_not_keep_its_wrappers_alive() -> None:
    inner = gymnasium.make("gym_mara/MARA-v0").unwrapped
    TimeLimit(inner, 9).reset()
    assert inner.save_state()["time_limits"] == []  # type: ignore[attr-defined]


def test_the_episode_size_of_gym_gazebo2_is_restored() -> None:
    env: Any = gymnasium.make("MARA-v0").unwrapped
    env.set_episode_size(5)
    env.reset()
    snapshot = env.save_state()
    env.set_episode_size(50)
    env.restore_state(snapshot)
    assert _length(env) == 5


OTHERS: dict[str, Callable[[], Any]] = {
    "another robot": lambda: _saved(MaraEnv(RANDOM, robot="ur5")),
    "another backend": lambda: _saved(MaraEnv(RANDOM, backend="dart")),
    "a batch": lambda: _saved(MaraVectorEnv(1, RANDOM)),
    "a part is missing": lambda: {k: v for k, v in _saved(MaraEnv(RANDOM)).items() if k != "goal"},
    "NaN": lambda: _with_backend(q=np.full((1, 6), np.nan)),
    "no arrays": lambda: _with_backend(q=None),
    "generators": lambda: _saved(MaraEnv(RANDOM)) | {"np_random": 3},
    "no arguments": lambda: _saved(MaraEnv(RANDOM)) | {"made_with": ("mara",)},
    "nothing": lambda: None,
}
RANDOM = "MARARandomTarget-v0"


def _saved(env: Any) -> Any:
    env.reset(seed=3)
    snapshot = env.save_state()
    env.close()
    return snapshot


def _with_backend(**changes: Any) -> dict[str, Any]:
    snapshot = _saved(MaraEnv(RANDOM))
    return snapshot | {"backend": snapshot["backend"] | changes}  # type: ignore[no-any-return]


@pytest.mark.parametrize("make", OTHERS.values(), ids=OTHERS)
def test_a_snapshot_of_another_environment_is_refused_and_changes_nothing(
    make: Callable[[], Any],
) -> None:
    snapshot = make()
    env, same = MaraEnv(RANDOM), MaraEnv(RANDOM)
    for each in (env, same):
        each.reset(seed=1)
    with pytest.raises(GymMaraError, match="snapshot"):
        env.restore_state(snapshot)
    assert _future(env, 1, 5) == _future(same, 1, 5)
    assert repr(env.reset()) == repr(same.reset())


@pytest.mark.parametrize("backend", ["pinocchio", "dart", "mujoco"])
def test_a_snapshot_of_another_batch_is_refused(backend: str) -> None:
    env = MaraVectorEnv(2, backend=backend)
    env.reset(seed=1)
    with pytest.raises(GymMaraError, match="num_envs 3"):
        env.restore_state(_saved(MaraVectorEnv(3, backend=backend)))
    env.close()


@pytest.mark.parametrize(
    ("make", "differs"),
    [
        (lambda: _saved(MaraEnv(RANDOM)), "task 'RandomReachTask'"),
        (lambda: _saved(MaraGoalEnv("MARA-v0")), "goal_environment True"),
        (lambda: _saved(MaraEnv(target_position=[-0.3, 0.3, 0.8])), "target_position"),
        (lambda: _saved(MaraEnv("MARACollisionOrient-v0")), "collision_penalty True"),
        (lambda: _saved(MaraEnv(control_period=0.05)), r"control_period 0.05 \(here 0.02\)"),
        (lambda: _saved(MaraEnv(max_joint_velocity=0.3)), "max_joint_velocity 0.3"),
        (lambda: _saved(MaraEnv(velocity_limit=0.3)), "robot_fingerprint"),
    ],
)
def test_a_snapshot_of_an_environment_with_other_arguments_is_refused(
    make: Callable[[], Any], differs: str
) -> None:
    env, same = MaraEnv(), MaraEnv()
    for each in (env, same):
        each.reset(seed=1)
    with pytest.raises(GymMaraError, match=f"the snapshot is of an environment with .*{differs}"):
        env.restore_state(make())
    assert repr(env.reset()) == repr(same.reset())


def test_goal_environments_with_other_tolerances_do_not_share_snapshots() -> None:
    env = MaraGoalEnv()
    env.reset(seed=1)
    with pytest.raises(GymMaraError, match=r"position_tolerance 0.05 \(here 0.02\)"):
        env.restore_state(_saved(MaraGoalEnv(position_tolerance=0.05)))


def test_snapshots_are_shared_by_equal_arguments_in_other_words_and_by_other_threads() -> None:
    start = np.full(6, 0.1)
    snapshot = _saved(MaraEnv(start_q=start, control_period=0.02, collision_threads=2))
    env = MaraEnv(start_q=tuple(start.tolist()))
    env.restore_state(pickled(snapshot))
    np.testing.assert_allclose(env.simulation.backend.state.q[0], start)


def test_a_snapshot_of_the_first_form_is_restored() -> None:
    # 0.2.0 stored four arguments; checkpoints of its runs have them.
    env = MaraEnv()
    env.restore_state(_saved(MaraEnv()) | {"made_with": ("mara", "pinocchio", 1, "absolute")})
    with pytest.raises(GymMaraError, match="robot 'ur5'"):
        env.restore_state(_saved(MaraEnv()) | {"made_with": ("ur5", "pinocchio", 1, "absolute")})
