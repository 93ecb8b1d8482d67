"""Errors: their messages and their types."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError

import pytest

from gym_mara import extras
from gym_mara.errors import GymMaraError, MissingExtraError, unknown
from gym_mara.testing import pickled


def test_unknown_suggests_a_similar_name_and_lists_all_valid_names() -> None:
    assert str(unknown("engine", "cola", ["fcl", "coal"])) == (
        "unknown engine 'cola'. Did you mean 'coal'? Valid: coal, fcl."
    )


def test_unknown_suggests_nothing_if_no_name_is_similar() -> None:
    assert str(unknown("engine", "xyz", ["fcl", "coal"])) == (
        "unknown engine 'xyz'. Valid: coal, fcl."
    )


@pytest.mark.parametrize("name", [None, 7, ["coal"]])
def test_an_unknown_name_can_be_any_object(name: object) -> None:
    assert f"unknown engine {name!r}." in str(unknown("engine", name, ["fcl"]))


def test_a_missing_extra_error_names_the_extra_and_can_be_pickled() -> None:
    error = MissingExtraError("robot 'ur5'", "example-robot-data", "robots")
    for each in (error, pickled(error)):
        assert isinstance(each, ImportError)
        assert isinstance(each, GymMaraError)
        assert str(each) == (
            "robot 'ur5' needs example-robot-data, which is not installed: "
            "pip install 'gym_mara[robots]'"
        )


def test_gym_mara_errors_are_value_errors() -> None:
    assert issubclass(GymMaraError, ValueError)


def test_the_error_for_an_old_library_names_the_required_version(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(extras, "version", lambda name: "0.1")
    with (
        pytest.raises(MissingExtraError, match=r"dart' needs dartpy>=\S+, and 0.1 is installed"),
        extras.needs("the backend 'dart'", "dart"),
    ):
        pass


def test_the_error_for_a_missing_library_names_the_required_version(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def not_found(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(extras, "version", not_found)
    with (
        pytest.raises(MissingExtraError, match=r"films needs imageio-ffmpeg>=\S+, which is not"),
        extras.needs("films", "render", "imageio-ffmpeg"),
    ):
        pass


def test_the_error_for_a_library_that_cannot_be_imported_gives_the_reason() -> None:
    with (
        pytest.raises(MissingExtraError, match=r"dartpy, which cannot be imported \(no libGL"),
        extras.needs("the backend 'dart'", "dart", "dartpy"),
    ):
        raise ImportError("no libGL", name="dartpy")


def test_an_import_error_without_a_library_name_lists_the_libraries_of_the_extra() -> None:
    with (
        pytest.raises(
            MissingExtraError, match=r"needs dartpy, which cannot be imported \(no libGL"
        ),
        extras.needs("the backend 'dart'", "dart"),
    ):
        raise ImportError("no libGL")


def test_a_missing_module_of_gym_mara_is_not_a_missing_extra() -> None:
    with pytest.raises(ModuleNotFoundError) as error, extras.needs("training", "train"):
        import gym_mara.nowhere  # type: ignore[import-not-found] # noqa: F401
    assert not isinstance(error.value, MissingExtraError)


def test_every_extra_that_the_package_uses_has_requirements() -> None:
    for extra in ("dart", "fcl", "render", "robots", "train"):
        assert extras._requirements(extra), extra
