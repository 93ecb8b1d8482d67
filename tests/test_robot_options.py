"""The options of a robot reach it through every door: environments, reward records, runs and the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import trimesh

from gym_mara import regression
from gym_mara.agents.inspection.transfer import transfer
from gym_mara.agents.runs.evaluation import Player, evaluate_run, options_on
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.training.train import train
from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError
from gym_mara.files import DamagedFileError
from gym_mara.robot import RobotModel
from gym_mara.robot.options import ROBOT_KEYWORDS
from tests.agents.conftest import ROLLOUT, config, shorten_episodes, silent
from tests.helpers import joint_xml, urdf_xml, write


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an arm, and a package elsewhere that holds the mesh of its first link."""
    folder = tmp_path_factory.mktemp("robot")
    meshes = folder / "elsewhere" / "parts"
    meshes.mkdir(parents=True)
    trimesh.creation.box((0.1, 0.1, 0.1)).export(meshes / "base.stl")
    mesh = '<mesh filename="package://parts/base.stl"/>'
    xml = urdf_xml(joint_xml(0), joint_xml(1, axis="0 1 0")).replace(
        '<sphere radius="0.05"/>', mesh, 1
    )
    write(folder / "arm.urdf", xml)
    return folder


@pytest.fixture
def options(folder: Path) -> dict[str, Any]:
    """Keyword arguments with every option of a robot."""
    return {
        "robot": str(folder / "arm.urdf"),
        "ee_frame": "link2",
        "package_dirs": [str(folder / "elsewhere")],
        "default_mass": 0.5,
        "effort_limit": {"joint1": 3.0},
        "velocity_limit": [1.0, 0.5],
        "convex_hulls": True,
    }


def _check(robot: RobotModel) -> None:
    assert robot.effort_limit.tolist() == [10.0, 3.0]
    assert robot.velocity_limit.tolist() == [1.0, 0.5]
    assert robot.options.default_mass == 0.5
    assert robot.options.convex_hulls


def test_these_are_all_options(options: dict[str, Any]) -> None:
    assert set(options) == set(ROBOT_KEYWORDS)


def test_environments_take_them(options: dict[str, Any]) -> None:
    env = gymnasium.make("gym_mara/MARA-v0", **options)
    _check(env.unwrapped.simulation.robot)  # type: ignore[attr-defined]
    assert env.spec is not None
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    _check(again.unwrapped.simulation.robot)  # type: ignore[attr-defined]
    for name in ("gym_mara/MARA-v0", "gym_mara/MARAGoal-v0"):
        envs = gymnasium.make_vec(name, num_envs=2, **options)
        _check(envs.simulation.robot)  # type: ignore[attr-defined]


def test_the_error_for_an_unknown_keyword_lists_them() -> None:
    with pytest.raises(GymMaraError, match="Did you mean 'default_mass'") as error:
        MaraEnv(defualt_mass=1.0)
    for name in ROBOT_KEYWORDS:
        assert name in str(error.value)


def test_a_reward_record_has_them_with_paths_relative_to_itself(
    folder: Path, options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    relative = {**options, "robot": "arm.urdf", "package_dirs": ["elsewhere"]}
    recorded = regression.record("MARA-v0", options=relative, states=4)
    regression.write(folder / "record.csv", recorded)
    monkeypatch.chdir(tmp_path)
    assert regression.check(folder / "record.csv") == []
    assert regression.read(folder / "record.csv").options["package_dirs"] == [
        str(folder / "elsewhere")
    ]


def test_a_configuration_has_absolute_package_dirs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = config(env_options={"package_dirs": ["meshes", "/parts"]})
    assert made.env_options["package_dirs"] == [str(tmp_path / "meshes"), "/parts"]


# Runs.


@pytest.fixture(scope="module")
def run(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run with options of its robot."""
    options = {
        "robot": str(folder / "arm.urdf"),
        "ee_frame": "link2",
        "package_dirs": [str(folder / "elsewhere")],
        "default_mass": 0.5,
        "effort_limit": {"joint1": 3.0},
    }
    asked = config(env="MARA-v0", env_options=options, steps=ROLLOUT)
    return train(asked, tmp_path_factory.mktemp("runs") / "run", silent)


def test_a_run_keeps_the_options_of_its_robot(run: RunFolder) -> None:
    opened = RunFolder.open(run.path)
    with Player(opened, "pinocchio", options_on("pinocchio", opened.config)) as player:
        assert player.env.simulation.robot.effort_limit.tolist() == [10.0, 3.0]


def test_the_configuration_of_a_stranger_has_no_relative_package_dirs(
    run: RunFolder, tmp_path: Path
) -> None:
    text = (run.path / "config.json").read_text()
    (elsewhere,) = run.config.env_options["package_dirs"]
    write(tmp_path / "config.json", text.replace(elsewhere, "elsewhere"))
    with pytest.raises(DamagedFileError, match="paths of the robot must be absolute"):
        RunFolder.open(tmp_path)


def test_an_option_for_an_evaluation_joins_those_of_the_run(run: RunFolder) -> None:
    robot = options_on("pinocchio", run.config, {"velocity_limit": 0.5})["robot"]
    assert robot.velocity_limit.tolist() == [0.5, 0.5]
    assert robot.effort_limit.tolist() == [10.0, 3.0]
    assert robot.options.default_mass == 0.5
    assert len(evaluate_run(run, episodes=1, options={"velocity_limit": 0.5})["return"]) == 1


def test_the_place_of_the_packages_makes_no_other_robot(run: RunFolder, tmp_path: Path) -> None:
    moved = options_on("pinocchio", run.config, {"package_dirs": [str(tmp_path)]})
    assert moved["package_dirs"] == [str(tmp_path)]
    assert moved["robot"] == run.config.env_options["robot"]


def test_a_loaded_robot_replaces_that_of_the_run_with_its_options(run: RunFolder) -> None:
    robot = RobotModel.load("ur5")
    assert options_on("pinocchio", run.config, {"robot": robot}) == {"robot": robot}
    with pytest.raises(GymMaraError, match="default_mass cannot change a RobotModel"):
        options_on("pinocchio", run.config, {"robot": robot, "default_mass": 1.0})


def test_another_robot_keeps_the_options_of_the_run_unless_they_are_replaced(
    run: RunFolder,
) -> None:
    with pytest.raises(GymMaraError, match="'joint1' in effort_limit"):
        options_on("pinocchio", run.config, {"robot": "ur5", "ee_frame": "tool0"})
    given = {"robot": "ur5", "ee_frame": None, "effort_limit": None}
    assert options_on("pinocchio", run.config, given)["robot"].options.default_mass == 0.5


def test_a_transfer_has_them_on_every_backend(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 2)
    backends = ["dart", "mujoco", "pinocchio"]
    rows = transfer(run, backends=backends, options={"velocity_limit": 0.5})
    assert [row.backend for row in rows] == [*backends, "pinocchio"]
    assert rows[-1].settings == {"max_joint_velocity": 0.5}
    assert np.nanmax([row.metrics["highest_velocity"] for row in rows]) <= 0.5 + 1e-9
