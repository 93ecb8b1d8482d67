"""An exported policy in the viewer: the arm follows the target that the user drags."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError
from gym_mara.registration import environment
from gym_mara.viewer import exported, watch
from gym_mara.viewer.viewer import Viewer
from tests.deploy.models import fitting, model, solving, write_model
from tests.helpers import TARGET_Q, robot_model

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # from viser's server

START = [0.1, -0.4, 0.7, 0.1, 1.5, 0.0]
"""Not singular: from here inverse kinematics reaches the targets below."""
TRAINED: dict[str, Any] = {"start_q": START, "max_joint_velocity": 1.57, "servo_gain": 10.0}
LENGTH = 200
"""The length of an episode, steps."""


class User:
    """What a user in the browser does before each step, instead of a wait for the step; at the end Ctrl+C."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.acts: dict[int, Callable[[Viewer], Any]] = {}
        self.steps = 0
        self.q: list[Any] = []
        self.collided: list[bool] = []
        monkeypatch.setattr(exported, "watch", functools.partial(watch, seed=0))
        monkeypatch.setattr(Viewer, "_wait", lambda viewer: self._before_step(viewer))

    def _before_step(self, viewer: Viewer) -> None:
        simulation = viewer._simulation
        self.q.append(simulation.backend.state.q[0])
        if simulation.outcome is not None:
            self.collided.append(bool(simulation.outcome.state.collided[0]))
        if (act := self.acts.get(self.steps)) is not None:
            act(viewer)
        viewer._handle_requests()
        self.steps += 1

    def watch(self, file: Path, steps: int, **options: Any) -> list[str]:
        """Watch a policy for this many steps; returns what was logged."""

        def leave(viewer: Viewer) -> None:
            raise KeyboardInterrupt

        self.acts[steps] = leave
        notes: list[str] = []
        with pytest.raises(KeyboardInterrupt):
            exported.watch_exported(file, None, None, options, 1.0, notes.append)
        return notes


@pytest.fixture
def user(monkeypatch: pytest.MonkeyPatch) -> User:
    return User(monkeypatch)


def drag(position: Any, quaternion: Any = (1.0, 0.0, 0.0, 0.0)) -> Callable[[Viewer], None]:
    """The user drags the target to a pose."""

    def act(viewer: Viewer) -> None:
        target = viewer._scene.target
        target.position, target.wxyz = np.array(position), np.array(quaternion)
        viewer._on_target(None)

    return act


def pose(*q: float) -> tuple[Any, Any]:
    """The pose of MARA's tool in a configuration."""
    position, quaternion = robot_model("mara").kinematics().pose(np.array([q]))
    return position[0], quaternion[0]


def jumps(q: list[Any]) -> Any:
    """The largest change of a joint at each step, relative to the way of a step at the velocity limit."""
    return np.abs(np.diff(q, axis=0)).max(axis=1) / (1.57 * 0.02)


@pytest.mark.parametrize("name", ["MARAReach-v0", "MARAPose-v0"])
def test_the_arm_follows_the_target_for_longer_than_an_episode(
    user: User, tmp_path: Path, name: str
) -> None:
    places = {0: pose(*TARGET_Q), LENGTH + 20: pose(0.4, -0.4, 0.9, 0.2, 1.2, 0.3)}
    user.acts = {step: drag(*place) for step, place in places.items()}
    notes = user.watch(solving(tmp_path / "policy.onnx", name, **TRAINED), 2 * LENGTH + 40)
    for (position, quaternion), q in zip(
        places.values(), (user.q[LENGTH], user.q[-1]), strict=True
    ):
        reached, turned = pose(*q)
        assert np.linalg.norm(reached - position) < 1e-3
        if name == "MARAPose-v0":
            assert abs(turned @ quaternion) > np.cos(np.radians(1.0))
    assert jumps(user.q).max() < 1.001, "the arm is never put back"
    assert notes == []


def test_a_target_out_of_reach_stops_nothing(user: User, tmp_path: Path) -> None:
    places = [(10.0, -10.0, 10.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.1), (0.1, -0.1, -1.0)]
    user.acts = {60 * number: drag(place) for number, place in enumerate(places)}
    user.watch(solving(tmp_path / "policy.onnx", "MARAPose-v0", **TRAINED), 60 * len(places))
    assert np.isfinite(user.q).all()
    assert any(user.collided), "the arm runs into itself"
    assert jumps(user.q).max() < 1.001, "the arm is never put back"


def test_the_user_may_choose_what_a_collision_does(user: User, tmp_path: Path) -> None:
    user.acts = {5: drag((0.0, 0.0, 0.1))}
    file = solving(tmp_path / "policy.onnx", "MARAReach-v0", **TRAINED)
    user.watch(file, 120, on_collision="reset")
    assert any(user.collided)
    assert jumps(user.q).max() > 2.0


def test_where_the_target_is_always_the_same_episodes_are_repeated(
    user: User, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = environment("MARA-v0")._replace(max_episode_steps=20)
    monkeypatch.setattr("gym_mara.viewer.environment", lambda _: short)
    file = write_model(tmp_path / "policy.onnx", model(fitting(MaraEnv())))
    [note] = user.watch(file, 50)
    assert "at most 1.57 rad/s" in note, "joints that teleported in the training travel"
    home = robot_model("mara").home
    at_home = [number for number, q in enumerate(user.q) if (q == home).all()]
    assert at_home == [0, 20, 40]
    assert user.watch(file, 50, max_joint_velocity=None) == []


def test_a_policy_that_does_not_fit_opens_no_viewer(tmp_path: Path) -> None:
    file = write_model(tmp_path / "policy.onnx", model(fitting(MaraEnv("MARAOrient-v0"))))
    with pytest.raises(GymMaraError, match="does not fit the environment"):
        exported.watch_exported(file, "MARA-v0", None, {"viewer_host": "192.0.2.1"}, 1.0, print)
