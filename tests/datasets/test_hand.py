"""Demonstrations by hand: what the user of the viewer does becomes episodes."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest

from gym_mara.datasets.episode import Steps
from gym_mara.datasets.hand import HandViewer, record_by_hand
from gym_mara.datasets.minari import MinariWriter
from gym_mara.datasets.recorder import Recorded
from gym_mara.envs import make_vector_env
from gym_mara.testing import COLLIDING_Q
from gym_mara.viewer.viewer import Viewer
from tests.helpers import TARGET_Q, Cli, robot_model

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # from viser's server

OPTIONS: dict[str, Any] = {"start_q": [0.1, -0.4, 0.7, 0.1, 1.5, 0.0], "max_joint_velocity": 1.57}


class User:
    """What a user in the browser does, instead of the waits of the viewer; at the end Ctrl+C."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.acts: dict[int, Callable[[HandViewer], Any]] = {}
        self.waits, self.q = 0, [np.zeros(6)]
        monkeypatch.setattr(Viewer, "_wait", lambda viewer: self._instead_of_waiting(viewer))

    def _instead_of_waiting(self, viewer: Any) -> None:
        self.q.append(viewer._simulation.backend.state.q[0])
        if self.waits > max(self.acts):
            raise KeyboardInterrupt
        if (act := self.acts.get(self.waits)) is not None:
            act(viewer)
        viewer._handle_requests()
        self.waits += 1


