"""Steps a simulation in real time and shows it in the browser; its user can pause, jog joints and drag the target."""

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

from gym_mara.envs.outcome import Outcome
from gym_mara.envs.simulation import Simulation
from gym_mara.envs.view import view_of
from gym_mara.errors import GymMaraError, positive_number
from gym_mara.extras import needs
from gym_mara.rendering.camera import place_camera
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.settings import RenderSettings
from gym_mara.types import Floats

with needs("the viewer", "render", "viser"):
    import viser

from gym_mara.viewer.browser_scene import BrowserScene
from gym_mara.viewer.gate import Gate
from gym_mara.viewer.panel import Panel

_FRAME_PERIOD = 1.0 / 30.0
"""The time between two pictures in the browser, s."""
_PLOT_PERIOD = 0.2
"""The time between two updates of the plots and sliders, s."""
_CLOSING_TIME = 0.3
"""The time for the last message to reach the browser, s."""
_PORTS = 100
"""The number of ports to try, from the configured one upwards."""


class Viewer:
    """Steps a simulation of one arm and shows it in the browser.

    `step` first handles the requests of the user in the browser, then waits until the next step is due, then steps. All
    of this happens in the thread that calls `step`; viser's threads only store the requests. All that comes from a
    browser has passed the gate (`gym_mara.viewer.gate`).

    Args:
        simulation: the simulation.
        settings: the initial camera, and the address to listen on.

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
        gate = Gate(settings.viewer_host)
        self._server = start_server(settings, simulation.robot.name, gate)
        self.url = f"http://{settings.viewer_host}:{self._server.get_port()}"
        """The address to open in a browser."""
        view, scene = view_of(simulation, 0), Scene(simulation.robot)
        self.camera = place_camera(scene, view, settings)
        """The initial camera of a browser."""
        self._scene = BrowserScene(self._server, scene, self.camera, view)
        self._shown_goal = simulation.goal
        self._panel = Panel(self._server, simulation, view.q)
        for control, check in self._panel.checks():
            gate.let_in(control, check)
        self._gate = gate
        self._connect_controls()

    def run(self, policy: Callable[[Any], ArrayLike | None], episode_steps: int | None) -> None:
        """Play a policy, one episode after the other, until the user interrupts.

        Args:
            policy: maps observations of one arm, with a leading axis of length 1, to actions as in `step`.
            episode_steps: the length of an episode; None for no end.
        """
        while True:
            observation, _ = self._simulation.reset()
            self.show()
            for _ in count() if episode_steps is None else range(episode_steps):
                outcome = self.step(policy(self._simulation.present(observation)))
                observation = outcome.observation
                if outcome.terminated.any() or outcome.truncated is not None:
                    break

    def step(self, action: ArrayLike | None) -> Outcome:
        """Wait until the next step is due, then step with the actions (1, A) of one arm; None moves it to its home pose.

        While the user jogs the joints, the joint targets of the sliders take their place.

        Raises:
            GymMaraError: the action has the wrong shape or is not finite.
        """
        self._wait()
        outcome = self._move(action)
        self._panel.add(outcome)
        now = time.monotonic()
        if now - self._drawn >= _FRAME_PERIOD or not self._playing:
            self.show()
        if now - self._plotted >= _PLOT_PERIOD or not self._playing:
            self._plotted = now
            with sender_errors_ignored():
                self._panel.update(self._simulation, follow=not self._jogging)
        return outcome

    def _move(self, action: ArrayLike | None) -> Outcome:
        """Step as the user or the program wants."""
        simulation = self._simulation
        if self._jogging:
            return simulation.step_towards(self._panel.targets())
        if action is None:
            return simulation.step_towards(simulation.robot.home[None])
        return simulation.step(action)

    def show(self) -> None:
        """Draw the arm in its current state, and the target if the program has moved it, as a new episode does."""
        self._drawn = time.monotonic()
        view, goal = view_of(self._simulation, 0), self._simulation.goal
        with sender_errors_ignored():
            self._scene.show(view)
            if goal is not self._shown_goal:
                self._shown_goal = goal
                self._scene.move_target(view)

    def jog(self) -> None:
        """Take the joint targets from the sliders, as if the user had moved one."""
        self._panel.jogging.value = True
        self._request(_jogging=True)

    def set_speed(self, speed: float) -> None:
        """Set the speed relative to real time, clipped to the range of its slider.

        Raises:
            GymMaraError: it is not a positive number.
        """
        self._panel.set_speed(positive_number("speed", speed))

    def set_playing(self, playing: bool) -> None:
        """Play, or pause before the next step. A pause lasts only while a browser is connected."""
        self._panel.show_playing(playing)
        self._request(_playing=playing, _single_steps=0)

    def close(self) -> None:
        """Notify the connected browsers and stop the server."""
        clients = self._server.get_clients().values()
        for client in clients:
            with sender_errors_ignored():
                client.add_notification(
                    "Closed", "The environment was closed; the arm no longer moves."
                )
                client.flush()
        if clients:
            time.sleep(_CLOSING_TIME)
        self._server.stop()

    # The methods from here on run in viser's threads: they store requests.

    def _connect_controls(self) -> None:
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
        if event.client is not None:  # the user made the change, not the viewer
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

    # The methods from here on run in the thread that calls `step`: they handle the requests.

    def _wait(self) -> None:
        """Handle the user's requests, and wait until the next step is due."""
        while True:
            self._handle_requests()
            with self._requests:
                if self._goal is not None or self._backend is not None:
                    continue
                if self._playing or not self._server.get_clients():
                    break  # a pause lasts only while a browser is connected
                if self._single_steps:
                    self._single_steps -= 1
                    break
                self._requests.wait(0.1)
        now, period = time.monotonic(), self._simulation.backend.control_period
        self._due = max(self._due + period / self._panel.speed, now - period)
        time.sleep(max(0.0, self._due - now))

    def _handle_requests(self) -> None:
        with self._requests:
            goal, self._goal = self._goal, None
            backend, self._backend = self._backend, None
        if goal is not None:
            self._simulation.set_goal(*goal)
            self._shown_goal = self._simulation.goal  # the browser shows it already
        if backend not in (None, self._simulation.backend_name):
            try:
                self._simulation.switch_backend(str(backend))
            except GymMaraError as error:
                self._panel.refuse_backend(self._simulation.backend_name, str(error))


