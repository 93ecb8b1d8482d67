"""Pinocchio's parser of URDFs, urdfdom, with what it writes to C++'s standard error."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gym_mara.errors import GymMaraError

_lock = threading.Lock()  # a process has one standard error


@contextmanager
def parsing(urdf: Path) -> Iterator[list[str]]:
    """Let Pinocchio parse a URDF in this block; what C++ writes to standard error is in the list after it.

    Raises:
        GymMaraError: Pinocchio cannot load the file; the message has the parser's reasons.
    """
    written: list[str] = []
    try:
        with _standard_error_in(written):
            yield written
    except GymMaraError:
        raise
    except (OSError, ValueError, RuntimeError) as error:
        # Coal's errors begin with lines about its own source code.
        own = " ".join(str(error).rpartition("message:")[2].split())
        reasons = "; ".join([*written, own])
        raise GymMaraError(f"Pinocchio cannot load the URDF {str(urdf)!r}: {reasons}") from error


@contextmanager
def _standard_error_in(written: list[str]) -> Iterator[None]:
    """Append what is written to file descriptor 2 to a list, without the places in the parser's source code."""
    with _lock, tempfile.TemporaryFile() as file:
        try:
            own = os.dup(2)
        except OSError:  # the process has closed its standard error
            yield
            return
        sys.stderr.flush()
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(own, 2)
            os.close(own)
            file.seek(0)
            lines = file.read().decode(errors="replace").splitlines()
            reasons = (" ".join(line.split()) for line in lines if "at line " not in line)
            written += [reason.removeprefix("Error: ") for reason in reasons if reason]
