"""Pictures: the contract of the renderers, and the content of a picture."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import imageio.v3 as imageio
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from numpy.typing import NDArray
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecVideoRecorder

from gym_mara.agents.runs.evaluation import make_env
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.envs.view import view_of
from gym_mara.errors import GymMaraError, MissingExtraError
from gym_mara.rendering import CAMERAS, RENDERERS, RenderSettings
from gym_mara.rendering.camera import VIEW_ANGLE, place_camera
from gym_mara.rendering.scene import Scene
from gym_mara.testing import COLLIDING_Q
from tests.helpers import DEVICES, EVERY_BACKEND, TARGET_Q

Picture = NDArray[np.uint8]

STORED = Path(__file__).parents[1] / "data" / "pictures"
SMALL: dict[str, Any] = {"width": 320, "height": 240}
POSES = {"home": (0.0,) * 6, "target": TARGET_Q, "collision": COLLIDING_Q}


def picture(q: tuple[float, ...] = POSES["home"], **options: Any) -> Picture:
    """The picture of MARA after one step to q, rad."""
    env = MaraEnv(render_mode="rgb_array", **{**SMALL, **options})
    try:
        env.reset(seed=0)
        env.step(np.array(q, np.float32))
        return draw(env)
    finally:
        env.close()


def draw(env: MaraEnv) -> Picture:
    """The picture of an environment with render_mode="rgb_array"."""
    drawn = env.render()
    assert drawn is not None
    return drawn


def red(drawn: Picture) -> int:
    """The number of pixels with the red of a collision."""
    r, g, b = np.moveaxis(drawn.astype(int), -1, 0)
    return int(((r > 90) & (g < 0.4 * r) & (b < 0.4 * r)).sum())


@pytest.mark.parametrize("name", POSES)
def test_a_picture_matches_the_stored_one(renderer: str, name: str) -> None:
    drawn = picture(POSES[name], renderer=renderer)
    stored = imageio.imread(STORED / f"{name}_{renderer}.png")
    difference = np.abs(drawn.astype(int) - stored.astype(int))
    assert difference.mean() < 1.0
    assert (difference.max(axis=-1) > 40).mean() < 0.01


@pytest.mark.parametrize("name", POSES)
def test_the_renderers_draw_the_same_scene(name: str) -> None:
    vtk, raycast = (picture(POSES[name], renderer=r).astype(int) for r in ("vtk", "raycast"))
    assert (np.abs(vtk - raycast).max(axis=-1) > 40).mean() < 0.05


def test_a_picture_is_a_fresh_array_of_the_requested_size(renderer: str) -> None:
    env = MaraEnv(render_mode="rgb_array", width=161, height=99, renderer=renderer)
    env.reset()
    first = draw(env)
    kept = first.copy()
    env.step(np.array(TARGET_Q, np.float32))
    second = draw(env)
    for drawn in (first, second):
        assert drawn.shape == (99, 161, 3)
        assert drawn.dtype == np.uint8
    assert (first != second).any()
    np.testing.assert_array_equal(first, kept)
    env.close()


@pytest.mark.parametrize("backend", EVERY_BACKEND)
def test_colliding_links_are_red_until_the_next_step(renderer: str, backend: str) -> None:
    options = SMALL | DEVICES.get(backend, {})
    env = MaraEnv(render_mode="rgb_array", backend=backend, renderer=renderer, **options)
    env.reset(seed=0)
    counts, hits = [], []
    for step in range(90):
        q = COLLIDING_Q if step < 80 else POSES["home"]
        *_, info = env.step(np.array(q, np.float32))
        if info["collided"] or step >= 85:
            counts.append(red(draw(env)))
            hits.append(info["collided"])
        if info["collided"]:
            break
    assert hits[-1], "the arm did not collide"
    env.step(np.array(POSES["home"], np.float32))
    assert counts[-1] > 1000 + red(draw(env))
    env.reset()
    assert red(draw(env)) < 100, "only the x axes of target and tool are red"
    env.close()


def test_only_colliding_links_are_red() -> None:
    env = MaraEnv(render_mode="rgb_array")
    env.reset()
    env.step(np.array(COLLIDING_Q, np.float32))
    touching = view_of(env.simulation, 0).touching
    assert "table" in touching
    assert "base_robot" not in touching
    assert 2 <= len(touching) < 8
    env.close()


def project(point: NDArray[np.float64], env: MaraEnv) -> tuple[int, int]:
    """The row and column of the pixel that shows a point (3,), m, from the camera's pose and field of view."""
    settings = RenderSettings()
    camera = place_camera(Scene(env.simulation.robot), view_of(env.simulation, 0), settings)
    forwards = (camera.at - camera.eye) / np.linalg.norm(camera.at - camera.eye)
    right = np.cross(forwards, camera.up)
    right /= np.linalg.norm(right)
    up = np.cross(right, forwards)
    ray = point - camera.eye
    scale = settings.height / 2.0 / np.tan(np.radians(VIEW_ANGLE / 2.0)) / (ray @ forwards)
    row = (settings.height - 1) / 2.0 - scale * (ray @ up)
    return round(row), round((settings.width - 1) / 2.0 + scale * (ray @ right))


