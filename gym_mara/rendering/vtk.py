"""The renderer "vtk": OpenGL on a GPU or in software, with or without a display."""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from gym_mara.extras import needs
from gym_mara.rendering.camera import (
    AMBIENT,
    BACKGROUND,
    FILL,
    FLOOR,
    KEY,
    SHADOW,
    SPECULAR,
    TO_KEY_LIGHT,
    VIEW_ANGLE,
    Camera,
    floor_colour,
    shaded,
)
from gym_mara.rendering.renderer import NoDisplayError, Picture, Renderer
from gym_mara.rendering.scene import Part, Scene
from gym_mara.rendering.settings import RenderSettings
from gym_mara.rendering.view import View
from gym_mara.types import Floats

with needs("the renderer 'vtk'", "render", "pyvista"):
    import pyvista
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkObject, vtkUnsignedCharArray
    from vtkmodules.vtkCommonDataModel import vtkPlane

with suppress(ImportError):
    # OpenGL in software (Mesa) and Triton, which comes with torch for CUDA, have an LLVM each. Where Triton's comes second, as at the
    # first optimiser that torch makes after a picture, the process crashes.
    importlib.import_module("triton")

_SAMPLES = 4
_idle: list[pyvista.Plotter] = []
"""The plotter of a renderer that was closed, for the next one. Mesa keeps 10 MB of address space of each window that is closed."""
_process: int | None = None
"""The process that has loaded OpenGL; a fork of it inherits this value."""
# Exits with 0 if VTK can draw. It runs in a process of its own, because VTK may crash where it finds no OpenGL.
_OPENGL_PROBE = """
import sys
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderWindow
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.SetSize(8, 8)
window.Render()
sys.exit(not window.SupportsOpenGL())
"""
_SHADOW_OFFSET = 0.0015
"""The height of a shadow above its receiver, which avoids z-fighting, m."""


class _Shadow(NamedTuple):
    """The shadow of a part on the floor or on the top of a box."""

    caster: int
    """The index of the part that casts the shadow."""
    receiver: int | None
    """The index of the part that the shadow falls on; None for the floor."""
    actor: Any
    """The shadow's VTK actor."""
    projection: Floats
    """The projection along the key light's direction onto the plane (4, 4)."""


class VtkRenderer(Renderer):
    """VTK's rasteriser. A shadow is a copy of its part, projected along the key light onto a horizontal plane."""

    def __init__(self, scene: Scene, camera: Camera, settings: RenderSettings, first: View) -> None:
        super().__init__(scene, camera, settings, first)
        global _process
        if _process not in (None, os.getpid()):
            raise NoDisplayError(
                "VTK has drawn before this process was forked, and a forked process cannot use the OpenGL of its parent: "
                "start processes with 'spawn' or 'forkserver', or choose renderer='raycast'"
            )
        if not _has_opengl():
            raise NoDisplayError(
                "VTK finds no OpenGL: install EGL or OSMesa (Debian: libegl1 with libgl1-mesa-dri, "
                "or libosmesa6), or choose renderer='raycast'"
            )
        _process = os.getpid()
        vtkObject.GlobalWarningDisplayOff()  # VTK warns of each display that it cannot open
        size = [self.width, self.height]
        self._plotter = _idle.pop() if _idle else _plotter()
        self._plotter.window_size = size
        self._meshes = [_polydata(part) for part in scene.parts]
        self._actors = [
            self._add_part(*pair) for pair in zip(scene.parts, self._meshes, strict=True)
        ]
        to_camera = camera.eye - camera.at
        # A horizontal surface in shadow receives the ambient light and the fill light.
        self._light_in_shadow = AMBIENT + FILL * max(0.0, to_camera[2] / np.linalg.norm(to_camera))
        self._shadows = self._add_shadows(scene.placements(first))
        self._add_floor()
        self._add_lights()
        self._place_camera()

    def _add_part(self, part: Part, mesh: pyvista.PolyData) -> Any:
        return self._plotter.add_mesh(
            mesh,
            color=part.colour,
            ambient=0.8 if part.marker else AMBIENT,
            diffuse=0.2 if part.marker else 1.0,
            specular=0.0 if part.marker else SPECULAR,
            specular_power=20.0,
            interpolation="phong",
            render=False,
        )

    def _add_shadows(self, placements: Floats) -> list[_Shadow]:
        """Add the shadows of all parts on the floor, and on the fixed boxes, such as a table, below them."""
        parts = self.scene.parts
        boxes = [_bounding_box(part, m) for part, m in zip(parts, placements, strict=True)]
        # The height of each receiver, m, and the index of its part; None for the floor.
        receivers: list[tuple[float, int | None]] = [(float(self.camera.floor[2]), None)]
        for index, (part, placement) in enumerate(zip(parts, placements, strict=True)):
            if part.fixed and _is_box(part, placement, boxes[index]):
                receivers.append((float(boxes[index][1, 2]), index))
        shadows = []
        for height, receiver in receivers:
            for caster, mesh in enumerate(self._meshes):
                if parts[caster].fixed and boxes[caster][0, 2] < height - 1e-6:
                    continue
                colour = shaded(FLOOR, SHADOW)
                actor = self._plotter.add_mesh(mesh, color=colour, lighting=False, render=False)
                if receiver is not None:
                    _clip(actor, boxes[receiver])
                shadows.append(
                    _Shadow(caster, receiver, actor, _projection(height + _SHADOW_OFFSET))
                )
        return shadows

    def _add_floor(self) -> None:
        """Add the floor, a disc that fades into the background."""
        radius = self.camera.floor_radius
        disc = pyvista.Disc(
            center=self.camera.floor, inner=0.0, outer=radius, normal=(0, 0, 1), r_res=24, c_res=64
        )
        distance = np.linalg.norm(disc.points[:, :2] - self.camera.floor[:2], axis=1)
        disc["colour"] = np.uint8(255.0 * floor_colour(distance / radius))
        self._plotter.add_mesh(disc, scalars="colour", rgb=True, lighting=False, render=False)

    def _add_lights(self) -> None:
        position = 100.0 * TO_KEY_LIGHT
        key = pyvista.Light(position=position, focal_point=(0, 0, 0), intensity=KEY)
        self._plotter.add_light(key)
        self._plotter.add_light(pyvista.Light(light_type="headlight", intensity=FILL))

    def _place_camera(self) -> None:
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
                shadow.actor.prop.color = shaded(colours[shadow.receiver], self._light_in_shadow)
        window = self._plotter.render_window
        self._plotter.renderer.ResetCameraClippingRange()
        window.Render()
        pixels = vtkUnsignedCharArray()
        window.GetPixelData(0, 0, self.width - 1, self.height - 1, 1, pixels, 0)
        rows = vtk_to_numpy(pixels).reshape(self.height, self.width, 3)
        return rows[::-1].copy()  # VTK's first row is the lowest

    def close(self) -> None:
        if _idle:
            self._plotter.close()
        else:
            self._plotter.clear()
            _idle.append(self._plotter)

    @classmethod
    def close_idle(cls) -> None:
        while _idle:
            _idle.pop().close()


