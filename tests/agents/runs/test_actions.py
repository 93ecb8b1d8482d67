"""The action mode of a policy: it is stored with it, and every environment in which it plays gets it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

import gym_mara
from gym_mara.agents.inspection.transfer import transfer
from gym_mara.agents.runs import load_policy
from gym_mara.agents.runs.description import ABSOLUTE
from gym_mara.agents.runs.evaluation import Player, evaluate_run, make_env, options_on
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.training.train import resume, train
from gym_mara.errors import GymMaraError
from tests.agents.conftest import ROLLOUT, config, silent
from tests.helpers import robot_model

ID = "gym_mara/MARACollisionOrient-v0"
PERIOD = 0.03
OPTIONS = {"action": "relative", "servo_gain": 10.0, "control_period": PERIOD}
STEPS = robot_model("mara").velocity_limit * (PERIOD + 0.1)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run with relative actions on kinematic servos."""
    asked = config(env_options=OPTIONS, steps=ROLLOUT)
    return train(asked, tmp_path_factory.mktemp("relative") / "run", silent)


def test_a_description_has_the_mode_the_steps_and_the_period(
    run: RunFolder, finished_run: RunFolder
) -> None:
    about = load_policy(run).about
    assert about.format == 2
    assert (about.action.mode, about.action.reference) == ("relative", "position")
    np.testing.assert_allclose(about.action.steps, STEPS, rtol=1e-12)
    assert (about.low, about.high) == ([-1.0] * 6, [1.0] * 6)
    assert about.control_period == PERIOD
    about = load_policy(finished_run).about
    assert (about.action, about.control_period) == (ABSOLUTE, 0.02)


@pytest.mark.parametrize("backend", ["pinocchio", "mujoco", "dart"])
def test_a_policy_plays_with_its_own_steps_on_every_backend(run: RunFolder, backend: str) -> None:
    with Player(run, backend, options_on(backend, run.config)) as player:
        simulation = player.env.simulation
        assert simulation.actions.mode == "relative"
        np.testing.assert_allclose(simulation.actions.steps, STEPS, rtol=1e-12)
        assert simulation.backend.control_period == PERIOD
        player.step()
    assert np.isfinite(evaluate_run(run, backend=backend, episodes=1)["return"]).all()


def test_a_transfer_plays_with_the_steps_of_the_policy(run: RunFolder) -> None:
    (trained, *_, limited) = transfer(run, backends=["pinocchio"])
    assert trained.settings == {"servo_gain": 10.0, "control_period": PERIOD}
    assert limited.settings == {"max_joint_velocity": pytest.approx(np.pi / 2, rel=1e-3)}
    with pytest.raises(GymMaraError, match="its actions are relative"):
        transfer(run, backends=["pinocchio"], options={"action": "absolute"})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"action": "absolute"}, "its actions are relative, .*environment absolute: leave out"),
        ({"action": "cartesian"}, "its actions are relative, .*environment cartesian: leave out"),
        ({"action_from": "target"}, "its steps begin at the position, .*leave out action_from"),
        ({"action_scale": 0.01}, "its action 1 means .*leave out action_scale"),
    ],
)
def test_another_mode_or_step_than_the_policys_is_refused(
    run: RunFolder, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        evaluate_run(run, episodes=1, options=options)


def test_a_policy_of_joint_targets_gets_joint_targets(finished_run: RunFolder) -> None:
    with pytest.raises(GymMaraError, match=r"its actions are absolute, .* relative: leave out"):
        evaluate_run(finished_run, episodes=1, options={"action": "relative"})


def test_a_policy_in_python_acts_in_an_environment_with_its_keywords(run: RunFolder) -> None:
    assert gym_mara
    policy = load_policy(run)
    env = gymnasium.make(ID, **policy.about.action.keywords)
    observation, _ = env.reset(seed=0)
    action, _ = policy.predict(observation)
    assert env.action_space == Box(-1.0, 1.0, (6,), np.float32)
    env.step(action)  # type: ignore[arg-type]
    env = gymnasium.make(ID)
    env.reset(seed=0)
    with pytest.raises(GymMaraError, match="relative or cartesian actions needs an environment"):
        env.step(action)  # type: ignore[arg-type]


def test_a_policy_of_joint_targets_keeps_its_control_period_on_another_backend(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    path = Path(shutil.copytree(finished_run.path, tmp_path / "run"))
    for file, changes in (
        ("config.json", {"env_options": {"control_period": 0.1}}),
        ("last/policy.json", {"control_period": 0.1}),
    ):
        content = json.loads((path / file).read_text())
        (path / file).write_text(json.dumps(content | changes))
    run = RunFolder.open(path)
    for backend, options, period in (
        ("pinocchio", {}, 0.1),
        ("mujoco", {}, 0.1),
        ("mujoco", {"control_period": 0.04}, 0.04),
    ):
        with Player(run, backend, options_on(backend, run.config, options)) as player:
            assert player.env.simulation.backend.control_period == period


def test_policies_of_the_first_format_act_with_joint_targets(
    finished_run: RunFolder, tmp_path: Path
) -> None:
    path = Path(shutil.copytree(finished_run.path, tmp_path / "run"))
    file = path / "last" / "policy.json"
    content = json.loads(file.read_text())
    del content["action"], content["control_period"]
    file.write_text(json.dumps(content | {"format": 1}))
    about = load_policy(path).about
    assert (about.action, about.control_period) == (ABSOLUTE, 0.02)
    expected = evaluate_run(finished_run, episodes=1)["return"]
    np.testing.assert_array_equal(
        evaluate_run(RunFolder.open(path), episodes=1)["return"], expected
    )
    file.write_text(json.dumps(content | {"format": 2}))
    with pytest.raises(GymMaraError, match="is damaged"):
        load_policy(path)


def test_a_resumed_run_gives_what_it_would_have_given(tmp_path: Path) -> None:
    options = OPTIONS | {"action": "cartesian", "action_from": "target"}
    asked = config(env_options=options, steps=2 * ROLLOUT)
    whole = train(asked, tmp_path / "whole", silent)
    again = RunFolder.open(Path(shutil.copytree(whole.path, tmp_path / "again")))
    shutil.rmtree(again.path / "last")
    shutil.rmtree(again.checkpoints()[-1])
    resume(again.path, silent)
    observations = np.random.default_rng(0).normal(size=(4, load_policy(whole).about.size))
    expected = load_policy(whole).predict(observations)[0]
    assert expected.shape == (4, 6)
    np.testing.assert_array_equal(load_policy(again).predict(observations)[0], expected)


@pytest.mark.parametrize("action", ["relative", "cartesian"])
def test_an_agent_acts_in_the_action_space_without_scaling(action: str) -> None:
    env = make_env("MARA-v0", "pinocchio", 2, {"action": action, "robot": "panda"})
    assert env.action_space == env.env.single_action_space
    actions = np.full((2, *env.action_space.shape), 0.5, np.float32)  # type: ignore[misc]
    assert env.targets(actions) is actions
    env.close()
