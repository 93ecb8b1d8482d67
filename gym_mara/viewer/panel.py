"""The viewer's panel: buttons, sliders and plots next to the scene."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import viser

from gym_mara.backends import simulated_backends
from gym_mara.envs.outcome import Outcome
from gym_mara.envs.simulation import Simulation
from gym_mara.types import Floats
from gym_mara.viewer.gate import boolean, number, one_of

_SLIDER_STEP = 0.001
"""The resolution of the joint sliders, rad."""
_HISTORY = 300
"""The number of steps that the plots show."""
_COLOURS = ("#1f77b4", "#2ca02c", "#ff7f0e", "#d62728", "#9467bd", "#111111")


class Panel:
    """Controls and plots of one arm.

    Args:
        server: the viser server that shows the panel.
        simulation: the simulation.
        q: the initial joint positions of the sliders (J,), rad.
    """

    def __init__(self, server: viser.ViserServer, simulation: Simulation, q: Floats) -> None:
        self._server = server
        self._low, self._high = simulation.target_low, simulation.target_high
        self._history: deque[dict[str, float]] = deque(maxlen=_HISTORY)
        gui = server.gui
        # The share button would make the server public; it must be reachable from this machine only.
        gui.configure_theme(show_share_button=False)
        self.play = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self.step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT, disabled=True)
        self._speed = gui.add_slider(
            "Speed", min=0.1, max=5.0, step=0.1, initial_value=1.0, hint="1 is real time"
        )
        current = simulation.backend_name
        names = dict.fromkeys([*simulated_backends(), current])
        self.backends = gui.add_dropdown("Backend", [*names], initial_value=current)
        with gui.add_folder("Joints, rad"):
            self.jogging = gui.add_checkbox("Jog", initial_value=False)
            # Rounded outwards, because a long number is cut off; `targets` clips to the true limits.
            low, high = np.floor(1e3 * self._low) / 1e3, np.ceil(1e3 * self._high) / 1e3
            bounds = zip(simulation.robot.joint_names, low, high, q.round(3), strict=True)
            self.sliders = [
                gui.add_slider(
                    name,
                    float(lowest),
                    float(highest),
                    step=_SLIDER_STEP,
                    initial_value=float(np.clip(value, lowest, highest)),
                )
                for name, lowest, highest, value in bounds
            ]
        # For each plot: the names of its values, their scale, and the handle.
        self._plots: list[tuple[list[str], float, Any]] = []

    def checks(self) -> Iterator[tuple[Any, Callable[[Any], Any]]]:
        """The controls, each with the check of its values from a browser."""
        for control in (self.play, self.step, self.jogging):
            yield control, boolean
        for slider in (self._speed, *self.sliders):
            yield slider, functools.partial(number, low=slider.min, high=slider.max)
        yield self.backends, functools.partial(one_of, valid=self.backends.options)

    @property
    def speed(self) -> float:
        """The speed relative to real time."""
        return float(self._speed.value)

    def set_speed(self, speed: float) -> None:
        """Set the speed relative to real time, clipped to the range of its slider."""
        self._speed.value = min(max(speed, self._speed.min), self._speed.max)

    def show_playing(self, playing: bool) -> None:
        """Show the Pause button while playing, else the Play and Step buttons."""
        self.play.label = "Pause" if playing else "Play"
        self.play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY
        self.step.disabled = playing

    def targets(self) -> Floats:
        """The joint targets (1, J), rad, that the sliders show."""
        return np.array([[slider.value for slider in self.sliders]]).clip(self._low, self._high)

    def refuse_backend(self, current: str, reason: str) -> None:
        """Show the current backend again, and the reason why it was not switched."""
        self.backends.value = current
        for client in self._server.get_clients().values():
            client.add_notification("The backend was not switched", reason, color="red")

    def add(self, outcome: Outcome) -> None:
        """Add the result of a step to the plots."""
        shown = {"reward": float(outcome.reward[0])}
        shown |= {
            name: float(values[0])
            for name, values in outcome.info.items()
            if values.dtype == np.float64 and values.ndim == 1
        }
        if not self._plots:
            self._build_plots(shown)
        self._history.append(shown)

    def _build_plots(self, shown: dict[str, float]) -> None:
        """Add a plot of the reward and its terms, and a plot of the position error with a logarithmic axis.

        The error is in µm, because the browser shows at most three decimals at an axis.
        """
        rewards = [name for name in shown if name.startswith("reward")]
        distance = [name for name in shown if name in ("position_error", "distance")][-1:]
        for title, names, scale, y in (
            ("Reward", rewards, 1.0, viser.uplot.Scale(auto=True)),
            ("Position error, µm", distance, 1e6, viser.uplot.Scale(auto=True, distr=3)),
        ):
            if not names:
                continue
            with self._server.gui.add_folder(title):
                series = [viser.uplot.Series(label="step")]
                series += [
                    viser.uplot.Series(label=name.removeprefix("reward_"), stroke=colour, width=1.5)
                    for name, colour in zip(names, _COLOURS, strict=False)
                ]
                empty = tuple(np.ones(1) for _ in series)
                no_ticks = viser.uplot.Axis_Ticks(show=False)
                scales = {"x": viser.uplot.Scale(time=False, auto=True), "y": y}
                plot = self._server.gui.add_uplot(
                    empty,
                    tuple(series),
                    scales=scales,
                    axes=(
                        viser.uplot.Axis(ticks=no_ticks),
                        viser.uplot.Axis(ticks=no_ticks, size=74),
                    ),
                    legend=viser.uplot.Legend(show=len(names) > 1, live=False),
                    aspect=1.9,
                    padding=(12, 8, 0, 0),  # pixels; else the highest label is cut off
                )
            self._plots.append((names, scale, plot))

    def update(self, simulation: Simulation, *, follow: bool) -> None:
        """Redraw the plots. With `follow`, also set the sliders to the joint positions."""
        rows = list(self._history)
        steps = np.arange(len(rows), dtype=np.float64)
        for names, scale, plot in self._plots:
            columns = [scale * np.array([row.get(name, np.nan) for row in rows]) for name in names]
            plot.data = (steps, *columns)
        if follow:
            q = simulation.observed(0).q[0].clip(self._low, self._high)
            for slider, value in zip(self.sliders, q, strict=True):
                if abs(slider.value - value) > _SLIDER_STEP:
                    slider.value = round(float(value), 3)
