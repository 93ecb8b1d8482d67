"""What the actions of an environment mean: joint targets, steps of the joints, or a twist of the tool."""

from __future__ import annotations

from gym_mara.backends import Backend
from gym_mara.envs.actions.base import AbsoluteActions, Actions
from gym_mara.envs.actions.settings import ACTIONS, REFERENCES, ActionSettings
from gym_mara.envs.actions.steps import CartesianActions, RelativeActions
from gym_mara.errors import one_of
from gym_mara.robot import RobotModel

__all__ = [
    "ACTIONS",
    "REFERENCES",
    "AbsoluteActions",
    "ActionSettings",
    "Actions",
    "CartesianActions",
    "RelativeActions",
    "make_actions",
]

_MODES: dict[str, type[Actions]] = {
    mode.mode: mode for mode in (AbsoluteActions, RelativeActions, CartesianActions)
}


def make_actions(
    settings: ActionSettings, default: str, robot: RobotModel, backend: Backend
) -> Actions:
    """The actions of a backend's arms.

    Args:
        settings: the mode and its scale.
        default: the mode if the settings have none: that of the task.
        robot: the arm.
        backend: it moves the arms.

    Raises:
        GymMaraError: the task's mode is unknown, or a setting does not fit the mode or the robot.
    """
    mode = settings.action
    if mode is None:
        mode = one_of("default_action of the task", default, ACTIONS)
    return _MODES[mode](settings, robot, backend)
