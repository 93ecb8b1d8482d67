"""The viewer's panel: no number and no plot in it is cut off."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.viewer.stepping import ACTION, Loop

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # from viser's server


@pytest.fixture
def shown() -> Iterator[Loop]:
    """A viewer whose program stands still."""
    loop = Loop(max_joint_velocity=1.2345)  # rad/s, so that positions have many decimals
    yield loop
    loop.env.close()


def is_short(value: float) -> bool:
    """Whether a number has at most three decimals, which is what a slider has space for."""
    return len(repr(float(value)).partition(".")[2]) <= 3


def test_the_numbers_of_the_sliders_are_short_and_reach_the_limits(shown: Loop) -> None:
    panel, simulation = shown.viewer._panel, shown.env.simulation
    sliders = panel.sliders
    assert all(is_short(n) for one in sliders for n in (one.min, one.max, one.value))
    for end, limits in (("min", simulation.target_low), ("max", simulation.target_high)):
        for slider in sliders:
            slider.value = getattr(slider, end)
        np.testing.assert_array_equal(panel.targets()[0], limits)


def test_the_sliders_follow_the_arm_with_short_numbers(shown: Loop) -> None:
    for _ in range(3):
        shown.env.step(ACTION * np.pi)
    panel, simulation = shown.viewer._panel, shown.env.simulation
    panel.update(simulation, follow=True)
    assert all(is_short(slider.value) for slider in panel.sliders)
    q = simulation.observed(0).q[0]
    np.testing.assert_allclose([slider.value for slider in panel.sliders], q, atol=1e-3)


def test_the_plots_have_space_for_their_labels(shown: Loop) -> None:
    panel = shown.viewer._panel
    panel.update(shown.env.simulation, follow=True)
    plots: list[Any] = [plot for _, _, plot in panel._plots]
    assert len(plots) == 2
    for plot in plots:
        top, right, *_ = plot.padding
        assert min(top, right) >= 8, "pixels around the first and the last label"
        assert plot.axes[1]["size"] >= 70, "pixels for numbers such as -1,000.5"
    (error,) = plots[1].data[1][-1:]
    assert error == pytest.approx(1e6 * shown.info["position_error"]), "in µm: decimals are cut off"
    assert is_short(round(error, 3))


def test_the_user_jogs_to_joint_targets_whatever_actions_mean() -> None:
    loop = Loop(action="relative", action_scale=0.01)
    simulation, viewer = loop.env.simulation, loop.viewer
    before = simulation.observed(0).q[0]
    viewer.jog()
    for slider in viewer._panel.sliders:
        slider.value = 0.02
    loop.env.step(ACTION)
    np.testing.assert_allclose(simulation.observed(0).q[0], 0.02, atol=1e-9)
    viewer._request(_jogging=False)
    loop.env.step(ACTION)
    np.testing.assert_allclose(simulation.observed(0).q[0], 0.02 + 0.01 * ACTION, atol=1e-9)
    viewer.step(None)
    np.testing.assert_allclose(simulation.observed(0).q[0], simulation.robot.home, atol=1e-9)
    assert before.any()
    loop.env.close()
