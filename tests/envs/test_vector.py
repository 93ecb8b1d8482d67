"""MaraVectorEnv: it gives the results of single environments, compared with Gymnasium's SyncVectorEnv."""

from __future__ import annotations

import copy
import gc
import re
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.envs.statistics import EpisodeStatistics
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import COLLIDING_Q, COPIES, pickled
from tests.backends.fake import FakeBackend
from tests.helpers import ENV_IDS, TASK_NAMES, Floats, robot_model

MODES = ("NextStep", "SameStep")
ON_COLLISION = ("reset", "terminate", "continue")

VecEnv = VectorEnv[Any, Any, Any]


def _pair(name: str, count: int, mode: str, **options: Any) -> tuple[MaraVectorEnv, VecEnv]:
    """The native vector env, and Gymnasium's SyncVectorEnv of single envs."""
    native = gymnasium.make_vec(name, num_envs=count, autoreset_mode=mode, **options)
    assert type(native) is MaraVectorEnv
    singles = gymnasium.make_vec(
        name,
        num_envs=count,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode(mode)},
        **options,
    )
    return native, singles


def _assert_same_info(mine: dict[str, Any], theirs: dict[str, Any]) -> None:
    """Both have equal masks, and equal values where a mask is set; dictionaries are compared recursively.

    An exception are `statistics`: single envs report them at every step, the vector env only at the end of an episode.
    """
    for key in {k for k in (*mine, *theirs) if not k.startswith("_")}:
        mask = mine[f"_{key}"] if f"_{key}" in mine else np.zeros(0, np.bool_)
        if key not in theirs:
            assert not mask.any(), key
            continue
        if key == "statistics":
            assert theirs[f"_{key}"][mask].all()
            for name in EpisodeStatistics.NAMES if mask.any() else ():
                one, other = (info[key][name][mask] for info in (mine, theirs))
                np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-11, err_msg=name)
            continue
        np.testing.assert_array_equal(mask, theirs[f"_{key}"], err_msg=key)
        if isinstance(theirs[key], dict):
            _assert_same_info(mine[key], theirs[key])
            continue
        assert mine[key].dtype == theirs[key].dtype, key
        for one, other in zip(mine[key][mask], theirs[key][mask], strict=True):
            if isinstance(one, list):
                assert one == other, key
            else:
                np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-11, err_msg=key)
        if theirs[key].dtype == object:
            assert all(value is None for value in mine[key][~mask])
        else:
            assert not mine[key][~mask].any()


def _assert_same_results(native: VecEnv, singles: VecEnv, steps: int, limit: float = 2.5) -> None:
    """Both give the same results for the same random actions, with at least one collision and one end of an episode."""
    rng = np.random.default_rng(0)
    observation, _ = native.reset(seed=3)
    np.testing.assert_allclose(observation, singles.reset(seed=3)[0], rtol=0.0, atol=1e-12)
    collisions = ends = 0
    target = np.zeros(native.action_space.shape or ())
    for _ in range(steps):
        # Some joints rest, so that the paths of the arms differ in length.
        moves = rng.random(target.shape) < rng.random((len(target), 1))
        target = np.where(moves, rng.uniform(-limit, limit, target.shape), target)
        mine, theirs = native.step(target), singles.step(target)
        for one, other in zip(mine[:2], theirs[:2], strict=True):
            np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)
        for one, other in zip(mine[2:4], theirs[2:4], strict=True):
            np.testing.assert_array_equal(one, other)
        _assert_same_info(mine[4], theirs[4])
        assert native.observation_space.contains(mine[0])
        collisions += int(np.sum(mine[4]["collided"]))
        if "final_info" in mine[4]:
            collisions += int(np.sum(mine[4]["final_info"]["collided"]))
        ends += int(np.sum(mine[2] | mine[3]))
        ended = mine[2] | mine[3]
        reported = mine[4].get("final_info", {}) if "final_info" in mine[4] else mine[4]
        no_arm = np.zeros(len(ended), np.bool_)
        np.testing.assert_array_equal(reported.get("_statistics", no_arm), ended)
    assert collisions > 0
    assert ends > 0
    native.close()
    singles.close()


