"""The backends by name, those of this package and those of other packages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gym_mara.backends import backend_names, make_backend
from gym_mara.backends.pinocchio import PinocchioBackend
from gym_mara.backends.registry import (
    BrokenBackendError,
    backend_class,
    installed_backends,
)
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from tests.backends.fake import FakeBackend
from tests.helpers import write


def test_pinocchio_is_built_in(mara: RobotModel) -> None:
    assert "pinocchio" in backend_names()
    assert type(make_backend("pinocchio", mara, 1, {})) is PinocchioBackend


def test_another_package_adds_a_backend_by_an_entry_point(
    mara: RobotModel, fake_backend: str
) -> None:
    assert backend_names() == sorted({*backend_names(), "fake", "pinocchio"})
    backend = make_backend(fake_backend, mara, 2, {"wall": 0.25})
    assert isinstance(backend, FakeBackend)
    assert backend.step(np.array([[0.3] * 6, [0.2] * 6])).collided.tolist() == [True, False]


def test_an_unknown_backend_is_named_with_the_nearest_and_the_known_ones() -> None:
    with pytest.raises(
        GymMaraError,
        match=r"unknown backend 'pinochio'\. Did you mean 'pinocchio'\? Valid: .*pinoc",
    ):
        backend_class("pinochio")


def test_an_unknown_setting_is_named_with_the_known_ones(mara: RobotModel) -> None:
    with pytest.raises(
        GymMaraError,
        match=r"unknown keyword argument 'wall' with backend 'pinocchio'.*collision, .*control_period.*"
        r"max_joint_velocity, path_resolution",
    ):
        make_backend("pinocchio", mara, 1, {"wall": 1.0})


@pytest.mark.parametrize("period", [0.0, -0.02, np.nan, np.inf])
def test_a_control_period_out_of_its_range(
    mara: RobotModel, fake_backend: str, period: float
) -> None:
    for name in (fake_backend, "pinocchio"):
        with pytest.raises(
            GymMaraError, match=r"control_period must be finite and positive \(s\), not "
        ):
            make_backend(name, mara, 1, {"control_period": period})


def test_the_control_period_is_a_setting_of_every_backend(
    mara: RobotModel, fake_backend: str
) -> None:
    for name in (fake_backend, "pinocchio"):
        backend = make_backend(name, mara, 1, {"control_period": 0.5})
        assert backend.step(np.zeros((1, 6))).time.tolist() == [0.5]


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("no_such_module:Backend", "ModuleNotFoundError: .*no_such_module"),
        ("tests.backends.fake:NoBackend", "AttributeError: .*NoBackend"),
        ("tests.backends.fake:SimState", "not a subclass of gym_mara.backends.Backend"),
    ],
)
def test_a_broken_backend_of_another_package_is_named_and_stops_no_other(
    mara: RobotModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str, reason: str
) -> None:
    installed_before, reasons_before = installed_backends()
    package = tmp_path / "gym_mara_broken-0.1.dist-info"
    package.mkdir()
    write(package / "METADATA", "Metadata-Version: 2.1\nName: gym_mara_broken\nVersion: 0.1\n")
    write(package / "entry_points.txt", f"[gym_mara.backends]\nbroken = {value}\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert {"broken", "dart", "pinocchio"} <= set(backend_names())
    with pytest.raises(BrokenBackendError, match=f"'broken' of gym_mara_broken .*{reason}"):
        make_backend("broken", mara, 1, {})
    assert isinstance(make_backend("pinocchio", mara, 1, {}), PinocchioBackend)
    installed, reasons = installed_backends()
    assert installed == installed_before
    (why,) = set(reasons) - set(reasons_before)
    assert "'broken' of gym_mara_broken" in why
