"""Options of reset: a start and a target for one episode, in place of what is drawn."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from gym_mara import rotations
from gym_mara.envs import MaraEnv, MaraGoalEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.tasks.reach import out_of_reach
from gym_mara.testing import COLLIDING_Q, pickled
from tests.helpers import DEVICES, EVERY_BACKEND, TARGET_Q, robot_model

START = (0.3, -0.4, 0.6, 0.2, 1.2, -0.1)
STILL = np.zeros(6, np.float32)
AT, TURN = (
    value[0].tolist() for value in robot_model("mara").kinematics().pose(np.array([TARGET_Q]))
)
IN_THE_TABLE = [0.3, 0.2, 0.62]
DRAWN = ("MARAReach-v0", "MARAPose-v0", "MARARandomTarget-v0")


def _episode(env: Any) -> list[Any]:
    """The start and the goal of the first arm."""
    episodes = env.unwrapped.simulation.episodes
    goal = episodes.goal
    return [values[0].tolist() for values in (episodes.start, goal.position, goal.quaternion)]


@pytest.mark.parametrize("backend", EVERY_BACKEND)
def test_observation_reward_and_info_have_the_given_target_at_once(backend: str) -> None:
    env = MaraEnv("MARAPose-v0", backend=backend, **DEVICES.get(backend, {}))
    options = {"start_q": TARGET_Q, "target_position": AT, "target_quaternion": TURN}
    observation, _ = env.reset(seed=0, options=options)
    # Warp stores float32.
    np.testing.assert_allclose(env.simulation.backend.state.q[0], TARGET_Q, rtol=0.0, atol=1e-6)
    seen = env.simulation.observation.split(observation)
    np.testing.assert_allclose(seen["target_position"], AT, rtol=0.0, atol=1e-6)
    rotation = rotations.to_matrix(np.array([TURN], np.float64)).ravel()
    np.testing.assert_allclose(seen["target_rotation"], rotation, rtol=0.0, atol=1e-6)
    _, reward, _, _, info = env.step(STILL)
    assert info["success"]
    assert info["position_error"] < 1e-4
    assert reward > 0.9
    env.close()


@pytest.mark.parametrize("task", DRAWN)
def test_what_is_left_out_is_drawn_as_without_options(task: str) -> None:
    env = MaraEnv(task)
    env.reset(seed=4)
    start, position, quaternion = _episode(env)
    env.reset(seed=4, options={"target_position": AT, "start_q": None})
    assert _episode(env)[:2] == [start, AT]
    env.reset(seed=4, options={"start_q": START})
    assert _episode(env)[0] == list(START)
    if task == "MARARandomTarget-v0":  # whose targets do not depend on the start
        assert _episode(env)[1:] == [position, quaternion]


@pytest.mark.parametrize(
    ("task", "names"),
    [
        ("MARAReach-v0", ["target_position"]),
        ("MARAPose-v0", ["target_position"]),
        ("MARAPose-v0", ["target_quaternion"]),
        ("MARAPose-v0", ["start_q"]),
        ("MARAPose-v0", ["start_q", "target_position", "target_quaternion"]),
        ("MARARandomTarget-v0", ["start_q", "target_position"]),
    ],
)
def test_options_do_not_change_later_episodes_and_repeat_with_the_seed(
    task: str, names: list[str]
) -> None:
    values = {"target_position": AT, "target_quaternion": TURN, "start_q": START}
    options = {name: values[name] for name in names}
    plain, env = MaraEnv(task), MaraEnv(task)
    plain.reset(seed=7)
    repeated = []
    for _ in range(2):
        repeated.append(env.reset(seed=7, options=options)[0].tolist())
        given = dict(
            zip(("start_q", "target_position", "target_quaternion"), _episode(env), strict=True)
        )
        for name in names:
            np.testing.assert_allclose(given[name], values[name], rtol=0.0, atol=1e-12)
    assert repeated[0] == repeated[1]
    for _ in range(2):
        np.testing.assert_array_equal(env.reset()[0], plain.reset()[0])
        assert _episode(env) == _episode(plain)


@pytest.mark.parametrize(
    "options", [{"target_position": AT}, {"target_quaternion": [0.5, 0.5, 0.5, 0.5]}]
)
def test_the_rest_of_a_pose_is_drawn_so_that_the_arm_reaches_it(
    mara: RobotModel, options: dict[str, Any]
) -> None:
    env = MaraEnv("MARAPose-v0")
    seen = []
    for seed in range(4):
        env.reset(seed=seed, options=options)
        _, position, quaternion = _episode(env)
        workspace = env.simulation.episodes._workspace
        assert not out_of_reach(mara, workspace, np.array(position), np.array(quaternion))
        seen.append([*position, *quaternion])
    assert len(np.unique(seen, axis=0)) == 4


def test_the_target_of_a_given_start_is_drawn_as_with_the_keyword() -> None:
    one, other = MaraEnv("MARAReach-v0", start_q=START), MaraEnv("MARAReach-v0")
    for seed in range(5):
        one.reset(seed=seed)
        other.reset(seed=seed, options={"start_q": START})
        assert _episode(one) == _episode(other)


@pytest.mark.parametrize("task", ["MARA-v0", "MARACollision-v0"])
def test_with_a_fixed_target_a_start_can_be_given_for_one_episode(task: str) -> None:
    env, envs = MaraEnv(task), MaraVectorEnv(2, task)
    assert env.reset(options={"start_q": START})[0][:6].tolist() == list(START)
    env.step(np.array(COLLIDING_Q, np.float32))
    assert env.simulation.backend.state.q[0].tolist() == list(START), "a collision goes back there"
    assert not env.reset()[0][:6].any()
    envs.reset()
    mask = np.array([False, True])
    observations, _ = envs.reset(options={"start_q": START, "reset_mask": mask})
    assert observations[:, :6].tolist() == [[0.0] * 6, list(START)]


def test_with_a_fixed_target_another_one_is_an_error_that_names_the_keyword() -> None:
    with pytest.raises(GymMaraError, match=r"give target_position to gymnasium\.make"):
        MaraEnv().reset(options={"target_position": AT})
    with pytest.raises(GymMaraError, match="environment that draws its targets"):
        MaraGoalEnv("MARA-v0").reset(options={"target_quaternion": TURN})


def test_a_goal_environment_takes_a_target() -> None:
    env = gymnasium.make("gym_mara/MARAGoal-v0", reward_type="dense")
    observation, _ = env.reset(seed=1, options={"target_position": AT, "start_q": TARGET_Q})
    np.testing.assert_array_equal(observation["desired_goal"], AT)
    np.testing.assert_allclose(observation["achieved_goal"], AT, rtol=0.0, atol=1e-12)
    oriented = gymnasium.make("gym_mara/MARAGoal-v0", orientation=True)
    observation, _ = oriented.reset(options={"target_position": AT, "target_quaternion": TURN})
    np.testing.assert_allclose(observation["desired_goal"], [*AT, *TURN], rtol=0.0, atol=1e-12)


# Vector environments.


def _rows(count: int) -> dict[str, Any]:
    """Different starts and poses of MARA, a row for each arm."""
    q = np.array(TARGET_Q) + np.linspace(0.0, 0.2, count)[:, None]
    position, quaternion = robot_model("mara").kinematics().pose(q)
    return {"target_position": position, "target_quaternion": quaternion, "start_q": q - 0.1}


@pytest.mark.parametrize("together", [True, False])
def test_each_arm_of_a_batch_has_the_episode_of_the_environment_with_its_seed(
    together: bool,
) -> None:
    rows = _rows(3)
    options = {name: values[0] for name, values in rows.items()} if together else rows
    envs = MaraVectorEnv(3, "MARAPose-v0")
    observations, _ = envs.reset(seed=5, options=options)
    for arm in range(3):
        env = MaraEnv("MARAPose-v0")
        own = {name: values[0 if together else arm] for name, values in rows.items()}
        observation, _ = env.reset(seed=5 + arm, options=own)
        np.testing.assert_allclose(observations[arm], observation, rtol=0.0, atol=1e-9)


def test_rows_of_arms_that_the_mask_leaves_out_are_not_read() -> None:
    envs = MaraVectorEnv(3, "MARAPose-v0")
    before, _ = envs.reset(seed=5)
    goal = envs.simulation.goal.position
    rows, mask = _rows(3), np.array([False, True, False])
    for values in rows.values():
        values[~mask] = np.nan
    after, _ = envs.reset(options={**rows, "reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], before[~mask])
    expected = np.where(mask[:, None], rows["target_position"], goal)
    np.testing.assert_array_equal(envs.simulation.goal.position, expected)
    np.testing.assert_array_equal(after[1, :6], rows["start_q"][1])


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_episodes_that_follow_in_step_are_drawn(mode: str) -> None:
    options: dict[str, Any] = {"max_episode_steps": 1, "autoreset_mode": mode}
    envs, plain = (MaraVectorEnv(2, "MARAReach-v0", **options) for _ in range(2))
    envs.reset(seed=0, options={"target_position": AT, "start_q": START})
    plain.reset(seed=0)
    for _ in range(2):
        for each in (envs, plain):
            each.step(np.zeros((2, 6)))
    np.testing.assert_array_equal(envs.simulation.goal.position, plain.simulation.goal.position)
    np.testing.assert_array_equal(envs.simulation.episodes.start, plain.simulation.episodes.start)


@pytest.mark.parametrize("mode", ["sync", "vector_entry_point"])
def test_wrappers_pass_the_options(mode: str) -> None:
    envs = gymnasium.make_vec(
        "gym_mara/MARAReach-v0",
        num_envs=2,
        vectorization_mode=mode,
        vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED} if mode == "sync" else None,
    )
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    mask = np.array([True, True])
    observations, _ = envs.reset(seed=0, options={"start_q": START, "reset_mask": mask})
    np.testing.assert_array_equal(observations[:, :6], [START, START])
    envs.close()


# Errors and snapshots.

WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "shape": ({"target_position": [0.1, 0.2]}, "target_position must be a list of 3 finite"),
    "ragged": ({"target_position": [[0.1], [0.2, 0.3]]}, "target_position must be a list of 3"),
    "rows": ({"target_position": np.zeros((5, 3))}, r"must be 3 numbers.*not of shape \(5, 3\)"),
    "NaN": ({"target_position": [0.1, np.nan, 0.2]}, "target_position must be.*finite"),
    "text": ({"start_q": "home"}, "start_q must be a list of 6 finite"),
    "zero": ({"target_quaternion": [0.0] * 4}, "target_quaternion .* has length 0.0000"),
    "length": ({"target_quaternion": [1, 1, 0, 0]}, "length 1.4142; give a unit quaternion"),
    "far": (
        {"target_position": [2.0, 0.0, 0.5]},
        r"out of reach of mara.*closest pose is \d+\.\d mm",
    ),
    "turned": (
        {"target_position": [0.0, 0.0, 1.7], "target_quaternion": [0.0, 1.0, 0.0, 0.0]},
        r"out of reach of mara.* mm and .*° away",
    ),
    "obstacle": (
        {"target_position": IN_THE_TABLE},
        "collides in every configuration that 50 searches",
    ),
    "limits": ({"start_q": [0, 0, 9, 0, 0, 0]}, "start_q: joint .* cannot be at 9.0; its limits"),
    "collision": (
        {"start_q": COLLIDING_Q},
        "start_q .* is in collision.*: motor4_link, motor5_link, table",
    ),
    "joints": ({"start_q": [0.0] * 7}, "start_q must be a list of 6 finite"),
    "name": ({"target": AT}, "unknown option of reset 'target'.*Valid: .*target_position"),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("count", [None, 2])
def test_a_wrong_value_is_an_error_and_nothing_changes(count: int | None, case: str) -> None:
    options, message = WRONG[case]
    env, other = (
        MaraEnv("MARAPose-v0") if count is None else MaraVectorEnv(count, "MARAPose-v0")
        for _ in range(2)
    )
    for each in (env, other):
        each.reset(seed=3)
    with pytest.raises(GymMaraError, match=message):
        env.reset(seed=4, options=options)
    action = np.full((6,) if count is None else (count, 6), 0.5, np.float32)
    for mine, theirs in ((env.step(action), other.step(action)), (env.reset(), other.reset())):
        np.testing.assert_array_equal(mine[0], theirs[0])


def test_an_orientation_for_a_task_without_one_is_an_error() -> None:
    for task in ("MARAReach-v0", "MARARandomTarget-v0"):
        with pytest.raises(GymMaraError, match=r"have no orientation.*MARAPose-v0"):
            MaraEnv(task).reset(options={"target_quaternion": TURN})
    MaraEnv("MARARandomTarget-v0", orientation=True).reset(options={"target_quaternion": TURN})


def test_a_snapshot_keeps_what_was_given() -> None:
    env = MaraEnv("MARAPose-v0", on_collision="reset")
    options = {"start_q": START, "target_position": AT, "target_quaternion": TURN}
    env.reset(seed=0, options=options)
    snapshot, expected = pickled(env.save_state()), _episode(env)
    env.reset()
    for each in (env, pickled(env)):
        each.restore_state(snapshot)
        assert _episode(each) == expected
    plain = MaraEnv("MARAPose-v0")
    plain.reset(seed=0)
    np.testing.assert_array_equal(env.reset()[0], plain.reset()[0])
