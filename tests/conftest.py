"""Fixtures of the whole suite."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

from gym_mara.agents.parallel import ONE_THREAD
from gym_mara.robot import RobotModel
from tests.helpers import robot_model, write

# Tests run in several processes, which share the cores, and so do the processes that they begin.
os.environ.update(dict.fromkeys(ONE_THREAD, "1"))

settings.register_profile("gym_mara", deadline=None, max_examples=40, derandomize=True)
settings.load_profile("gym_mara")


@pytest.fixture(scope="session")
def mara() -> RobotModel:
    """MARA, loaded once: a RobotModel does not change."""
    return robot_model("mara")


@pytest.fixture
def fake_backend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of FakeBackend, offered as another package would: by an entry point."""
    package = tmp_path / "gym_mara_fake-0.1.dist-info"
    package.mkdir()
    write(package / "METADATA", "Metadata-Version: 2.1\nName: gym_mara_fake\nVersion: 0.1\n")
    write(
        package / "entry_points.txt",
        "[gym_mara.backends]\nfake = tests.backends.fake:FakeBackend\n",
    )
    monkeypatch.syspath_prepend(tmp_path)
    return "fake"
