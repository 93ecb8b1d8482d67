"""Keyword arguments: each belongs to exactly one part of the environment."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from gym_mara.backends import backend_settings
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.envs.options import Options
from gym_mara.errors import GymMaraError
from gym_mara.tasks import ReachTask


def test_each_part_receives_its_own_keyword_arguments() -> None:
    keywords = {"alpha": 4.0, "path_resolution": 0.01, "width": 320, "velocity_filter": 0.1}
    options = Options.sort("MARA-v0", "mara", None, "pinocchio", keywords)
    assert isinstance(options.task, ReachTask)
    assert options.task.alpha == 4.0
    assert options.settings == {"path_resolution": 0.01}
    assert options.rendering.width == 320
    assert options.sensors.velocity_filter == 0.1


@pytest.mark.parametrize("make", [MaraEnv, MaraVectorEnv])
def test_the_error_for_an_unknown_keyword_lists_all_valid_ones(make: type[MaraEnv]) -> None:
    with pytest.raises(
        GymMaraError, match=r"'widht' with backend 'pinocchio'\. Did you mean 'width'"
    ) as error:
        make(widht=3)
    for name in ("alpha", "camera", "collision", "velocity_filter"):
        assert name in str(error.value)


@pytest.mark.parametrize(("name", "asked"), [("kapa", False), ("wholly_other", True)])
def test_a_misspelt_keyword_imports_no_other_engine_and_a_broken_one_does_not_hide_it(
    name: str, asked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    others: list[str] = []

    def settings(backend: str) -> list[str]:
        if backend != "pinocchio":
            others.append(backend)
            raise OSError("libGL.so.1: cannot open shared object file")
        return backend_settings(backend)

    monkeypatch.setattr("gym_mara.envs.options.backend_settings", settings)
    with pytest.raises(GymMaraError, match=f"unknown keyword argument '{name}'"):
        MaraEnv(**{name: 1})  # type: ignore[arg-type]
    assert bool(others) == asked


@pytest.mark.parametrize("name", ["target_position", "target_quaternion"])
def test_the_error_for_a_target_that_is_drawn_names_the_option_of_reset(name: str) -> None:
    with pytest.raises(GymMaraError, match=f"draws its targets: give '{name}' to reset"):
        MaraEnv("MARAPose-v0", **{name: (0.3, 0.3, 0.8, 0.0)})  # type: ignore[arg-type]


@dataclass(frozen=True)
class Ambiguous(ReachTask):
    """A task with a value that is also a name of a rendering setting."""

    width: float = 1.0


def test_a_keyword_of_two_parts_is_refused() -> None:
    with pytest.raises(GymMaraError, match="'width' belongs to the task and the rendering"):
        MaraEnv(Ambiguous(), width=2.0)
    MaraEnv(Ambiguous()).close()
