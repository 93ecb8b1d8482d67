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

PERIOD = 0.1


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


def test_an_option_of_the_task_counts_on_every_backend(
    finished_run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "roll_out", partial(roll_out, steps=20))
    options: dict[str, Any] = {"target_position": [-0.3, 0.1, 0.8], "servo_gain": 50.0}
    rows = transfer(finished_run, options=options)
    titles = [row.backend for row in rows]
    assert not any("target_position" in title for title in titles), "it is the same for all"
    assert all(("servo_gain" in title) == title.startswith("dart") for title in titles)
    before = {row.backend: row for row in transfer(finished_run)}
    assert rows[0].position_error_mm != before["dart"].position_error_mm


def test_the_settings_of_the_training_have_a_row(tmp_path: Path) -> None:
    slow = train(
        config(steps=ROLLOUT, env_options={"max_joint_velocity": 0.5}), tmp_path / "run", silent
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "roll_out", partial(roll_out, steps=5))
        titles = [row.backend for row in transfer(slow)]
    limits = [title.partition("max_joint_velocity=")[2] for title in titles]
    assert titles[0] == "dart"
    assert limits[1:] == ["0.5", "", "1.57"]


def test_an_episode_has_the_length_of_the_environment(tmp_path: Path) -> None:
    dense = {"reward_type": "dense"}
    run = train(
        config(env="MARAGoal-v0", steps=ROLLOUT, env_options=dense), tmp_path / "run", silent
    )
    with Player(run, "pinocchio", dense) as player:
        assert len(roll_out(player).reward) == 50


@pytest.mark.parametrize("name", ["target_positon", "camera", "task", "num_envs", "render_mode"])
def test_an_unknown_option_is_an_error(finished_run: RunFolder, name: str) -> None:
    with pytest.raises(GymMaraError, match=f"unknown keyword argument '{name}' on any installed"):
        transfer(finished_run, options={name: 1})


@pytest.mark.parametrize("episodes", [0, -1, 1.5, True])
def test_a_wrong_number_of_episodes_is_an_error(episodes: Any) -> None:
    with pytest.raises(GymMaraError, match="episodes must be a whole number"):
        transfer(None, episodes=episodes)  # type: ignore[arg-type]
