"""The viewer in a real browser: the user's actions there reach the simulation."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio
import pytest
from playwright.sync_api import Browser, Page

from gym_mara.envs import MaraEnv
from gym_mara.envs.view import view_of
from gym_mara.errors import GymMaraError
from gym_mara.rendering.camera import VIEW_ANGLE
from gym_mara.testing import COLLIDING_Q, pickled
from tests.browser import chromium
from tests.viewer.stepping import ACTION, Loop, wait_until

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # from viser's server


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as opened:
        yield opened


@pytest.fixture
def page(browser: Browser, loop: Loop) -> Iterator[Page]:
    opened = browser.new_page(viewport={"width": 900, "height": 700})
    opened.goto(loop.viewer.url)
    opened.get_by_role("button", name="Pause").wait_for()
    yield opened
    opened.close()


def test_pause_step_and_play(page: Page, loop: Loop) -> None:
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Play").wait_for()
    time.sleep(0.3)
    paused_at = loop.steps
    time.sleep(0.5)
    assert loop.steps == paused_at
    for count in (1, 2):
        page.get_by_role("button", name="Step").click()
        wait_until(lambda count=count: loop.steps >= paused_at + count, "one step")  # type: ignore[misc]
        time.sleep(0.3)
        assert loop.steps == paused_at + count
    page.get_by_role("button", name="Play").click()
    wait_until(lambda: loop.steps > paused_at + 10, "the viewer takes ten more steps")


def test_the_user_jogs_a_joint_with_its_slider(page: Page, loop: Loop) -> None:
    wait_until(lambda: abs(loop.q[0] - 0.3) < 1e-3, "the arm reaches the action's targets")
    page.get_by_role("slider").nth(2).focus()  # the first slider is the speed
    page.keyboard.press("End")
    wait_until(lambda: loop.q[1] > 1.5, "motor2 moves to its upper limit")
    wait_until(page.get_by_label("Jog").is_checked, "the page shows that the user jogs")
    page.get_by_label("Jog").uncheck()
    wait_until(lambda: abs(loop.q[1]) < 1e-3, "the arm follows the action again")


def test_the_slider_sets_the_speed(page: Page, loop: Loop) -> None:
    def rate() -> float:
        begin, steps = time.monotonic(), loop.steps
        time.sleep(1.0)
        return (loop.steps - steps) / (time.monotonic() - begin)

    assert rate() < 55.0, "real time is 50 steps per second"
    page.get_by_role("slider").first.focus()
    page.keyboard.press("Home")  # 0.1 of real time
    time.sleep(0.5)
    assert rate() < 8.0


def test_the_backend_can_be_switched(page: Page, loop: Loop) -> None:
    page.get_by_role("combobox").last.click()
    page.get_by_role("option", name="dart").click()
    wait_until(lambda: "joint_torque" in loop.info, "DART reports torques")
    assert loop.env.simulation.backend_name == "dart"
    wait_until(lambda: abs(loop.q[0] - 0.3) < 0.05, "DART moves the arm to the action's targets")


def test_the_user_drags_the_target(page: Page, loop: Loop) -> None:
    simulation = loop.env.simulation
    goal, error = simulation.goal.position[0].copy(), loop.observation[6:9].copy()
    axis = pinocchio.Quaternion(*simulation.goal.quaternion[0]).matrix()[:, 0]
    grip, end = goal + 0.17 * axis, goal + 0.27 * axis  # the arrow head of the handle's x axis

    def pixel(point: Any) -> tuple[float, float]:
        camera = loop.viewer.camera
        forwards = (camera.at - camera.eye) / np.linalg.norm(camera.at - camera.eye)
        right = np.cross(forwards, camera.up)
        right /= np.linalg.norm(right)
        ray = point - camera.eye
        scale = 350.0 / np.tan(np.radians(VIEW_ANGLE / 2.0)) / (ray @ forwards)
        return 450.0 + scale * (ray @ right), 350.0 - scale * (ray @ np.cross(right, forwards))

    time.sleep(2.0)  # this browser draws the scene in software, which is slow
    page.mouse.move(*pixel(grip))
    time.sleep(0.5)
    page.mouse.down()
    for fraction in np.linspace(0.0, 1.0, 8):
        page.mouse.move(*pixel((1.0 - fraction) * grip + fraction * end))
        time.sleep(0.1)
    page.mouse.up()
    wait_until(lambda: bool((simulation.goal.position[0] != goal).any()), "the goal moves")
    time.sleep(0.5)
    moved = simulation.goal.position[0] - goal
    assert 0.05 < moved @ axis < 0.15
    np.testing.assert_allclose(moved, (moved @ axis) * axis, atol=1e-3)
    wait_until(
        lambda: bool(np.allclose(loop.observation[6:9], error - moved, atol=0.01)),
        "the observation shows the new goal",
    )


def test_the_panel_plots_reward_and_distance(page: Page, loop: Loop) -> None:
    page.locator(".uplot").first.wait_for()
    assert page.locator(".uplot").count() == 2
    for label in ("Reward", "Position error, µm"):
        assert page.get_by_text(label, exact=True).is_visible()


def test_the_page_shows_when_the_environment_closes(browser: Browser) -> None:
    loop = Loop()
    loop.start()
    page = browser.new_page()
    page.goto(loop.viewer.url)
    page.get_by_role("button", name="Pause").click()  # closing must work while paused
    loop.stop()
    page.get_by_text("The environment was closed").wait_for()
    page.close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", int(loop.viewer.url.rsplit(":", 1)[1])))


def test_a_pause_has_no_effect_without_a_browser() -> None:
    loop = Loop()
    loop.viewer.set_playing(False)
    loop.start()
    wait_until(lambda: loop.steps > 3, "the arm steps without a browser")
    loop.stop()


def test_the_viewer_uses_the_next_port_if_its_port_is_in_use(
    capsys: pytest.CaptureFixture[str],
) -> None:
    first, second = Loop(viewer_port=8200), Loop(viewer_port=8200)
    ports = [int(loop.viewer.url.rsplit(":", 1)[1]) for loop in (first, second)]
    assert ports[1] == ports[0] + 1
    assert f"port 8200 is in use; the viewer uses port {ports[1]}" in capsys.readouterr().out
    for loop in (first, second):
        loop.env.close()


def test_the_viewer_listens_on_localhost_only() -> None:
    loop = Loop()
    host, port = loop.viewer.url.removeprefix("http://").split(":")
    assert host == "127.0.0.1"
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_STREAM)) as other:
        other.bind(("127.0.0.2", int(port)))  # fails if the viewer listens on all addresses
    loop.env.close()


def test_an_address_of_another_machine_is_refused() -> None:
    env = MaraEnv(render_mode="human", viewer_host="192.0.2.1")
    with pytest.raises(GymMaraError, match="viewer_host"):
        env.reset()
    env.close()


def test_a_copy_has_no_viewer_until_it_is_reset() -> None:
    loop = Loop()
    copied = pickled(loop.env)
    assert copied.viewer is None
    copied.step(ACTION)
    copied.close()
    loop.env.close()


def test_the_view_marks_colliding_links() -> None:
    loop = Loop(max_joint_velocity=None)
    loop.env.step(np.array(COLLIDING_Q, np.float32))
    assert view_of(loop.env.simulation, 0).touching
    assert loop.env.render() is None
    loop.env.close()


def test_the_target_is_shown_where_a_new_episode_has_it() -> None:
    loop = Loop(task="MARARandomTarget-v0")
    simulation, target = loop.env.simulation, loop.viewer._scene.target
    shown = []
    for _ in range(3):
        loop.env.reset()
        np.testing.assert_array_equal(target.position, simulation.goal.position[0])
        np.testing.assert_array_equal(target.wxyz, simulation.goal.quaternion[0])
        shown.append(tuple(target.position))
    assert len({*shown}) == 3
    loop.env.close()


def test_the_target_stays_under_the_hand_that_drags_it() -> None:
    loop = Loop(task="MARARandomTarget-v0")
    simulation, target = loop.env.simulation, loop.viewer._scene.target
    target.position = np.array([0.3, 0.2, 0.5])
    loop.viewer._on_target(None)
    target.position = np.array([0.3, 0.2, 0.6])  # the hand has moved on
    loop.env.step(ACTION)
    loop.viewer.show()
    np.testing.assert_array_equal(simulation.goal.position[0], [0.3, 0.2, 0.5])
    np.testing.assert_array_equal(target.position, [0.3, 0.2, 0.6])
    loop.env.close()


@pytest.mark.parametrize("failing", ["_panel.update", "_scene.show"])
def test_a_race_in_visers_sender_does_not_stop_the_arm(
    monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise RuntimeError(reason)

    loop = Loop()
    owner, method = failing.split(".")
    monkeypatch.setattr(getattr(loop.viewer, owner), method, fails)
    loop.viewer._drawn = loop.viewer._plotted = 0.0  # the scene and the plots are due
    reason = "deque mutated during iteration"
    loop.env.step(ACTION)
    loop.viewer._drawn = loop.viewer._plotted = 0.0
    reason = "anything else"
    with pytest.raises(RuntimeError, match="anything else"):
        loop.env.step(ACTION)
    loop.env.close()
