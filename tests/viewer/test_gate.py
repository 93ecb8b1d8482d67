"""What the viewer accepts: its own page, and values within their ranges."""

from __future__ import annotations

import contextlib
import math
import random
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from gym_mara.errors import GymMaraError
from gym_mara.viewer.gate import Gate
from tests.viewer.stepping import Loop, wait_until

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # from viser's server

NUMBERS: tuple[Any, ...] = (0, -1, 0.0, 1e-300, 1e18, -1e18, 1e308, math.nan, math.inf, -math.inf)
OTHERS: tuple[Any, ...] = (None, "", "nan", "1e400", "x" * 5000, [], [math.nan], {}, {"value": 1})
POSITIONS: tuple[Any, ...] = (
    [math.nan] * 3,
    [0.1, math.inf, 0.0],
    [1e300] * 3,
    [1e5, 0, 0],
    [0.1, 0.2],
    [0.1] * 4,
    ["a", "b", "c"],
    None,
    0.3,
)
QUATERNIONS: tuple[Any, ...] = ([0] * 4, [math.nan] * 4, [1e300] * 4, [1e-300] * 4, [1, 0], None)


@contextlib.contextmanager
def connected(loop: Loop, host: str = "127.0.0.1", origin: str | None = None) -> Iterator[Any]:
    """A websocket to the viewer, as one opens it under this name of the machine, from a page of this origin."""
    port = int(loop.viewer.url.rpartition(":")[2])
    with (
        socket.create_connection(("127.0.0.1", port)) as stream,
        connect(
            f"ws://{host}:{port}",
            sock=stream,
            origin=origin and origin.format(port=port),  # type: ignore[arg-type]
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            max_size=None,
            max_queue=None,
        ) as client,
    ):
        yield client


def send(client: ClientConnection, kind: str, **fields: Any) -> None:
    """Send a message as the viewer's page does."""
    client.send(msgspec.msgpack.encode({"type": kind, **fields}))


def send_camera(client: ClientConnection) -> None:
    """Send the camera's pose; then viser takes the client for a browser."""
    vectors = {"wxyz": [1, 0, 0, 0], "position": [1, 1, 1], "look_at": [0, 0, 0]}
    numbers = {"fov": 0.5, "near": 0.1, "far": 10.0, "image_height": 600, "image_width": 800}
    send(client, "ViewerCameraMessage", up_direction=[0, 0, 1], **vectors, **numbers)


def send_value(client: ClientConnection, control: Any, value: Any) -> None:
    """Send a value of a control."""
    send(client, "GuiUpdateMessage", uuid=control._impl.uuid, updates={"value": value})


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1", "http://127.0.0.1:{port}"),
        ("localhost", "http://localhost:{port}"),
        (socket.gethostname(), f"http://{socket.gethostname()}:{{port}}"),
        ("127.0.0.1", None),
    ],
)
def test_the_viewers_own_page_may_connect(loop: Loop, host: str, origin: str | None) -> None:
    with connected(loop, host, origin) as client:
        assert client.recv()


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1", "https://evil.example"),
        ("127.0.0.1", "http://127.0.0.1.evil.example:{port}"),
        ("127.0.0.1", "http://127.0.0.1"),
        ("localhost", "http://localhost:3000"),
        ("localhost", "null"),
        ("evil.example", "http://evil.example:{port}"),
        ("evil.example", None),
    ],
)
def test_the_page_of_another_site_may_not_connect(
    loop: Loop, host: str, origin: str | None
) -> None:
    with pytest.raises(InvalidStatus, match="403"), connected(loop, host, origin):
        pass


def test_the_viewers_page_is_not_served_under_a_strangers_name(loop: Loop) -> None:
    def answer(host: str) -> int:
        request = urllib.request.Request(loop.viewer.url, headers={"Host": host})
        with urllib.request.urlopen(request, timeout=10) as page:
            return int(page.status)

    assert answer("localhost:1234") == 200  # as through an SSH tunnel
    assert answer("[::1]") == 200
    with pytest.raises(urllib.error.HTTPError, match="403"):
        answer("evil.example")


def test_values_are_clipped_to_their_ranges(loop: Loop) -> None:
    panel, simulation = loop.viewer._panel, loop.env.simulation
    with connected(loop) as client:
        send_camera(client)
        send_value(client, panel._speed, 1e18)
        wait_until(lambda: panel.speed == 5.0, "the highest speed")
        send_value(client, panel._speed, 1e-300)
        wait_until(lambda: panel.speed == 0.1, "the lowest speed")
        send_value(client, panel._speed, 5)
        send_value(client, panel.sliders[1], -1e300)
        wait_until(lambda: panel.targets()[0, 1] == simulation.target_low[1], "the lower limit")
        pose = {"position": [0.1, 1e300, 0.2], "wxyz": [0, 0, 0, 1]}
        send(client, "TransformControlsUpdateMessage", name="/target", **pose)
        wait_until(lambda: simulation.goal.position[0, 1] == 10.0, "the target is 10 m away")
        np.testing.assert_array_equal(simulation.goal.quaternion[0], [0, 0, 0, 1])