def _plotter() -> pyvista.Plotter:
    """A plotter without lights and meshes."""
    plotter = pyvista.Plotter(off_screen=True, lighting="none")
    plotter.set_background(BACKGROUND)
    plotter.render_window.SetMultiSamples(_SAMPLES)
    return plotter


@functools.cache
def _has_opengl() -> bool:
    """Whether VTK can draw on this machine; a separate process tries it."""
    probe = subprocess.run([sys.executable, "-c", _OPENGL_PROBE], capture_output=True, check=False)
    return probe.returncode == 0


def _polydata(part: Part) -> pyvista.PolyData:
    mesh = pyvista.PolyData.from_regular_faces(part.vertices, part.faces)
    mesh.point_data.active_normals = part.normals
    return mesh


def _bounding_box(part: Part, placement: Floats) -> Floats:
    """The lowest and the highest corner (2, 3) of a part's axis-aligned bounding box, m, in the world frame."""
    points = part.placed(placement)
    return np.array([points.min(axis=0), points.max(axis=0)], np.float64)


def _is_box(part: Part, placement: Floats, box: Floats) -> bool:
    """Whether a part has the shape of its axis-aligned bounding box."""
    points = part.placed(placement)
    at_corner = np.isclose(points, box[0], atol=1e-5) | np.isclose(points, box[1], atol=1e-5)
    return bool(at_corner.all())


def _clip(actor: Any, box: Floats) -> None:
    """Clip an actor at the vertical sides of a box."""
    for axis in (0, 1):
        for corner, inwards in zip(box, (1.0, -1.0), strict=True):
            normal = [0.0, 0.0, 0.0]
            normal[axis] = inwards
            plane = vtkPlane()
            plane.SetOrigin(*corner)
            plane.SetNormal(*normal)
            actor.mapper.AddClippingPlane(plane)


def _projection(height: float) -> Floats:
    """The projection (4, 4) along the key light's direction onto the plane z = height, m."""
    matrix = np.eye(4)
    matrix[:2, 2] = -TO_KEY_LIGHT[:2] / TO_KEY_LIGHT[2]
    matrix[:2, 3] = height * TO_KEY_LIGHT[:2] / TO_KEY_LIGHT[2]
    matrix[2, 2:] = 0.0, height
    return matrix
