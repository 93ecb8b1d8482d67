"""Bags: files of ROS 2 messages, read and written without ROS."""

from __future__ import annotations

import struct
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.files import DamagedFileError, MissingFileError, plain_size, read_bytes, read_text

with needs("a bag", "ros2", "rosbags"):
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

LARGEST = 2**31
"""The largest file of a bag that is read, bytes."""
CHUNK = 1.0
"""How much of a recording a kill can lose, s: after this time what came is on the disk."""
_MAGIC = b"\x89MCAP0\r\n"
_DATA_END, _FOOTER = 0x0F, 0x02
_ENDINGS = (".mcap", ".db3")


class Message(NamedTuple):
    """A message of a bag."""

    topic: str
    kind: str
    """Its type, such as "sensor_msgs/msg/JointState"."""
    time: int
    """When it was recorded, ns."""
    value: Any
    """An object with the fields of the type."""


class Bag:
    """A bag that is read: a folder with metadata.yaml, or a single file .mcap or .db3.

    A folder without metadata.yaml is a recording that was killed. It is read as far as its file is whole.

    Args:
        path: the folder or the file.

    Raises:
        MissingFileError: there is no such bag.
        DamagedFileError: it cannot be read.
        MissingExtraError: `rosbags` is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stack = ExitStack()
        self._types = get_typestore(Stores.ROS2_JAZZY)
        with _reading(path):
            try:
                self._reader = Reader(self._file(path))
                self._reader.open()
                self._stack.callback(self._reader.close)
            except BaseException:
                self._stack.close()
                raise
        self.topics: dict[str, str] = {c.topic: c.msgtype for c in self._reader.connections}
        """The type of the messages of each topic."""

    def _file(self, path: Path) -> Path:
        """What rosbags can read."""
        if not path.exists():
            raise MissingFileError(f"cannot read the bag {str(path)!r}: there is no such folder")
        if not path.is_dir():
            plain_size(path)
            files = [path]
        elif (path / "metadata.yaml").exists():
            read_text(path / "metadata.yaml")
            files = [file for file in path.iterdir() if file.suffix in _ENDINGS]
        else:
            return self._unfinished(path)
        for file in files:
            if plain_size(file) > LARGEST:
                raise DamagedFileError(
                    f"cannot read {str(file)!r}: it is larger than {LARGEST:,} bytes, the most allowed"
                )
        return path

    def _unfinished(self, folder: Path) -> Path:
        """A copy of the file of a recording that was killed, with an end."""
        files = [file for file in folder.iterdir() if file.suffix == ".mcap"]
        if len(files) != 1:
            raise DamagedFileError(
                f"{str(folder)!r} is not a bag: it has no metadata.yaml, and not one file .mcap"
            )
        whole = _with_end(read_bytes(files[0], LARGEST), files[0])
        copy = Path(self._stack.enter_context(tempfile.TemporaryDirectory())) / "unfinished.mcap"
        copy.write_bytes(whole)
        return copy

    def messages(self, topics: Sequence[str]) -> Iterator[Message]:
        """The messages of some topics, in the order of their times.

        Raises:
            DamagedFileError: the bag is damaged.
        """
        for connection, stamp, data in self.raw(topics):
            with _reading(self.path):
                value = self._types.deserialize_cdr(data, connection.msgtype)
            yield Message(connection.topic, connection.msgtype, stamp, value)

    def raw(self, topics: Sequence[str]) -> Iterator[tuple[Connection, int, bytes]]:
        """As `messages`, with the connection, the time, ns, and the serialised message."""
        chosen = [c for c in self._reader.connections if c.topic in topics]
        messages = iter(self._reader.messages(chosen)) if chosen else iter(())
        while True:
            with _reading(self.path):
                try:
                    found = next(messages)
                except StopIteration:
                    return
            yield found

    def close(self) -> None:
        """Close the file."""
        self._stack.close()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Raise whatever rosbags raises for a damaged file as DamagedFileError."""
    try:
        yield
    except GymMaraError:
        raise
    except (
        Exception
    ) as error:  # rosbags checks little: there are struct.error, KeyError, MemoryError, …
        reason = str(error) or type(error).__name__
        raise DamagedFileError(f"cannot read the bag {str(path)!r}: {reason}") from error


