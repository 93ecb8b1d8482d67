"""The figures of a report: what they show is within their axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gym_mara.agents.inspection.report_figures import Episode, joints, path, torques
from gym_mara.robot import RobotModel
from tests.agents.evaluation.conftest import trajectory
from tests.helpers import Floats
from tests.robot.arms import arm, arm_file

STEPS = 40
PLOTLY_SPREAD = 2.5
"""Plotly rounds the distance of two ticks up to 1, 2, 5 or 10: at most 2.5 times as far as `nticks` asks for."""


def episode(backend: str, tool: Floats) -> Episode:
    """An episode of one arm whose tool takes this path (T, 3), m."""
    return Episode(backend, trajectory(tool=tool[:, None]))


@pytest.mark.parametrize("length", [0.0, 1e-4, 0.3, 2.0])
def test_the_whole_path_and_the_target_are_within_axes_with_ticks(length: float) -> None:
    along = np.linspace([0.0, 0.0, 0.5], [0.0, length, 0.5], STEPS)
    across = np.linspace([0.0, 0.0, 0.5], [-0.1 * length, 0.0, 0.5], STEPS)
    target = np.array([0.2 * length, 0.1 * length, 0.5])
    scene = path([episode("pinocchio", along), episode("dart", across)], target).layout.scene
    shown = np.vstack([along, across, target])
    lengths = []
    for name, values in zip("xyz", shown.T, strict=True):
        axis = scene[f"{name}axis"]
        low, high = axis.range
        lengths.append(high - low)
        margin = 0.05 * (high - low)
        assert low + margin <= values.min()
        assert values.max() <= high - margin
        assert axis.nticks / PLOTLY_SPREAD >= 3.0, "at least three ticks"
    assert scene.aspectmode == "cube"
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-9, err_msg="one scale for all axes")
    assert 0.01 <= lengths[0] <= max(0.02, 1.5 * length)


@pytest.mark.parametrize(
    ("sliding", "positions", "efforts"),
    [
        ((), ["rad", None, None], ["Nm", None, None]),
        (("j1", "j2", "j3"), ["m", None, None], ["N", None, None]),
        (("j2",), ["rad", "m", "rad"], ["Nm", "N", "Nm"]),
    ],
)
def test_joints_that_slide_have_their_own_units(
    tmp_path: Path, sliding: tuple[str, ...], positions: list[str], efforts: list[str]
) -> None:
    text = arm()
    for name in sliding:
        text = text.replace(f'name="{name}" type="revolute"', f'name="{name}" type="prismatic"')
    robot = RobotModel.load(str(arm_file(tmp_path, text)), ee_frame="tool")
    zeros = np.zeros((STEPS, 1, 3))
    of_joints = dict.fromkeys(("q", "qd", "torque", "action"), zeros)
    limits = {"velocity_limit": robot.velocity_limit, "effort_limit": robot.effort_limit}
    one = [Episode("dart", trajectory(tool=zeros, start=zeros[0], **of_joints, **limits))]
    for figure, units in ((joints(one, robot), positions), (torques(one, robot), efforts)):
        assert figure is not None
        axes = figure.layout.yaxis, figure.layout.yaxis2, figure.layout.yaxis3
        assert [axis.title.text for axis in axes] == units
