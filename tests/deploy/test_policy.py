"""An exported policy is played with NumPy and onnxruntime alone; what does not fit is refused."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.testing import assert_allclose
from onnx import helper

from gym_mara.deploy import OnnxPolicy
from gym_mara.errors import GymMaraError
from gym_mara.files import DamagedFileError, MissingFileError
from tests.deploy.models import (
    ABSOLUTE,
    ARRAY,
    FROM_TARGET,
    GROUPS,
    PACED,
    RELATIVE,
    TWIST,
    about,
    model,
    write_model,
)

ROOT = Path(__file__).resolve().parents[2]
Q = np.array([0.5, 0.2, 1.0])


def policy(folder: Path, *form: Any) -> OnnxPolicy:
    return OnnxPolicy(write_model(folder / "policy.onnx", model(about(*form))))


# Alone.

# What a robot's computer needs not have.
NOT_THERE = ("torch", "gymnasium", "pinocchio", "stable_baselines3", "onnx", "pydantic", "scipy")
SCRIPT = f"""
import sys
import numpy as np
from gym_mara.deploy import OnnxPolicy
policy = OnnxPolicy(sys.argv[1])
action, _ = policy.predict(np.full(5, 0.1))
print(*policy.targets(action, [0.49, 0.2, 1.0]).round(6), policy.about.robot.joints[0].name)
for name in {NOT_THERE}:
    try:
        __import__(name)
    except ModuleNotFoundError:
        continue
    print(name, "is there")