@contextmanager
def sender_errors_ignored() -> Iterator[None]:
    """Ignore two races in viser.

    It wakes its sender thread through an asyncio event that is not thread-safe: the message is already queued, and the next
    message wakes the sender. And it warns of a message to a browser that has just disconnected, which is an exception
    where warnings are errors.
    """
    try:
        yield
    except (RuntimeError, UserWarning) as error:
        if "deque mutated" not in str(error) and "closed connection" not in str(error):
            raise


def start_server(settings: RenderSettings, robot: str, gate: Gate) -> viser.ViserServer:
    """Start a server with this gate on the configured port, or on the next free port.

    Raises:
        GymMaraError: the host is not an address of this machine, no port is free, or viser does not let a gate be installed.
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
            print(f"gym_mara: port {first} is in use; the viewer uses port {port}", flush=True)
        with gate.installed() as guarded:
            server = viser.ViserServer(host, port, label=f"gym_mara: {robot}", verbose=False)
        if not guarded.is_set():
            server.stop()
            raise GymMaraError(
                f"the viewer cannot be guarded with viser {viser.__version__}: install viser 1.1.1"
            )
        return server
    raise GymMaraError(
        f"the viewer cannot listen on {host!r}, port {first} or any of the next {_PORTS - 1} ports: {reason}; "
        "choose another viewer_host or viewer_port"
    ) from reason
