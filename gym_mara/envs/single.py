"""MaraEnv: one arm."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.envs.given import GIVEN
from gym_mara.envs.options import Options, check_reset_options
from gym_mara.envs.simulation import Simulation
from gym_mara.envs.streams import Streams
from gym_mara.envs.time_limits import TimeLimits
from gym_mara.envs.view import first_view, view_of
from gym_mara.errors import GymMaraError, one_of
from gym_mara.rendering import Pictures
from gym_mara.robot import RobotLike
from gym_mara.tasks import Task
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.viewer.viewer import Viewer


class MaraEnv(gymnasium.Env[Floats, NDArray[np.float32]]):
    """One arm.

    The task defines the observation (O,). An action (A,) is an array of absolute joint targets, rad, or what else `action`
    chooses (`gym_mara.envs.actions`). `info` has the terms of the reward, `collided`, and the `statistics` of the episode so
    far (`gym_mara.envs.statistics`).

    Args:
        task: the name of a task, such as "MARA-v0", or a Task.
        robot: a robot's name, the path of a URDF, a list of MARA's modules, or a RobotModel.
        ee_frame: the end-effector link of a URDF of your own.
        backend: the name of a backend.
        render_mode: "rgb_array" for pictures, "human" for a viewer in the browser, or None.
        **options: values of the task (`target_position`, `on_collision`, …), settings of the backend
            (`max_joint_velocity`, …), of the actions (`action`, …), of the sensors (`velocity_filter`), of the rendering
            (`width`, `camera`, …; `gym_mara.rendering.RenderSettings`) and of pictures as observations (`observation`,
            `pixel_size`, …; `gym_mara.rendering.settings.PixelSettings`).

    Raises:
        GymMaraError: a name is unknown, or a value is out of its range.
        MissingExtraError: a library is not installed.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"]}  # noqa: RUF012 - Gymnasium defines it so

    def __init__(
        self,
        task: str | Task = "MARA-v0",
        *,
        robot: RobotLike = "mara",
        ee_frame: str | None = None,
        backend: str = DEFAULT_BACKEND,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        self.render_mode = checked_render_mode(render_mode, self.metadata["render_modes"])
        self._options = Options.sort(task, robot, ee_frame, backend, options, type(self))
        self.simulation = self._make_simulation(self._options)
        if self.simulation.backend.arrays != "numpy":
            self.simulation.close()
            raise GymMaraError(
                "an environment of one arm has NumPy's arrays: leave out arrays, or make a vector environment with make_vec"
            )
        self._pictures = Pictures(
            self.simulation.robot, self._options.rendering, first_view(self.simulation)
        )
        self.viewer: Viewer | None = None
        self._time_limits = TimeLimits()
        # The generator from which the simulation's streams were spawned.
        self._spawned_from: np.random.Generator | None = None
        self.observation_space = self.simulation.observation_space
        self.action_space = self.simulation.action_space
        self.metadata = self.metadata | {"render_fps": 1.0 / self.simulation.backend.control_period}

    def _make_simulation(self, options: Options) -> Simulation:
        return Simulation(options, 1)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of all random numbers from now on; None to go on with those that follow.
            options: values for this episode alone, each of which can be left out: `start_q` (J,), rad (m for a prismatic
                joint), and where targets are drawn, `target_position` (3,), m, and `target_quaternion` (4,), [w, x, y, z],
                both in the world. What is left out is drawn as usual, and fits to what is given; only the way from the start
                to a given target is not checked. Later episodes are the same as without these options.

        Raises:
            GymMaraError: an option is unknown or has a wrong value, or the environment does not take it; the start is beyond
                the limits or collides; the target is out of reach, or the arm collides in all configurations found there.
                Nothing has changed then.
        """
        check_reset_options(options, GIVEN)
        given = self.simulation.episodes.given(options)
        self._time_limits.note_reset(self)
        super().reset(seed=seed)
        if self._spawned_from is not self.np_random:
            self._spawned_from = self.np_random
            self.simulation.streams = (Streams.of(self.np_random),)
        observation, report = self.simulation.reset(given=given)
        if self.render_mode == "human":
            self._show()
        return self._first_of(observation), _info_of_one(report)

    def step(self, action: NDArray[np.float32]) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Execute an action (A,) for one control period.

        Raises:
            GymMaraError: the action has the wrong type or shape, or is not finite. The arm does not move then.
        """
        batch = self.simulation.actions.of_one_arm(action)
        # The viewer steps the simulation in real time, and may replace the action.
        step = self.simulation.step if self.viewer is None else self.viewer.step
        outcome = step(batch)
        info = _info_of_one(outcome.info)
        # At every step, because an environment does not know when Gymnasium's TimeLimit truncates its episode.
        info["statistics"] = self.simulation.statistics.of(0)
        terminated, truncated = outcome.terminated.item(), outcome.truncated is not None
        observation = self._first_of(outcome.observation)
        return observation, outcome.reward.item(), terminated, truncated, info

    def _first_of(self, flat: Floats) -> Any:
        """The observation of the only arm, of flat observations (1, O)."""
        observation = self.simulation.present(flat)
        if isinstance(observation, dict):
            return {name: values[0] for name, values in observation.items()}
        return observation[0]

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Draw the state of the last observation: uint8 (height, width, 3), RGB; None without render_mode "rgb_array".

        Raises:
            MissingExtraError: no renderer is installed.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() draws nothing without a render_mode: choose render_mode='rgb_array' or 'human'"
            )
        if self.render_mode != "rgb_array":
            return None
        return self._pictures.of(view_of(self.simulation, 0))

    def _show(self) -> None:
        """Show the arm in the viewer; the first call opens the viewer."""
        if self.viewer is None:
            from gym_mara.viewer.viewer import Viewer

            self.viewer = Viewer(self.simulation, self._options.rendering)
        self.viewer.show()

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"viewer": None}  # a copy opens its own viewer in reset()

    def save_state(self) -> dict[str, Any]:
        """A snapshot of the arm, the episode and the random generators; it can be pickled.

        It also has the step counts of Gymnasium's TimeLimit wrappers around this environment, but nothing else of the
        wrappers.
        """
        return self.simulation.save() | {
            "np_random": copy.deepcopy(self.np_random),
            "time_limits": self._time_limits.counts(),
        }

    def restore_state(self, snapshot: dict[str, Any]) -> None:
        """Restore a snapshot of an environment with the same arguments.

        Raises:
            GymMaraError: it is of another environment. Nothing has changed then.
        """
        self.simulation.check_snapshot(snapshot, self._snapshot_form())
        self.simulation.restore(snapshot)
        steps = int(self.simulation.statistics.steps[0])
        self._time_limits.restore(snapshot["time_limits"], steps)
        self.np_random = copy.deepcopy(snapshot["np_random"])
        self._spawned_from = self.np_random if self.simulation.streams else None

    def _snapshot_form(self) -> dict[str, Any]:
        """Examples of the values of a snapshot that are not the simulation's."""
        return {"np_random": np.random.Generator, "time_limits": list}

    def close(self) -> None:
        """Free the backend, the renderer and the viewer."""
        self._pictures.close()
        if self.viewer is not None:
            self.viewer.close()
            self.viewer = None
        self.simulation.close()


def checked_render_mode(render_mode: str | None, known: Sequence[str]) -> str | None:
    """Return the render mode if it is a known one.

    Raises:
        GymMaraError: it is unknown.
    """
    return None if render_mode is None else one_of("render_mode", render_mode, known)


def _info_of_one(values: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Convert the batch of one arm's infos to plain numbers, arrays and objects."""
    return {name: v.item() if v.ndim == 1 else v[0] for name, v in values.items()}
