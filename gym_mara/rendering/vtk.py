"""Pictures by VTK, on a GPU or in software, with or without a display."""

from __future__ import annotations

import functools
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np

from gym_mara.extras import needs
from gym_mara.rendering.camera import (
    AMBIENT,
    BACKGROUND,
    FILL,
    FLOOR,
    KEY,
    SHADE,
    SHINE,
    TO_LAMP,
    VIEW_ANGLE,
    Camera,
    floor_colour,
    shaded,
)
from gym_mara.rendering.renderer import NoDisplayError, Picture, Renderer
from gym_mara.rendering.scene import Floats, Part, Scene
from gym_mara.rendering.settings import RenderSettings
from gym_mara.rendering.view import View

with needs("the renderer 'vtk'", "render", "pyvista"):
    import pyvista
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkObject, vtkUnsignedCharArray
    from vtkmodules.vtkCommonDataModel import vtkPlane

_SAMPLES = 4
# Draws nothing, and ends well where VTK could draw; where it cannot, VTK may take its process along.
_PROBE = """
import sys
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderWindow
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.SetSize(8, 8)
window.Render()
sys.exit(not window.SupportsOpenGL())
"""
_ABOVE = 0.0015
"""How high a shadow lies above what it falls on, m."""


class _Shadow(NamedTuple):
    """The shadow of a part on a horizontal plane."""

    caster: int
    """The number of the part."""
    receiver: int | None
    """The number of the part that it falls on; None for the floor."""
    actor: Any
    projection: Floats
    """Along the lamp's light onto the plane (4, 4)."""


class VtkRenderer(Renderer):
    """VTK's rasteriser, with shadows that are the parts themselves, flattened along the lamp's light."""

    def __init__(self, scene: Scene, camera: Camera, settings: RenderSettings, first: View) -> None:
        super().__init__(scene, camera, settings, first)
        if not _has_opengl():
            raise NoDisplayError(
                "VTK finds no OpenGL to draw with: install EGL or OSMesa (Debian: libegl1 with libgl1-mesa-dri, "
                "or libosmesa6), or choose renderer='raycast'"
            )
        vtkObject.GlobalWarningDisplayOff()  # it warns of every display that it tries and that is not there
        size = [self.width, self.height]
        self._plotter = pyvista.Plotter(off_screen=True, window_size=size, lighting="none")
        self._plotter.set_background(BACKGROUND)
        self._plotter.render_window.SetMultiSamples(_SAMPLES)
        self._meshes = [_polydata(part) for part in scene.parts]
        self._actors = [self._add_part(*of) for of in zip(scene.parts, self._meshes, strict=True)]
        towards = camera.eye - camera.at
        self._left_in_shadow = AMBIENT + FILL * max(0.0, towards[2] / np.linalg.norm(towards))
        self._shadows = self._add_shadows(scene.placements(first))
        self._add_floor()
        self._light()

    def _add_part(self, part: Part, mesh: pyvista.PolyData) -> Any:
        return self._plotter.add_mesh(
            mesh,
            color=part.colour,
            ambient=0.8 if part.marker else AMBIENT,
            diffuse=0.2 if part.marker else 1.0,
            specular=0.0 if part.marker else SHINE,
            specular_power=20.0,
            interpolation="phong",
            render=False,
        )

    def _add_shadows(self, placements: Floats) -> list[_Shadow]:
        """Let everything cast its shadow on the floor, and on the boxes below it that stay where they are."""
        parts = self.scene.parts
        boxes = [_box_around(part, m) for part, m in zip(parts, placements, strict=True)]
        # What shadows fall on: its height, and the number of the box.
        receivers: list[tuple[float, int | None]] = [(float(self.camera.floor[2]), None)]
        for index, (part, placement) in enumerate(zip(parts, placements, strict=True)):
            if part.fixed and _fills(part, placement, boxes[index]):
                receivers.append((float(boxes[index][1, 2]), index))
        shadows = []
        for height, receiver in receivers:
            for caster, mesh in enumerate(self._meshes):
                if parts[caster].fixed and boxes[caster][0, 2] < height - 1e-6:
                    continue
                colour = shaded(FLOOR, SHADE)
                actor = self._plotter.add_mesh(mesh, color=colour, lighting=False, render=False)
                if receiver is not None:
                    _clip(actor, boxes[receiver])
                shadows.append(_Shadow(caster, receiver, actor, _projection(height + _ABOVE)))
        return shadows

    def _add_floor(self) -> None:
        """A disc that fades into the background."""
        radius = self.camera.floor_radius
        disc = pyvista.Disc(
            center=self.camera.floor, inner=0.0, outer=radius, normal=(0, 0, 1), r_res=24, c_res=64
        )
        away = np.linalg.norm(disc.points[:, :2] - self.camera.floor[:2], axis=1)
        disc["colour"] = np.uint8(255.0 * floor_colour(away / radius))
        self._plotter.add_mesh(disc, scalars="colour", rgb=True, lighting=False, render=False)

    def _light(self) -> None:
        lamp = pyvista.Light(position=100.0 * TO_LAMP, focal_point=(0, 0, 0), intensity=KEY)
        self._plotter.add_light(lamp)
        self._plotter.add_light(pyvista.Light(light_type="headlight", intensity=FILL))
        camera = self._plotter.camera
        camera.position, camera.focal_point, camera.up = (
            self.camera.eye,
            self.camera.at,
            self.camera.up,
        )
        camera.view_angle = VIEW_ANGLE
        self._plotter.renderer.ResetCameraClippingRange()
        self._plotter.renderer.camera_set = True

    def render(self, view: View) -> Picture:
        placements, colours = self.scene.placements(view), self.scene.colours(view)
        for actor, placement, colour in zip(self._actors, placements, colours, strict=True):
            actor.user_matrix = placement
            actor.prop.color = colour
        for shadow in self._shadows:
            shadow.actor.user_matrix = shadow.projection @ placements[shadow.caster]
            if shadow.receiver is not None:
                shadow.actor.prop.color = shaded(colours[shadow.receiver], self._left_in_shadow)
        window = self._plotter.render_window
        self._plotter.renderer.ResetCameraClippingRange()
        window.Render()
        pixels = vtkUnsignedCharArray()
        window.GetPixelData(0, 0, self.width - 1, self.height - 1, 1, pixels, 0)
        rows = vtk_to_numpy(pixels).reshape(self.height, self.width, 3)
        return rows[::-1].copy()  # VTK's first row is the lowest

    def close(self) -> None:
        self._plotter.close()


