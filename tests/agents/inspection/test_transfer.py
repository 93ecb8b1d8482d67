"""The comparison of backends: when an arm has settled, and which backend gets which option."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.agents.inspection import transfer as module
from gym_mara.agents.inspection.rollout import Player, roll_out
from gym_mara.agents.inspection.transfer import settling_time, transfer
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.training.train import train
from gym_mara.errors import GymMaraError
from tests.agents.conftest import ROLLOUT, config, silent
from tests.backends.fake import FakeBackend

PERIOD = 0.1
pytestmark = pytest.mark.filterwarnings("ignore:left out. the backend 'warp'")  # without a GPU


@pytest.mark.parametrize(
    ("error", "seconds"),
    [
        ([0.001] * 20, 0.0),
        ([1.0] * 5 + [0.001] * 15, 0.5),
        ([0.001, 1.0] + [0.004] * 18, 0.2),
        ([1.022] * 20, None),  # it rests, but far from the target
        ([0.001] * 19 + [1.0], None),  # it leaves the target
        ([1.0] * 19 + [0.001], None),  # it only just arrived, and may be passing by
        ([1.0, 0.001] * 10, None),
        ([float("nan")] * 20, None),  # a task without a position error
    ],
)
def test_an_arm_has_settled_once_it_stays_at_the_target(
    error: list[float], seconds: float | None
) -> None:
    other = [0.001] * len(error)
    times = settling_time(np.array([error, other]).T, PERIOD)
    np.testing.assert_allclose(times, [np.nan if seconds is None else seconds, 0.0])


@pytest.fixture
def _short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "roll_out", partial(roll_out, steps=20))


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
    assert rows[0].position_error_mm != before[0].position_error_mm


def test_the_settings_of_the_training_have_a_row(tmp_path: Path) -> None:
    slow = train(
        config(steps=ROLLOUT, env_options={"max_joint_velocity": 0.5}), tmp_path / "run", silent
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "roll_out", partial(roll_out, steps=5))
        rows = transfer(slow, backends=["pinocchio", "dart"])
    limits = [row.settings.get("max_joint_velocity") for row in rows]
    assert [row.backend for row in rows] == ["pinocchio"] * 3 + ["dart"]
    assert limits == [0.5, None, 1.57, None]


def test_an_episode_has_the_length_of_the_environment(tmp_path: Path) -> None:
    dense = {"reward_type": "dense"}
    run = train(
        config(env="MARAGoal-v0", steps=ROLLOUT, env_options=dense), tmp_path / "run", silent
    )
    with Player(run, "pinocchio", dense) as player:
        assert len(roll_out(player).reward) == 50


@pytest.mark.parametrize("name", ["target_positon", "camera", "task", "num_envs", "render_mode"])
def test_an_unknown_option_is_an_error(finished_run: RunFolder, name: str) -> None:
    with pytest.raises(GymMaraError, match=f"unknown keyword argument '{name}' on any of"):
        transfer(finished_run, backends=["dart", "pinocchio"], options={name: 1})


@pytest.mark.parametrize("episodes", [0, -1, 1.5, True])
def test_a_wrong_number_of_episodes_is_an_error(episodes: Any) -> None:
    with pytest.raises(GymMaraError, match="episodes must be a whole number"):
        transfer(None, episodes=episodes)  # type: ignore[arg-type]
