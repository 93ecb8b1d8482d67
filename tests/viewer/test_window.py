"""The window that shows an arm which another program moves, in a real browser."""

from __future__ import annotations

import io
import time
import urllib.request
from collections.abc import Iterator

import imageio.v3 as imageio
import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from gym_mara.robot import RobotModel
from gym_mara.types import Floats
from gym_mara.viewer.window import Window
from tests.browser import chromium


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as opened:
        yield opened


@pytest.fixture
def window(mara: RobotModel) -> Iterator[Window]:
    opened = Window(mara)
    yield opened
    opened.close()


def picture(window: Window, page: Page, q: Floats) -> Floats:
    """What the browser shows of the arm at q, when that does not change any more; it draws in software, which is slow."""
    last, end = np.zeros(1), time.monotonic() + 60.0
    while time.monotonic() < end:
        for _ in range(20):
            window.show(q)
            page.wait_for_timeout(50)
        now = imageio.imread(io.BytesIO(page.screenshot())).astype(np.float64)
        if now.shape == last.shape and np.abs(now - last).mean() < 0.02:
            return now
        last = now
    raise AssertionError("the picture does not come to rest")


def test_a_page_without_a_browser_holds_nothing_up(window: Window, mara: RobotModel) -> None:
    with urllib.request.urlopen(window.url, timeout=10.0) as response:
        assert response.status == 200
    for _ in range(100):
        window.show(mara.home)


def test_a_browser_sees_the_arm_move(window: Window, browser: Browser, mara: RobotModel) -> None:
    page = browser.new_page(viewport={"width": 500, "height": 400})
    try:
        page.goto(window.url)
        page.locator("canvas").first.wait_for()
        at_home, moved = (picture(window, page, q) for q in (mara.home, mara.home + 0.7))
        assert np.abs(moved - at_home).mean() > 1.0
    finally:
        page.close()