@pytest.mark.parametrize("count", [1, 3, 40])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("on_collision", ON_COLLISION)
@pytest.mark.parametrize("velocity", [None, 5.0], ids=["teleport", "travel"])
def test_it_gives_the_results_of_single_envs(
    count: int, mode: str, on_collision: str, velocity: float | None
) -> None:
    native, singles = _pair(
        "gym_mara/MARACollisionOrient-v0",
        count,
        mode,
        robot=robot_model("mara", velocity_limit=5.0),
        on_collision=on_collision,
        max_joint_velocity=velocity,
        control_period=0.1,
        max_episode_steps=9,
    )
    _assert_same_results(native, singles, 14 if count == 40 else 40)


@pytest.mark.parametrize("name", ENV_IDS)
def test_every_id_gives_the_results_of_single_envs(mara: RobotModel, name: str) -> None:
    native, singles = _pair(name, 3, "NextStep", robot=mara, max_episode_steps=6)
    _assert_same_results(native, singles, 20)


@pytest.mark.parametrize("on_collision", ON_COLLISION)
def test_another_backend_gives_the_results_of_single_envs(
    mara: RobotModel, fake_backend: str, on_collision: str
) -> None:
    options = {"robot": mara, "backend": fake_backend, "on_collision": on_collision}
    native, singles = _pair("gym_mara/MARA-v0", 3, "SameStep", max_episode_steps=6, **options)
    _assert_same_results(native, singles, 20)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("backend", "count"), [("dart", 3), ("dart", 4), ("mujoco", 3)])
def test_random_episodes_of_a_dynamic_backend_equal_those_of_single_envs(
    mara: RobotModel, mode: str, backend: str, count: int
) -> None:
    ranges = {"mass": (0.5, 1.5), "latency": (0.0, 0.05), "sensor_noise": (0.0, 0.01)}
    options = {"robot": mara, "backend": backend, "randomisation": ranges}
    start = (1.4, 1.9, 0.0, 0.0, 0.0, 0.0)  # just above the table
    native, singles = _pair(
        "gym_mara/MARACollisionOrient-v0",
        count,
        mode,
        max_episode_steps=6,
        start_q=start,
        **options,
    )
    _assert_same_results(native, singles, 20)