@pytest.fixture
def user(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> User:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return User(monkeypatch)


def drag(*q: float) -> Callable[[HandViewer], None]:
    """The user drags the target to the pose of a configuration."""
    position, quaternion = robot_model("mara").kinematics().pose(np.array([q]))

    def act(viewer: HandViewer) -> None:
        target = viewer._scene.target
        target.position, target.wxyz = position[0], quaternion[0]
        viewer._on_target(None)

    return act


def slide(joint: int, value: float) -> Callable[[HandViewer], None]:
    """The user moves the slider of a joint."""

    def act(viewer: HandViewer) -> None:
        viewer._panel.sliders[joint].value = value
        viewer.jog()  # as `_on_slider` does for a change in a browser

    return act


def press(name: str) -> Callable[[HandViewer], None]:
    """The user presses a button."""

    def act(viewer: HandViewer) -> None:
        for callback in getattr(viewer, name)._impl.update_cb:
            callback(None)

    return act


def demonstrate(tmp_path: Path, env: str = "MARAReach-v0", **options: Any) -> tuple[Recorded, Any]:
    """What is recorded until the user has enough, and the data set."""
    notes: list[str] = []
    given = {**OPTIONS, **options}
    recorded = record_by_hand(
        env, "pinocchio", given, "minari", tmp_path / "own-v0", episodes=2, log=notes.append
    )
    assert "http://" in notes[-1]
    return recorded, minari.load_dataset("own-v0")


def test_a_dragged_target_and_jogged_joints_become_demonstrations(
    user: User, tmp_path: Path
) -> None:
    user.acts = {
        10: drag(*TARGET_Q),
        110: press("save"),
        120: slide(0, 0.6),
        200: slide(3, -0.2),
        240: press("save"),
    }
    recorded, data = demonstrate(tmp_path)
    assert recorded.episodes == data.total_episodes == 2
    dragged, jogged = data.iterate_episodes()
    assert len(dragged.rewards) == 100, "the wait before the first move is not part of it"
    assert dragged.infos["success"][-1]
    assert (len(jogged.rewards), jogged.truncations.tolist()) == (120, [False] * 119 + [True])
    np.testing.assert_allclose(jogged.observations[0, :6], OPTIONS["start_q"], atol=1e-9)
    aimed = [0.6, -0.4, 0.7, -0.2, 1.5, 0.0]
    np.testing.assert_allclose(jogged.observations[-1, :6], aimed, atol=2e-3)
    env = data.recover_environment()
    env.reset()
    for step, action in enumerate(jogged.actions):
        seen = env.step(action)[0]
        np.testing.assert_allclose(seen[:6], jogged.observations[step + 1, :6], atol=1e-6)
    assert env.unwrapped.simulation.backend.joint_velocity.max() == pytest.approx(1.57)
    env.close()


def test_a_discarded_episode_is_not_recorded(user: User, tmp_path: Path) -> None:
    user.acts = {0: slide(0, 0.6), 20: press("discard"), 25: slide(0, -0.6), 45: press("save")}
    recorded, data = demonstrate(tmp_path)
    assert recorded.episodes == 1, "Ctrl-C ends the recording, and keeps what was saved"
    [episode] = data.iterate_episodes()
    assert episode.observations[-1, 0] < -0.1


@pytest.mark.parametrize(
    ("owner", "method", "saved"),
    [
        (Steps, "episode", 1),  # Save was clicked, and the pictures are drawn
        (MinariWriter, "add", 1),
        (HandViewer, "notify", 1),
        (MinariWriter, "finish", 2),
        (HandViewer, "close", 2),
    ],
)
def test_an_interrupt_at_any_time_keeps_what_was_saved(
    user: User,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    owner: Any,
    method: str,
    saved: int,
) -> None:
    undisturbed = getattr(owner, method)

    def interrupted(*arguments: Any) -> Any:
        for _ in range(2):  # an impatient user
            signal.raise_signal(signal.SIGINT)
        return undisturbed(*arguments)

    monkeypatch.setattr(owner, method, interrupted)
    user.acts = {0: slide(0, 0.6), 9: press("save"), 12: slide(0, 0.6), 19: press("save")}
    before = signal.getsignal(signal.SIGINT)
    recorded, data = demonstrate(tmp_path)
    assert recorded.episodes == data.total_episodes == saved
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_ends_a_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(make_vector_env("MARAReach-v0", 1, backend="pinocchio", **OPTIONS)) as arms:
        arms.reset(seed=0)
        viewer = HandViewer(arms.simulation, arms.simulation.options.rendering)
        monkeypatch.setattr(viewer._server, "get_clients", lambda: {0: None})
        viewer.set_playing(False)
        interrupt = threading.Timer(0.2, viewer.interrupt)
        interrupt.start()
        with pytest.raises(KeyboardInterrupt):
            viewer.episode(None)
        interrupt.join()
        monkeypatch.undo()
        viewer.close()


def test_a_dragged_target_of_a_task_with_a_fixed_one_lasts_for_an_episode(
    user: User, tmp_path: Path
) -> None:
    goals: list[Any] = []

    def save(viewer: Any) -> None:
        goals.append(viewer._simulation.goal.position[0])
        press("save")(viewer)

    user.acts = {0: drag(*OPTIONS["start_q"]), 9: save, 12: slide(0, 0.6), 19: save}
    _, data = demonstrate(tmp_path, env="MARA-v0")
    env = data.recover_environment()
    first, observed = env.reset()[0], [e.observations[0] for e in data.iterate_episodes()]
    own = env.unwrapped.simulation.goal.position[0]
    env.close()
    assert np.abs(goals[0] - own).max() > 0.1
    np.testing.assert_allclose(goals[1], own, atol=1e-12)
    np.testing.assert_allclose(observed, [first, first], atol=1e-9)


def test_a_save_before_the_first_move_records_nothing(user: User, tmp_path: Path) -> None:
    user.acts = {3: press("save"), 5: slide(0, 0.6), 9: press("save")}
    recorded, data = demonstrate(tmp_path)
    assert recorded == Recorded(1, 4, 0)
    assert data.total_steps == 4


def test_the_arm_waits_where_the_task_has_ended_the_episode(user: User, tmp_path: Path) -> None:
    user.acts = {joint: slide(joint, float(COLLIDING_Q[joint])) for joint in range(6)}
    user.acts[400] = press("save")
    _, data = demonstrate(tmp_path, on_collision="terminate")
    [episode] = data.iterate_episodes()
    assert episode.terminations[-1]
    assert not episode.truncations.any()
    assert 10 < len(episode.rewards) < 390


def test_without_a_saved_episode_there_is_no_data_set(
    user: User, gym_mara: Cli, tmp_path: Path
) -> None:
    user.acts = {5: slide(0, 0.6)}
    call = "record --policy hand --env MARAReach-v0 --episodes 3 --out"
    code, _, error = gym_mara(*call.split(), str(tmp_path / "own-v0"))
    assert (code, error) == (130, "Interrupted; no data set was written.\n")
    assert list(tmp_path.iterdir()) == []


def test_the_backend_cannot_be_switched_and_teleporting_joints_travel(
    user: User, tmp_path: Path
) -> None:
    seen: list[Any] = []
    user.acts = {
        0: lambda viewer: seen.append(viewer._panel.backends.disabled),
        1: slide(0, 1.0),
        4: press("save"),
    }
    notes: list[str] = []
    record_by_hand(
        "MARA-v0", "pinocchio", {}, "minari", tmp_path / "own-v0", episodes=1, log=notes.append
    )
    assert seen == [True]
    assert "at most at 1.57 rad/s" in notes[0]
    data: Any = minari.load_dataset("own-v0")
    assert data.env_spec.kwargs["max_joint_velocity"] == 1.57
    [episode] = data.iterate_episodes()
    assert np.abs(np.diff(episode.observations[:, 0])).max() < 0.0315