def hostile(generator: random.Random, loop: Loop) -> bytes:
    """A message that no page of the viewer sends, or garbage."""
    panel = loop.viewer._panel
    switches = [panel.play, panel.step, panel.backends]
    sliders = [panel._speed, *panel.sliders]
    control = generator.choice([*switches, panel.jogging, *sliders])
    values = NUMBERS + OTHERS
    match generator.randrange(9):
        case 0 | 1 | 2:
            updates: Any = {"value": generator.choice(values)}
            message = {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": updates}
        case 3:
            name = generator.choice(["update_cb", "sync_cb", "is_button", "removed", "x", "uuid"])
            updates = generator.choice([{name: "x"}, {name: "x", "value": 1.0}, [], "value", None])
            message = {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": updates}
        case 4 | 5:
            message = {
                "type": "TransformControlsUpdateMessage",
                "name": generator.choice(["/target", "/target", "/floor", "", None, 3]),
                "position": generator.choice([*POSITIONS, [0.2, 0.1, 0.3]]),
                "wxyz": generator.choice([*QUATERNIONS, [1, 0, 0, 0]]),
            }
        case 6:
            pose = {"wxyz": generator.choice(QUATERNIONS), "position": generator.choice(POSITIONS)}
            message = {"type": "ViewerCameraMessage", "fov": generator.choice(values), **pose}
        case 7:
            kinds = [one.__name__ for one in viser._messages.Message.get_subclasses()]
            kind = generator.choice([*kinds, "ShareUrlRequest", "?", None, ["x"], 7])
            message = {"type": kind, "name": "/target", "uuid": "", "value": math.nan}
        case _:
            return generator.randbytes(generator.randrange(60))
    raw = msgspec.msgpack.encode(message)
    return raw if generator.random() < 0.9 else raw[: generator.randrange(len(raw))]


def test_no_message_stops_or_poisons_the_program(
    loop: Loop, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared: list[Any] = []
    monkeypatch.setattr(loop.viewer._server, "request_share_url", shared.append)
    generator, panel, simulation = random.Random(0), loop.viewer._panel, loop.env.simulation
    with connected(loop) as client:
        send_camera(client)
        for number in range(1000):
            message = hostile(generator, loop)
            client.send(message)
            if number % 50 == 0:
                client.send("a text")
                before = loop.steps
                wait_until(lambda before=before: loop.steps > before, "the arm steps", 5.0)  # type: ignore[misc]
                assert np.isfinite(loop.observation).all()
                assert np.isfinite(simulation.goal.position).all()
                assert np.isfinite(simulation.goal.quaternion).all()
        send_value(client, panel._speed, 2.5)
        wait_until(lambda: panel.speed == 2.5, "the viewer answers")
    assert loop.is_alive()
    assert simulation.backend_name == "pinocchio"
    assert not shared, "the viewer is not shared in public"
    with connected(loop) as another:
        assert another.recv()


@pytest.mark.parametrize(
    ("position", "quaternion", "message"),
    [
        ([0.1, math.nan, 0.0], [1, 0, 0, 0], "position"),
        ([0.1, 0.0], [1, 0, 0, 0], "position must be a list of 3 finite numbers"),
        ([0.1, 0.0, 0.2], [1, 0, 0], "quaternion"),
        ([0.1, 0.0, 0.2], [0, 0, 0, 0], "quaternion must not be zero"),
        ([0.1, 0.0, 0.2], "abcd", "quaternion"),
    ],
)
def test_a_wrong_goal_is_refused(position: Any, quaternion: Any, message: str) -> None:
    loop = Loop()
    before = loop.env.simulation.goal
    with pytest.raises(GymMaraError, match=message):
        loop.env.simulation.set_goal(position, quaternion)
    assert loop.env.simulation.goal is before
    loop.env.close()


def test_a_wrong_speed_is_refused() -> None:
    loop = Loop()
    for speed in (math.nan, 0.0, -1.0):
        with pytest.raises(GymMaraError, match="speed"):
            loop.viewer.set_speed(speed)
    loop.env.close()


def test_the_viewer_does_not_open_without_its_gate(monkeypatch: pytest.MonkeyPatch) -> None:
    never = contextlib.nullcontext(threading.Event())
    monkeypatch.setattr(Gate, "installed", lambda _: never)
    with pytest.raises(GymMaraError, match="cannot be guarded"):
        Loop()