def test_the_orientation_error_of_a_half_turn_equals_that_of_a_single_env() -> None:
    """There w is zero except for rounding, and rounding must not change the sign of the other components."""
    q = np.random.default_rng(0).uniform(-0.7, 0.7, (100, 6))
    # motor2 and motor3 cancel each other, so that the tool points straight up.
    q[:, 2], q[:, 4:] = q[:, 1], 0.0
    batch, single = MaraVectorEnv(100, "MARAOrient-v0"), MaraEnv("MARAOrient-v0")
    batch.reset()
    together = batch.step(q)[0]
    assert (together[:, 9] < 1e-12).all()
    for action, observation in zip(q, together, strict=True):
        single.reset()
        np.testing.assert_allclose(single.step(action)[0], observation, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", TASK_NAMES)
def test_the_spaces_are_batches_of_the_single_envs_spaces(name: str) -> None:
    env = MaraVectorEnv(5, name)
    single = gymnasium.make(f"gym_mara/{name}")
    assert env.single_observation_space == single.observation_space
    assert env.single_action_space == single.action_space
    assert env.observation_space == batch_space(single.observation_space, 5)
    assert env.action_space == batch_space(single.action_space, 5)
    observation, _ = env.reset()
    assert env.observation_space.contains(observation)
    assert observation.shape == (5, 16 if "Orient" in name else 12)


def _random_actions(count: int, steps: int, seed: int = 0) -> Floats:
    return np.random.default_rng(seed).uniform(-2.3, 2.3, (steps, count, 6))


def test_later_steps_do_not_change_earlier_results() -> None:
    env = MaraVectorEnv(3, "MARACollisionOrient-v0", max_episode_steps=3)
    returned: list[Any] = [env.reset()]
    for actions in _random_actions(3, 10):
        returned.append(env.step(actions))
        if len(returned) == 5:
            copied = copy.deepcopy(returned)
    assert str(returned[:5]) == str(copied)
    np.testing.assert_array_equal(returned[0][0], copied[0][0])


def test_next_step_resets_in_the_next_step_and_ignores_its_action() -> None:
    env = MaraVectorEnv(2, max_episode_steps=2, autoreset_mode="NextStep")
    start, _ = env.reset()
    env.step(np.full((2, 6), 0.1))
    last, _, _, truncated, _ = env.step(np.full((2, 6), 0.2))
    assert truncated.all()
    np.testing.assert_allclose(last[:, :6], 0.2)
    observation, reward, terminated, truncated, info = env.step(np.full((2, 6), 0.3))
    np.testing.assert_array_equal(observation, start)
    for result in (reward, terminated, truncated):
        assert not result.any()
    assert not info["_distance"].any()


@pytest.mark.parametrize("count", [1, 2])
def test_no_arm_is_moved_in_the_step_in_which_all_begin_their_next_episodes(
    fake_backend: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = MaraVectorEnv(count, backend=fake_backend, max_episode_steps=1)
    env.reset()
    infos = env.step(np.full((count, 6), 0.1))[4]
    with monkeypatch.context() as context:
        context.delattr(FakeBackend, "step")
        info = env.step(np.full((count, 6), np.nan))[4]
    assert info.keys() == infos.keys() - {"statistics", "_statistics"}
    assert env.step(np.full((count, 6), 0.1))[3].all()


def test_same_step_returns_the_first_observation_and_the_final_one_in_info() -> None:
    env = MaraVectorEnv(2, max_episode_steps=2, autoreset_mode="SameStep")
    start, _ = env.reset()
    env.step(np.full((2, 6), 0.1))
    observation, reward, _, truncated, info = env.step(np.full((2, 6), 0.2))
    assert truncated.all()
    np.testing.assert_array_equal(observation, start)
    assert info["_final_obs"].all()
    for final in info["final_obs"]:
        np.testing.assert_allclose(final[:6], 0.2)
    distance = info["final_info"]["distance"]
    expected = [np.sqrt(np.mean(final[6:9] ** 2)) for final in info["final_obs"]]
    np.testing.assert_allclose(distance, expected)
    assert (reward == env.step(np.full((2, 6), 0.2))[1]).all(), (
        "the reward is that of the final state"
    )


def test_disabled_needs_a_reset_by_the_user() -> None:
    env = MaraVectorEnv(2, max_episode_steps=2, autoreset_mode="Disabled")
    start, _ = env.reset()
    env.step(np.full((2, 6), 0.1))
    env.reset(options={"reset_mask": np.array([True, False])})
    _, _, _, truncated, _ = env.step(np.full((2, 6), 0.2))
    assert truncated.tolist() == [False, True]
    with pytest.raises(GymMaraError, match=r"episodes have ended: call reset.*reset_mask"):
        env.step(np.full((2, 6), 0.3))
    observation, _ = env.reset(options={"reset_mask": np.array([False, True])})
    np.testing.assert_array_equal(observation[1], start[1])
    np.testing.assert_allclose(observation[0, :6], 0.2)
    env.step(np.full((2, 6), 0.3))


def test_without_max_episode_steps_an_episode_is_not_truncated() -> None:
    env = MaraVectorEnv(2, max_episode_steps=None, on_collision="continue")
    env.reset()
    assert not any(env.step(actions)[3].any() for actions in _random_actions(2, 20))


@pytest.mark.parametrize("duplicate", COPIES)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("velocity", [None, 1.0])
def test_a_copy_continues_identically(
    duplicate: Callable[[MaraVectorEnv], MaraVectorEnv], mode: str, velocity: float | None
) -> None:
    env = MaraVectorEnv(
        3,
        "MARACollisionOrient-v0",
        max_episode_steps=5,
        autoreset_mode=mode,
        max_joint_velocity=velocity,
    )
    env.reset(seed=1)
    for actions in _random_actions(3, 5):
        env.step(actions)
    other = duplicate(env)
    for actions in _random_actions(3, 8, seed=1):
        assert str(env.step(actions)) == str(other.step(actions))
    assert env.np_random.random() == other.np_random.random()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("velocity", [None, 1.0])
def test_restore_state_returns_to_a_snapshot(mode: str, velocity: float | None) -> None:
    options: dict[str, Any] = {"autoreset_mode": mode, "max_joint_velocity": velocity}
    env = MaraVectorEnv(3, "MARACollision-v0", max_episode_steps=5, **options)
    env.reset(seed=1)
    for actions in _random_actions(3, 5):
        env.step(actions)
    snapshot = pickled(env.save_state())
    expected = [str(env.step(actions)) for actions in _random_actions(3, 8, seed=1)]
    drawn = env.np_random.random()
    other = MaraVectorEnv(3, "MARACollision-v0", max_episode_steps=5, **options)
    for each in (env, other, env):
        each.restore_state(snapshot)
        assert [str(each.step(a)) for a in _random_actions(3, 8, seed=1)] == expected
        assert each.np_random.random() == drawn


def test_each_arm_can_have_its_own_seed() -> None:
    env = MaraVectorEnv(2)
    env.reset(seed=[4, 5])
    drawn = env.np_random.random()
    env.reset(seed=4)
    assert env.np_random.random() == drawn
    with pytest.raises(GymMaraError, match="3 seeds for 2 environments"):
        env.reset(seed=[1, 2, 3])


@pytest.mark.parametrize(
    "mask", [[True], np.ones(2), np.zeros(2, np.bool_), np.ones((2, 1), np.bool_)]
)
def test_an_invalid_reset_mask_is_refused(mask: Any) -> None:
    env = MaraVectorEnv(2)
    env.reset()
    with pytest.raises(GymMaraError, match=r"reset_mask must be bool, of shape \(2,\)"):
        env.reset(options={"reset_mask": mask})


NOISY: dict[str, Any] = {"backend": "dart", "randomisation": {"sensor_noise": (0.05, 0.05)}}
INTO_THE_TABLE = np.array([[0.0] * 6, [0.0, 2.3, 2.6, 0.0, 0.0, 0.0], [0.3] * 6], np.float32)


@pytest.mark.parametrize("mode", ["Disabled", *MODES])
@pytest.mark.parametrize("options", [{}, NOISY, {"on_collision": "continue"}])
def test_a_reset_with_a_mask_returns_the_last_observation_of_the_other_arms(
    mode: str, options: dict[str, Any]
) -> None:
    native, singles = _pair("gym_mara/MARARandomTarget-v0", 3, mode, **options)
    mask = np.array([True, False, False])
    native.reset(seed=0)
    singles.reset(seed=0)
    for _ in range(2):
        last, *_, info = native.step(INTO_THE_TABLE)
        assert info["collided"][1] or options is NOISY
        kept = last.copy()
        last[:] = np.nan  # the user's own array
        singles.step(INTO_THE_TABLE)
        for _ in range(2):
            mine, info = native.reset(options={"reset_mask": mask})
            theirs, expected = singles.reset(options={"reset_mask": mask.copy()})
            np.testing.assert_array_equal(mine[1:], kept[1:])
            np.testing.assert_allclose(mine, theirs, rtol=0.0, atol=1e-12)
            _assert_same_info(info, expected)
    next_step, its_step = native.step(INTO_THE_TABLE), singles.step(INTO_THE_TABLE)
    np.testing.assert_allclose(next_step[0], its_step[0], rtol=0.0, atol=1e-12)
    _assert_same_info(next_step[4], its_step[4])
    native.close()
    singles.close()


def test_a_snapshot_holds_the_last_observations() -> None:
    env = MaraVectorEnv(3, autoreset_mode="Disabled")
    env.reset()
    last = env.step(INTO_THE_TABLE)[0]
    snapshot = pickled(env.save_state())
    env.reset()
    env.restore_state(snapshot)
    after, _ = env.reset(options={"reset_mask": np.array([True, False, False])})
    np.testing.assert_array_equal(after[1:], last[1:])


def test_a_limit_below_the_steps_of_an_episode_truncates_it() -> None:
    env = MaraVectorEnv(2, max_episode_steps=100)
    env.reset()
    for _ in range(5):
        assert not env.step(np.zeros((2, 6)))[3].any()
    env.max_episode_steps = 3
    assert env.step(np.zeros((2, 6)))[3].all()


@pytest.mark.parametrize("options", [{"mask": None}, {"reset_masks": np.ones(2, np.bool_)}])
def test_an_unknown_option_of_reset_is_refused(options: dict[str, Any]) -> None:
    names = "start_q, target_position, target_quaternion"
    with pytest.raises(
        GymMaraError, match=rf"unknown option of reset .*Valid: reset_mask, {names}"
    ):
        MaraVectorEnv(2).reset(options=options)
    with pytest.raises(GymMaraError, match=rf"unknown option of reset .*Valid: {names}"):
        MaraEnv().reset(options=options)


def test_options_of_another_type_are_refused() -> None:
    with pytest.raises(GymMaraError, match="must be a dictionary or None"):
        MaraEnv().reset(options=["seed"])  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_wrappers_that_pass_options_work(mode: str) -> None:
    envs = gymnasium.make_vec(
        "gym_mara/MARA-v0",
        num_envs=2,
        vectorization_mode=mode,
        vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED},
    )
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    envs.reset(seed=0, options={})
    envs.reset(options={"reset_mask": np.array([True, False])})
    envs.close()


@pytest.mark.parametrize("count", [0, -1, 1.5, True, "two", None])
def test_an_invalid_number_of_envs_is_refused(count: Any) -> None:
    with pytest.raises(
        GymMaraError, match=f"num_envs must be a whole number of at least 1, not {count!r}"
    ):
        MaraVectorEnv(count)


def test_num_envs_can_be_a_numpy_integer() -> None:
    env = MaraVectorEnv(np.int64(2))  # type: ignore[arg-type]
    assert env.reset()[0].shape == (2, 12)


@pytest.mark.parametrize("steps", [0, -3, 2.5, True])
def test_an_invalid_max_episode_steps_is_refused(steps: Any) -> None:
    with pytest.raises(GymMaraError, match=r"max_episode_steps must be .*or None for no limit"):
        MaraVectorEnv(1, max_episode_steps=steps)


def test_the_error_for_an_unknown_autoreset_mode_lists_the_valid_ones() -> None:
    with pytest.raises(GymMaraError, match=r"unknown autoreset_mode 'Never'.*Disabled, NextStep"):
        MaraVectorEnv(1, autoreset_mode="Never")


def test_a_wrong_argument_is_found_before_a_backend_is_made(
    fake_backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    monkeypatch.setattr(FakeBackend, "__init__", lambda self, *_, **__: made.append(self))
    for wrong in ({"autoreset_mode": "Never"}, {"max_episode_steps": 0}, {"render_mode": "x"}):
        with pytest.raises(GymMaraError, match=next(iter(wrong))):
            MaraVectorEnv(1, backend=fake_backend, **wrong)
    assert not made


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((3, 6)), r"the action has shape \(3, 6\); mara needs \(2, 6\)"),
        (np.zeros((2, 5)), r"the action has shape \(2, 5\); mara needs \(2, 6\)"),
        (np.zeros(6), r"the action has shape \(6,\); mara needs \(2, 6\)"),
        (np.array([[0.1] * 6, [np.nan] + [0.1] * 5]), "the action contains NaN or infinity"),
        (np.array([[0.1] * 6, [np.inf] + [0.1] * 5]), "the action contains NaN or infinity"),
    ],
)
def test_invalid_actions_move_no_arm(actions: Floats, message: str) -> None:
    env = MaraVectorEnv(2, max_joint_velocity=1.0)
    env.reset()
    env.step(np.full((2, 6), 0.1))
    before = str(env.save_state()["backend"])
    with pytest.raises(GymMaraError, match=message):
        env.step(actions)
    assert str(env.save_state()["backend"]) == before


