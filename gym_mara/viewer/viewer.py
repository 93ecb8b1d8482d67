"""A viewer in the browser: the arm moves live, and a hand can stop it, lead it, and drag its target."""

from __future__ import annotations

import socket
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from gym_mara.backends import backend_names
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.rendering.look import look_at
from gym_mara.rendering.scene import Floats, Scene
from gym_mara.rendering.settings import RenderSettings

with needs("the viewer", "render", "viser"):
    import viser

from gym_mara.viewer.stage import Stage

if TYPE_CHECKING:
    from gym_mara.envs.simulation import Outcome, Simulation

_FRAME_PERIOD = 1.0 / 30.0
"""Between two pictures in the browser, s."""
_PLOT_PERIOD = 0.2
"""Between two updates of the plots and sliders, s."""
_SLIDER_STEP = 0.001
"""rad."""
_HISTORY = 300
"""How many steps the plots show."""
_FAREWELL = 0.3
"""How long the last message may take to the browser, s."""
_PORTS = 100
"""How many ports are tried, from the one that was asked for."""
_COLOURS = ("#1f77b4", "#2ca02c", "#ff7f0e", "#d62728", "#9467bd", "#111111")


class Viewer:
    """Shows arm 0 of a simulation in the browser, and does with it what the browser's user asks for.

    `before_step` and `after_step` go around each step of the simulation, in one thread. What the user does in the
    browser is heard in others; it is noted there, and done between two steps.

    Args:
        simulation: the simulation, reset.
        settings: the camera that sees the scene at first, and the address to listen on.

    Raises:
        GymMaraError: the address cannot be listened on.
    """

    def __init__(self, simulation: Simulation, settings: RenderSettings) -> None:
        self._wishes = threading.Condition()
        self._playing, self._single_steps, self._by_hand = True, 0, False
        self._goal: tuple[Floats, Floats] | None = None
        self._backend: str | None = None
        self._due = self._drawn = self._plotted = 0.0
        self._period = simulation.backend.control_period
        self._low, self._high = simulation.target_low, simulation.target_high
        self._history: deque[dict[str, float]] = deque(maxlen=_HISTORY)
        self._server = _serve(settings, simulation.robot.name)
        self.url = f"http://{settings.viewer_host}:{self._server.get_port()}"
        """Where a browser finds it."""
        view, scene = simulation.view(0), Scene(simulation.robot)
        self.camera = look_at(scene, view, settings)
        """From where a browser sees the scene at first."""
        self._stage = Stage(self._server, scene, self.camera, view)
        self._build_controls(simulation)

    def _build_controls(self, simulation: Simulation) -> None:
        gui = self._server.gui
        # What listens on this machine alone must not be shared with the world by a click.
        gui.configure_theme(show_share_button=False)
        self._play = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._step = gui.add_button("Step", icon=viser.Icon.PLAYER_TRACK_NEXT, disabled=True)
        self._speed = gui.add_slider(
            "Speed", min=0.1, max=5.0, step=0.1, initial_value=1.0, hint="1 is real time"
        )
        self._backends = gui.add_dropdown(
            "Backend", backend_names(), initial_value=simulation.backend_name
        )
        self._play.on_click(lambda _: self.set_playing(not self._playing))
        self._step.on_click(lambda _: self._wish(_single_steps=self._single_steps + 1))
        self._backends.on_update(self._hear_backend)
        self._stage.target.on_update(self._hear_target)
        with gui.add_folder("Joints, rad"):
            self._hand = gui.add_checkbox("By hand", initial_value=False)
            self._hand.on_update(self._hear_hand)
            self._sliders = []
            start = simulation.view(0).q.clip(self._low, self._high)
            bounds = zip(simulation.robot.joint_names, self._low, self._high, start, strict=True)
            for name, low, high, value in bounds:
                slider = gui.add_slider(
                    name, low, high, step=_SLIDER_STEP, initial_value=float(value)
                )
                slider.on_update(self._hear_slider)
                self._sliders.append(slider)
        self._plots: list[tuple[list[str], float, Any]] = []

    def _build_plots(self, shown: dict[str, float]) -> None:
        """A plot of the reward and its terms, and one of the position error, which spans powers of ten."""
        rewards = [name for name in shown if name.startswith("reward")]
        distance = [name for name in shown if name in ("position_error", "distance")][-1:]
        for title, names, scale, y in (
            ("Reward", rewards, 1.0, viser.uplot.Scale(auto=True)),
            ("Position error, mm", distance, 1e3, viser.uplot.Scale(auto=True, distr=3)),
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
                scales = {"x": viser.uplot.Scale(time=False, auto=True), "y": y}
                plot = self._server.gui.add_uplot(empty, tuple(series), scales=scales, aspect=1.6)
            self._plots.append((names, scale, plot))

    def lead_by_hand(self) -> None:
        """Begin with the sliders leading the joints, as if the user had moved one."""
        self._hand.value = True
        self._wish(_by_hand=True)

    def set_speed(self, speed: float) -> None:
        """Begin at so many times real time, within what the slider shows."""
        self._speed.value = min(max(speed, self._speed.min), self._speed.max)

    def set_playing(self, playing: bool) -> None:
        """Play, or pause before the next step; a pause holds only while somebody looks."""
        self._play.label = "Pause" if playing else "Play"
        self._play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY
        self._step.disabled = playing
        self._wish(_playing=playing, _single_steps=0)

    # What the browser's user does, heard in viser's threads.

    def _wish(self, **wishes: Any) -> None:
        with self._wishes:
            vars(self).update(wishes)
            self._wishes.notify_all()

    def _hear_hand(self, event: Any) -> None:
        if event.client is not None:
            self._wish(_by_hand=self._hand.value)

    def _hear_slider(self, event: Any) -> None:
        if event.client is not None:  # not the viewer's own updates
            self._hand.value = True
            self._wish(_by_hand=True)

    def _hear_target(self, _: Any) -> None:
        target = self._stage.target
        self._wish(_goal=(np.array(target.position), np.array(target.wxyz)))

    def _hear_backend(self, event: Any) -> None:
        if event.client is not None:
            self._wish(_backend=self._backends.value)

    # What the simulation's thread does.

    def before_step(self, simulation: Simulation, action: ArrayLike) -> Any:
        """Wait for the step's turn, do what the user asked for, and return the joint targets to go for: (1, J), rad.

        They are the action's, or while the user leads by hand the sliders'.
        """
        while True:
            with self._wishes:
                goal, self._goal = self._goal, None
                backend, self._backend = self._backend, None
            if goal is not None:
                simulation.set_goal(*goal)
            if backend not in (None, simulation.backend_name):
                self._switch(simulation, backend)
            with self._wishes:
                if self._goal is not None or self._backend is not None:
                    continue
                if self._playing or not self._server.get_clients():
                    break  # a viewer that nobody looks at holds nothing up
                if self._single_steps:
                    self._single_steps -= 1
                    break
                self._wishes.wait(0.1)
        now = time.monotonic()
        self._due = max(self._due + self._period / self._speed.value, now - self._period)
        time.sleep(max(0.0, self._due - now))
        if self._by_hand:
            return np.array([[slider.value for slider in self._sliders]]).clip(
                self._low, self._high
            )
        return action

    def _switch(self, simulation: Simulation, backend: str) -> None:
        try:
            simulation.switch_backend(backend)
        except GymMaraError as error:
            self._backends.value = simulation.backend_name
            for client in self._server.get_clients().values():
                client.add_notification("The backend stays", str(error), color="red")

    def after_step(self, simulation: Simulation, outcome: Outcome) -> None:
        """Show what a step brought."""
        shown = {"reward": float(outcome.reward[0])}
        shown |= {
            k: float(v[0]) for k, v in outcome.info.items() if v.dtype == np.float64 and v.ndim == 1
        }
        if not self._plots:
            self._build_plots(shown)
        self._history.append(shown)
        now = time.monotonic()
        if now - self._drawn >= _FRAME_PERIOD or not self._playing:
            self.show(simulation)
        if now - self._plotted >= _PLOT_PERIOD or not self._playing:
            self._plotted = now
            with _whatever_its_sender_does():
                self._plot(simulation)

    def show(self, simulation: Simulation) -> None:
        """Show the arm as it is."""
        self._drawn = time.monotonic()
        with _whatever_its_sender_does():
            self._stage.show(simulation.view(0))

    def _plot(self, simulation: Simulation) -> None:
        rows = list(self._history)
        steps = np.arange(len(rows), dtype=np.float64)
        for names, scale, plot in self._plots:
            columns = [scale * np.array([row.get(name, np.nan) for row in rows]) for name in names]
            plot.data = (steps, *columns)
        if not self._by_hand:
            q = simulation.view(0).q
            for slider, value in zip(self._sliders, q.clip(self._low, self._high), strict=True):
                if abs(slider.value - value) > _SLIDER_STEP:
                    slider.value = float(value)

    def close(self) -> None:
        """Tell whoever looks, and stop listening."""
        clients = self._server.get_clients().values()
        for client in clients:
            client.add_notification("Closed", "The environment was closed; the arm moves no more.")
            client.flush()
        if clients:
            time.sleep(_FAREWELL)
        self._server.stop()


@contextmanager
def _whatever_its_sender_does() -> Iterator[None]:
    """Go on where viser could not wake its sender: it does so from our thread, by an asyncio event that may be changing.

    What was to be shown is queued by then, and what comes next wakes it.
    """
    try:
        yield
    except RuntimeError as error:
        if "deque mutated" not in str(error):
            raise


def _serve(settings: RenderSettings, robot: str) -> viser.ViserServer:
    """A server on the port that was asked for, or the next one that is free.

    Raises:
        GymMaraError: the address is not one of this machine, or no port is free.
    """
    host, first = settings.viewer_host, settings.viewer_port
    reason: OSError | None = None
    for port in range(first, min(first + _PORTS, 65536)):
        try:
            with socket.create_server((host, port)):
                pass
        except OSError as error:
            reason = error
            continue
        if port != first:
            print(f"gym_mara: port {first} is in use; the viewer takes {port}", flush=True)
        return viser.ViserServer(host, port, label=f"gym_mara: {robot}", verbose=False)
    raise GymMaraError(
        f"the viewer cannot listen on {host!r}, port {first} or one of the {_PORTS - 1} after it: {reason}; "
        "choose another viewer_host or viewer_port"
    ) from reason
