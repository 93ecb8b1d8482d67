"""Films and reports of a policy, and the command watch."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest

from gym_mara.agents.inspection import report as report_module
from gym_mara.agents.inspection import watch as watch_module
from gym_mara.agents.inspection.report import write_report
from gym_mara.agents.inspection.watch import (
    Show,
    film_episode,
    film_targets,
    show_run,
    watch_run,
)
from gym_mara.agents.runs.evaluation import Player, Playing
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.training.train import train
from gym_mara.collision.coal import CoalChecker
from gym_mara.collision.free_poses import straight_move
from gym_mara.envs.actions.straight import StraightActions
from gym_mara.envs.outcome import Outcome
from gym_mara.errors import GymMaraError, MissingExtraError
from gym_mara.rendering.film import Film, labelled
from gym_mara.robot import RobotModel
from gym_mara.robot.inverse_kinematics import solve_ik
from gym_mara.types import Floats
from tests.agents.conftest import ROLLOUT, config, silent
from tests.browser import chromium
from tests.deploy.models import solving
from tests.helpers import robot_model, started

# The libraries that read films leave pipes open.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)
SMALL: dict[str, Any] = {"width": 160, "height": 120}


def pictures(film: Path) -> Any:
    """The pictures of a film (T, height, width, 3)."""
    if film.suffix == ".gif":
        return np.array([np.asarray(picture)[..., :3] for picture in imageio.imiter(film)])
    return np.asarray(imageio.imread(film, plugin="FFMPEG"))


def differing(one: Any, other: Any) -> float:
    """The fraction of pixels that differ clearly between two pictures."""
    return float((np.abs(one.astype(int) - other.astype(int)).max(axis=-1) > 40).mean())


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_film_shows_the_start_of_an_episode(
    finished_run: RunFolder, tmp_path: Path, suffix: str
) -> None:
    film = tmp_path / f"film{suffix}"
    film_episode(show_run(finished_run), film, ["dart"], SMALL, seconds=0.4)
    shown = pictures(film)
    if suffix == ".gif":  # one picture of the start pose, with a long duration
        times = [imageio.immeta(film, index=index)["duration"] for index in range(len(shown))]
        assert times[0] == 500
        assert sum(times) == 900
    else:
        assert len(shown) == 25 + 20
        assert differing(shown[0], shown[24]) < 0.001
    assert shown.shape[1:] == (120, 160, 3)
    assert differing(shown[0], shown[-1]) > 0.005, "the arm moves"
    assert [path.name for path in tmp_path.iterdir()] == [film.name]


def test_two_backends_are_filmed_side_by_side(
    finished_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names: list[str] = []

    def noted(picture: Any, text: str) -> Any:
        names.append(text)
        return labelled(picture, text)

    monkeypatch.setattr(watch_module, "labelled", noted)
    film = tmp_path / "film.mp4"
    film_episode(show_run(finished_run), film, ["pinocchio", "dart"], SMALL, seconds=0.2)
    shown = pictures(film)
    assert shown.shape[1:] == (120, 320, 3)
    label, scene = np.s_[:18], np.s_[18:]
    start = shown[0]
    assert differing(start[label, :160], start[label, 160:]) > 0.01, "each side has its name"
    assert names[:2] == ["pinocchio, at most 1.57 rad/s", "dart"]
    assert differing(start[scene, :160], start[scene, 160:]) < 0.001
    assert differing(shown[-1, scene, :160], shown[-1, scene, 160:]) > 0.0005


def test_an_arm_whose_episode_ends_stays_where_it_is_until_the_end_of_the_film(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    acts = iter([2.5, 2.5, 0.3, 0.3])  # the first arm moves into the table; each arm is made twice
    frames: list[Any] = []
    add = Film.add

    def play(backend: str, options: dict[str, Any], mode: str) -> Playing:
        act = np.array([[0.0, next(acts), 0.0, 0.0, 0.0, 0.0]])
        own = options | {"on_collision": "terminate"}
        name = "MARARandomTarget-v0"
        return Playing(name, backend, own, lambda _: lambda _: act, autoreset_mode=mode)

    def noted(film: Film, picture: Any) -> None:
        frames.append(picture)
        add(film, picture)

    monkeypatch.setattr(Film, "add", noted)
    both = ["pinocchio", "pinocchio"]
    film_episode(Show("pinocchio", play), tmp_path / "film.gif", both, SMALL, seconds=1.8, rate=5)
    left, right = (np.array(frames)[3:, 20:, half] for half in (np.s_[:160], np.s_[160:]))
    last = 0
    while (left[last] != left[-1]).any():
        last += 1
    assert 3 < last < len(left) - 3, "the collision"
    np.testing.assert_array_equal(left[last:], left[-1:].repeat(len(left) - last, axis=0))
    red, other = (
        (sides[-1, ..., 0] > 150) & (sides[-1, ..., 1:] < 100).all(-1) for sides in (left, right)
    )
    assert red.sum() > other.sum() + 100, "the links that touch"


def test_a_film_shows_backends_of_one_control_period(tmp_path: Path) -> None:
    def play(backend: str, options: dict[str, Any], mode: str) -> Playing:
        own = options | {"control_period": {"pinocchio": 0.02, "mujoco": 0.1}[backend]}
        return Playing("MARA-v0", backend, own, lambda _: lambda _: np.zeros((1, 6)))

    with pytest.raises(GymMaraError, match=r"0.02 s on pinocchio, and 0.1 s on mujoco: film them"):
        film_episode(Show("", play), tmp_path / "film.gif", ["pinocchio", "mujoco"], SMALL)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def random_target_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run of an environment that draws its targets."""
    run = config(env="MARARandomTarget-v0", steps=ROLLOUT)
    return train(run, Path(tmp_path_factory.mktemp("runs")) / "run", silent)


