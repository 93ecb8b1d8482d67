"""The drawing thread: one thread of a process makes all renderers, draws all pictures, and frees the renderers.

An OpenGL context belongs to the thread that made it, so in another thread VTK draws black pictures. Renderers share
libraries that are not thread-safe, too. The handover costs about 50 µs per picture.
"""

from __future__ import annotations

import atexit
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any

from gym_mara.rendering.renderer import NoDisplayError, Picture, Renderer
from gym_mara.rendering.view import View

_EXIT_TIME = 5.0
"""The time to free the renderers when Python exits, s."""

_Request = tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]


class DrawingThread:
    """Owns the renderers of a process. Each has a key, which is chosen by its user."""

    def __init__(self) -> None:
        self._renderers: dict[int, Renderer] = {}
        # A SimpleQueue, because the garbage collector may call `free` at any moment, also in `put` of this thread.
        self._requests: SimpleQueue[_Request | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._serve, name="gym_mara drawing", daemon=True)
        self._thread.start()

    @property
    def live_renderers(self) -> int:
        """The number of renderers that are not freed."""
        return len(self._renderers)

    def draw(self, key: int, make: Callable[[], Renderer], view: View) -> Picture:
        """Draw a view with the renderer of this key; it is made if there is none."""
        return self._request(self._draw, key, make, view).result()

    def free(self, key: int, *, wait: bool) -> None:
        """Free the renderer of this key, if there is one."""
        if self._thread.is_alive():  # else it has freed all renderers
            freed = self._request(self._free, key)
            if wait:
                freed.result()

    def stop(self) -> None:
        """Free all renderers and end the thread."""
        self._requests.put(None)
        self._thread.join(_EXIT_TIME)

    def _request(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        answer: Future[Any] = Future()
        if self._thread.is_alive():
            self._requests.put((answer, function, arguments))
        else:
            answer.set_exception(NoDisplayError("no picture can be drawn while Python exits"))
        return answer

    # The methods from here on run in the drawing thread.

    def _serve(self) -> None:
        while (request := self._requests.get()) is not None:
            answer, function, arguments = request
            try:
                answer.set_result(function(*arguments))
            except BaseException as error:  # it belongs to the thread that waits for the answer
                answer.set_exception(error)
            del request, answer, function, arguments  # keep nothing of theirs alive
        for key in list(self._renderers):
            self._free(key)
        for kind in Renderer.__subclasses__():
            kind.close_idle()

    def _draw(self, key: int, make: Callable[[], Renderer], view: View) -> Picture:
        if key not in self._renderers:
            self._renderers[key] = make()
        return self._renderers[key].render(view)

    def _free(self, key: int) -> None:
        renderer = self._renderers.pop(key, None)
        if renderer is not None:
            renderer.close()


_current: DrawingThread | None = None
_starting = threading.Lock()
# The drawing threads of this process's parents. Their renderers can neither be used nor freed here.
_inherited: list[DrawingThread | None] = []


def drawing_thread() -> DrawingThread:
    """The drawing thread of this process; it starts with the first picture."""
    global _current
    with _starting:
        if _current is None:
            _current = DrawingThread()
            atexit.register(_current.stop)
        return _current


def free(key: int, *, wait: bool) -> None:
    """Free the renderer of this key, if this process has one."""
    if _current is not None:
        _current.free(key, wait=wait)


def _begin_in_forked_process() -> None:
    """A fork copies only the thread that forks, so the new process starts a drawing thread of its own."""
    global _current, _starting
    if _current is not None:
        atexit.unregister(_current.stop)
        _inherited.append(_current)
    _current, _starting = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_in_forked_process)