def _with_end(data: bytes, file: Path) -> bytes:
    """The whole records of an MCAP file, and an end without an index.

    Raises:
        DamagedFileError: it is no MCAP file.
    """
    if not data.startswith(_MAGIC):
        raise DamagedFileError(f"cannot read {str(file)!r}: it is not an MCAP file")
    at = len(_MAGIC)
    while at + 9 <= len(data) and data[at] not in (_DATA_END, _FOOTER):
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        if end > len(data):
            break
        at = end
    end_of_data = struct.pack("<BQI", _DATA_END, 4, 0)
    footer = struct.pack("<BQQQI", _FOOTER, 20, 0, 0, 0)
    return data[:at] + end_of_data + footer + _MAGIC


class Recorder:
    """Writes messages as a bag in MCAP, with the definitions of their types.

    Args:
        folder: a new folder.

    Raises:
        GymMaraError: it exists, or cannot be made.
        MissingExtraError: `rosbags` is not installed.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.counts: dict[str, int] = {}
        """How many messages of each topic were written."""
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Connection] = {}
        self._last, self._flushed = 0, time.monotonic()
        with _writing(folder):
            self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()

    def knows(self, kind: str) -> bool:
        """Whether messages of this type can be recorded: those whose definition is known."""
        return kind in self._types.fielddefs

    def define(self, kind: str, definition: str) -> bool:
        """Take the definition of a type, the text of its file .msg; returns whether its messages can be recorded now."""
        try:
            self._types.register(get_types_from_msg(definition, kind))
            self._types.generate_msgdef(kind, ros_version=2)
        except Exception:  # it is no definition, or one with types that are unknown too
            self._types.fielddefs.pop(kind, None)
        return self.knows(kind)

    def add(self, topic: str, kind: str, data: bytes, stamp: int) -> None:
        """Write a serialised message.

        Args:
            topic: its topic.
            kind: its type, such as "sensor_msgs/msg/JointState".
            data: CDR, as a raw subscription of ROS gives it.
            stamp: when it came, ns. Times do not go back in a bag: an earlier time becomes that of the message before.

        Raises:
            GymMaraError: the type is unknown, another than before, or the disk is full.
        """
        connection = self._connections.get(topic) or self._new_connection(topic, kind)
        if connection.msgtype != kind:
            raise GymMaraError(
                f"the messages of {topic} are {connection.msgtype} and {kind}: record one of them"
            )
        self._last = max(stamp, self._last)
        with _writing(self.folder):
            self._writer.write(connection, self._last, data)
            self.counts[topic] += 1
            if time.monotonic() - self._flushed >= CHUNK:
                self._flush()

    def add_value(self, topic: str, value: Any, stamp: int) -> None:
        """Write a message of rosbags' classes, as `add`."""
        kind = value.__msgtype__
        self.add(topic, kind, bytes(self._types.serialize_cdr(value, kind)), stamp)

    def _new_connection(self, topic: str, kind: str) -> Connection:
        if not self.knows(kind):
            raise GymMaraError(
                f"the type {kind} of {topic} has no definition here: leave this topic out"
            )
        with _writing(self.folder):
            made = self._writer.add_connection(topic, kind, typestore=self._types)
        self._connections[topic], self.counts[topic] = made, 0
        return made

    def _flush(self) -> None:
        storage: Any = self._writer.storage
        storage.close_chunk()
        storage.bio.flush()
        self._flushed = time.monotonic()

    def close(self) -> None:
        """Finish the bag. A second call has no effect."""
        if self._writer.storage is not None:
            with _writing(self.folder):
                try:
                    self._writer.close()
                except BaseException:
                    with suppress(Exception):  # the disk is full: it can only be closed
                        self._writer.abort()
                    raise

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: object, where: TracebackType | None
    ) -> None:
        if kind is None or issubclass(kind, KeyboardInterrupt):
            self.close()
        else:  # what was written is kept, if the disk allows
            with suppress(GymMaraError):
                self.close()


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except GymMaraError:
        raise
    except Exception as error:
        if not isinstance(error, OSError) and "exists already" in str(error):
            raise GymMaraError(
                f"{str(folder)!r} exists and is not overwritten: delete it first"
            ) from None
        reason = getattr(error, "strerror", None) or str(error)
        raise GymMaraError(f"cannot write the bag {str(folder)!r}: {reason}") from error
