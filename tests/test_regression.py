"""Reward records: the records of the project's tasks, and the detection of changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gym_mara import regression
from gym_mara.backends import backend_names
from gym_mara.errors import GymMaraError
from gym_mara.tasks import TASKS
from gym_mara.tasks.reach import ReachTask

RECORDS = Path(__file__).parent / "rewards"


@pytest.mark.parametrize("backend", backend_names())
@pytest.mark.parametrize("task", TASKS)
def test_the_rewards_match_the_stored_records(
    check_rewards: Callable[..., None], task: str, backend: str
) -> None:
    check_rewards(RECORDS / f"{task}.csv", backend=backend)


def test_a_record_covers_far_and_near_states() -> None:
    recorded = regression.record("MARACollisionOrient-v0", states=64)
    assert recorded.values["distance"].max() > 0.5
    assert recorded.values["distance"].min() < 1e-3
    assert recorded.values["reward"].max() > 9.0
    assert 0.1 < recorded.values["collided"].mean() < 0.9


def test_reading_a_written_record_gives_exactly_the_same_values(tmp_path: Path) -> None:
    recorded = regression.record("MARAOrient-v0", options={"kappa": 0.03}, states=16)
    regression.write(tmp_path / "record.csv", recorded)
    read = regression.read(tmp_path / "record.csv")
    assert (read.env, read.backend, read.options) == (
        "MARAOrient-v0",
        "pinocchio",
        {"kappa": 0.03},
    )
    np.testing.assert_array_equal(read.q, recorded.q)
    for name, values in recorded.values.items():
        np.testing.assert_array_equal(read.values[name], values)
    assert regression.check(tmp_path / "record.csv") == []


def test_check_finds_every_changed_value(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    regression.write(tmp_path / "record.csv", regression.record("MARA-v0", states=16))
    monkeypatch.setitem(TASKS, "MARA-v0", ReachTask(alpha=5.001))
    moved = regression.check(tmp_path / "record.csv")
    assert {m.name for m in moved} == {"reward_distance", "reward"}
    assert {m.row for m in moved} == set(range(16))
    assert all(m.now < m.recorded for m in moved)
    assert "moved by -" in str(moved[0])
    assert regression.check(tmp_path / "record.csv", tolerance=0.1) == []


def test_nan_counts_as_a_change(tmp_path: Path) -> None:
    recorded = regression.record("MARA-v0", states=2)
    recorded.values["reward"][1] = np.nan
    assert [m.row for m in regression.compare(recorded, recorded)] == [1]


def test_the_fixture_fails_and_lists_the_changed_values(
    tmp_path: Path, check_rewards: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    regression.write(tmp_path / "record.csv", regression.record("MARA-v0", states=4))
    monkeypatch.setitem(TASKS, "MARA-v0", ReachTask(kappa=0.03))
    with pytest.raises(
        pytest.fail.Exception, match=r"values differ from the record(.|\n)*state 3: reward"
    ):
        check_rewards(tmp_path / "record.csv")


def test_another_robot_can_be_recorded(tmp_path: Path) -> None:
    recorded = regression.record("MARAOrient-v0", options={"robot": "ur5"}, states=8)
    regression.write(tmp_path / "record.csv", recorded)
    assert regression.check(tmp_path / "record.csv") == []


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    file = tmp_path / "record.csv"
    file.write_text("existing")
    with pytest.raises(GymMaraError, match="not overwritten"):
        regression.write(file, regression.record("MARA-v0", states=2))
    assert file.read_text() == "existing"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "q1,q2\n0,0\n",
        "# gym_mara reward record: {}\nq1,reward\n1,x\n",
        "# gym_mara reward record: x",
    ],
)
def test_a_file_that_is_not_a_record_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "record.csv"
    file.write_text(text)
    with pytest.raises(GymMaraError, match="is not a reward record"):
        regression.check(file)


def test_a_missing_record_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(GymMaraError, match="cannot read"):
        regression.check(tmp_path / "record.csv")


def test_a_record_with_other_terms_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "record.csv"
    regression.write(file, regression.record("MARA-v0", states=2))
    file.write_text(file.read_text().replace("angle_error", "angle"))
    with pytest.raises(
        GymMaraError, match=r"the task now has .*delete the record and write a new one"
    ):
        regression.check(file)


def test_a_record_needs_at_least_two_states() -> None:
    with pytest.raises(GymMaraError, match="at least 2"):
        regression.record("MARA-v0", states=1)
