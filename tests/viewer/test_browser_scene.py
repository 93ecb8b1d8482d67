"""The viewer's scene: each part is where the arm has it, whatever its links are called."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pinocchio as pin
import pytest

from gym_mara.rendering import RenderSettings
from gym_mara.rendering.camera import place_camera
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.view import View
from gym_mara.robot import RobotModel
from gym_mara.types import Floats
from gym_mara.viewer.browser_scene import BrowserScene
from tests.robot import arms

NAMES = {"base": "floor", "l1": "target", "l2": "target/1", "l3": "tool", "lf": "links"}
"""Names of links that the scene has nodes for, too, and one that looks like the child of another."""


class Nodes(dict[str, Any]):
    """The nodes of a server, by their names, as viser has them: a node's pose is relative to those whose names begin its own."""

    def __init__(self) -> None:
        self.server = mock.MagicMock()
        for kind in ("grid", "frame", "mesh_simple", "transform_controls"):
            getattr(self.server.scene, f"add_{kind}").side_effect = self._add

    def _add(self, name: str, *shape: Any, **options: Any) -> Any:
        assert name not in self, "it would replace the other one"
        pose = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 0.0)}
        self[name] = SimpleNamespace(vertices=shape[0] if shape else None, **{**pose, **options})
        return self[name]

    def placed(self, vertices: Any) -> Floats:
        """The pose (4, 4) in the world of the mesh with these vertices."""
        [name] = [name for name, node in self.items() if node.vertices is vertices]
        pose, steps = np.eye(4), name.split("/")
        for depth in range(2, len(steps) + 1):
            if node := self.get("/".join(steps[:depth])):
                rotation = pin.Quaternion(*node.wxyz).matrix()
                pose = pose @ pin.SE3(rotation, np.array(node.position)).homogeneous
        return pose


@pytest.mark.parametrize("names", [{}, NAMES], ids=["usual", "of nodes"])
def test_each_part_is_drawn_where_the_arm_has_it(tmp_path: Path, names: dict[str, str]) -> None:
    text = arms.arm(more=arms.FOLLOWER).replace('link="tool"', 'link="hand"')
    text = text.replace('name="tool"', 'name="hand"')
    for old, new in names.items():
        text = text.replace(f'link="{old}"', f'link="{new}"')
        text = text.replace(f'link name="{old}"', f'link name="{new}"')
    robot = RobotModel.load(arms.arm_file(tmp_path, text), "hand")
    scene, nodes = Scene(robot), Nodes()
    target = np.array([0.4, 0.1, 0.5]), np.array([0.8, 0.6, 0.0, 0.0])
    first, later = (View(np.array(q), *target, frozenset()) for q in (robot.home, [0.5, 0.7, -1.0]))
    camera = place_camera(scene, first, RenderSettings())
    shown = BrowserScene(nodes.server, scene, camera, first)
    assert {names.get("l1", "l1"), names.get("lf", "lf")} < {part.link for part in scene.parts}
    for view in (first, later):
        shown.show(view)
        for part, placement in zip(scene.parts, scene.placements(view), strict=True):
            np.testing.assert_allclose(nodes.placed(part.vertices), placement, atol=1e-6)
    assert shown.target is nodes["/target"]
    assert nodes["/floor"].width > 1.0