class Steps:
    """Notes each step of a player, and the labels of the pictures; another thing than the policy acts."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, act: Any) -> None:
        self.labels: list[str] = []
        self.starts: list[Any] = []
        self.outcomes: list[Outcome] = []
        self.targets: list[Any] = []
        step = Player.step

        def noted_step(player: Player) -> Outcome:
            simulation = player.env.simulation
            self.starts.append(simulation.backend.state.q[0])
            self.targets.append(tuple(simulation.goal.position[0]))
            self.outcomes.append(step(player))
            return self.outcomes[-1]

        def noted_label(picture: Any, text: str) -> Any:
            self.labels.append(text)
            return labelled(picture, text)

        monkeypatch.setattr(Player, "step", noted_step)
        monkeypatch.setattr(Player, "begin", lambda player, _: partial(act, player))
        monkeypatch.setattr(watch_module, "labelled", noted_label)


def _with_a_free_way(robot: RobotModel, here: Floats, position: Floats) -> Floats:
    """A configuration (1, J) for a position, to which the straight move from here is free."""
    rng, checker = np.random.default_rng(0), CoalChecker(robot)
    for start in (here, *rng.uniform(robot.lower, robot.upper, (100, robot.num_joints))):
        q = solve_ik(robot, position, None, start=start)
        exact = np.abs(robot.kinematics().pose(q[None])[0][0] - position).max() < 1e-3
        if exact and not checker.check(np.vstack([straight_move(here, q), q])).any():
            return q[None]
    raise AssertionError(f"no way from {here} to {position} was found")


def test_in_a_film_of_targets_the_arm_goes_on_from_each_that_it_has_reached(
    random_target_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    goals: dict[bytes, Any] = {}

    def straight(player: Player, observation: Any) -> Any:
        simulation = player.env.simulation
        target = simulation.goal.position.tobytes()
        if target not in goals:
            here = simulation.backend.state.q[0]
            goals[target] = _with_a_free_way(simulation.robot, here, simulation.goal.position[0])
        return StraightActions(simulation).to(goals[target])

    steps, film = Steps(monkeypatch, straight), tmp_path / "film.gif"
    film_targets(show_run(random_target_run), film, "pinocchio", SMALL, targets=3, rate=5.0)
    ends = [outcome.state.q[0] for outcome in steps.outcomes]
    assert len(set(steps.targets)) == 3
    np.testing.assert_array_equal(steps.starts[1:], ends[:-1])
    for target in dict.fromkeys(steps.targets):
        errors = [
            float(outcome.info["position_error"][0])
            for outcome, own in zip(steps.outcomes, steps.targets, strict=True)
            if own == target
        ]
        assert max(errors[-25:]) <= 0.005 < errors[-26], "it ends after half a second at the target"
    assert steps.labels[0] == "target 1 of 3"
    assert steps.labels[-1].startswith("target 3 of 3: 0.")
    times = [imageio.immeta(film, index=index)["duration"] for index in range(len(pictures(film)))]
    still = 600  # three pictures
    assert sum(times) == pytest.approx(still + 20 * len(steps.outcomes), abs=200)


def test_a_film_of_targets_shows_a_collision_and_puts_the_arm_back(
    random_target_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    into_the_table = np.array([[0.0, 2.5, 0.0, 0.0, 0.0, 0.0]])
    steps = Steps(monkeypatch, lambda *_: into_the_table)
    film_targets(
        show_run(random_target_run), tmp_path / "film.gif", "pinocchio", SMALL, targets=2, rate=5.0
    )
    collided = [bool(outcome.state.collided[0]) for outcome in steps.outcomes]
    assert collided.count(True) == 2
    assert steps.labels[-1] == "target 2 of 2: collision"
    second = collided.index(True) + 1
    np.testing.assert_array_equal(steps.starts[second], steps.starts[0])


def test_a_film_of_targets_needs_an_environment_that_draws_them(
    finished_run: RunFolder, random_target_run: RunFolder, tmp_path: Path
) -> None:
    film = tmp_path / "film.gif"
    with pytest.raises(GymMaraError, match=r"MARACollisionOrient-v0 has the same target in every"):
        film_targets(show_run(finished_run), film, "pinocchio", SMALL, targets=2)
    with pytest.raises(GymMaraError, match="leave out on_collision"):
        film_targets(
            show_run(random_target_run), film, "pinocchio", {"on_collision": "continue"}, targets=2
        )
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The keyword arguments with which viewers would have been opened."""
    opened: list[dict[str, Any]] = []
    monkeypatch.setattr(
        watch_module, "watch", lambda _task, _backend, keywords, *_, **__: opened.append(keywords)
    )
    return opened


