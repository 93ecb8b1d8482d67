"""Runs jobs on a Ray cluster, forwards their messages and restarts those whose process dies; an interrupt ends them all."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from gym_mara.agents.experiments.executor import ONE_THREAD, Job, OnMessage, failure_of
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs

with needs("the executor 'ray'", "ray"):
    import ray
    from ray.exceptions import RayError, RayTaskError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

MAX_RESTARTS = 10
"""How often a job is restarted whose process or machine died."""
_PERIOD = 0.5
"""Between two readings of the messages, s."""


class _Mailbox:
    """An actor on the caller's machine that collects the jobs' messages."""

    def __init__(self) -> None:
        self._messages: list[tuple[str, Any]] = []

    def put(self, name: str, message: Any) -> None:
        self._messages.append((name, message))

    def take(self) -> list[tuple[str, Any]]:
        messages, self._messages = self._messages, []
        return messages


def run_on_ray(
    jobs: Mapping[str, Job], on_message: OnMessage, address: str | None = None
) -> dict[str, str]:
    """Run jobs on a Ray cluster, one at a time on each core.

    A job may be restarted on another machine. It must find there the files that it wrote, so they must lie on storage that all
    machines share.

    Args:
        jobs: name → job.
        on_message: called with a job's name and each message that it sends.
        address: of the cluster, host:port; by default RAY_ADDRESS, or else a cluster on this machine, started if there is
            none.

    Returns:
        Name → reason, for each job that failed; a failure does not stop the others.

    Raises:
        GymMaraError: there is no cluster at the address.
        KeyboardInterrupt: the user interrupted; all jobs have ended.
    """
    with _cluster(address):
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        mailbox = ray.remote(_Mailbox).options(num_cpus=0, scheduling_strategy=here).remote()
        start = ray.remote(_run).options
        running = {
            start(name=name, num_cpus=1, max_retries=MAX_RESTARTS).remote(job, name, mailbox): name
            for name, job in jobs.items()
        }
        failures: dict[str, str] = {}
        while running:
            done, _ = ray.wait(list(running), num_returns=len(running), timeout=_PERIOD)
            for name, message in ray.get(mailbox.take.remote()):
                on_message(name, message)
            for reference in done:
                name = running.pop(reference)
                reason = _failure(reference)
                if reason is not None:
                    failures[name] = reason
        for name, message in ray.get(mailbox.take.remote()):
            on_message(name, message)
        return failures


def _run(job: Job, name: str, mailbox: Any) -> str | None:
    """On the cluster: run the job; the reason if it failed."""
    return failure_of(job, lambda message: mailbox.put.remote(name, message))


def _failure(reference: Any) -> str | None:
    """Why a job that has ended failed, if it did."""
    try:
        return ray.get(reference)
    except RayTaskError as error:  # before the job itself started, for example because gym_mara is not installed there
        return f"its machine could not start it: {error.cause or error}"
    except RayError as error:
        return f"Ray gave it up: {error}"


def _check_reachable(address: str) -> None:
    """Raises OSError if nothing listens at host:port; Ray itself would try for minutes, and then end the process."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if port.isdigit():
        socket.create_connection((host, int(port)), timeout=10.0).close()


@contextmanager
def _cluster(address: str | None) -> Iterator[None]:
    """Join a cluster, and leave it at the end."""
    if ray.is_initialized():  # by the caller, who also ends it
        yield
        return
    # The same number of threads as in local processes: the last bits of the results depend on it.
    environment = {"env_vars": dict.fromkeys(ONE_THREAD, "1")}
    try:
        _check_reachable(address or os.environ.get("RAY_ADDRESS", ""))
        ray.init(
            address=address,
            runtime_env=environment,
            log_to_driver=False,
            logging_level=logging.ERROR,
        )
    except (OSError, ValueError, RuntimeError) as error:
        where = f"at {address!r}" if address else "at RAY_ADDRESS or on this machine"
        raise GymMaraError(
            f"there is no Ray cluster {where} ({error}); start one with `ray start --head`, and give its host:port"
        ) from error
    try:
        yield
    finally:
        ray.shutdown()