"""


def test_it_needs_numpy_and_onnxruntime_alone(tmp_path: Path) -> None:
    """In a folder with nothing else: not even a blocked library is there to be found."""
    file, alone = write_model(tmp_path / "policy.onnx", model(about())), tmp_path / "alone"
    alone.mkdir()
    # The last three are what onnxruntime itself requires.
    for name in ("numpy", "onnxruntime", "flatbuffers", "packaging", "google"):
        spec = find_spec(name)
        assert spec is not None
        assert spec.submodule_search_locations
        (place,) = spec.submodule_search_locations
        (alone / name).symlink_to(place)
        if (libraries := Path(place).with_name(f"{name}.libs")).exists():
            (alone / libraries.name).symlink_to(libraries)
    (alone / "gym_mara").symlink_to(ROOT / "gym_mara")
    # -S leaves out the libraries of this Python, and -I what the environment variables name.
    code = f"import sys; sys.path.append({str(alone)!r})\n{SCRIPT}"
    command = [sys.executable, "-S", "-I", "-W", "error", "-c", code, str(file)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["0.5", "0.202", "0.5", "turn"]


def test_importing_it_loads_no_engine(tmp_path: Path) -> None:
    code = "import sys, gym_mara.deploy; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True
    ).stdout.split()
    assert not {"torch", "pinocchio", "stable_baselines3", "onnx", "pydantic"} & {*loaded}


# Actions.


def test_predict_has_the_form_of_stable_baselines3(tmp_path: Path) -> None:
    own = policy(tmp_path)
    action, state = own.predict(np.full(5, 0.1), None, None, deterministic=True)
    assert state is None
    assert_allclose(action, [0.5] * 3)
    actions, _ = own.predict(np.arange(10.0).reshape(2, 5))
    assert_allclose(actions, [[10.0] * 3, [35.0] * 3])
    assert_allclose(own.predict([[0, 0, 0, 0, 1]])[0], [[1.0] * 3])


def test_an_observation_may_be_a_dictionary(tmp_path: Path) -> None:
    own = policy(tmp_path, ABSOLUTE, GROUPS)
    action, _ = own.predict({"desired_goal": np.ones(2), "observation": np.zeros(3)})
    assert_allclose(action, [2.0] * 3)
    actions, _ = own.predict({"desired_goal": np.ones((4, 2)), "observation": np.zeros((4, 3))})
    assert actions.shape == (4, 3)


def test_a_random_action_is_refused(tmp_path: Path) -> None:
    with pytest.raises(GymMaraError, match="no random actions"):
        policy(tmp_path).predict(np.zeros(5), deterministic=False)


WRONG = [
    (ARRAY, np.full(5, np.nan), "contains NaN or infinity"),
    (ARRAY, np.full((2, 5), np.inf), "contains NaN or infinity"),
    (
        ARRAY,
        np.zeros(4),
        r"shape \(5,\) or \(N, 5\), not \(4,\): joint_positions \(3\), position_error",
    ),
    (ARRAY, np.zeros((0, 5)), "must have the shape"),
    (ARRAY, np.zeros((1, 1, 5)), "must have the shape"),
    (ARRAY, np.float64(1.0), "must have the shape"),
    (ARRAY, ["a"] * 5, "must be an array of numbers"),
    (ARRAY, {"observation": np.zeros(5)}, "must be an array of numbers"),
    (ARRAY, None, "must have the shape|must be an array"),
    (GROUPS, np.zeros(5), "a dictionary of observation, desired_goal"),
    (GROUPS, {"observation": np.zeros(3)}, "a dictionary of observation, desired_goal"),
    (GROUPS, {"observation": np.zeros(3), "desired_goal": np.zeros(3)}, "must have the shape"),
    (GROUPS, {"observation": np.zeros((2, 3)), "desired_goal": np.zeros((3, 2))}, "lengths"),
    (GROUPS, {"observation": np.zeros(3), "desired_goal": np.zeros((1, 2))}, "lengths"),
]


@pytest.mark.parametrize(("parts", "observation", "message"), WRONG)
def test_a_wrong_observation_is_an_error(
    tmp_path: Path, parts: Any, observation: Any, message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        policy(tmp_path, ABSOLUTE, parts).predict(observation)


def test_an_action_that_is_not_finite_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DamagedFileError, match="action is not finite"):
        policy(tmp_path).predict(np.full(5, 1e308))


# Joint targets.


def test_targets_of_absolute_actions_are_within_limits_and_travel(tmp_path: Path) -> None:
    own = policy(tmp_path)
    assert_allclose(own.targets([0.51, 0.201, -2.0], Q), [0.51, 0.201, -2.0])
    assert_allclose(own.targets([3.0, -1.0, 9.0], Q), [0.53, 0.198, 3.0])  # as far as they travel
    edge = np.array([2.49, 0.0, 3.0])
    assert_allclose(own.targets([3.0, -1.0, 3.0], edge), [2.5, 0.0, 3.0])  # and no limit is passed


def test_a_joint_beyond_its_limits_is_sent_back(tmp_path: Path) -> None:
    targets = policy(tmp_path, RELATIVE).targets(np.zeros(3), [2.6, 0.2, 1.0])
    assert_allclose(targets, [2.5, 0.2, 1.0])


def test_relative_actions_are_steps_from_where_the_joints_are(tmp_path: Path) -> None:
    own = policy(tmp_path, RELATIVE)
    steps = np.array(RELATIVE.steps)
    assert_allclose(own.targets([1.0, -0.5, 0.2], Q), Q + steps * [1.0, -0.5, 0.2])
    assert_allclose(own.targets([7.0, -7.0, 7.0], Q), Q + steps * [1.0, -1.0, 1.0])
    assert_allclose(
        own.targets([0.5] * 3, Q, Q + 1.0), Q + 0.5 * steps
    )  # last_target has no effect


def test_relative_actions_may_start_from_the_last_target(tmp_path: Path) -> None:
    own = policy(tmp_path, FROM_TARGET)
    assert_allclose(own.targets([0.5] * 3, Q, [0.51, 0.2, 1.3]), [0.525, 0.2005, 1.55])
    # Not farther from the joint than it travels.
    assert_allclose(own.targets([1.0] * 3, Q, [0.52, 0.2, 1.3]), [0.53, 0.201, 1.8])
    with pytest.raises(GymMaraError, match="start from the last targets: give last_target"):
        own.targets([0.5] * 3, Q)


def test_steps_are_multiplied_by_the_pace_of_the_observation(tmp_path: Path) -> None:
    own, steps = policy(tmp_path, RELATIVE, PACED), np.array(RELATIVE.steps)
    assert_allclose(
        own.targets([1.0, -1.0, 0.5], Q, pace=[0.1]), Q + 0.1 * steps * [1.0, -1.0, 0.5]
    )
    assert_allclose(own.targets([1.0] * 3, Q, pace=[3.0]), own.targets([1.0] * 3, Q, pace=[1.0]))
    both = own.targets(np.ones((2, 3)), np.stack([Q, Q]), pace=[[0.5], [1.0]])
    assert_allclose(both, [Q + 0.5 * steps, Q + steps])
    for pace, message in (
        (None, "steps are multiplied by the observation's part 'pace': give it as pace"),
        ([0.1, 0.2], "pace"),
        ([[0.1], [0.2]], "must have one row for each arm"),
        ([np.nan], "pace"),
    ):
        with pytest.raises(GymMaraError, match=message):
            own.targets([1.0] * 3, Q, pace=pace)


def test_targets_of_many_arms(tmp_path: Path) -> None:
    own = policy(tmp_path, RELATIVE)
    rows = np.array([[1.0, 0.0, -1.0], [0.0, 0.5, 0.0]])
    both = own.targets(rows, np.stack([Q, Q]))
    assert_allclose(both, [own.targets(row, Q) for row in rows])


def test_a_twist_is_no_joint_target(tmp_path: Path) -> None:
    with pytest.raises(GymMaraError, match="cartesian actions are twists"):
        policy(tmp_path, TWIST).targets(np.zeros(6), Q)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ((np.zeros(2), Q, Q), "action must have the shape"),
        ((np.zeros(3), Q[:2], Q), "q must have the shape"),
        ((np.zeros(3), Q, Q[:2]), "last_target must have the shape"),
        ((np.full(3, np.nan), Q, Q), "action contains NaN"),
        ((np.zeros(3), np.full(3, np.inf), Q), "q contains NaN or infinity"),
        ((np.zeros(3), Q, ["a"] * 3), "last_target must be an array of numbers"),
        ((np.zeros((2, 3)), Q, Q), "equally many arms"),
        ((np.zeros((2, 3)), np.zeros((3, 3)), Q), "equally many arms"),
    ],
)
def test_wrong_arrays_are_errors(tmp_path: Path, arrays: Any, message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        policy(tmp_path, FROM_TARGET).targets(*arrays)


@pytest.mark.parametrize("action", [ABSOLUTE, RELATIVE])
def test_the_arms_of_an_action_are_those_of_the_positions(tmp_path: Path, action: Any) -> None:
    with pytest.raises(GymMaraError, match="equally many arms"):
        policy(tmp_path, action).targets(np.zeros((2, 3)), np.zeros((3, 3)))


# Files.


def test_a_file_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="there is no such file"):
        OnnxPolicy(tmp_path / "policy.onnx")


@pytest.mark.parametrize("content", [b"", b"no model", b"PK\x03\x04" + bytes(500)])
def test_a_file_that_is_no_model_is_an_error(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "policy.onnx"
    file.write_bytes(content)
    with pytest.raises(DamagedFileError, match=r"policy\.onnx': (onnxruntime|it has no)"):
        OnnxPolicy(file)


def test_a_file_that_is_cut_off_is_an_error(tmp_path: Path) -> None:
    file = write_model(tmp_path / "policy.onnx", model(about()))
    whole = file.read_bytes()
    for length in range(0, len(whole), 97):
        file.write_bytes(whole[:length])
        with pytest.raises(DamagedFileError, match="cannot read"):
            OnnxPolicy(file)


def test_a_model_without_metadata_is_an_error(tmp_path: Path) -> None:
    made = model(about())
    del made.metadata_props[:]
    with pytest.raises(DamagedFileError, match="no metadata of gym_mara; export the policy with"):
        OnnxPolicy(write_model(tmp_path / "policy.onnx", made))


def test_a_model_with_metadata_in_another_encoding_is_an_error(tmp_path: Path) -> None:
    file = write_model(tmp_path / "policy.onnx", model(about()))
    file.write_bytes(file.read_bytes().replace(b'"rad"', b'"r\xb4d"', 1))
    with pytest.raises(DamagedFileError, match=r"policy\.onnx': its metadata are not UTF-8"):
        OnnxPolicy(file)


@pytest.mark.parametrize("text", ["", "{}", about().to_json().replace('"rad"', "5")])
def test_a_model_with_damaged_metadata_is_an_error(tmp_path: Path, text: str) -> None:
    made = model(about())
    helper.set_model_props(made, {"gym_mara": text})
    with pytest.raises(DamagedFileError, match=r"policy\.onnx': the metadata"):
        OnnxPolicy(write_model(tmp_path / "policy.onnx", made))


@pytest.mark.parametrize(
    "made",
    [
        model(about(), {"observation": 6}),
        model(about(), {"observations": 5}),
        model(about(observation=GROUPS), {"observation": 5}),
        model(about(), dtype=np.float32),
    ],
)
def test_a_model_that_contradicts_its_metadata_is_an_error(tmp_path: Path, made: Any) -> None:
    with pytest.raises(DamagedFileError, match=r"the model has .* and its metadata want"):
        OnnxPolicy(write_model(tmp_path / "policy.onnx", made))


def test_a_model_reads_no_other_file(tmp_path: Path) -> None:
    made = model(about())
    onnx.save_model(
        made, tmp_path / "policy.onnx", save_as_external_data=True, location="w", size_threshold=0
    )
    with pytest.raises(DamagedFileError, match="onnxruntime does not take it"):
        OnnxPolicy(tmp_path / "policy.onnx")


# The page.


class FakeRobot:
    """A robot that goes where it is told, for a few periods."""

    def __init__(self) -> None:
        self.q, self.periods = np.zeros(3), 0

    def is_running(self) -> bool:
        self.periods += 1
        return self.periods <= 5

    def joint_positions(self) -> Any:
        return self.q.copy()

    def tool_position(self) -> Any:
        return np.array([0.3])

    def tool_velocity(self) -> Any:
        return np.array([0.1])

    def move_to(self, target: Any) -> None:
        self.q = target


def test_the_example_of_the_page_moves_a_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (ROOT / "docs" / "deploy.md").read_text(encoding="utf-8")
    first, loop = re.findall(r"^```python\n(.*?)^```", text, re.M | re.S)
    policy(tmp_path, FROM_TARGET)  # writes policy.onnx
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    robot = FakeRobot()
    exec(first, {})
    exec(loop, {"robot": robot, "goal": np.zeros(1)})
    assert robot.periods == 6
    assert (robot.q > 0.0).all()


def test_the_page_names_every_entry_of_the_metadata() -> None:
    text = (ROOT / "docs" / "deploy.md").read_text(encoding="utf-8").split("## The metadata")[1]

    def names(value: Any) -> set[str]:
        if isinstance(value, dict):
            return {*value} | {n for v in value.values() for n in names(v)}
        return {n for v in value for n in names(v)} if isinstance(value, list) else set()

    values = json.loads(about().to_json())
    assert [name for name in names(values) if f"`{name}`" not in text] == []
