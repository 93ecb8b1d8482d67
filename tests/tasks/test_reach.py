"""The reach task: observation, reward, goal and the four variants."""

from __future__ import annotations

import copy
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.inverse_kinematics import solve_ik
from gym_mara.rotations import canonical, conjugate, multiply
from gym_mara.state import SimState
from gym_mara.tasks import PAPER_TASKS, TASKS, Goal, Observation, ReachTask, Task, named_task
from gym_mara.testing import arms_of, arrays_of, uniform_q
from gym_mara.types import Floats
from tests.helpers import (
    TARGET_Q,
    TASK_NAMES,
    golden,
    golden_q,
    joint_xml,
    robot_model,
    urdf_xml,
    write,
)

TARGET_POSITION = (-0.40028, 0.095615, 0.72466)
TARGET_QUATERNION = (0.0, 0.7071068, 0.7071068, 0.0)


def _state(robot: RobotModel, q: Floats, seed: int | None = None) -> SimState:
    """The state at q (N, J), rad; with a seed, the arms move and some have collided."""
    count = len(q)
    position, quaternion = robot.kinematics().pose(q)
    qd, velocity, collided = np.zeros_like(q), np.zeros((count, 3)), np.zeros(count, np.bool_)
    if seed is not None:
        rng = np.random.default_rng(seed)
        qd = rng.normal(size=q.shape)
        velocity = robot.kinematics().velocity(q, qd)
        collided = rng.random(count) < 0.5
    return SimState(q, qd, position, quaternion, velocity, collided, np.zeros(count))


def _row(state: SimState, row: int) -> SimState:
    return arms_of(state, slice(row, row + 1))


def _goal(task: Task, robot: RobotModel, count: int) -> Goal:
    return task.goal(robot, RobotWorkspace(robot), count)


def _observe(task: Task, robot: RobotModel, state: SimState, goal: Goal) -> Floats:
    return Observation(task.observation(robot, goal, robot.velocity_limit))(state, goal)


def test_the_four_tasks_are_values_of_one_class() -> None:
    assert PAPER_TASKS == TASK_NAMES
    four = [TASKS[name] for name in PAPER_TASKS]
    uses = {
        name: (task.orientation, task.collision_penalty)
        for name, task in zip(PAPER_TASKS, four, strict=True)
        if type(task) is ReachTask
    }
    assert uses == {
        "MARA-v0": (False, False),
        "MARAOrient-v0": (True, False),
        "MARACollision-v0": (False, True),
        "MARACollisionOrient-v0": (True, True),
    }
    for task in four:
        plain = dataclasses.replace(task, orientation=False, collision_penalty=False)  # type: ignore[call-arg]
        assert plain == TASKS["MARA-v0"], "the tasks differ only in these two values"


def test_the_constants_are_the_published_ones() -> None:
    task = ReachTask()
    constants = (task.alpha, task.beta, task.gamma, task.delta, task.eta, task.kappa)
    assert constants == (5.0, 1.5, 1.0, 3.0, 0.03, 0.02)


def test_golden_configurations_have_the_golden_distances_angles_and_rewards(
    mara: RobotModel,
) -> None:
    rows = golden("kinematics_golden.csv")
    state = _state(mara, golden_q())
    for name, orientation in (("reward_MARA", False), ("reward_MARAOrient", True)):
        task = ReachTask(orientation=orientation)
        goal = _goal(task, mara, len(golden_q()))
        reward, terms = task.reward(state, goal)
        np.testing.assert_allclose(terms["distance"], rows["rmse_m"], rtol=0.0, atol=1e-8)
        np.testing.assert_allclose(terms["angle_error"], rows["angle_rad"], rtol=0.0, atol=1e-7)
        # Near the target the slope of the reward is 2,500 per metre.
        np.testing.assert_allclose(reward, rows[name], rtol=0.0, atol=2e-5)
        far = rows["rmse_m"] > 0.01
        np.testing.assert_allclose(reward[far], rows[name][far], rtol=0.0, atol=1e-7)


