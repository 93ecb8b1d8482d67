"""An exported policy, played with onnxruntime."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gym_mara.deploy.about import ACTION, METADATA_KEY, PACE, About
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.files import DamagedFileError, read_bytes
from gym_mara.types import Floats

if TYPE_CHECKING:
    import onnxruntime

LARGEST = 2**26
"""The largest size of a policy's file, bytes."""


class OnnxPolicy:
    """A policy that `gym-mara export` has written. It needs NumPy and onnxruntime alone.

    It has the `predict` of Stable-Baselines3's policies. It runs in one thread: the network is so small that more would only
    wait for each other.

    Args:
        path: the file.

    Raises:
        DamagedFileError: the file is missing, is no ONNX model, or its metadata are missing or damaged.
        MissingExtraError: onnxruntime is not installed.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        # Here, because gym_mara exports policies also where onnxruntime is not installed.
        with needs("an exported policy", "deploy", "onnxruntime"):
            import onnxruntime

        file = Path(path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what is wrong is raised as well
        # From bytes, so that a model cannot name other files that are read with it.
        content = read_bytes(file, LARGEST)
        try:
            session = onnxruntime.InferenceSession(content, options, ["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no base class
            raise DamagedFileError(
                f"cannot read {str(file)!r}: onnxruntime does not take it for an ONNX model ({error})"
            ) from error
        try:
            text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
        except UnicodeDecodeError as error:
            raise DamagedFileError(
                f"cannot read {str(file)!r}: its metadata are not UTF-8 ({error})"
            ) from None
        if text is None:
            raise DamagedFileError(
                f"cannot read {str(file)!r}: it has no metadata of gym_mara; export the policy with gym-mara export"
            )
        try:
            self.about = About.from_json(text)
            _check_model(session, self.about)
        except GymMaraError as error:
            raise DamagedFileError(f"cannot read {str(file)!r}: {error}") from None
        self._session = session
        joints, action = self.about.robot.joints, self.about.action
        self._lower, self._upper = (
            np.array([getattr(joint, name) for joint in joints]) for name in ("lower", "upper")
        )
        self._travel = np.array([np.inf if j.travel is None else j.travel for j in joints])
        self._low, self._high, self._steps = map(np.array, (action.low, action.high, action.steps))

    def predict(
        self,
        observation: ArrayLike | dict[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Floats, None]:
        """The action (A,) or (N, A) for an observation (O,) or a batch (N, O) of the environment.

        Args:
            observation: as the environment returns it, not normalised: an array, or a dictionary of arrays. `about.observation`
                lists its parts.
            state, episode_start: not used; the policy has no memory.
            deterministic: must be true; an exported policy has no random actions.

        Raises:
            GymMaraError: the observation has another layout or is not finite, or a random action is asked for.
        """
        if not deterministic:
            raise GymMaraError("an exported policy has no random actions: leave out deterministic")
        sizes = self.about.inputs
        if len(sizes) == 1:
            arrays: dict[str, Any] = dict.fromkeys(sizes, observation)
        elif isinstance(observation, dict) and observation.keys() == sizes.keys():
            arrays = observation
        else:
            raise GymMaraError(
                f"the policy needs an observation that is a dictionary of {', '.join(sizes)}"
            )
        layout = f": {self.about.layout}"
        inputs = {
            name: _rows("the observation", arrays[name], size, layout)
            for name, size in sizes.items()
        }
        shapes = {array.shape[:-1] for array in inputs.values()}
        if len(shapes) > 1:
            raise GymMaraError(f"the entries of the observation have different lengths: {shapes}")
        rows = {name: np.atleast_2d(array) for name, array in inputs.items()}
        (actions,) = self._session.run([ACTION], rows)
        if not np.isfinite(actions).all():
            raise DamagedFileError("the policy's action is not finite: its weights are damaged")
        return actions if shapes.pop() else actions[0], None

    def targets(
        self,
        action: ArrayLike,
        q: ArrayLike,
        last_target: ArrayLike | None = None,
        pace: ArrayLike | None = None,
    ) -> Floats:
        """The joint targets (J,) or (N, J), rad (m), of an action (A,) or (N, A).

        Targets are within the joints' limits. They are also at most `travel` away from the joint, for a robot whose own
        controller does not limit the velocity; a robot with the servos of the training moves as it would without that.

        Args:
            action: from `predict`.
            q: the joint positions now (J,) or (N, J), rad (m).
            last_target: the last targets, needed for relative actions that start from them; at the start of an episode q.
            pace: the part `pace` of the observation (1,) or (N, 1), in [0, 1], needed if it has one: steps are multiplied by it.

        Raises:
            GymMaraError: an array has another shape or is not finite, the last targets or the pace are missing, or actions are
                cartesian.
        """
        about = self.about.action
        joints = len(self._lower)
        if about.mode == "cartesian":
            raise GymMaraError(
                "cartesian actions are twists of the end effector, action · about.action.steps: give them to a controller that "
                "follows twists"
            )
        here = start = _rows("q", q, joints)
        asked = np.clip(_rows("action", action, joints), self._low, self._high)
        if about.mode == "relative" and about.reference == "target":
            if last_target is None:
                raise GymMaraError(
                    "the actions start from the last targets: give last_target, at the start of an episode q"
                )
            start = _rows("last_target", last_target, joints)
        if len(shapes := {asked.shape, here.shape, start.shape}) > 1:
            raise GymMaraError(f"the arrays must be of equally many arms, not of shapes {shapes}")
        if about.mode == "relative":
            asked = start + asked * self._steps * self._pace(pace, here.shape)
        near = np.clip(asked, here - self._travel, here + self._travel)
        return np.clip(near, self._lower, self._upper)

    def _pace(self, pace: ArrayLike | None, shape: tuple[int, ...]) -> Floats:
        """The pace, for joint positions of a shape (J,) or (N, J)."""
        if all(part.name != PACE for part in self.about.observation):
            return np.ones(1)
        if pace is None:
            raise GymMaraError(
                f"steps are multiplied by the observation's part {PACE!r}: give it as {PACE}"
            )
        checked = np.clip(_rows(PACE, pace, 1), 0.0, 1.0)
        if checked.shape[:-1] != shape[:-1]:
            raise GymMaraError(
                f"{PACE} has shape {checked.shape}; it must have one row for each arm"
            )
        return checked

    def keywords(
        self, env: str | None = None, backend: str | None = None, **given: Any
    ) -> dict[str, Any]:
        """The keyword arguments of an environment in which the policy acts as in its training, for `gymnasium.make`.

        They are those of the training, the policy's actions and its control period. The folders of a robot of your own are not
        in the file: give `robot` and `package_dirs`.

        Args:
            env: the name of the environment; by default `about.env`. Another one, and another backend, gets those keyword
                arguments of the training that it knows.
            backend: by default that of the training, or "pinocchio", with a warning, where that does not work on this machine.
            **given: what replaces the keyword arguments of the training.

        Raises:
            GymMaraError: a name is unknown, or the environment of the training has no such keyword argument.
        """
        from gym_mara.deploy.environment import backend_of, keywords

        return keywords(self.about, env or self.about.env, backend or backend_of(self.about), given)

    def check(self, env: Any) -> None:
        """Check that the policy can act in an environment of gym_mara: single, vectorised or wrapped.

        Raises:
            GymMaraError: it is no such environment, or the robot, the observation, the actions or the control period are others.
        """
        simulation = getattr(getattr(env, "unwrapped", env), "simulation", None)
        if simulation is None:
            raise GymMaraError(f"an environment of gym_mara is needed, not {env!r}")
        from gym_mara.deploy.environment import check_fits

        check_fits(self.about, simulation)


def _check_model(session: onnxruntime.InferenceSession, about: About) -> None:
    """Raises GymMaraError if the model's inputs and outputs are not those of the metadata."""
    sizes = {**about.inputs, ACTION: len(about.action.low)}
    found = {v.name: v for v in (*session.get_inputs(), *session.get_outputs())}
    if found.keys() != sizes.keys() or any(
        (value.type, value.shape[1:]) != ("tensor(double)", [sizes[name]])
        for name, value in found.items()
    ):
        there = ", ".join(f"{name} {value.type} {value.shape}" for name, value in found.items())
        raise GymMaraError(f"the model has {there}, and its metadata want {sizes}")


def _rows(name: str, values: Any, size: int, layout: str = "") -> Floats:
    """Values as an array (size,) or (N, size).

    Raises:
        GymMaraError: they have another shape or are not finite.
    """
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise GymMaraError(f"{name} must be an array of numbers: {error}") from error
    if array.ndim not in (1, 2) or array.shape[-1] != size or not array.size:
        raise GymMaraError(
            f"{name} must have the shape ({size},) or (N, {size}), not {array.shape}{layout}"
        )
    if not np.isfinite(array).all():
        raise GymMaraError(f"{name} contains NaN or infinity")
    return array
