"""A viewer in the browser: it steps the simulation in real time, and its user can pause it, jog the joints, and drag the target."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gym_mara.envs.simulation import Outcome, Simulation
from gym_mara.envs.view import view_of
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.rendering.camera import place_camera
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.settings import RenderSettings
from gym_mara.types import Floats

with needs("the viewer", "render", "viser"):
    import viser

from gym_mara.viewer.browser_scene import BrowserScene
from gym_mara.viewer.panel import Panel

_FRAME_PERIOD = 1.0 / 30.0
"""Between two pictures in the browser, s."""
_PLOT_PERIOD = 0.2
"""Between two updates of the plots and sliders, s."""
_CLOSING_TIME = 0.3
"""How long the last message may take to the browser, s."""
_PORTS = 100
"""How many ports are tried, from the one that was asked for."""


class Viewer:
    """Steps a simulation of one arm and shows it in the browser.

    `step` takes one step when it is due, and does before it what the browser's user has asked for. All of it happens in
    the thread that calls `step`; viser's threads only note what the user asks for.

    Args:
        simulation: the simulation.
        settings: the camera that sees the scene at first, and the address to listen on.

    Raises:
        GymMaraError: the viewer cannot listen on the address.
    """

    def __init__(self, simulation: Simulation, settings: RenderSettings) -> None:
        self._simulation = simulation
        self._requests = threading.Condition()
        self._playing, self._single_steps, self._jogging = True, 0, False
        self._goal: tuple[Floats, Floats] | None = None
        self._backend: str | None = None
        self._due = self._drawn = self._plotted = 0.0
        self._server = _serve(settings, simulation.robot.name)
        self.url = f"http://{settings.viewer_host}:{self._server.get_port()}"
        """Its address for a browser."""
        view, scene = view_of(simulation, 0), Scene(simulation.robot)
        self.camera = place_camera(scene, view, settings)
        """The camera that a browser begins with."""
        self._scene = BrowserScene(self._server, scene, self.camera, view)
        self._panel = Panel(self._server, simulation, view.q)
        self._listen()

    def run(self, policy: Callable[[Floats], ArrayLike], episode_steps: int | None) -> None:
        """Play a policy, episode after episode, until the user interrupts.

        Args:
            policy: the joint targets (1, J), rad, for observations (1, O).
            episode_steps: the length of an episode; None for no end.
        """
        while True:
            observation, _ = self._simulation.reset()
            self.show()
            for _ in count() if episode_steps is None else range(episode_steps):
                outcome = self.step(policy(observation))
                observation = outcome.observation
                if outcome.terminated.any() or outcome.truncated is not None:
                    break

    def step(self, targets: ArrayLike) -> Outcome:
        """Take one step, when it is due, towards joint targets (1, J), rad; or towards the sliders, while the user jogs.

        Raises:
            GymMaraError: the targets have the wrong shape or are not finite.
        """
        self._wait()
        outcome = self._simulation.step(self._panel.targets() if self._jogging else targets)
        self._panel.add(outcome)
        now = time.monotonic()
        if now - self._drawn >= _FRAME_PERIOD or not self._playing:
            self.show()
        if now - self._plotted >= _PLOT_PERIOD or not self._playing:
            self._plotted = now
            with _sender_errors_ignored():
                self._panel.update(self._simulation, follow=not self._jogging)
        return outcome

    def show(self) -> None:
        """Show the arm as it is."""
        self._drawn = time.monotonic()
        with _sender_errors_ignored():
            self._scene.show(view_of(self._simulation, 0))

    def jog(self) -> None:
        """Let the sliders lead the joints, as if the user had moved one."""
        self._panel.jogging.value = True
        self._request(_jogging=True)

    def set_speed(self, speed: float) -> None:
        """Play at so many times real time, within the range of the slider."""
        self._panel.set_speed(speed)

    def set_playing(self, playing: bool) -> None:
        """Play, or pause before the next step; a pause holds only while a browser is connected."""
        self._panel.show_playing(playing)
        self._request(_playing=playing, _single_steps=0)

    def close(self) -> None:
        """Tell connected browsers, and stop listening."""
        clients = self._server.get_clients().values()
        for client in clients:
            client.add_notification("Closed", "The environment was closed; the arm moves no more.")
            client.flush()
        if clients:
            time.sleep(_CLOSING_TIME)
        self._server.stop()

    # In viser's threads: note what the user asks for.

    def _listen(self) -> None:
        panel = self._panel
        panel.play.on_click(lambda _: self.set_playing(not self._playing))
        panel.step.on_click(lambda _: self._request(_single_steps=self._single_steps + 1))
        panel.backends.on_update(self._on_backend)
        panel.jogging.on_update(self._on_jogging)
        for slider in panel.sliders:
            slider.on_update(self._on_slider)
        self._scene.target.on_update(self._on_target)

    def _request(self, **requests: Any) -> None:
        with self._requests:
            vars(self).update(requests)
            self._requests.notify_all()

    def _on_jogging(self, event: Any) -> None:
        if event.client is not None:  # the user's change, not the viewer's own
            self._request(_jogging=self._panel.jogging.value)

    def _on_slider(self, event: Any) -> None:
        if event.client is not None:
            self.jog()

    def _on_target(self, _: Any) -> None:
        target = self._scene.target
        self._request(_goal=(np.array(target.position), np.array(target.wxyz)))

    def _on_backend(self, event: Any) -> None:
        if event.client is not None:
            self._request(_backend=self._panel.backends.value)

    # In the thread that steps: do it.

    def _wait(self) -> None:
        """Do what the user has asked for, and wait until the next step is due."""
        while True:
            self._do_requests()
            with self._requests:
                if self._goal is not None or self._backend is not None:
                    continue
                if self._playing or not self._server.get_clients():
                    break  # without a browser nothing is paused
                if self._single_steps:
                    self._single_steps -= 1
                    break
                self._requests.wait(0.1)
        now, period = time.monotonic(), self._simulation.backend.control_period
        self._due = max(self._due + period / self._panel.speed, now - period)
        time.sleep(max(0.0, self._due - now))

    def _do_requests(self) -> None:
        with self._requests:
            goal, self._goal = self._goal, None
            backend, self._backend = self._backend, None
        if goal is not None:
            self._simulation.set_goal(*goal)
        if backend not in (None, self._simulation.backend_name):
            try:
                self._simulation.switch_backend(str(backend))
            except GymMaraError as error:
                self._panel.refuse_backend(self._simulation.backend_name, str(error))


@contextmanager
def _sender_errors_ignored() -> Iterator[None]:
    """Go on where viser could not wake its sender: it does so from our thread, by an asyncio event that may be changing.

    By then the message is queued, and the next one wakes the sender.
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
