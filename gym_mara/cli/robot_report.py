"""What gym-mara robot knows of an arm, as plain data: the tables and the JSON are made of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np

from gym_mara.backends import make_backend
from gym_mara.backends.registry import backend_class
from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.diagnosis.bodies import body_name
from gym_mara.robot.diagnosis.sampling import random_configurations
from gym_mara.robot.kinematics import motion_axis
from gym_mara.tasks import ReachTask

_POSES = 4096
"""The number of random poses of which the reach is the farthest."""


def report(robot: RobotModel, backends: list[str]) -> dict[str, Any]:
    """What is known of an arm: of its description, and of what works on these backends."""
    goal = ReachTask().goal(robot, RobotWorkspace(robot), 1)
    return {
        "robot": robot.name,
        "urdf": str(robot.urdf),
        "srdf": str(robot.srdf) if robot.srdf else None,
        "ee_frame": robot.ee_frame,
        "findings": [asdict(finding) for finding in robot.findings],
        "joints": [_joint(robot, number) for number in range(robot.num_joints)],
        "home": robot.home.tolist(),
        "reach": _reach(robot),
        "default_target": {
            "position": goal.position[0].tolist(),
            "quaternion": goal.quaternion[0].tolist(),
        },
        "pairs": {
            "checked": sorted(sorted(pair) for pair in robot.collision_pairs),
            "excluded": [
                {"links": sorted(pair), "why": why}
                for pair, why in sorted(
                    robot.excluded_pairs.items(), key=lambda item: sorted(item[0])
                )
            ],
            "count": {"checked": len(robot.collision_pairs)}
            | Counter(robot.excluded_pairs.values()),
        },
        "backends": {name: _problem(robot, name) for name in backends},
    }


def _joint(robot: RobotModel, number: int) -> dict[str, Any]:
    """A joint of the chain, and the body that it moves."""
    linear, angular = np.split(motion_axis(robot.model.joints[number + 1]), 2)
    inertia = robot.model.inertias[number + 1]
    return {
        "name": robot.joint_names[number],
        "type": "revolute" if angular.any() else "prismatic",
        "axis": (angular if angular.any() else linear).tolist(),
        "lower": float(robot.lower[number]),
        "upper": float(robot.upper[number]),
        "velocity": float(robot.velocity_limit[number]),
        "effort": float(robot.effort_limit[number]),
        "link": body_name(robot, number + 1),
        "mass": float(inertia.mass),
    }


def _reach(robot: RobotModel) -> float:
    """How far from the first joint's origin the tool was in random poses, m."""
    q = random_configurations(robot, _POSES)
    position, _ = robot.kinematics().pose(np.vstack([q, robot.home]))
    return float(
        np.linalg.norm(position - robot.model.jointPlacements[1].translation, axis=1).max()
    )


def _problem(robot: RobotModel, name: str) -> str | None:
    """Why a backend cannot simulate an arm; None if it took a step."""
    dynamic = backend_class(name).dynamic
    errors = [f for f in robot.findings if f.severity == "error" and (dynamic or not f.dynamics)]
    if errors:
        return "; ".join(finding.message for finding in errors)
    try:
        backend = make_backend(name, robot, 1, {})
        backend.reset(robot.home[None])
        backend.step(robot.home[None])
        backend.close()
    except GymMaraError as error:
        return str(error)
    return None
