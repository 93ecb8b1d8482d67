"""Identification: the parameters of a backend that follows the log of a moving arm best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gym_mara.identification.following import Followers
from gym_mara.identification.identified import Identified
from gym_mara.identification.log import Log
from gym_mara.identification.parameters import DEFAULT, Space
from gym_mara.identification.retries import leave_out_unreached, retry
from gym_mara.identification.search import Search
from gym_mara.identification.start import SEGMENT, start
from gym_mara.identification.uncertainty import estimates
from gym_mara.robot import RobotModel

_RETRIES = 3
"""How often the search continues at most from other effort limits and frictions."""


def identify(
    log: Log,
    robot: RobotModel,
    backend: str,
    parameters: Sequence[str] = DEFAULT,
    **settings: Any,
) -> Identified:
    """Find the parameters with which a backend follows a log best.

    Only joints that were told to move have parameters. Servos are ideal up to their effort limit: friction and masses show
    only while a motor is at its limit, and there (effort limits, friction, masses) and their multiples move the arm alike. So
    masses can be identified only without effort limits; with both, the result says that only ratios show. The arms follow in a
    process for each core.

    Args:
        log: what happened. The arm touched nothing.
        robot: the arm.
        backend: a backend with dynamics and position servos: "dart" or "mujoco".
        parameters: names of `PRIORS`.
        **settings: keyword arguments of the backend.

    Raises:
        GymMaraError: the log is of another arm or does not move, a name or a setting is wrong.
        MissingExtraError: the engine is not installed.
    """
    log.require(robot.joint_names, robot.name)
    space = Space(robot, parameters, log.moving)
    followers = Followers(log, robot, backend, space, settings)
    try:
        before = followers.errors(space.nominal[None])[0]
        search = Search(space, followers, start(log, space, followers))
        search.descend(SEGMENT, 15, rough=True)
        retry(search)
        leave_out_unreached(search)
        search.descend(math.inf, 8)
        for number in range(_RETRIES):
            better = retry(search, near=True, unreached=number == 0)
            leave_out_unreached(search)
            search.descend(math.inf, 10)  # each joint now counts by its own noise
            if not better:
                break
        search.measure()
        found = estimates(search, log)
    finally:
        followers.close()
    names = robot.joint_names
    return Identified(
        robot=robot.name,
        backend=backend,
        settings={**settings, "control_period": log.control_period},
        duration=log.duration,
        error=dict(zip(names, search.deviation.tolist(), strict=True)),
        error_before=dict(zip(names, np.sqrt((before**2).mean(axis=0)).tolist(), strict=True)),
        estimates=found,
    )
