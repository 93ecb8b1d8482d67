"""Vector environments of tensors: they give the numbers of those of NumPy's arrays, and nothing but tensors.

float64 agrees to 1e-12. With float32 the tolerances are those of `TOLERANCE`: seven digits, and half of them for angles.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from gym_mara.arrays import host
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.envs.goal import MaraGoalVectorEnv
from gym_mara.envs.simulation import Simulation
from gym_mara.envs.statistics import EpisodeStatistics
from gym_mara.envs.view import view_of
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.tasks import TASKS, AnyTargetTask
from gym_mara.testing import COLLIDING_Q, COPIES, pickled
from tests.helpers import robot_model

ARMS = 5
TOLERANCE = {"float64": 1e-12, "float32": 2e-3}
SOLVED = {"float64": 1e-10, "float32": 0.02}
"""The tolerance of the tasks whose observation has the solution of linear equations, near singular at home."""
MODES = ("NextStep", "SameStep", "Disabled")
DTYPES = ("float64", "float32")

Make = Callable[..., tuple[Any, Any]]
"""Makes a vector environment of tensors, and the same of NumPy's arrays."""


ANY_TARGET = ("MARAReach-v0", "MARAPose-v0")
NEAR_THE_TABLE = (1.5, 1.9, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture
def pair(mara: RobotModel, tensor_backend: str) -> Make:
    def make(
        task: str = "MARACollisionOrient-v0", dtype: str = "float64", **options: Any
    ) -> tuple[Any, Any]:
        kind: Any = MaraGoalVectorEnv if "reward_type" in options else MaraVectorEnv
        options = {"robot": mara, "backend": tensor_backend, "max_episode_steps": 9} | options
        return (
            kind(ARMS, task, arrays="torch", dtype=dtype, **options),
            kind(ARMS, task, arrays="numpy", **options),
        )

    return make


def _actions(steps: int, seed: int = 0) -> Iterator[torch.Tensor]:
    generator = np.random.default_rng(seed)
    for _ in range(steps):
        yield torch.tensor(generator.uniform(-2.5, 2.5, (ARMS, 6)), dtype=torch.float32)


def _tensors(value: Any) -> list[torch.Tensor]:
    """All leaves of a step's results, which must be tensors."""
    if isinstance(value, dict):
        return [t for each in value.values() for t in _tensors(each)]
    if isinstance(value, tuple):
        return [t for each in value for t in _tensors(each)]
    assert type(value) is torch.Tensor, type(value)
    assert not value.requires_grad
    return [value]


def _assert_same(
    mine: Any, theirs: Any, dtype: str, name: str = "", tolerance: dict[str, float] = TOLERANCE
) -> None:
    """Equal trees; an object array of final observations equals the rows of a tensor."""
    if isinstance(theirs, dict):
        assert mine.keys() == theirs.keys(), name
        for key in theirs:
            if key == "final_obs":
                chosen = theirs["_final_obs"]
                _assert_same_finals(mine[key], theirs[key], chosen, dtype, tolerance)
            else:
                _assert_same(mine[key], theirs[key], dtype, key, tolerance)
        return
    kinds = {"f": getattr(torch, dtype), "b": torch.bool, "i": torch.int64}
    assert mine.dtype == kinds[theirs.dtype.kind], name
    assert mine.shape == theirs.shape, name
    np.testing.assert_allclose(host(mine), theirs, rtol=0, atol=tolerance[dtype], err_msg=name)


def _assert_same_finals(
    mine: Any, theirs: Any, chosen: Any, dtype: str, tolerance: dict[str, float]
) -> None:
    groups = {"": mine} if not isinstance(mine, dict) else mine
    for name, values in groups.items():
        assert len(values) == ARMS
        assert not values[torch.tensor(~chosen)].any()
        for arm in np.flatnonzero(chosen):
            expected = theirs[arm][name] if name else theirs[arm]
            _assert_same(values[arm], expected, dtype, "final_obs", tolerance)


def _assert_same_runs(
    tensors: Any, arrays: Any, steps: int, dtype: str = "float64", collide: bool = True
) -> None:
    """The same results for the same random actions, with ends of episodes, and with collisions if `collide` is true."""
    mine, theirs = tensors.reset(seed=3), arrays.reset(seed=3)
    collisions = ends = 0
    solves = isinstance(arrays.simulation.task, AnyTargetTask)
    tolerance = SOLVED if solves else TOLERANCE
    for actions in _actions(steps):
        for results, expected in zip(mine, theirs, strict=True):
            _assert_same(results, expected, dtype, tolerance=tolerance)
        _tensors(mine)
        mine, theirs = tensors.step(actions), arrays.step(actions.numpy())
        infos = [theirs[4], theirs[4].get("final_info", {})]
        collisions += sum(int(np.sum(info.get("collided", 0))) for info in infos)
        ended = theirs[2] | theirs[3]
        ends += int(ended.sum())
        if tensors.autoreset_mode.value == "Disabled" and ended.any():
            firsts = (
                tensors.reset(options={"reset_mask": torch.tensor(ended)}),
                arrays.reset(options={"reset_mask": ended}),
            )
            for results, expected in zip(*firsts, strict=True):
                _assert_same(results, expected, dtype)
    assert collisions > 0 or not collide
    assert ends > 0


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("on_collision", "dtype"),
    [("reset", "float32"), ("reset", "float64"), ("terminate", "float64"), ("continue", "float64")],
)
def test_every_autoreset_mode_gives_the_numbers_of_numpy(
    pair: Make, mode: str, on_collision: str, dtype: str
) -> None:
    tensors, arrays = pair(autoreset_mode=mode, on_collision=on_collision, dtype=dtype)
    _assert_same_runs(tensors, arrays, 100, dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("task", list(TASKS))
def test_every_task_gives_the_numbers_of_numpy(pair: Make, task: str, dtype: str) -> None:
    # Random starts have room around them; near the table a few random steps collide.
    near: dict[str, Any] = {"start_q": NEAR_THE_TABLE} if task in ANY_TARGET else {}
    _assert_same_runs(*pair(task, dtype, **near), 100, dtype)


@pytest.mark.parametrize("task", ANY_TARGET)
def test_with_a_guide_the_numbers_are_those_of_numpy(pair: Make, task: str) -> None:
    _assert_same_runs(*pair(task, guide=True, start_q=NEAR_THE_TABLE), 50)


@pytest.mark.parametrize("mode", MODES)
def test_travelling_arms_with_random_parameters_that_diverge_give_the_numbers_of_numpy(
    pair: Make, mode: str
) -> None:
    options = {
        "robot": robot_model("mara", velocity_limit=20.0),
        "max_joint_velocity": 20.0,
        "random_mass": True,
        "diverges_beyond": 0.5,
    }
    tensors, arrays = pair("MARARandomTarget-v0", "float32", autoreset_mode=mode, **options)
    _assert_same_runs(tensors, arrays, 40, "float32", collide=False)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_goal_environments_give_the_numbers_of_numpy(
    pair: Make, mode: str, reward_type: str, dtype: str
) -> None:
    options: dict[str, Any] = {"reward_type": reward_type, "position_tolerance": 0.5}
    options["collision_penalty"] = reward_type == "dense"
    tensors, arrays = pair("MARARandomTarget-v0", dtype, autoreset_mode=mode, **options)
    _assert_same_runs(tensors, arrays, 60, dtype)
    poses, *_, info = tensors.step(next(_actions(1)))
    goals = [poses[name] for name in ("achieved_goal", "desired_goal")]
    again = tensors.compute_reward(*goals, info)
    expected = arrays.compute_reward(*map(host, goals), {"collided": host(info["collided"])})
    np.testing.assert_allclose(host(again), expected, rtol=0.0, atol=TOLERANCE[dtype])


def test_statistics_count_in_float64(pair: Make) -> None:
    """float32 counts to 16,777,216."""
    tensors, _ = pair(dtype="float32", max_episode_steps=2**24 + 1, on_collision="continue")
    tensors.reset()
    tensors.simulation.statistics.steps[:] = 2.0**24 - 1
    truncated = [tensors.step(actions)[3].all().item() for actions in _actions(2)]
    assert truncated == [False, True]


# Aliases and gradients.


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_results_are_fresh(pair: Make, mode: str) -> None:
    one, other = (pair(autoreset_mode=mode)[0] for _ in range(2))
    for env in (one, other):
        env.reset(seed=1)
    kept: list[Any] = []
    for actions in _actions(30):
        mine, theirs = one.step(actions.clone()), other.step(actions.clone())
        _assert_equal(mine, theirs)
        kept.append((theirs, copy.deepcopy(theirs)))
        for tensor in _tensors(mine):  # the user's own
            tensor.fill_(True if tensor.dtype == torch.bool else 99)
    for result, copied in kept:
        _assert_equal(result, copied)


def _assert_equal(mine: Any, theirs: Any) -> None:
    for one, other in zip(_tensors(mine), _tensors(theirs), strict=True):
        assert torch.equal(one, other)


def test_an_action_with_gradients_passes_none_on(pair: Make) -> None:
    tensors, _ = pair()
    tensors.reset(seed=0)
    actions = torch.zeros(ARMS, 6, requires_grad=True)
    _tensors(tensors.step(actions))
    for value in vars(tensors.simulation.outcome.state).values():
        assert value is None or not value.requires_grad


def test_steps_in_inference_mode_are_followed_by_steps_outside_of_it(pair: Make) -> None:
    tensors, arrays = pair(autoreset_mode="SameStep", max_episode_steps=3)
    with torch.inference_mode():
        tensors.reset(seed=0)
        tensors.step(torch.full((ARMS, 6), 0.1))
    arrays.reset(seed=0)
    arrays.step(np.full((ARMS, 6), 0.1, np.float32))
    for actions in _actions(6):
        _assert_same(tensors.step(actions)[0], arrays.step(actions.numpy())[0], "float64")


# Snapshots, copies and pictures.


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mode", MODES)
def test_restore_state_returns_to_a_snapshot_of_numpys_arrays(
    pair: Make, mode: str, dtype: str
) -> None:
    (env, _), (other, _) = (
        pair("MARARandomTarget-v0", dtype, autoreset_mode=mode, max_episode_steps=7)
        for _ in range(2)
    )
    env.reset(seed=1)
    for actions in _actions(5):
        env.step(actions)
    snapshot = env.save_state()
    assert not any(isinstance(value, torch.Tensor) for value in snapshot.values())
    assert type(snapshot["goal"][0]) is np.ndarray
    expected = [env.step(actions) for actions in _actions(2, seed=1)]
    for each in (env, other):
        each.restore_state(pickled(snapshot))
        for actions, results in zip(_actions(2, seed=1), expected, strict=True):
            _assert_equal(each.step(actions), results)


@pytest.mark.parametrize("duplicate", COPIES)
def test_a_copy_continues_identically(pair: Make, duplicate: Callable[[Any], Any]) -> None:
    env, _ = pair(dtype="float32")
    env.reset(seed=1)
    for actions in _actions(5):
        env.step(actions)
    other = duplicate(env)
    for actions in _actions(8, seed=1):
        _assert_equal(env.step(actions), other.step(actions))


@pytest.mark.parametrize("duplicate", COPIES)
def test_a_copy_of_statistics_keeps_library_and_type(duplicate: Callable[[Any], Any]) -> None:
    statistics = EpisodeStatistics(2, torch.zeros(1))
    statistics.add(*torch.ones(3, 2))
    for each in (duplicate(statistics), statistics.copy(torch.zeros(1))):
        _assert_equal(each.summary(), statistics.summary())
        assert each.summary()["ep_rew_mean"].dtype == torch.float32
    assert type(statistics.copy().steps) is np.ndarray


def test_a_picture_shows_the_state_and_the_goal_of_an_arm(pair: Make) -> None:
    env, arrays = pair(on_collision="reset")
    action = np.zeros((ARMS, 6), np.float32)
    action[1] = COLLIDING_Q
    for each in (env, arrays):
        each.reset()
    env.step(torch.tensor(action))
    arrays.step(action)
    for arm in range(2):
        mine, theirs = (view_of(each.simulation, arm) for each in (env, arrays))
        for name in ("q", "target_position", "target_quaternion"):
            one, other = getattr(mine, name), getattr(theirs, name)
            assert type(one) is np.ndarray
            np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)
        assert mine.touching == theirs.touching
        assert bool(mine.touching) == (arm == 1)


