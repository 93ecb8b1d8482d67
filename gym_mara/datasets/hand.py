"""Records episodes in which a user leads the arm, in the viewer: with the sliders of its joints, or with the target."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gym_mara.datasets.contents import contents_of
from gym_mara.datasets.episode import Episode, Steps
from gym_mara.datasets.formats import writer_class
from gym_mara.datasets.recorder import Recorded, recorder
from gym_mara.envs import make_vector_env
from gym_mara.envs.actions.straight import StraightActions
from gym_mara.envs.outcome import Outcome
from gym_mara.envs.simulation import Simulation
from gym_mara.envs.streams import Streams
from gym_mara.envs.travel import VELOCITY_LIMIT, travel_velocity
from gym_mara.envs.view import first_view
from gym_mara.rendering import Pictures, RenderSettings
from gym_mara.robot.inverse_kinematics import solve_ik
from gym_mara.types import Floats
from gym_mara.viewer.gate import boolean
from gym_mara.viewer.viewer import Viewer, sender_errors_ignored

MOST_STEPS = 10_000
"""The longest episode, steps. After it the arm waits for the user to save or discard it."""
NAME = "hand"
_HELP = (
    "move the joints with the sliders, or drag the target, which the arm follows. Save episode and Discard episode end an "
    "episode, and Ctrl-C the recording"
)


class HandViewer(Viewer):
    """A viewer whose user leads the arm through episodes.

    The arm moves straight to the joint positions of the sliders, or to the target by inverse kinematics: to what the user has
    moved last. It does so with actions of the environment, at its speed, as a policy would.

    Args:
        simulation, settings: as in Viewer.

    Raises:
        GymMaraError: the viewer cannot listen on the address, or the actions are not those of joints.
    """

    def __init__(self, simulation: Simulation, settings: RenderSettings) -> None:
        self._straight = StraightActions(simulation)
        self._touched = False
        self._keep: bool | None = None
        self._interrupted = False
        super().__init__(simulation, settings)
        self._panel.backends.disabled = True  # a data set has one environment
        gui = self._server.gui
        self.save, self.discard = gui.add_button("Save episode"), gui.add_button("Discard episode")
        for button, keep in ((self.save, True), (self.discard, False)):
            self._gate.let_in(button, boolean)
            button.on_click(lambda _, keep=keep: self._end(keep))

    def episode(self, pictures: Pictures | None) -> Episode | None:
        """Let the user lead the arm through an episode, which begins when the user moves something.

        Args:
            pictures: draws the arm; None for no pictures.

        Returns:
            The episode; None if the user has discarded it.

        Raises:
            KeyboardInterrupt: after `interrupt`, unless the user has saved or discarded the episode before.
        """
        simulation = self._simulation
        if not simulation.task.random_goal:  # the user may have dragged the target
            first = simulation.episodes.first_goal
            simulation.set_goal(first.position[0], first.quaternion[0])
        observation, _ = simulation.reset()
        self._rest()
        steps, ended = Steps(simulation, simulation.present(observation), pictures), False
        while self._keep is None:
            if self._interrupted:
                raise KeyboardInterrupt
            if ended or not self._touched or len(steps) == MOST_STEPS:
                self._wait()
                continue
            outcome = self.step(None)
            diverged = np.zeros(1, np.bool_) if outcome.truncated is None else outcome.truncated
            steps.add(simulation.present(outcome.observation), self._action, outcome, diverged)
            ended = bool(outcome.terminated[0] or diverged[0])
        if not self._keep or not len(steps):
            return None
        episode = steps.episode(0, len(steps), None)
        episode.truncated[-1] |= not episode.terminated[-1]  # by the user
        return episode

    def _rest(self) -> None:
        """Begin an episode: the arm stays where it is until the user moves something."""
        self.show()
        with sender_errors_ignored():
            self._panel.update(self._simulation, follow=True)
        super().jog()
        self._request(_touched=False, _keep=None, _goal=None)
        self._aim: tuple[Any, Floats] | None = None

    def _move(self, action: ArrayLike | None) -> Outcome:
        goal = self._panel.targets() if self._jogging else self._at_target()
        space = self._simulation.action_space
        self._action: NDArray[np.float32] = np.clip(
            self._straight.to(goal), space.low, space.high
        ).astype(np.float32)
        return self._simulation.step(self._action)

    def _at_target(self) -> Floats:
        """The configuration at the target (1, J), rad (m), or near it if that is out of reach."""
        simulation, goal = self._simulation, self._simulation.goal
        if self._aim is None or self._aim[0] is not goal:
            robot = simulation.robot
            q = simulation.backend.state.q[0].clip(robot.lower, robot.upper)
            oriented = getattr(simulation.task, "orientation", False)
            turn = goal.quaternion[0] if oriented else None
            self._aim = goal, solve_ik(robot, goal.position[0], turn, q)[None]
        return self._aim[1]

    def notify(self, text: str) -> None:
        """Show a text in the browsers."""
        for client in self._server.get_clients().values():
            with sender_errors_ignored():
                client.add_notification(text, "")

    def interrupt(self) -> None:
        """Let `episode` raise KeyboardInterrupt, also while the user has paused; a handler of signals may call this."""
        self._interrupted = self._playing = (
            True  # without a lock, which the interrupted code may hold
        )

    # The methods from here on run in viser's threads: they store requests.

    def jog(self) -> None:
        """Take the joint targets from the sliders, as if the user had moved one."""
        super().jog()
        self._request(_touched=True)

    def _on_target(self, event: Any) -> None:
        super()._on_target(event)
        self._panel.jogging.value = False
        self._request(_jogging=False, _touched=True)

    def _end(self, keep: bool) -> None:
        self.set_playing(True)
        self._request(_keep=keep)


def record_by_hand(
    env: str,
    backend: str,
    options: dict[str, Any],
    form: str,
    folder: Path,
    *,
    episodes: int,
    seed: int = 0,
    pixels: int | None = None,
    log: Callable[[str], None] = print,
) -> Recorded:
    """Open the viewer, and record the episodes that its user saves, until there are enough or Ctrl-C.

    Joints that would teleport move at the robot's velocity limit, unless the options have max_joint_velocity.

    Args:
        env: the name of the environment.
        backend: the name of the backend.
        options: keyword arguments of the environment.
        form: one of FORMATS.
        folder: a new folder.
        episodes: how many.
        seed: of the starts and the targets.
        pixels: the width and height of a picture at each step; None for no pictures.
        log: is called with a sentence about what to do, and about each episode.

    Raises:
        GymMaraError: as in `recorder`; a value is out of its range, or the viewer cannot open.
        MissingExtraError: a library is not installed.
        KeyboardInterrupt: no episode was saved before Ctrl-C.
    """
    writer_class(form)  # an error comes before the viewer
    arms = make_vector_env(env, 1, backend=backend, **options)
    if VELOCITY_LIMIT not in options and (limit := travel_velocity(arms.simulation)):
        arms.close()
        options = {**options, VELOCITY_LIMIT: limit}
        arms = make_vector_env(env, 1, backend=backend, **options)
        log(f"{backend}: joints move at most at {limit:.3g} rad/s, the robot's limit")
    with closing(arms):
        simulation = arms.simulation
        contents = contents_of(simulation, env, {"backend": backend, **options}, NAME, pixels)
        pictures: Pictures | None = None
        if contents.pictures:
            first = first_view(simulation)
            pictures = Pictures(simulation.robot, contents.pictures, first)
        simulation.streams = (Streams.seeded(seed),)
        viewer = HandViewer(simulation, simulation.options.rendering)
        with (
            _interrupts_call(viewer.interrupt),
            closing(viewer),
            recorder(form, folder, contents) as (add, recorded),
        ):
            log(f"{viewer.url}: {_HELP}")
            while recorded.episodes < episodes:
                try:
                    episode = viewer.episode(pictures)
                except KeyboardInterrupt:
                    if recorded.episodes:
                        break
                    raise
                if episode is not None:
                    add(episode)
                viewer.notify(f"{recorded.episodes} of {episodes} episodes are saved")
    return recorded


@contextmanager
def _interrupts_call(handle: Callable[[], None]) -> Iterator[None]:
    """Call a function at Ctrl-C, which then interrupts nothing. Where Ctrl-C is ignored, and in other threads, nothing changes."""
    before = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if not main or not callable(before):
        yield
        return
    signal.signal(signal.SIGINT, lambda *_: handle())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
