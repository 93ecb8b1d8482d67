"""The velocity with which joints travel where they are shown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gym_mara.envs import MaraEnv
from gym_mara.envs.travel import travel_velocity
from tests.helpers import joint_xml, urdf_xml, write


@pytest.mark.parametrize(
    ("options", "velocity"), [({}, 1.57), ({"max_joint_velocity": 1.0}, None)], ids=str
)
def test_teleporting_joints_are_shown_at_the_lowest_limit_of_the_robot(
    options: dict[str, Any], velocity: float | None
) -> None:
    env = MaraEnv(**options)
    assert travel_velocity(env.simulation) == velocity
    env.close()


def test_an_arm_without_velocity_limits_is_shown_as_it_moves(tmp_path: Path) -> None:
    path = write(tmp_path / "arm.urdf", urdf_xml(joint_xml(0, kind="continuous", limit="")))
    env = MaraEnv(robot=str(path), ee_frame="link1")
    assert travel_velocity(env.simulation) is None
    env.close()