# Wrong arrays.


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((ARMS, 6)), r"takes tensors of torch on cpu, .*torch.as_tensor\(actions, device='cpu'\)"),
        ([[0.0] * 6] * ARMS, r"takes tensors of torch on cpu, .*list"),
        (torch.zeros(ARMS, 6, device="meta"), r"tensor on meta, and .* on cpu: give actions.to\('cpu'\)"),
        (torch.zeros(ARMS, 6, dtype=torch.int64), r"tensor of floats .*not of torch.int64"),
        (torch.zeros(ARMS, 6, dtype=torch.bool), r"tensor of floats .*not of torch.bool"),
        (torch.zeros(ARMS, 5), r"the action has shape \(5, 5\); mara needs \(5, 6\)"),
        (torch.zeros(6), r"the action has shape \(6,\); mara needs \(5, 6\)"),
        (torch.full((ARMS, 6), torch.nan), "the action contains NaN or infinity"),
        (torch.full((ARMS, 6), -torch.inf), "the action contains NaN or infinity"),
    ],
)  # fmt: skip
def test_wrong_actions_move_no_arm(pair: Make, actions: Any, message: str) -> None:
    env, _ = pair()
    env.reset()
    env.step(torch.full((ARMS, 6), 0.1))
    before = str(env.save_state()["backend"])
    with pytest.raises(GymMaraError, match=message):
        env.step(actions)
    assert str(env.save_state()["backend"]) == before