def test_joints_that_would_teleport_are_shown_travelling(
    finished_run: RunFolder, tmp_path: Path, watched: list[dict[str, Any]]
) -> None:
    notes: list[str] = []
    for backend, chosen in (("pinocchio", {}), ("pinocchio", {"max_joint_velocity": None})):
        watch_run(finished_run, backend, chosen, "last", 1.0, notes.append)
    watch_run(finished_run, "dart", {}, "last", 1.0, notes.append)
    lowest = pytest.approx(robot_model("mara").velocity_limit.min())
    period = {"control_period": 0.02}
    assert watched == [
        period | {"max_joint_velocity": lowest},
        period | {"max_joint_velocity": None},
        period,
    ]
    film_episode(
        show_run(finished_run),
        tmp_path / "a.gif",
        ["pinocchio"],
        SMALL,
        seconds=0.1,
        log=notes.append,
    )
    assert len(notes) == 2, "one line for each that is shown otherwise than it was trained"
    assert "--set max_joint_velocity=null" in notes[0]


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "rate"), [(0.3, 15.0), (1.0, 50.0), (3.0, 50.0)])
def test_the_speed_of_a_film(
    finished_run: RunFolder, tmp_path: Path, speed: float, rate: float
) -> None:
    film = tmp_path / "film.mp4"
    film_episode(show_run(finished_run), film, ["pinocchio"], SMALL, seconds=1.2, speed=speed)
    properties = imageio.immeta(film, plugin="FFMPEG")
    assert properties["fps"] == pytest.approx(rate, rel=0.01)
    assert properties["duration"] == pytest.approx(0.5 + 1.2 / speed, abs=0.1)


@pytest.mark.parametrize("rate", [15.0, 37.5, 40.0, 50.0])
def test_a_gif_has_the_rate_that_was_asked_for(tmp_path: Path, rate: float) -> None:
    count = 30
    with Film(tmp_path / "film.gif", rate) as film:
        for grey in range(count):
            film.add(np.full((16, 16, 3), 8 * grey, np.uint8))
    times = [imageio.immeta(tmp_path / "film.gif", index=i)["duration"] for i in range(count)]
    assert sum(times) == pytest.approx(1000.0 * count / rate, abs=10)
    assert max(times) - min(times) <= 10


