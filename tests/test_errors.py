"""The errors a user can mend."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError

import pytest

from gym_mara import extras
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


def test_a_library_that_is_too_old_is_named_with_the_version_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(extras, "version", lambda name: "0.1")
    with (
        pytest.raises(MissingExtraError, match=r"dart' needs dartpy>=\S+, and 0.1 is installed"),
        extras.needs("the backend 'dart'", "dart"),
    ):
        pass


def test_a_library_that_is_absent_is_named_with_the_version_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def absent(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(extras, "version", absent)
    with (
        pytest.raises(MissingExtraError, match=r"films needs imageio-ffmpeg>=\S+, which is not"),
        extras.needs("films", "render", "imageio-ffmpeg"),
    ):
        pass


def test_a_library_that_does_not_load_is_told_with_the_reason() -> None:
    with (
        pytest.raises(MissingExtraError, match=r"dartpy, which cannot be imported \(no libGL"),
        extras.needs("the backend 'dart'", "dart", "dartpy"),
    ):
        raise ImportError("no libGL", name="dartpy")


def test_a_library_without_a_name_in_its_error_is_named_by_its_extra() -> None:
    with (
        pytest.raises(
            MissingExtraError, match=r"needs dartpy, which cannot be imported \(no libGL"
        ),
        extras.needs("the backend 'dart'", "dart"),
    ):
        raise ImportError("no libGL")


def test_a_mistake_of_ours_is_no_missing_library() -> None:
    with pytest.raises(ModuleNotFoundError) as told, extras.needs("training", "train"):
        import gym_mara.nowhere  # type: ignore[import-not-found] # noqa: F401
    assert not isinstance(told.value, MissingExtraError)


def test_every_extra_that_the_package_asks_for_exists() -> None:
    for extra in ("dart", "fcl", "render", "robots", "train"):
        assert extras._requirements(extra), extra