@pytest.mark.parametrize(
    "mask",
    [
        np.ones(ARMS, np.bool_),
        [True] * ARMS,
        torch.ones(ARMS),
        torch.zeros(ARMS, dtype=torch.bool),
        torch.ones(ARMS, 1, dtype=torch.bool),
        torch.ones(ARMS, dtype=torch.bool, device="meta"),
    ],
)
def test_a_wrong_reset_mask_is_refused(pair: Make, mask: Any) -> None:
    env, _ = pair()
    env.reset()
    with pytest.raises(GymMaraError, match=r"reset_mask must be a tensor on cpu, bool, of shape"):
        env.reset(options={"reset_mask": mask})


def test_numpys_environments_take_tensors_of_the_cpu_only() -> None:
    env: Any
    for env, shape in ((MaraEnv(), (6,)), (MaraVectorEnv(2), (2, 6))):
        env.reset()
        env.step(torch.full(shape, 0.1))
        with pytest.raises(GymMaraError, match=r"tensor on meta.*action.cpu\(\).numpy\(\)"):
            env.step(torch.zeros(shape, device="meta"))
    env.reset(options={"reset_mask": torch.tensor([True, False])})


def test_an_environment_of_one_arm_refuses_tensors(mara: RobotModel, tensor_backend: str) -> None:
    with pytest.raises(GymMaraError, match=r"one arm has NumPy's arrays.*make_vec"):
        MaraEnv(robot=mara, backend=tensor_backend)