def test_a_gif_is_held_with_one_byte_for_a_point_until_it_is_written(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
    with Film(tmp_path / "film.gif", 25.0) as film:
        for _ in range(3):
            film.add(picture)
        assert sum(len(held.tobytes()) for held in film._writer._pictures) == 3 * 32 * 32
    assert len(pictures(tmp_path / "film.gif")) == 1, "equal pictures are one that lasts longer"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("film.avi", "unknown format of a video"),
        ("film", "unknown format of a video"),
        ("missing/film.mp4", "cannot be written"),
        ("there.mp4", "exists and is not overwritten"),
    ],
)
def test_a_wrong_path_of_a_film_is_an_error_before_the_policy_is_played(
    tmp_path: Path, name: str, message: str
) -> None:
    (tmp_path / "there.mp4").write_text("kept")
    with pytest.raises(GymMaraError, match=message):
        film_episode(None, tmp_path / name, ["pinocchio"], {})  # type: ignore[arg-type]
    assert (tmp_path / "there.mp4").read_text() == "kept"


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_an_interrupted_film_leaves_no_file(tmp_path: Path, suffix: str, count: int) -> None:
    film = tmp_path / f"film{suffix}"

    def interrupted() -> None:
        with Film(film, 25.0) as unfinished:
            for _ in range(count):
                unfinished.add(np.zeros((120, 160, 3), np.uint8))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_full_disk_ends_a_film_with_a_clear_error(tmp_path: Path, suffix: str) -> None:
    film = tmp_path / f"film{suffix}"
    code = (
        "import resource, sys, numpy as np\n"
        "from pathlib import Path\n"
        "from gym_mara.errors import GymMaraError\n"
        "from gym_mara.rendering.film import Film\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "rng = np.random.default_rng(0)\n"
        "try:\n"
        f"    with Film(Path({str(film)!r}), 25.0) as film:\n"
        "        for _ in range(20): film.add(rng.integers(0, 256, (120, 160, 3), np.uint8))\n"
        "except GymMaraError as error: print(error)\n"
    )
    answer = subprocess.run(
        [sys.executable, "-B", "-c", code], check=True, capture_output=True, text=True, timeout=60
    )
    assert str(film) in answer.stdout
    assert len(answer.stdout.splitlines()) == 1
    assert answer.stderr == ""
    assert list(tmp_path.iterdir()) == []


def test_what_an_encoder_reports_in_many_lines_is_told_in_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(picture: Any) -> None:
        raise OSError("broken pipe\nffmpeg version\nfailed")

    with ExitStack() as stack:
        refused = stack.enter_context(pytest.raises(GymMaraError))
        film = stack.enter_context(Film(tmp_path / "film.mp4", 25.0))
        monkeypatch.setattr(film._writer, "append_data", fail)
        film.add(np.zeros((120, 160, 3), np.uint8))
    assert "film.mp4' could not be written to its end" in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["pipe", "folder", "link"])
def test_a_film_replaces_nothing(tmp_path: Path, kind: str) -> None:
    film = tmp_path / "film.mp4"
    make = {"pipe": os.mkfifo, "folder": os.mkdir, "link": lambda path: os.symlink("gone", path)}
    make[kind](film)
    with pytest.raises(GymMaraError, match="exists"):
        Film(film, 25.0)
    assert list(tmp_path.iterdir()) == [film]