@pytest.mark.parametrize("shape", [(6,), (2, 6)])
def test_the_error_for_a_shape_names_the_whole_shape_also_for_one_arm(shape: Any) -> None:
    env = MaraVectorEnv(1)
    env.reset()
    with pytest.raises(GymMaraError, match=re.escape(f"shape {shape}; mara needs (1, 6)")):
        env.step(np.zeros(shape))


def test_a_collision_of_one_arm_does_not_affect_the_others() -> None:
    env = MaraVectorEnv(3, "MARACollision-v0")
    env.reset()
    actions = np.array([COLLIDING_Q, [0.2] * 6, COLLIDING_Q])
    _, _, _, _, info = env.step(actions)
    assert info["collided"].tolist() == [True, False, True]
    q = env.simulation.backend.state.q
    np.testing.assert_array_equal(q, [[0.0] * 6, [0.2] * 6, [0.0] * 6])


@pytest.mark.parametrize("name", ["gym_mara/MARA-v0", "gym_mara/MARAGoal-v0"])
def test_a_dropped_environment_ends_its_worker_processes(name: str) -> None:
    envs: Any = gymnasium.make_vec(name, num_envs=2, backend="dart", workers=2)
    envs.reset(seed=0)
    processes = envs.simulation.backend.processes
    del envs
    gc.collect()
    assert not any(process.is_alive() for process in processes)


