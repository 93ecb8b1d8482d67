"""The robots known by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gym_mara.collision import make_checker
from gym_mara.errors import GymMaraError, MissingExtraError
from gym_mara.robot import catalog
from tests.helpers import robot_model


def test_mara_comes_first() -> None:
    assert catalog.robot_names()[0] == "mara"
    assert {"ur5", "panda"} <= set(catalog.robot_names())


@pytest.mark.parametrize("name", catalog.robot_names())
def test_every_robot_loads_and_starts_free_and_within_its_limits(name: str) -> None:
    robot = robot_model(name)
    assert robot.name == name
    assert robot.num_joints == len(robot.joint_names) >= 5
    assert (robot.lower <= robot.home).all()
    assert (robot.home <= robot.upper).all()
    assert (robot.velocity_limit > 0.0).all()
    assert robot.collision_pairs
    assert not make_checker("coal", robot).check(robot.home[None]).any()
    assert {finding.severity for finding in robot.findings} <= {"note"}  # not the user's own files


def test_an_unknown_name_gets_the_nearest_and_all_valid_ones() -> None:
    with pytest.raises(
        GymMaraError, match=r"unknown robot 'marra'\. Did you mean 'mara'\? Valid: .*mara.*ur5"
    ):
        catalog.find("marra")


def test_a_robot_of_a_package_that_is_not_installed_names_the_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(catalog, "example_robots_dir", lambda: None)
    with pytest.raises(
        MissingExtraError, match=r"'ur5' needs example-robot-data.*pip install 'gym_mara\[robots\]'"
    ):
        catalog.find("ur5")
    assert catalog.find("mara").urdf.is_file()


def test_every_folder_of_robots_holds_a_readme() -> None:
    for files in catalog.own_robots().values():
        assert (files.urdf.parent / "README.md").is_file()
        assert files.srdf is not None
        assert Path(files.srdf).is_file()


def test_mara_has_the_limits_of_the_real_arm() -> None:
    mara = robot_model("mara")
    np.testing.assert_allclose(mara.upper, [3.1416, 2.35, 2.61, 3.14, 2.56, 3.14])
    np.testing.assert_array_equal(mara.lower, -mara.upper)
    np.testing.assert_array_equal(mara.velocity_limit, np.full(6, 1.57))
    np.testing.assert_array_equal(mara.effort_limit, [104, 104, 69, 69, 34, 34])
    np.testing.assert_array_equal(mara.home, np.zeros(6))
