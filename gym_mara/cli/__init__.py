"""The command `gym-mara`."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

FAILED = 2
"""The exit code of a command that cannot do its work; 1 is for a check that found a difference."""
INTERRUPTED = 130
"""The exit code after Ctrl-C, SIGTERM or SIGHUP."""


def main() -> None:
    """Run the command, and end the process with 0, 1 (a check found a difference), 2 (an error) or 130 (interrupted)."""
    with _terminated_like_interrupted(), _plain_warnings():
        code = _run()
        try:
            if sys.stdout is not None:  # it is None if it was closed before the start
                sys.stdout.flush()
        except OSError as error:
            code = _output_failed(error)
    sys.exit(code)


def _run() -> int:
    """Run the command. An expected error is one line on stderr; a traceback is shown only for a fault of gym_mara."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a table must not fail in a Latin-1 terminal
    try:
        from gym_mara.cli.app import run  # the imports take a moment, and may be interrupted

        return run(sys.argv[1:])
    except KeyboardInterrupt:
        return _failed("Interrupted.", INTERRUPTED)
    except SystemExit:  # of Typer, when the reader of stdout has closed it
        return FAILED
    except MemoryError:
        return _failed("error: the memory is not enough; ask for less")
    except RecursionError:
        return _failed("error: the input is nested too deeply")
    except OSError as error:
        if error.filename is None:  # an error of the output
            return _output_failed(error)
        return _failed(f"error: {error.strerror}: {error.filename!r}")
    except Exception:
        traceback.print_exc()
        return _failed("error: this is a fault of gym_mara; please report it with the lines above")


def _failed(message: str, code: int = FAILED) -> int:
    with suppress(OSError):
        print(message, file=sys.stderr)
    return code


def _output_failed(error: OSError) -> int:
    """Report that stdout cannot be written; without a message if its reader has closed it, as `head` does."""
    with suppress(OSError, ValueError, AttributeError):
        # What is still buffered goes nowhere; Python would report it again when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError):
        return FAILED
    return _failed(f"error: cannot write the output: {error.strerror or error}")


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Print each warning once, as one line, without its place in the code."""
    before, shown = warnings.formatwarning, set[str]()

    def once(message: Warning | str, *_: Any, **__: Any) -> str:
        text = f"warning: {message}\n"
        if text in shown:
            return ""
        shown.add(text)
        return text

    warnings.formatwarning = once
    try:
        yield
    finally:
        warnings.formatwarning = before


@contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """Let SIGTERM, and SIGHUP of a closed terminal, do what Ctrl-C does: what is open is closed, nothing is half written.

    A signal that is ignored, as SIGHUP under nohup, stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not callable(signal.getsignal(signal.SIGINT)):  # ignored, as under nohup
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    endings = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    heard = [number for number in endings if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, interrupt) for number in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
