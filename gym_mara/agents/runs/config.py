"""The configuration of a run: what may stand in it, and how it is read."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NoReturn

from gym_mara.agents.algorithms.base import Preset, plain_values
from gym_mara.agents.algorithms.registry import DEFAULT_PRESET
from gym_mara.backends import backend_names, simulated_backends
from gym_mara.errors import GymMaraError, short, unknown
from gym_mara.files import DamagedFileError, parsed_json, read_json
from gym_mara.rendering import RenderSettings
from gym_mara.robot.options import with_paths

MOST_STEPS = 10**12

# Arguments of the environments that are no options of a run, and where to give them.
_FIELDS = {
    "task": "it is the run's env",
    "backend": "the run names it itself",
    "num_envs": "the preset sets the number of arms",
    "max_episode_steps": "a run has episodes of their usual length",
    "autoreset_mode": "Stable-Baselines3 needs 'SameStep'",
    "self": "it is no argument",
}
_PICTURES = {"render_mode", *(setting.name for setting in dataclasses.fields(RenderSettings))}


class DamagedRunError(DamagedFileError):
    """A file of a run is missing or cannot be read."""


@dataclass(frozen=True)
class Start:
    """The policy of another run with which a run starts. It is read once: the run does not need the other folder later.

    Raises:
        GymMaraError: the number of steps is out of its range.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

    run: str
    """The folder of the other run."""
    policy: str
    """Which of its policies, "last" or "best"."""
    steps: int
    """How many steps the other run had trained."""

    def __post_init__(self) -> None:
        if not 0 <= self.steps <= 2 * MOST_STEPS:
            raise GymMaraError(f"the steps of the start are out of range: {short(self.steps)}")


@dataclass(frozen=True)
class RunConfig:
    """What a run trains. The same configuration with the same versions of the libraries gives the same run.

    Relative paths of a robot and of its packages are made absolute.

    Raises:
        GymMaraError: a value is out of its range, or is no option of a run.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

    env: str
    algo: str
    backend: str
    steps: int
    """Of all arms together; training ends with the update that reaches them."""
    seed: int
    checkpoint_every: int = 50_000
    """Steps between two checkpoints; each checkpoint is evaluated."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the environment, without `backend`."""
    preset_name: str = DEFAULT_PRESET
    preset: dict[str, Any] = field(default_factory=dict)
    """The values of the preset, so that a later change of the preset does not change the run."""
    start: Start | None = None
    """The policy with which the run starts; None for an untrained one."""

    def __post_init__(self) -> None:
        for name in ("steps", "checkpoint_every"):
            if not 1 <= getattr(self, name) <= MOST_STEPS:
                raise GymMaraError(
                    f"{name} must be at least 1 and at most {MOST_STEPS}, not {short(getattr(self, name))}"
                )
        if not 0 <= self.seed < 2**32:
            raise GymMaraError(
                f"seed must be a whole number from 0 to 2**32 - 1, not {short(self.seed)}"
            )
        check_options(self.env_options, pictures=False)
        options = with_paths(self.env_options, lambda path: str(Path(path).absolute()))
        plain_values("env_options", options)
        object.__setattr__(self, "env_options", options)

    def made_preset(self) -> Preset:
        """The preset of a run that was trained.

        Raises:
            GymMaraError: a value is missing, unknown or out of its range.
        """
        return parsed_json(json.dumps(self.preset), Preset, "the preset")


@dataclass(frozen=True)
class _ConfigFile(RunConfig):
    """A configuration as it is written."""

    versions: dict[str, str] = field(kw_only=True)

    def __post_init__(self) -> None:
        with_paths(self.env_options, _refuse_path)
        super().__post_init__()


def _refuse_path(path: str) -> NoReturn:
    raise GymMaraError(f"the paths of the robot must be absolute, not {path!r}")


def read_config(file: Path) -> RunConfig:
    """Read the configuration of a run.

    Raises:
        MissingFileError: there is no such file.
        DamagedFileError: a value is missing, unknown, of another type or out of range.
    """
    values = vars(read_json(file, _ConfigFile)).copy()
    del values["versions"]
    return RunConfig(**values)


def config_values(config: RunConfig, versions: dict[str, str]) -> dict[str, Any]:
    """The JSON values of a configuration."""
    return {**dataclasses.asdict(config), "versions": versions}


def check_backend(name: str) -> None:
    """Check that a run can be trained on a backend.

    Raises:
        GymMaraError: it is unknown, or it moves a real arm.
    """
    if name not in backend_names():
        raise unknown("backend", name, backend_names())
    if name not in simulated_backends():
        raise GymMaraError(
            f"no run can be trained on the backend {name!r}: a run needs arms that are evaluated beside those that learn, and "
            f"snapshots of them, and this is one arm in real time. Train on another backend ({', '.join(simulated_backends())}) and "
            "play the policy on the arm with gym-mara ros2 deploy RUN; or let Stable-Baselines3 itself learn on "
            "gym_mara/MARAReal-v0, one arm, as docs/ros2.md shows"
        )


def check_options(options: dict[str, Any], *, pictures: bool) -> None:
    """Check that the names of options can be options of a run; the environment checks the rest.

    Args:
        options: keyword arguments of an environment.
        pictures: whether the settings of pictures and of the viewer are allowed.

    Raises:
        GymMaraError: a name is none of them.
    """
    for name in options:
        if name in _FIELDS:
            raise GymMaraError(f"{name!r} cannot be an option of a run: {_FIELDS[name]}")
        if name in _PICTURES and not pictures:
            raise GymMaraError(
                f"{name!r} cannot be an option of a run: pictures and the viewer are set when a run is watched"
            )
