"""Reads files that may come from strangers, and writes files whole or not at all."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from gym_mara.errors import GymMaraError, short

if TYPE_CHECKING:
    from pydantic import ValidationError

T = TypeVar("T")

LARGEST_TEXT = 2**24
"""The default bound on the size of a text file, bytes."""
_SHOWN_ERRORS = 3


class DamagedFileError(GymMaraError):
    """A file cannot be read, is not a plain file, is too large, or does not have the form that it must have."""


class MissingFileError(DamagedFileError):
    """A file does not exist."""


class BusyError(GymMaraError):
    """Another process holds a lock."""


def read_bytes(file: Path, largest: int) -> bytes:
    """Read a plain file of at most this many bytes. Pipes and devices are refused, so that nothing blocks.

    Raises:
        MissingFileError: there is no such file.
        DamagedFileError: it is not a plain file, it is too large, or it cannot be read.
    """
    try:
        # Opening a pipe without O_NONBLOCK would wait for its writer.
        descriptor = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with open(descriptor, "rb") as stream:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise DamagedFileError(f"cannot read {str(file)!r}: it is not a plain file")
            # Python allocates what it is asked for, so not more than the file seems to need.
            expected = min(largest, max(status.st_size, 2**16))
            content = stream.read(expected + 1) if status.st_size <= largest else None
    except FileNotFoundError:
        raise MissingFileError(f"cannot read {str(file)!r}: there is no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        if isinstance(error, GymMaraError):
            raise
        raise DamagedFileError(f"cannot read {str(file)!r}: {_reason(error)}") from error
    if content is None or len(content) > largest:
        raise DamagedFileError(
            f"cannot read {str(file)!r}: it is larger than {largest:,} bytes, the most allowed"
        )
    return content


def plain_size(file: Path) -> int:
    """The size of a plain file, bytes, for a library that reads the file itself.

    Raises:
        MissingFileError: there is no such file.
        DamagedFileError: it is not a plain file.
    """
    try:
        status = os.stat(file)
    except FileNotFoundError:
        raise MissingFileError(f"cannot read {str(file)!r}: there is no such file") from None
    except (OSError, ValueError) as error:
        raise DamagedFileError(f"cannot read {str(file)!r}: {_reason(error)}") from error
    if not stat.S_ISREG(status.st_mode):
        raise DamagedFileError(f"cannot read {str(file)!r}: it is not a plain file")
    return status.st_size


def read_text(file: Path, largest: int = LARGEST_TEXT) -> str:
    """Read a plain text file, in UTF-8, of at most this many bytes.

    Raises:
        MissingFileError: there is no such file.
        DamagedFileError: it is not a plain file, it is too large, or it is not UTF-8.
    """
    try:
        return read_bytes(file, largest).decode("utf-8")
    except UnicodeDecodeError as error:
        raise DamagedFileError(f"cannot read {str(file)!r}: it is not UTF-8 ({error})") from None


def read_json(file: Path, form: type[T], largest: int = LARGEST_TEXT) -> T:
    """Read a JSON file and check it against a form.

    Args:
        file: the file.
        form: a type that pydantic can check, such as a dataclass with annotated fields.
        largest: the largest size of the file, bytes.

    Raises:
        MissingFileError: there is no such file.
        DamagedFileError: it is not a plain file, not JSON, or a value is missing, unknown, of another type or out of range.
    """
    return parsed_json(read_bytes(file, largest), form, f"cannot read {str(file)!r}")


def parsed_json(text: str | bytes, form: type[T], message: str) -> T:
    """Check JSON against a form; `message` begins the message of an error.

    Raises:
        DamagedFileError: the text is not JSON, or a value is missing, unknown, of another type or out of range.
    """
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(form).validate_json(text, strict=True)
    except ValidationError as error:
        raise DamagedFileError(f"{message}: {_first_errors(error)}") from None


def _first_errors(error: ValidationError) -> str:
    """What is wrong with the first values that have the wrong form."""
    found = error.errors(include_url=False, include_context=False)
    shown = []
    for one in found[:_SHOWN_ERRORS]:
        where = ".".join(map(str, one["loc"]))
        complete = one["type"] in ("missing", "json_invalid", "value_error")
        value = "" if complete else f", not {short(one['input'])}"
        text = one["msg"].removeprefix("Value error, ") + value
        shown.append(f"{where}: {text}" if where else text)
    more = len(found) - len(shown)
    return "; ".join(shown) + (f"; and {more} more" if more else "")


def write_text(file: Path, text: str, *, new: bool = False) -> None:
    """Write a text file in UTF-8: at any time, even after a kill, it holds the old text or the new one.

    Args:
        file: the file.
        text: its content.
        new: whether an existing file is an error, and not replaced.

    Raises:
        GymMaraError: the file exists and must be new, or it cannot be written; then nothing has changed.
    """
    with written_aside(file, new=new) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def write_json(file: Path, value: Any, *, new: bool = False) -> None:
    """Write a value as a JSON file, as `write_text` does; NaN and infinity are not JSON."""
    write_text(file, json.dumps(value, indent=2, allow_nan=False) + "\n", new=new)


@contextmanager
def written_aside(file: Path, *, new: bool = False) -> Iterator[Path]:
    """Yield the path of a temporary file of the same type, which replaces the file if the block succeeds.

    Raises:
        GymMaraError: the file exists and must be new, is not a plain file, or it cannot be written; then nothing has
            changed.
    """
    if file.exists() and not file.is_file():
        raise GymMaraError(f"cannot write {str(file)!r}: it exists and is not a plain file")
    if new and os.path.lexists(file):
        raise _exists(file)
    # Nobody can guess this name, so nobody has put a link there that leads elsewhere.
    temporary = file.with_name(f".{file.stem[:100]}-{secrets.token_hex(8)}{file.suffix}")
    try:
        with writing(file):
            yield temporary
            _to_disk(temporary)
            if new:
                _publish(temporary, file)
            else:
                os.replace(temporary, file)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def folder_written_aside(folder: Path) -> Iterator[Path]:
    """Yield a new temporary folder beside a new one, whose name it gets if the block succeeds.

    Raises:
        GymMaraError: the folder exists, or cannot be written; then nothing is left.
    """
    if os.path.lexists(folder):
        raise _exists(folder)
    temporary = folder.with_name(f".{folder.name}-{secrets.token_hex(8)}")
    try:
        with writing(folder):
            temporary.mkdir()
        yield temporary
        with writing(folder):
            if os.path.lexists(folder):
                raise _exists(folder)
            os.replace(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def refuse_links(folder: Path) -> None:
    """Check that a folder which is written to holds no symbolic links: they may lead out of it.

    Raises:
        DamagedFileError: it holds one.
    """
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            if os.path.islink(path := os.path.join(parent, name)):
                raise DamagedFileError(
                    f"{path!r} is a symbolic link, and is not written to: put the file or folder itself there"
                )


def replace_folder(new: Path, target: Path) -> None:
    """Replace a folder by a new one; after a kill at any time at least one of the two exists."""
    old = target.with_name(f".{target.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        os.replace(target, old)
    os.replace(new, target)
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def locked(file: Path, busy: str, patience: float = 0.0) -> Iterator[None]:
    """Hold a lock file in the block; the operating system releases it if this process is killed.

    Args:
        file: the lock file, made if there is none.
        busy: the error if another process holds the lock.
        patience: how long to wait for the lock, s.

    Raises:
        BusyError: another process holds the lock.
        GymMaraError: the file cannot be made or is not a plain file.
    """
    from filelock import FileLock, Timeout

    if os.path.lexists(file) and not stat.S_ISREG(os.lstat(file).st_mode):
        raise GymMaraError(f"cannot lock {str(file)!r}: it is not a plain file")
    lock = FileLock(file, timeout=patience)
    try:
        lock.acquire()
    except Timeout:
        raise BusyError(busy) from None
    except OSError as error:
        raise GymMaraError(f"cannot lock {str(file)!r}: {_reason(error)}") from error
    try:
        yield
    finally:
        lock.release()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an operating system's error, such as a full disk, into a GymMaraError that names the path."""
    try:
        yield
    except (OSError, UnicodeError) as error:
        if isinstance(error, GymMaraError):
            raise
        why = _reason(error)
        if not path.parent.is_dir():
            why = f"there is no folder {str(path.parent)!r}; make it first"
        raise GymMaraError(f"cannot write {str(path)!r}: {why}") from error


def _to_disk(file: Path) -> None:
    descriptor = os.open(file, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _publish(temporary: Path, file: Path) -> None:
    """Give a file its final name if nothing else has this name."""
    try:
        os.link(temporary, file)
    except FileExistsError:
        raise _exists(file) from None
    except OSError:  # a file system without hard links
        if os.path.lexists(file):
            raise _exists(file) from None
        os.replace(temporary, file)


def check_new(file: Path) -> None:
    """Check early that a new file can be made: nothing has its name, and its folder can be written to.

    Raises:
        GymMaraError: it cannot.
    """
    if os.path.lexists(file):
        raise _exists(file)
    with writing(file), tempfile.TemporaryFile(dir=file.parent):
        pass


def _exists(file: Path) -> GymMaraError:
    return GymMaraError(f"{str(file)!r} exists and is not overwritten: delete it first")


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
