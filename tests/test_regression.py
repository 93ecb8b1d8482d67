"""Reward records: the records of the project's tasks, and the detection of changes."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara import regression
from gym_mara.backends import simulated_backends
from gym_mara.errors import GymMaraError
from gym_mara.tasks import TASKS
from gym_mara.tasks.reach import ReachTask
from tests.helpers import Floats, joint_xml, robot_model, urdf_xml, write

RECORDS = Path(__file__).parent / "rewards"


# The backend "warp" computes in single precision, on a GPU.
@pytest.mark.parametrize("backend", [name for name in simulated_backends() if name != "warp"])
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


def test_a_failed_write_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    recorded = regression.record("MARA-v0", states=2)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(GymMaraError, match=r"cannot write .*record.csv.*No space left"):
            regression.write(tmp_path / "record.csv", recorded)
    assert list(tmp_path.iterdir()) == []
    regression.write(tmp_path / "record.csv", recorded)


def test_many_states_are_computed_in_blocks_with_the_same_values() -> None:
    recorded = regression.record("MARACollisionOrient-v0", states=600)
    part = regression.compute("MARACollisionOrient-v0", "pinocchio", {}, recorded.q[500:])
    for name, column in recorded.values.items():
        np.testing.assert_allclose(column[500:], part.values[name], atol=1e-9)


def test_a_relative_path_of_a_robot_is_relative_to_the_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rewards").mkdir()
    arm = urdf_xml(*(joint_xml(number) for number in range(3)))
    write(tmp_path / "arm.urdf", arm)
    options: dict[str, Any] = {"robot": "arm.urdf", "ee_frame": "link3"}
    monkeypatch.chdir(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the default target is out of this arm's reach
        recorded = regression.record("MARA-v0", options=options, states=4)
        regression.write(Path("rewards/record.csv"), recorded)
        assert '"robot": "../arm.urdf"' in Path("rewards/record.csv").read_text()
        assert regression.check(Path("rewards/record.csv")) == []
        monkeypatch.chdir("/")
        assert regression.check(tmp_path / "rewards" / "record.csv") == []


@pytest.mark.parametrize(
    "option",
    [
        {"width": 480},
        {"render_mode": "human"},
        {"viewer_host": "0.0.0.0"},
        {"num_envs": 10**12},
        {"task": "MARA-v0"},
        {"backend": "dart"},
        {"max_episode_steps": 3},
        {"workers": 1000},
        {"kapa": 1},
    ],
)
def test_an_option_without_effect_on_a_reward_is_refused(
    tmp_path: Path, option: dict[str, Any]
) -> None:
    (name,) = option
    with pytest.raises(GymMaraError, match=f"unknown keyword argument '{name}' of a reward record"):
        regression.record("MARA-v0", options=option, states=2)
    file = tmp_path / "record.csv"
    write(file, f"{HEADER}{json.dumps({**ABOUT, 'options': option})}\n{COLUMNS}\n0,0,0,0,0,0,1\n")
    with pytest.raises(GymMaraError, match=f"unknown keyword argument '{name}'"):
        regression.check(file)


def test_another_backend_gets_the_settings_that_it_has(
    tmp_path: Path, fake_backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"kappa": 0.03, "control_period": 0.05, "wall": 0.5}
    regression.write(
        tmp_path / "record.csv", regression.record("MARA-v0", fake_backend, settings, 8)
    )
    computed: list[Any] = []
    compute = regression.compute

    def noted(env: str, backend: str, options: dict[str, Any], q: Floats) -> regression.Record:
        computed.append(options)
        return compute(env, backend, options, q)

    monkeypatch.setattr(regression, "compute", noted)
    moved = regression.check(tmp_path / "record.csv", "pinocchio")
    assert {each.name for each in moved} <= {"collided"}
    assert computed == [{"kappa": 0.03, "control_period": 0.05}]
    assert regression.check(tmp_path / "record.csv") == []


HEADER = "# gym_mara reward record: "
ABOUT = {"env": "MARA-v0", "backend": "pinocchio", "options": {}}
COLUMNS = "q1,q2,q3,q4,q5,q6,reward"
START = f"{HEADER}{json.dumps(ABOUT)}\n{COLUMNS}\n0,0,0,0,0,0,1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "first line"),
        ("q1,q2\n0,0\n", "first line"),
        (HEADER + "{}\nq1,reward\n1,x\n", "env: Field required"),
        (HEADER + "x", "JSON"),
        (HEADER + 100_000 * "[", "JSON"),
        (HEADER + json.dumps({**ABOUT, "options": []}), "options"),
        (HEADER + json.dumps({**ABOUT, "num_envs": 3}), "num_envs: Unexpected"),
        (HEADER + json.dumps(ABOUT) + "\nq1,reward,reward\n1,1,1\n", "each once"),
        (HEADER + json.dumps(ABOUT) + "\nreward\n1\n", "each once"),
        (START.rsplit("\n", 2)[0], "0 states"),
        (START + "0,0,0,0,0,1\n", "line 4 has 6 values, not 7"),
        (START + "0,0,0,0,0,0,x\n", "line 4: could not convert string to float: 'x'"),
        (START + "0,0,0,0,0,0,nan\n", "line 4: nan is not finite"),
        (START + "0,0,0,0,0,0,1e999\n", "line 4: 1e999 is not finite"),
        (START + 100_000 * "0,0,0,0,0,0,1\n", "100,001 states, and 1 to 100,000"),
    ],
)
def test_a_file_that_is_not_a_record_is_refused(tmp_path: Path, text: str, message: str) -> None:
    file = write(tmp_path / "record.csv", text)
    with pytest.raises(GymMaraError, match=f"is not a reward record: .*{message}"):
        regression.check(file)


def test_a_pipe_or_a_device_is_not_a_record(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for file in (tmp_path / "pipe", Path("/dev/full"), Path("/dev/zero")):
        with pytest.raises(GymMaraError, match="not a plain file"):
            regression.check(file)


@pytest.mark.parametrize("tolerance", [-1e-9, float("nan"), float("inf")])
def test_a_tolerance_is_finite_and_not_negative(
    check_rewards: Callable[..., None], tolerance: float
) -> None:
    with pytest.raises(GymMaraError, match="tolerance must be finite and not negative"):
        check_rewards(RECORDS / "MARA-v0.csv", tolerance=tolerance)


def test_a_record_holds_plain_finite_values(tmp_path: Path) -> None:
    file = tmp_path / "record.csv"
    recorded = regression.record("MARA-v0", options={"robot": robot_model("mara")}, states=2)
    with pytest.raises(GymMaraError, match="name a robot by its name, path or modules"):
        regression.write(file, recorded)
    options = {"target_position": np.array([-0.4, 0.1, 0.7])}
    recorded = regression.record("MARA-v0", options=options, states=2)
    regression.write(file, recorded)
    assert regression.check(file) == []
    recorded.values["reward"][1] = np.nan
    with pytest.raises(GymMaraError, match="reward is nan in state 1"):
        regression.write(tmp_path / "other.csv", recorded)


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


@pytest.mark.parametrize("states", [1, 0, -1, 2.5, 100_001, 10**400])
def test_the_number_of_states_is_bounded(states: Any) -> None:
    with pytest.raises(GymMaraError, match="states must be"):
        regression.record("MARA-v0", states=states)
