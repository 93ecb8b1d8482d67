"""The errors a user can mend."""

from __future__ import annotations

import pytest

from gym_mara.errors import GymMaraError, MissingExtraError, unknown
from gym_mara.testing import pickled


def test_unknown_names_the_nearest_and_all_valid_names_in_order() -> None:
    assert str(unknown("engine", "cola", ["fcl", "coal"])) == (
        "unknown engine 'cola'. Did you mean 'coal'? Valid: coal, fcl."
    )


def test_unknown_guesses_nothing_where_nothing_is_near() -> None:
    assert str(unknown("engine", "xyz", ["fcl", "coal"])) == (
        "unknown engine 'xyz'. Valid: coal, fcl."
    )


@pytest.mark.parametrize("name", [None, 7, ["coal"]])
def test_a_name_need_not_be_a_string(name: object) -> None:
    assert f"unknown engine {name!r}." in str(unknown("engine", name, ["fcl"]))


def test_a_missing_extra_says_what_to_install_and_pickles() -> None:
    error = MissingExtraError("robot 'ur5'", "example-robot-data", "robots")
    for each in (error, pickled(error)):
        assert isinstance(each, ImportError)
        assert isinstance(each, GymMaraError)
        assert str(each) == (
            "robot 'ur5' needs example-robot-data, which is not installed: "
            "pip install 'gym_mara[robots]'"
        )


def test_every_error_is_a_value_error() -> None:
    assert issubclass(GymMaraError, ValueError)
