"""The viewer's gate: only its own page may connect, and only valid messages come in.

viser has no option for either. It serves through `websockets`, whose public options have both.
"""

from __future__ import annotations

import ipaddress
import math
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from unittest import mock

from gym_mara.extras import needs

with needs("the viewer", "render", "viser"):
    import msgspec
    import viser.infra
    import websockets.asyncio.server
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

TARGET = "/target"
"""The name of the target's node in the viewer's scene."""
_LARGEST_MESSAGE = 2**16
"""The largest message that a browser may send, bytes; the viewer's page sends less than 1 kB."""
_FARTHEST = 10.0
"""The bound on each coordinate of the target, m."""
_DRAGS = ("TransformControlsDragStartMessage", "TransformControlsDragEndMessage")
_patching = threading.Lock()


class Gate:
    """Decides which requests and messages reach the viewer.

    A request must name this machine by an address, by `localhost`, by its own name or by `viewer_host`: a web page can
    give another name to this machine (DNS rebinding), but not these. Browsers send the origin of the page that opens a
    websocket: it must be the viewer. Programs other than browsers send no origin, and are let in.

    Of the messages, those come in that the viewer's page sends: values of its controls, poses of the target, and poses
    of the browser's camera. Values are clipped to their ranges. All other messages are dropped without an answer.

    Args:
        host: the address that the viewer listens on.
    """

    def __init__(self, host: str) -> None:
        self._names = {host.lower(), "localhost", socket.gethostname().lower()}
        self._controls: dict[str, Callable[[Any], Any]] = {}

    def let_in(self, control: Any, check: Callable[[Any], Any]) -> None:
        """Let values of a control of the panel in.

        Args:
            control: viser's handle.
            check: returns the value that is let in for one of a browser; raises ValueError if there is none.
        """
        self._controls[control._impl.uuid] = check

    def admits(self, request: Request) -> bool:
        """Whether a request is one for the viewer, and does not come from the page of another site."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0].lower()):
            return False
        return all(origin.lower().partition("://")[2] == hosts[0].lower() for origin in origins)

    def _is_own(self, host: str) -> bool:
        """Whether the header Host, with or without a port, is a name of this machine or any address."""
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdecimal() else host
        try:
            ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            return name in self._names
        return True

    def cleaned(self, raw: str | bytes) -> bytes | None:
        """The message of a browser with its values clipped to their ranges; None if it is not valid."""
        if isinstance(raw, str):
            return None
        try:
            message = msgspec.msgpack.decode(raw)
            match message:
                case {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}:
                    message["updates"] = {"value": self._controls[uuid](value)}
                case {"type": "TransformControlsUpdateMessage", "name": name} if name == TARGET:
                    message["position"] = _numbers(message["position"], 3, _FARTHEST)
                    message["wxyz"] = _numbers(message["wxyz"], 4, 1.0)
                    if math.hypot(*message["wxyz"]) < 0.5:
                        return None
                case {"type": kind, "name": name} if name == TARGET and kind in _DRAGS:
                    pass
                case {"type": "ViewerCameraMessage"}:
                    for name in message.keys() - {"type"}:
                        message[name] = _camera_value(name, message[name])
                case _:
                    return None
            clean = msgspec.msgpack.encode(message)
            viser.infra.Message.deserialize(clean)  # names and types of all fields
            return clean
        except (ValueError, TypeError, LookupError, OverflowError, RecursionError):
            return None  # msgspec's errors are ValueErrors

    @contextmanager
    def installed(self) -> Iterator[threading.Event]:
        """Servers of websockets that start in the `with` block have this gate; the event tells whether one has started."""
        gate, started, serve = self, threading.Event(), websockets.asyncio.server.serve

        class Guarded(ServerConnection):
            async def recv(self, decode: bool | None = None) -> Any:
                while (message := gate.cleaned(await super().recv(decode))) is None:
                    pass
                return message

        def guarded(*arguments: Any, process_request: Any, **options: Any) -> Any:
            def process(connection: ServerConnection, request: Request) -> Response | None:
                if not gate.admits(request):
                    text = "The viewer only answers its own page.\n"
                    return connection.respond(HTTPStatus.FORBIDDEN, text)
                answer: Response | None = process_request(connection, request)
                return answer

            started.set()
            options |= {"create_connection": Guarded, "max_size": _LARGEST_MESSAGE}
            return serve(*arguments, process_request=process, **options)

        with _patching, mock.patch.object(websockets.asyncio.server, "serve", guarded):
            yield started


def number(value: Any, low: float, high: float) -> float:
    """Check that a value is a finite number, and clip it.

    Raises:
        ValueError: it is not.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"no finite number: {value!r}")
    return float(min(max(value, low), high))


def _camera_value(name: str, value: Any) -> Any:
    """Check a value of a browser's camera: a finite number, a quaternion or a vector.

    Raises:
        ValueError: it is none.
    """
    if isinstance(value, list):
        return _numbers(value, 4 if name == "wxyz" else 3, math.inf)
    return number(value, -math.inf, math.inf)


def one_of(value: Any, valid: Sequence[str]) -> str:
    """Check that a value is one of the valid texts.

    Raises:
        ValueError: it is not.
    """
    if value not in valid:
        raise ValueError(f"unknown value: {value!r}")
    return str(value)


def boolean(value: Any) -> bool:
    """Check that a value is true or false.

    Raises:
        ValueError: it is not.
    """
    if not isinstance(value, bool):
        raise ValueError(f"neither true nor false: {value!r}")
    return value


def _numbers(values: Any, length: int, bound: float) -> list[float]:
    """Check that a value is a list of finite numbers, and clip each to ± the bound.

    Raises:
        ValueError: it is not.
    """
    if not isinstance(values, list) or len(values) != length:
        raise ValueError(f"not {length} numbers: {values!r}")
    return [number(value, -bound, bound) for value in values]
