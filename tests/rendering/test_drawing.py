"""Pictures in threads, in forked processes, and of environments that nobody closes."""

from __future__ import annotations

import gc
import subprocess
import sys
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import psutil
import pytest
from numpy.typing import NDArray

from gym_mara.envs import MaraEnv
from gym_mara.rendering import Pictures, RenderSettings
from gym_mara.rendering.drawing import drawing_thread
from gym_mara.rendering.renderer import NoDisplayError
from gym_mara.rendering.view import View
from gym_mara.testing import COPIES
from tests.helpers import TARGET_Q, joint_xml, robot_model, urdf_xml, write

SMALL: dict[str, Any] = {"width": 160, "height": 120}
# Newer versions of Python warn of a fork in a process with threads.
forks = pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")


def drawable(renderer: str | None, **options: Any) -> MaraEnv:
    """An environment with small pictures, at the start of an episode."""
    env = MaraEnv(render_mode="rgb_array", renderer=renderer, **{**SMALL, **options})
    env.reset(seed=0)
    return env


def draw(env: MaraEnv) -> NDArray[np.uint8]:
    """The picture of an environment."""
    picture = env.render()
    assert picture is not None
    return picture


def test_another_thread_draws_the_same_picture(renderer: str) -> None:
    env, other = drawable(renderer), drawable(renderer)
    with ThreadPoolExecutor(1) as pool:
        first = draw(env)
        np.testing.assert_array_equal(pool.submit(draw, env).result(), first)
        env.step(np.array(TARGET_Q, np.float32))
        moved = pool.submit(draw, env).result()
        assert (moved != first).any()
        np.testing.assert_array_equal(draw(env), moved)
        np.testing.assert_array_equal(pool.submit(draw, other).result(), first)
        pool.submit(other.close).result()
    env.close()


def test_many_threads_draw_at_once(renderer: str) -> None:
    env = drawable(renderer)
    expected = draw(env)
    with ThreadPoolExecutor(4) as pool:
        for picture in pool.map(draw, [env] * 12):
            np.testing.assert_array_equal(picture, expected)
    env.close()


def test_two_threads_draw_the_first_picture_of_a_process(renderer: str) -> None:
    code = (
        "import gymnasium, numpy as np, gym_mara\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        f"options = dict(render_mode='rgb_array', renderer={renderer!r}, width=64, height=48)\n"
        "envs = [gymnasium.make('gym_mara/MARA-v0', **options) for _ in range(2)]\n"
        "for env in envs: env.reset(seed=0)\n"
        "with ThreadPoolExecutor(2) as pool: one, two = pool.map(lambda env: env.render(), envs)\n"
        "np.testing.assert_array_equal(one, two)\n"
        "assert np.ptp(one) > 100\n"
    )
    # The renderers are still alive when this process exits.
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_the_llvm_of_torch_is_loaded_before_that_of_opengl(tmp_path: Path) -> None:
    """The other way round a process with torch for CUDA crashes; here a module stands in for Triton."""
    (tmp_path / "triton.py").write_text(
        "import sys; print('vtkmodules.vtkRenderingOpenGL2' in sys.modules)"
    )
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import gym_mara.rendering.vtk"
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60
    )
    assert done.stdout == "False\n"


@pytest.mark.parametrize("copy", COPIES)
def test_a_copy_draws_with_a_renderer_of_its_own(renderer: str, copy: Any) -> None:
    before = drawing_thread().live_renderers
    env = drawable(renderer)
    expected = draw(env)
    copied = copy(env)
    np.testing.assert_array_equal(draw(copied), expected)
    assert drawing_thread().live_renderers == before + 2
    copied.close()
    assert drawing_thread().live_renderers == before + 1
    np.testing.assert_array_equal(draw(env), expected)
    env.close()


def asynchronous(**options: Any) -> Any:
    """Two environments in forked processes."""
    return gymnasium.make_vec(
        "gym_mara/MARA-v0",
        2,
        "async",
        vector_kwargs={"context": "fork"},
        render_mode="rgb_array",
        **{**SMALL, **options},
    )


@forks
def test_forked_processes_draw_by_ray_casting_after_their_parent_has_drawn(renderer: str) -> None:
    here, cast = drawable(renderer), drawable("raycast")
    draw(here)
    for chosen in ("raycast", None) if renderer == "vtk" else ("raycast",):
        envs = asynchronous(renderer=chosen)
        envs.reset(seed=0)
        for picture in envs.render():
            np.testing.assert_array_equal(picture, draw(cast))
        envs.close()
    here.close()
    cast.close()


def test_embree_has_no_threads_whose_locks_a_fork_could_copy() -> None:
    code = (
        "import os\n"
        "from gym_mara.envs import MaraEnv\n"
        "env = MaraEnv(render_mode='rgb_array', renderer='raycast', width=64, height=48)\n"
        "env.reset(seed=0)\n"
        "before = len(os.listdir('/proc/self/task'))\n"
        "env.render()\n"
        "print(len(os.listdir('/proc/self/task')) - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60
    )
    assert done.stdout == "1\n"  # the drawing thread


@forks
def test_a_forked_process_cannot_use_the_opengl_of_its_parent() -> None:
    env = drawable("vtk")
    draw(env)
    env.close()
    with (
        ProcessPoolExecutor(1, get_context("fork")) as pool,
        pytest.raises(NoDisplayError, match=r"forked.*'spawn'.*renderer='raycast'"),
    ):
        pool.submit(draw_in_vtk).result()


def draw_in_vtk() -> None:
    """Draw a picture in a new environment."""
    draw(drawable("vtk"))


def test_pictures_are_freed_also_during_the_first_import_of_the_drawing_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    module = ModuleType("gym_mara.rendering.drawing")  # as it is before its first line
    monkeypatch.setitem(sys.modules, "gym_mara.rendering.drawing", module)
    first = View(np.zeros(6), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    Pictures(robot_model("mara"), RenderSettings(), first).close()


def test_environments_that_are_dropped_without_close_leave_no_renderer(
    renderer: str, tmp_path: Path
) -> None:
    arm = {"robot": str(write(tmp_path / "arm.urdf", urdf_xml(joint_xml(0)))), "ee_frame": "link1"}
    draw(drawable(renderer, **arm))
    gc.collect()
    drawing, threads = drawing_thread(), threading.active_count()
    drawing.free(-1, wait=True)  # what was dropped before is freed by now
    before = drawing.live_renderers
    space = psutil.Process().memory_info().vms
    for _ in range(20):
        draw(drawable(renderer, **arm))
    gc.collect()
    drawing.free(-1, wait=True)
    assert drawing.live_renderers == before
    assert threading.active_count() == threads
    assert (
        psutil.Process().memory_info().vms - space < 100e6
    )  # each window of OpenGL in software takes 10 MB for ever


def test_a_picture_is_the_same_after_those_of_other_scenes_and_sizes(renderer: str) -> None:
    def drawn(**options: Any) -> NDArray[np.uint8]:
        env = drawable(renderer, **options)
        picture = draw(env)
        env.close()
        return picture

    first, larger = drawn(), drawn(width=200)
    drawn(robot="ur5", width=100)
    np.testing.assert_array_equal(drawn(), first)
    np.testing.assert_array_equal(drawn(width=200), larger)