def test_a_film_with_an_odd_size_is_cropped(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    with Film(film, 25.0) as finished:
        for _ in range(3):
            finished.add(np.full((101, 161, 3), 128, np.uint8))
    assert pictures(film).shape == (3, 100, 160, 3)


@pytest.fixture
def short_films(monkeypatch: pytest.MonkeyPatch) -> None:
    """The video of a report has one second."""
    monkeypatch.setattr(report_module, "_VIDEO_SECONDS", 1)


@pytest.mark.slow
def test_a_report_opens_without_a_network(
    finished_run: RunFolder, tmp_path: Path, short_films: None
) -> None:
    file = write_report(finished_run, tmp_path / "report.html")
    requests, errors = [], []
    with chromium() as browser:
        context = browser.new_context(offline=True)
        page = context.new_page()
        page.on("request", lambda request: requests.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(file.as_uri())
        headings = [
            "The policy",
            "Video",
            "Learning curve",
            "Error over the episode",
            "Joint positions",
            "Joint torques",
            "Path of the tool",
            "Configuration",
        ]
        assert page.locator("h2").all_inner_texts() == headings
        page.locator(".js-plotly-plot .main-svg").first.wait_for()
        assert page.locator(".js-plotly-plot").count() == 5
        until_loaded = "video => new Promise(done => video.readyState ? done(video.duration) : (video.onloadedmetadata = () => done(video.duration)))"
        assert page.locator("video").evaluate(until_loaded) == pytest.approx(1.5, abs=0.1)
        played = "async video => { await video.play(); await new Promise(r => setTimeout(r, 800)); return video.currentTime; }"
        assert page.locator("video").evaluate(played) > 0.1
        traces = (
            "plot => plot.data.map(trace => [trace.name, trace.x.length ?? trace.x.bdata.length])"
        )
        torques = page.locator(".js-plotly-plot").nth(3).evaluate(traces)
        assert {name for name, _ in torques} == {"dart", "mujoco"}
        path = page.locator(".js-plotly-plot").nth(4).evaluate(traces)
        assert [name for name, _ in path] == ["pinocchio", "dart", "mujoco", "target"]
        assert '"seed": 5' in page.locator("pre").inner_text()
    assert [url for url in requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert errors == []


def test_a_report_does_not_overwrite_another_file(finished_run: RunFolder, tmp_path: Path) -> None:
    mine = tmp_path / "mine.html"
    mine.write_text("kept")
    with pytest.raises(GymMaraError, match="not overwritten"):
        write_report(finished_run, mine)
    assert mine.read_text() == "kept"
    with pytest.raises(GymMaraError, match=r"cannot write.*no folder"):
        write_report(finished_run, tmp_path / "missing" / "report.html")


def test_a_full_disk_ends_a_report_with_a_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(run: RunFolder, path: Path, *_: Any, **__: Any) -> None:
        path.write_text("a half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(report_module, "film_episode", full)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(GymMaraError, match=r"cannot write .*No space left"):
        report_module._video(RunFolder(tmp_path, config()), ["pinocchio"], "last")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_report_names_a_backend_that_is_not_installed(
    finished_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_films: None
) -> None:
    engines = {"dart": "dartpy", "mujoco": "mujoco"}
    packages = tuple(f"gym_mara.backends.{name}" for name in engines)
    for module in [name for name in sys.modules if name.startswith(packages)]:
        monkeypatch.delitem(sys.modules, module, raising=False)
    for library in engines.values():
        monkeypatch.setitem(sys.modules, library, None)
    text = write_report(finished_run, tmp_path / "report.html").read_text()
    assert all(f"gym_mara[{name}]" in text for name in engines)
    assert "No installed backend simulates torques" in text


@pytest.mark.slow
def test_a_report_escapes_the_texts_of_a_run(
    finished_run: RunFolder, tmp_path: Path, short_films: None
) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished_run.path, run)
    hostile = "</pre><script>alert('a & b')</script>"
    values = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(values | {"preset_name": hostile}))
    text = write_report(RunFolder.open(run)).read_text()
    assert hostile not in text
    escaped = "&lt;/pre&gt;&lt;script&gt;alert(&#39;a &amp; b&#39;)&lt;/script&gt;"
    assert text.count(escaped) == 2, "once in the subtitle, once in the configuration"


def test_without_plotly_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("report", "report_figures"):
        monkeypatch.delitem(sys.modules, f"gym_mara.agents.inspection.{name}")
    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    with pytest.raises(MissingExtraError, match=r"gym_mara\[render\]"):
        import gym_mara.agents.inspection.report  # noqa: F401


@pytest.mark.slow
@pytest.mark.parametrize(("what", "port"), [("run", 8300), ("exported", 8301), ("jog", 8302)])
def test_watch_serves_the_viewer_until_an_interrupt(
    finished_run: RunFolder, tmp_path: Path, what: str, port: int
) -> None:
    file = solving(tmp_path / "policy.onnx", "MARAReach-v0")
    arguments = {
        "run": [str(finished_run.path)],
        "exported": ["--policy", str(file), "--env", "MARAReach-v0"],
        "jog": ["--env", "MARAOrient-v0"],
    }
    command = ["-m", "gym_mara.cli", "watch", *arguments[what]]
    command += ["--backend", "dart", "--set", f"viewer_port={port}"]
    with started(*command) as watching:
        deadline = time.monotonic() + 60
        while True:
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5) as answer:
                    assert b"<html" in answer.read()
                break
            except OSError:
                assert time.monotonic() < deadline
                assert watching.poll() is None
                time.sleep(0.2)
        time.sleep(1.0)
        assert watching.poll() is None, "it keeps running"
        watching.send_signal(signal.SIGINT)
        watching.communicate(timeout=30)
    assert watching.returncode == 130
