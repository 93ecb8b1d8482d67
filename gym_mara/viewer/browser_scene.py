"""The viewer's 3D scene in the browser."""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

import numpy as np
import pinocchio as pin
import viser

from gym_mara.rendering.camera import BACKGROUND, VIEW_ANGLE, Camera
from gym_mara.rendering.scene import Colour, Part, Scene
from gym_mara.rendering.view import View
from gym_mara.types import Floats
from gym_mara.viewer.gate import TARGET


class BrowserScene:
    """The parts of a scene as nodes of a viser server. Each link is a node with its parts as children.

    The target has a handle that the user can drag.

    Args:
        server: the viser server that shows the scene.
        scene: the parts to show.
        camera: the initial camera of a browser.
        view: the first view.
    """

    def __init__(self, server: viser.ViserServer, scene: Scene, camera: Camera, view: View) -> None:
        self._server, self._scene = server, scene
        server.scene.set_up_direction("+z")
        server.scene.configure_default_lights(cast_shadow=True)
        server.scene.set_background_image(np.full((1, 1, 3), _bytes(BACKGROUND), np.uint8))
        server.scene.add_grid(
            "/floor",
            width=4.0,
            height=4.0,
            position=camera.floor,
            cell_color=(210, 214, 218),
            section_color=(190, 195, 200),
            shadow_opacity=0.2,
        )
        initial = server.initial_camera
        initial.position, initial.look_at = tuple(camera.eye), tuple(camera.at)
        initial.fov = float(np.radians(VIEW_ANGLE))
        self.target = server.scene.add_transform_controls(
            TARGET,
            scale=0.2,
            depth_test=False,
            position=view.target_position,
            wxyz=view.target_quaternion,
        )
        self._nodes: dict[str, Any] = {TARGET: self.target}
        self._first_parts: dict[str, int] = {}
        self._meshes: list[Any] = []
        placements = scene.placements(view)
        for index, part in enumerate(scene.parts):
            name = _node(part)
            if name not in self._first_parts:
                # The node has the pose of its first part.
                self._first_parts[name] = index
                if name not in self._nodes:
                    self._nodes[name] = server.scene.add_frame(name, show_axes=False)
            node_pose = placements[self._first_parts[name]]
            wxyz, position = _pose(np.linalg.inv(node_pose) @ placements[index])
            self._meshes.append(
                server.scene.add_mesh_simple(
                    f"{name}/{index}",
                    part.vertices,
                    part.faces,
                    color=_bytes(part.colour),
                    side="double",
                    cast_shadow=not part.marker,
                    receive_shadow=not part.marker,
                    wxyz=wxyz,
                    position=position,
                )
            )
        self._colours = [part.colour for part in scene.parts]
        self.show(view)

    def show(self, view: View) -> None:
        """Move the links to their poses in a view, and colour them. The target stays: the user may be dragging it."""
        placements = self._scene.placements(view)
        with self._server.atomic():
            for name, first_part in self._first_parts.items():
                if name != TARGET:
                    node = self._nodes[name]
                    node.wxyz, node.position = _pose(placements[first_part])
            for index, colour in enumerate(self._scene.colours(view)):
                if colour != self._colours[index]:
                    self._meshes[index].color = _bytes(colour)
                    self._colours[index] = colour

    def move_target(self, view: View) -> None:
        """Move the target to its pose in a view."""
        with self._server.atomic():
            self.target.position, self.target.wxyz = view.target_position, view.target_quaternion


def _node(part: Part) -> str:
    """The name of the node that carries a part: TARGET, "/tool", or one of its own for each link.

    A slash in a link's name would make its node a child of another.
    """
    return f"/{part.link}" if part.marker else f"/links/{quote(part.link, safe='')}"


def _bytes(colour: Colour) -> tuple[int, int, int]:
    """A colour as integers from 0 to 255."""
    red, green, blue = (round(255 * value) for value in colour)
    return red, green, blue


def _pose(placement: Floats) -> tuple[Floats, Floats]:
    """The quaternion (4,), [w, x, y, z], and the position (3,) of a homogeneous matrix (4, 4)."""
    x, y, z, w = pin.Quaternion(placement[:3, :3]).coeffs()
    return np.array([w, x, y, z]), placement[:3, 3].copy()
