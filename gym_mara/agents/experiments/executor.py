"""What the executors share: a job is a function that may send messages; an executor runs many jobs at once."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from typing import Any

from gym_mara.errors import GymMaraError

Send = Callable[[Any], None]
"""Sends a message, anything that pickles, from a job to whoever started it."""
Job = Callable[[Send], None]
"""What an executor runs; it pickles."""
OnMessage = Callable[[str, Any], None]
"""Called with a job's name and a message that it sent."""
Executor = Callable[[Mapping[str, Job], OnMessage], dict[str, str]]
"""Runs jobs by name, and returns the reason of failure for each that failed."""

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""The environment variables that limit a library's threads. Jobs get 1 each, because they share the cores."""


def failure_of(job: Job, send: Send) -> str | None:
    """Run a job; the reason if it failed, with a traceback unless it is an error that the user can correct."""
    try:
        job(send)
    except (GymMaraError, OSError) as error:
        return str(error)
    except Exception:
        return traceback.format_exc().rstrip()
    return None