@functools.cache
def _has_opengl() -> bool:
    """Whether VTK can draw on this machine, tried in a process of its own."""
    probe = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, check=False)
    return probe.returncode == 0


def _polydata(part: Part) -> pyvista.PolyData:
    mesh = pyvista.PolyData.from_regular_faces(part.vertices, part.faces)
    mesh.point_data.active_normals = part.normals
    return mesh


def _box_around(part: Part, placement: Floats) -> Floats:
    """The lowest and the highest corner (2, 3) of the upright box around a part, m, in the world frame."""
    points = part.placed(placement)
    return np.array([points.min(axis=0), points.max(axis=0)], np.float64)


def _fills(part: Part, placement: Floats, box: Floats) -> bool:
    """Whether a part is the upright box around it."""
    points = part.placed(placement)
    at_corner = np.isclose(points, box[0], atol=1e-5) | np.isclose(points, box[1], atol=1e-5)
    return bool(at_corner.all())


def _clip(actor: Any, box: Floats) -> None:
    """Cut off what of an actor lies beyond the sides of a box."""
    for axis in (0, 1):
        for corner, inwards in zip(box, (1.0, -1.0), strict=True):
            normal = [0.0, 0.0, 0.0]
            normal[axis] = inwards
            plane = vtkPlane()
            plane.SetOrigin(*corner)
            plane.SetNormal(*normal)
            actor.mapper.AddClippingPlane(plane)


def _projection(height: float) -> Floats:
    """Along the lamp's light onto the plane z = height, m; a matrix (4, 4)."""
    matrix = np.eye(4)
    matrix[:2, 2] = -TO_LAMP[:2] / TO_LAMP[2]
    matrix[:2, 3] = height * TO_LAMP[:2] / TO_LAMP[2]
    matrix[2, 2:] = 0.0, height
    return matrix