@pytest.mark.parametrize("task", ["MARA-v0", "MARAReach-v0"])
def test_the_first_reset_is_of_all_arms(task: str) -> None:
    env, same = MaraVectorEnv(3, task), MaraVectorEnv(3, task)
    everyone = np.ones(3, np.bool_)
    with pytest.raises(ResetNeeded, match=r"call reset\(\) for all arms"):
        env.reset(seed=7, options={"reset_mask": everyone & [True, False, False]})
    with pytest.raises(ResetNeeded, match="before the first step"):
        env.step(np.zeros((3, 6)))
    mine, theirs = (each.reset(seed=0, options={"reset_mask": everyone})[0] for each in (env, same))
    np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("seed", [-1, 5.0, "ab", b"ab", [0, -1], [0, "a"], [1.5, 2], {1: 2, 3: 4}])
def test_a_wrong_seed_is_an_error_and_changes_nothing(seed: Any) -> None:
    env, same = MaraVectorEnv(2, "MARARandomTarget-v0"), MaraVectorEnv(2, "MARARandomTarget-v0")
    for each in (env, same):
        each.reset(seed=1)
    with pytest.raises(GymMaraError, match="seed"):
        env.reset(seed=seed)
    with pytest.raises(GymMaraError, match="reset_mask"):
        env.reset(seed=7, options={"reset_mask": np.zeros(2, np.bool_)})
    assert repr(env.reset()) == repr(same.reset())
    assert env.np_random.random() == same.np_random.random()


def test_seeds_may_be_numpys() -> None:
    env = MaraVectorEnv(2, "MARARandomTarget-v0")
    expected = env.reset(seed=[3, 4])[0]
    assert np.array_equal(env.reset(seed=np.array([3, 4]))[0], expected)  # type: ignore[arg-type]