def test_the_target_is_drawn_as_a_frame_at_its_position(renderer: str) -> None:
    target = (-0.3, -0.2, 1.1)
    env = MaraEnv(
        render_mode="rgb_array",
        renderer=renderer,
        target_position=target,
        target_quaternion=(1.0, 0.0, 0.0, 0.0),
    )
    env.reset()
    drawn = draw(env)
    for axis in range(3):
        tip = np.array(target)
        tip[axis] += 0.1
        row, column = project(tip, env)
        colour = drawn[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0)
        assert colour.argmax() == axis, "x red, y green, z blue"
        assert colour[axis] > 1.3 * np.delete(colour, axis).max()
    env.close()


def test_each_camera_shows_the_arm_from_another_side(renderer: str) -> None:
    pictures = [picture(TARGET_Q, camera=camera, renderer=renderer) for camera in CAMERAS]
    for index, one in enumerate(pictures):
        dark = (one.max(axis=-1) < 60).sum()
        assert dark > 300, "the arm's black parts are visible"
        for other in pictures[index + 1 :]:
            assert (np.abs(one.astype(int) - other.astype(int)).max(axis=-1) > 40).mean() > 0.02


def test_a_camera_can_be_placed_anywhere(renderer: str) -> None:
    near = picture(renderer=renderer, camera=[[-0.6, -0.3, 1.6], [0.0, 0.0, 1.5]])
    assert (near.max(axis=-1) < 60).mean() > 0.01
    down = picture(renderer=renderer, camera=[[0.0, 0.0, 5.0], [0.0, 0.0, 0.0]])
    assert np.ptp(down) > 100


def test_two_environments_render_in_turn(renderer: str) -> None:
    alone = [picture(POSES[name], renderer=renderer) for name in ("home", "target")]
    envs = [MaraEnv(render_mode="rgb_array", renderer=renderer, **SMALL) for _ in alone]
    for env, name in zip(envs, ("home", "target"), strict=True):
        env.reset()
        env.step(np.array(POSES[name], np.float32))
    for _ in range(3):
        for env, expected in zip(envs, alone, strict=True):
            np.testing.assert_array_equal(env.render(), expected)
    for env in envs:
        env.close()


def test_drawing_does_not_change_the_simulation() -> None:
    def trajectory(render_mode: str | None) -> list[Any]:
        env = MaraEnv("MARACollisionOrient-v0", render_mode=render_mode, **SMALL)
        results: list[Any] = [env.reset(seed=3)[0]]
        rng = np.random.default_rng(0)
        for _ in range(10):
            observation, reward, *_ = env.step(rng.uniform(-2.0, 2.0, 6).astype(np.float32))
            results += [observation, reward]
            if render_mode:
                env.render()
        env.close()
        return results

    for plain, drawn in zip(trajectory(None), trajectory("rgb_array"), strict=True):
        np.testing.assert_array_equal(plain, drawn)


def test_a_vector_environment_draws_every_arm() -> None:
    envs = MaraVectorEnv(2, render_mode="rgb_array", autoreset_mode="SameStep", **SMALL)
    envs.reset(seed=0)
    envs.step(np.array([POSES["home"], TARGET_Q]))
    pictures = envs.render()
    assert pictures is not None
    np.testing.assert_array_equal(pictures[0], picture())
    np.testing.assert_array_equal(pictures[1], picture(TARGET_Q))
    envs.close()


def test_without_a_render_mode_nothing_is_drawn() -> None:
    env = gymnasium.make("gym_mara/MARA-v0")
    env.reset()
    with pytest.warns(UserWarning, match="render"):
        assert env.render() is None
    envs = MaraVectorEnv(2)
    envs.reset()
    assert envs.render() is None


