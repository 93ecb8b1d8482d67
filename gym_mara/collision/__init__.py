"""Collision checking: whether an arm collides at given configurations. One interface, several engines."""

from __future__ import annotations

from gym_mara.collision.base import CollisionChecker, NoChecker
from gym_mara.errors import GymMaraError, one_of, whole_number
from gym_mara.robot import RobotModel

__all__ = ["CollisionChecker", "make_checker"]


def make_checker(name: str, robot: RobotModel, threads: int = 1) -> CollisionChecker:
    """The checker of this name: "coal", "fcl", or "none", which finds no collision.

    Args:
        name: the engine.
        robot: the arm.
        threads: how many threads "coal" uses for a batch of configurations; 1 for the other engines.

    Raises:
        GymMaraError: the name is unknown, or the engine does not support this number of threads.
        MissingExtraError: the engine is not installed.
    """
    name = one_of("collision engine", name, ("coal", "fcl", "none"))
    threads = whole_number(
        "collision_threads", threads, at_most=256, reason="each thread has a copy of the robot"
    )
    if threads > 1 and name != "coal":
        raise GymMaraError(
            f"collision_threads must be 1 unless collision='coal'; not {threads} with {name!r}"
        )
    if name == "coal":
        from gym_mara.collision.coal import CoalChecker, ParallelCoalChecker

        return CoalChecker(robot) if threads == 1 else ParallelCoalChecker(robot, threads)
    if name == "fcl":
        from gym_mara.collision.fcl import FclChecker

        return FclChecker(robot)
    return NoChecker(robot)
