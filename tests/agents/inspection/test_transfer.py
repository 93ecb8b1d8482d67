"""The comparison of backends: which backend gets which option."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.agents.inspection.transfer import transfer
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.training.train import train
from gym_mara.errors import GymMaraError
from tests.agents.conftest import ROLLOUT, config, shorten_episodes, silent
from tests.backends.fake import FakeBackend

pytestmark = pytest.mark.filterwarnings("ignore:left out. the backend 'warp'")  # without a GPU


@pytest.fixture
def _short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_episodes(monkeypatch, 20)


@pytest.mark.usefixtures("_short_episodes")
def test_a_policy_plays_on_every_engine(finished_run: RunFolder) -> None:
    rows = transfer(finished_run)
    played = [(row.backend, row.settings) for row in rows]
    kinematic = [("pinocchio", {}), ("pinocchio", {"max_joint_velocity": 1.57})]
    expected = [("dart", {}), ("mujoco", {}), *kinematic]
    assert [each for each in played if each[0] != "warp"] == expected
    of = dict(zip((row.backend for row in rows), rows, strict=False))
    # Both engines with dynamics have the same servos.
    mine, theirs = of["mujoco"].metrics, of["dart"].metrics
    np.testing.assert_allclose(mine["position_error_mm"], theirs["position_error_mm"], atol=3.0)
    assert (mine["highest_torque"] > 0.0).all()


@pytest.mark.usefixtures("_short_episodes")
def test_only_the_chosen_backends_are_played(finished_run: RunFolder) -> None:
    rows = transfer(finished_run, backends=["mujoco"], options={"servo_gain": 50.0})
    assert [(row.backend, row.settings) for row in rows] == [("mujoco", {"servo_gain": 50.0})]
    with pytest.raises(GymMaraError, match="unknown backend 'mojuco'"):
        transfer(finished_run, backends=["mojuco"])


@pytest.mark.usefixtures("_short_episodes")
def test_a_backend_that_this_machine_cannot_run_is_left_out_with_the_reason(
    finished_run: RunFolder, fake_backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_gpu() -> None:
        raise GymMaraError("no GPU")

    monkeypatch.setattr(FakeBackend, "require_machine", no_gpu)
    with pytest.warns(UserWarning, match="left out: no GPU"):
        rows = transfer(finished_run)
    assert fake_backend not in [row.backend for row in rows]
    # It may work with other settings, which only who names it knows.
    assert [row.backend for row in transfer(finished_run, backends=[fake_backend])] == ["fake"]


@pytest.mark.usefixtures("_short_episodes")
def test_an_option_of_the_task_counts_on_every_backend(finished_run: RunFolder) -> None:
    options: dict[str, Any] = {"target_position": [-0.3, 0.1, 0.8], "physics_step": 0.002}
    backends = ["dart", "pinocchio"]
    rows = transfer(finished_run, backends=backends, options=options)
    assert not any("target_position" in row.settings for row in rows), "it is the same for all"
    assert all(("physics_step" in row.settings) == (row.backend == "dart") for row in rows)
    before = transfer(finished_run, backends=backends)
    assert (rows[0].metrics["return"] != before[0].metrics["return"]).all()


def test_the_settings_of_the_training_have_a_row(tmp_path: Path) -> None:
    slow = train(
        config(steps=ROLLOUT, env_options={"max_joint_velocity": 0.5}), tmp_path / "run", silent
    )
    with pytest.MonkeyPatch.context() as patch:
        shorten_episodes(patch, 5)
        rows = transfer(slow, backends=["pinocchio", "dart"])
    limits = [row.settings.get("max_joint_velocity") for row in rows]
    assert [row.backend for row in rows] == ["pinocchio"] * 3 + ["dart"]
    assert limits == [0.5, None, 1.57, None]


@pytest.mark.parametrize("name", ["target_positon", "camera", "task", "num_envs", "render_mode"])
def test_an_unknown_option_is_an_error(finished_run: RunFolder, name: str) -> None:
    with pytest.raises(GymMaraError, match=f"unknown keyword argument '{name}' on any of"):
        transfer(finished_run, backends=["dart", "pinocchio"], options={name: 1})