def test_graphics_libraries_are_not_imported_before_the_first_picture() -> None:
    code = (
        "import sys, gymnasium, gym_mara\n"
        "env = gymnasium.make('gym_mara/MARA-v0', render_mode='rgb_array')\n"
        "env.reset(); env.step(env.action_space.sample())\n"
        "loaded = {'pyvista', 'vtkmodules', 'embreex', 'trimesh', 'viser', 'imageio'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("missing", "named"),
    [(["pyvista", "embreex"], "PyVista"), (["trimesh"], "trimesh")],
)
def test_without_any_renderer_the_error_names_the_extra(
    missing: list[str], named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in list(sys.modules):
        if module.startswith(("gym_mara.rendering.", *missing)):
            monkeypatch.delitem(sys.modules, module)
    for module in missing:
        monkeypatch.setitem(sys.modules, module, None)
    env = MaraEnv(render_mode="rgb_array")
    env.reset()
    with pytest.raises(MissingExtraError, match=rf"{named}.*gym_mara\[render\]"):
        env.render()
    env.close()


def test_without_opengl_the_raycast_renderer_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    code = (
        "import gymnasium, gym_mara, sys\n"
        "env = gymnasium.make('gym_mara/MARA-v0', render_mode='rgb_array', renderer={})\n"
        "env.reset(); picture = env.render()\n"
        "assert picture.shape == (480, 640, 3)\n"
        "assert 'gym_mara.rendering.raycast' in sys.modules\n"
    )
    # There is no EGL driver and no display, so VTK would crash the process.
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", "/nonexistent")
    monkeypatch.delenv("DISPLAY", raising=False)
    subprocess.run([sys.executable, "-c", code.format(None)], check=True)
    with_vtk = [sys.executable, "-c", code.format("'vtk'")]
    refused = subprocess.run(with_vtk, check=False, capture_output=True, text=True)
    assert refused.returncode == 1
    assert "OpenGL" in refused.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "width must be a whole number of at least 1"),
        ({"height": -3}, "height"),
        ({"width": 100_000}, "width must be at most 4096"),
        ({"height": 2.5}, "height"),
        ({"camera": "frnt"}, "Did you mean 'front'"),
        ({"camera": [[0, 0, 1], [0, 0]]}, "camera must be one of"),
        ({"camera": [[0, 0, 1], [0, 0, 1]]}, "camera must be one of"),
        ({"camera": [[0, 0, np.nan], [0, 0, 1]]}, "camera must be one of"),
        ({"renderer": "opengl"}, "unknown renderer"),
        ({"viewer_port": 70_000}, "viewer_port must be at most"),
        ({"render_mode": "ansi"}, "unknown render_mode"),
        ({"widht": 3}, "Did you mean 'width'"),
    ],
)
def test_invalid_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        MaraEnv(**options)
    if "render_mode" not in options:
        with pytest.raises(GymMaraError, match=message):
            MaraVectorEnv(2, **options)


def test_a_vector_environment_has_no_viewer() -> None:
    with pytest.raises(GymMaraError, match="render_mode"):
        MaraVectorEnv(2, render_mode="human")


# MoviePy and imageio's reader do not close their pipes.
ignore_video_warnings = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning",
    "ignore::ResourceWarning",
    "ignore::pytest.PytestUnraisableExceptionWarning",
)


def frames(folder: Path) -> NDArray[np.uint8]:
    """The pictures of the only video in a folder."""
    (video,) = folder.glob("*.mp4")
    return np.asarray(imageio.imread(video, plugin="FFMPEG"))


@ignore_video_warnings
def test_gymnasium_records_a_video(tmp_path: Path) -> None:
    env = RecordVideo(
        gymnasium.make("gym_mara/MARA-v0", render_mode="rgb_array", max_episode_steps=6, **SMALL),
        str(tmp_path / "videos"),
        disable_logger=True,
    )
    env.reset(seed=0)
    for _ in range(6):
        env.step(env.action_space.sample())
    env.close()  # type: ignore[no-untyped-call]
    assert frames(tmp_path / "videos").shape == (7, 240, 320, 3)


def native() -> VecEnv:
    return make_env("MARA-v0", "pinocchio", 2, {"render_mode": "rgb_array", **SMALL})


def in_processes() -> VecEnv:
    options = {"render_mode": "rgb_array", **SMALL}
    spawned = {"start_method": "spawn"}
    return make_vec_env(
        "gym_mara:gym_mara/MARA-v0",
        2,
        env_kwargs=options,
        vec_env_cls=SubprocVecEnv,
        vec_env_kwargs=spawned,
    )


@ignore_video_warnings
@pytest.mark.parametrize("make", [native, in_processes])
def test_stable_baselines_records_a_video(make: Any, tmp_path: Path) -> None:
    env = VecVideoRecorder(make(), str(tmp_path), lambda step: step == 0, video_length=4)
    env.reset()
    for _ in range(5):
        env.step(np.array([env.action_space.sample() for _ in range(2)]))
    env.close()
    assert frames(tmp_path).shape[1:] == (480, 320, 3), "the two pictures are stacked vertically"


def store() -> None:
    """Draw the stored pictures again and overwrite them."""
    for renderer in RENDERERS:
        for name, q in POSES.items():
            imageio.imwrite(STORED / f"{name}_{renderer}.png", picture(q, renderer=renderer))


if __name__ == "__main__":
    store()