def test_noisy_sensors_are_refused_with_tensors(pair: Make) -> None:
    with pytest.raises(GymMaraError, match=r"sensor_noise.*arrays='numpy'"):
        pair(noise=0.01)


def test_a_simulation_of_tensors_keeps_its_backend(pair: Make) -> None:
    for env in pair():
        simulation: Simulation = env.simulation
        env.reset()
        simulation.options.settings["arrays"] = "torch"
        with pytest.raises(GymMaraError, match="make a new environment"):
            simulation.switch_backend("tensors")


def test_set_goal_moves_the_goal_to_the_device(pair: Make) -> None:
    seen = []
    for env in pair():
        env.reset()
        env.simulation.set_goal([0.1, 0.2, 0.3], [0.0, 0.0, 0.0, 2.0])
        seen.append(env.reset()[0])
    tensors, arrays = seen
    _assert_same(tensors, arrays, "float64")


def test_given_starts_and_targets_move_to_the_device(pair: Make) -> None:
    seen = []
    for env in pair("MARAReach-v0"):
        env.reset(seed=0)
        mask = env.simulation.backend.asarray(np.arange(ARMS) % 2 == 0)
        q = np.full((ARMS, 6), 0.2)
        position = env.simulation.robot.kinematics().pose(q + 0.1)[0]
        options = {"start_q": torch.tensor(q), "target_position": position, "reset_mask": mask}
        seen.append(env.reset(options=options)[0])
        np.testing.assert_allclose(host(env.simulation.goal.position)[0], position[0], atol=1e-12)
    tensors, arrays = seen
    _tensors(tensors)
    _assert_same(tensors, arrays, "float64", tolerance=SOLVED)


class _HostReads(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts how often a number is read from a tensor, for which a program waits until a GPU has done all its work."""

    count = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        self.count += function is torch.ops.aten._local_scalar_dense.default
        return function(*args, **(kwargs or {}))


def test_a_step_waits_for_the_device_a_few_times_whatever_the_infos(pair: Make) -> None:
    tensors, _ = pair(autoreset_mode="SameStep", max_episode_steps=100)
    tensors.reset(seed=0)
    actions = list(_actions(5))
    with _HostReads() as reads:  # type: ignore[no-untyped-call]
        for each in actions:
            tensors.step(each)
    assert reads.count <= 6 * len(actions)
