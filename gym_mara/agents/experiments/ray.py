"""Tasks on a Ray cluster: what they say is heard, one whose process dies is tried again, an interrupt leaves none behind."""

from __future__ import annotations

import functools
import logging
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from gym_mara.agents.experiments.local import ONE_THREAD, Hear, Task, told
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs

with needs("the engine 'ray'", "ray"):
    import ray
    from ray.exceptions import RayError, RayTaskError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

TRIES = 10
"""How often a task is begun anew whose process or machine died."""
_PERIOD = 0.5
"""Between two looks at what the tasks have said, s."""


class _Mailbox:
    """An actor beside the caller, where tasks leave what they say."""

    def __init__(self) -> None:
        self._messages: list[tuple[str, Any]] = []

    def put(self, name: str, message: Any) -> None:
        self._messages.append((name, message))

    def take(self) -> list[tuple[str, Any]]:
        messages, self._messages = self._messages, []
        return messages


def run_on_ray(tasks: Mapping[str, Task], hear: Hear, address: str | None = None) -> dict[str, str]:
    """Run tasks on a Ray cluster, one on each of its cores at a time.

    What a task finds on disk when it is begun anew, on whatever machine, must be what it left there: its files lie on storage
    that all machines share.

    Args:
        tasks: name → what to do; it pickles, and is given a function by which to say things.
        hear: called with a task's name and what it said.
        address: the cluster's, host:port; by default RAY_ADDRESS says it, else it is the one of this machine, which is begun
            where there is none.

    Returns:
        Name → what went wrong, of the tasks that failed; the others go on.

    Raises:
        GymMaraError: there is no cluster at the address.
        KeyboardInterrupt: the user interrupted; no task goes on.
    """
    with _cluster(address):
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        mailbox = ray.remote(_Mailbox).options(num_cpus=0, scheduling_strategy=here).remote()
        begin = ray.remote(_work).options
        running = {
            begin(name=name, num_cpus=1, max_retries=TRIES).remote(task, name, mailbox): name
            for name, task in tasks.items()
        }
        failed: dict[str, str] = {}
        while running:
            done, _ = ray.wait(list(running), num_returns=len(running), timeout=_PERIOD)
            for name, message in ray.get(mailbox.take.remote()):
                hear(name, message)
            for reference in done:
                name = running.pop(reference)
                try:
                    reason = ray.get(reference)
                except RayTaskError as error:
                    # Before the task itself began: gym_mara is not there, say.
                    reason = f"its machine could not begin it: {error.cause or error}"
                except RayError as error:
                    reason = f"Ray gave it up: {error}"
                if reason is not None:
                    failed[name] = reason
        for name, message in ray.get(mailbox.take.remote()):
            hear(name, message)
        return failed


def _work(task: Task, name: str, mailbox: Any) -> str | None:
    """On the cluster: do the task; what went wrong, if anything."""

    def say(message: Any) -> None:
        mailbox.put.remote(name, message)

    return told(functools.partial(task, say))


def _knock(address: str) -> None:
    """Raises OSError where nobody listens at host:port: Ray itself tries for minutes, and ends the process."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if port.isdigit():
        socket.create_connection((host, int(port)), timeout=10.0).close()


@contextmanager
def _cluster(address: str | None) -> Iterator[None]:
    """Join a cluster, and leave it again."""
    if ray.is_initialized():  # the caller's own
        yield
        return
    # As many threads as with processes of this machine: the last bits of the results hang on it.
    environment = {"env_vars": dict.fromkeys(ONE_THREAD, "1")}
    try:
        _knock(address or os.environ.get("RAY_ADDRESS", ""))
        ray.init(
            address=address,
            runtime_env=environment,
            log_to_driver=False,
            logging_level=logging.ERROR,
        )
    except (OSError, ValueError, RuntimeError) as error:
        where = f"at {address!r}" if address else "where RAY_ADDRESS says, or on this machine"
        raise GymMaraError(
            f"there is no Ray cluster {where} ({error}); begin one with `ray start --head`, and give its host:port"
        ) from error
    try:
        yield
    finally:
        ray.shutdown()