def test_states_at_the_golden_distances_have_the_golden_rewards(mara: RobotModel) -> None:
    rows = golden("reward_golden.csv")
    count = len(rows["reward"])
    task = ReachTask(orientation=True, collision_penalty=True)
    goal = _goal(task, mara, count)
    half = rows["angle_rad"] / 2.0
    about_z = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    state = dataclasses.replace(
        _state(mara, np.zeros((count, 6))),
        ee_position=goal.position + rows["rmse_m"][:, None] * [1.0, -1.0, 1.0],
        ee_quaternion=multiply(about_z, goal.quaternion),
        collided=rows["collision"] == 1,
    )
    reward, terms = task.reward(state, goal)
    np.testing.assert_allclose(reward, rows["reward"], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(terms["distance"], rows["rmse_m"], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(terms["position_error"], 3**0.5 * rows["rmse_m"], atol=1e-12)
    np.testing.assert_allclose(terms["angle_error"], rows["angle_rad"], rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("name", TASK_NAMES)
def test_the_terms_add_up_to_the_reward(mara: RobotModel, name: str) -> None:
    task = TASKS[name]
    state = _state(mara, uniform_q(mara, 40, 0), seed=0)
    reward, terms = task.reward(state, _goal(task, mara, 40))
    total = terms["reward_distance"] * terms["reward_orientation"] - 1 - terms["reward_collision"]
    np.testing.assert_allclose(reward, total, rtol=0.0, atol=1e-12)
    assert (terms["reward_orientation"] < 1.0).all() == ("Orient" in name)
    penalised = terms["reward_collision"] > 0.0
    np.testing.assert_array_equal(penalised, state.collided & ("Collision" in name))


@pytest.mark.parametrize("orientation", [False, True])
def test_the_observation_holds_q_position_error_orientation_error_and_velocity(
    mara: RobotModel, orientation: bool
) -> None:
    task = ReachTask(orientation=orientation)
    goal = _goal(task, mara, 40)
    state = _state(mara, uniform_q(mara, 40, 1), seed=1)
    observation = _observe(task, mara, state, goal)
    assert observation.shape == (40, 16 if orientation else 12)
    np.testing.assert_array_equal(observation[:, :6], state.q)
    np.testing.assert_allclose(
        observation[:, 6:9], state.ee_position - TARGET_POSITION, rtol=0.0, atol=1e-12
    )
    np.testing.assert_array_equal(observation[:, -3:], state.ee_velocity)
    if orientation:
        error = observation[:, 9:13]
        assert (error[:, 0] >= 0.0).all()
        np.testing.assert_allclose(
            multiply(error, goal.quaternion),
            multiply(
                canonical(multiply(state.ee_quaternion, conjugate(goal.quaternion))),
                goal.quaternion,
            ),
            rtol=0.0,
            atol=1e-12,
        )


def test_the_orientation_error_rotates_the_target_to_the_tool_and_ignores_the_sign_of_q(
    mara: RobotModel,
) -> None:
    task = ReachTask(orientation=True)
    goal = _goal(task, mara, 40)
    state = _state(mara, uniform_q(mara, 40, 2))
    flipped = dataclasses.replace(state, ee_quaternion=-state.ee_quaternion)
    error = _observe(task, mara, state, goal)[:, 9:13]
    np.testing.assert_allclose(
        _observe(task, mara, flipped, goal)[:, 9:13], error, rtol=0.0, atol=1e-12
    )
    turned = canonical(multiply(error, goal.quaternion))
    np.testing.assert_allclose(turned, canonical(state.ee_quaternion), rtol=0.0, atol=1e-12)


def test_at_the_target_the_errors_are_zero(mara: RobotModel) -> None:
    task = ReachTask(orientation=True)
    observation = _observe(task, mara, _state(mara, np.array([TARGET_Q])), _goal(task, mara, 1))[0]
    np.testing.assert_allclose(observation[6:9], 0.0, atol=2e-5)
    np.testing.assert_allclose(observation[9:13], [1.0, 0.0, 0.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("name", TASK_NAMES)
def test_a_batch_gives_the_same_results_as_single_rows(mara: RobotModel, name: str) -> None:
    task = TASKS[name]
    state = _state(mara, uniform_q(mara, 40, 3), seed=3)
    observation = _observe(task, mara, state, _goal(task, mara, 40))
    reward, terms = task.reward(state, _goal(task, mara, 40))
    goal = _goal(task, mara, 1)
    for row in range(40):
        one, alone = slice(row, row + 1), _row(state, row)
        np.testing.assert_allclose(
            observation[one], _observe(task, mara, alone, goal), rtol=0, atol=1e-12
        )
        single_reward, single_terms = task.reward(alone, goal)
        np.testing.assert_allclose(reward[one], single_reward, rtol=0.0, atol=1e-12)
        assert single_terms.keys() == terms.keys()
        for term, values in single_terms.items():
            np.testing.assert_allclose(terms[term][one], values, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", TASK_NAMES)
def test_overwriting_the_results_leaves_the_state_and_the_goal_unchanged(
    mara: RobotModel, name: str
) -> None:
    task = TASKS[name]
    state, goal = _state(mara, uniform_q(mara, 3, 4), seed=4), _goal(task, mara, 3)
    inputs = [*arrays_of(state).values(), goal.position, goal.quaternion]
    originals = copy.deepcopy(inputs)
    observation = _observe(task, mara, state, goal)
    reward, terms = task.reward(state, goal)
    for result in (observation, reward, *terms.values()):
        result[...] = -7.0
    for array, original in zip(inputs, originals, strict=True):
        np.testing.assert_array_equal(array, original)


def test_the_task_terminates_no_episode(mara: RobotModel) -> None:
    task = ReachTask()
    state = _state(mara, uniform_q(mara, 40, 5), seed=5)
    assert not task.terminated(state, _goal(task, mara, 40)).any()


def test_maras_default_target_is_the_published_one(mara: RobotModel) -> None:
    goal = _goal(ReachTask(), mara, 3)
    np.testing.assert_array_equal(goal.position, np.tile(TARGET_POSITION, (3, 1)))
    np.testing.assert_allclose(goal.quaternion, np.tile(TARGET_QUATERNION, (3, 1)), atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(goal.quaternion, axis=1), 1.0, rtol=0, atol=1e-12)


def test_the_user_can_give_a_target(mara: RobotModel) -> None:
    (position,), (quaternion,) = mara.kinematics().pose(uniform_q(mara, 1, 6))
    task = ReachTask(
        orientation=True, target_position=tuple(position), target_quaternion=tuple(-quaternion)
    )
    goal = _goal(task, mara, 2)
    np.testing.assert_allclose(goal.position, np.tile(position, (2, 1)), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(goal.quaternion, np.tile(quaternion, (2, 1)), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_another_robot_has_its_own_target_and_can_reach_it(name: str) -> None:
    robot = robot_model(name)
    goal, repeated = _goal(ReachTask(), robot, 1), _goal(ReachTask(), robot, 1)
    np.testing.assert_array_equal(repeated.position, goal.position)
    np.testing.assert_array_equal(repeated.quaternion, goal.quaternion)
    q = solve_ik(robot, goal.position[0], goal.quaternion[0])[None]
    np.testing.assert_allclose(robot.kinematics().pose(q)[0], goal.position, atol=1e-3)


@pytest.mark.parametrize("name", TASK_NAMES)
@pytest.mark.parametrize("robot", ["mara", "ur5", "panda"])
def test_every_observation_lies_in_the_observation_space(name: str, robot: str) -> None:
    arm, task = robot_model(robot), TASKS[name]
    goal = _goal(task, arm, 300)
    space = Observation(task.observation(arm, goal, arm.velocity_limit)).space
    assert space.shape == (arm.num_joints + (10 if "Orient" in name else 6),)
    q = uniform_q(arm, 300, 7)
    qd = np.random.default_rng(8).choice([-1.0, 1.0], size=q.shape) * arm.velocity_limit
    state = dataclasses.replace(_state(arm, q), ee_velocity=arm.kinematics().velocity(q, qd))
    for observation in _observe(task, arm, state, goal):
        assert space.contains(observation)


def test_the_warning_for_a_target_out_of_reach_gives_the_distance(mara: RobotModel) -> None:
    task = ReachTask(target_position=(0.0, 0.0, 2.0))
    # The tool is at a height of 1.7917 m when the arm points straight up.
    with pytest.warns(UserWarning, match=r"out of reach of mara's 'ee_link'.*208\.3 mm"):
        _goal(task, mara, 1)


def test_the_warning_for_an_orientation_out_of_reach_gives_the_angle(mara: RobotModel) -> None:
    target: dict[str, Any] = {
        "target_position": (0.0, -0.001, 1.79),
        "target_quaternion": (0.0, 1.0, 0.0, 0.0),
    }
    with pytest.warns(UserWarning, match=r"the closest pose is [\d.]+ mm and [\d.]+° away"):
        _goal(ReachTask(orientation=True, **target), mara, 1)
    # Without `orientation` only the position must be in reach: a warning would fail the test here.
    _goal(ReachTask(orientation=False, **target), mara, 1)


def test_a_custom_arm_gets_a_default_target_in_reach(tmp_path: Path) -> None:
    urdf = write(tmp_path / "stick.urdf", urdf_xml(*map(joint_xml, range(4))))
    robot = RobotModel.load(urdf, "link4")
    goal = _goal(ReachTask(), robot, 1)
    q = solve_ik(robot, goal.position[0], goal.quaternion[0])
    np.testing.assert_allclose(robot.kinematics().pose(q[None])[0], goal.position, atol=1e-3)


def test_options_become_plain_values_that_json_can_store() -> None:
    task = ReachTask(target_position=np.array([0.1, 0.2, 0.9]), start_q=[0] * 6)  # type: ignore[arg-type]
    assert task.target_position == (0.1, 0.2, 0.9)
    assert task.start_q == (0.0,) * 6
    assert ReachTask(**json.loads(json.dumps(dataclasses.asdict(task)))) == task


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"on_collision": "stop"}, r"unknown on_collision 'stop'.*continue, reset, terminate"),
        ({"target_position": (0.1, 0.2)}, "target_position must be a list of 3 finite numbers"),
        ({"target_position": (0.1, 0.2, np.nan)}, "target_position must be a list of 3 finite"),
        (
            {"target_position": "here"},
            "target_position must be a list of 3 finite numbers.*not 'here'",
        ),
        ({"target_quaternion": (1, 0, 0)}, "target_quaternion must be a list of 4 finite numbers"),
        ({"target_quaternion": (1, 1, 0, 0)}, r"length 1\.4142; give a unit quaternion \[w, x"),
        ({"target_quaternion": (0, 0, 0, 0)}, r"length 0\.0000; give a unit quaternion"),
        ({"start_q": [[0.0] * 6]}, "start_q must be a list of finite numbers"),
        ({"alpha": 0.0}, "alpha must be finite and positive, not 0"),
        ({"beta": -1.0}, "beta must be finite and positive, not -1"),
        ({"kappa": np.nan}, "kappa must be finite and positive, not nan"),
        ({"gamma": -0.1}, "gamma must be finite and not negative, not -0.1"),
        ({"delta": np.inf}, "delta must be finite and not negative, not inf"),
        ({"eta": -1}, "eta must be finite and not negative, not -1"),
        ({"alpha": "steep"}, "alpha must be"),
    ],
)
def test_invalid_values_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        ReachTask(**options)


def test_the_error_for_an_unknown_task_suggests_a_known_one() -> None:
    with pytest.raises(GymMaraError, match=r"unknown task 'MARO-v0'\. Did you mean 'MARA-v0'\?"):
        named_task("MARO-v0")


def test_a_task_is_immutable() -> None:
    task: Task = ReachTask()
    with pytest.raises(dataclasses.FrozenInstanceError):
        task.on_collision = "continue"  # type: ignore[misc]
