"""Steps many arms at once in threads of MuJoCo, which do not hold Python's lock."""

from __future__ import annotations

import os
import weakref
from typing import Any

import numpy as np

from gym_mara.backends.processes import cores
from gym_mara.backends.workers import in_worker
from gym_mara.errors import whole_number
from gym_mara.extras import needs
from gym_mara.types import Floats

with needs("the backend 'mujoco'", "mujoco"):
    import mujoco
    from mujoco.rollout import Rollout


def choose_threads(num_envs: int, threads: int | None) -> int:
    """The number of threads for N arms: the one asked for, else one for each core; at most one for each arm.

    Unless asked for it is one in a process started by multiprocessing or Ray: the program that started it has already
    shared out the cores.

    Raises:
        GymMaraError: it is no whole number of at least 1, or far above the number of cores.
    """
    if threads is None:
        threads = 1 if in_worker() else len(cores())
    else:
        threads = whole_number(
            "threads",
            threads,
            or_else="None for one on each core",
            at_most=max(16, 4 * len(cores())),
            reason="more of them only wait for each other",
        )
    return min(threads, num_envs)


class Stepper:
    """Runs models of the same sizes through physics steps.

    Args:
        model: one of the models.
        threads: how many arms are stepped at the same time; one is stepped on the calling thread.
    """

    def __init__(self, model: mujoco.MjModel, threads: int) -> None:
        self._state_size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS.value)
        self._num_sensors = model.nsensordata
        self._data = [mujoco.MjData(model) for _ in range(threads)]
        self._rollout: Rollout | None = None
        _STEPPERS.add(self)

    def run(
        self, models: list[mujoco.MjModel], states: Floats, warmstarts: Floats, controls: Floats
    ) -> tuple[Floats, Floats]:
        """Step each arm once for each row of its controls.

        A result does not depend on the other arms, nor on the thread that computes it.

        Args:
            models: of the arms, N.
            states: at the beginning (N, S): time, positions, velocities.
            warmstarts: the accelerations from which the solver starts (N, V).
            controls: of each step (N, K, U).

        Returns:
            The states after each step (N, K, S); and what the sensors measured at the beginning of each step (N, K, C). A
            warning, as of values that are not finite, ends the steps of an arm: its time stands still.
        """
        arms, steps, _ = controls.shape
        after = np.empty((arms, steps, self._state_size))
        measured = np.empty((arms, steps, self._num_sensors))
        if self._rollout is None:
            self._rollout = Rollout(nthread=len(self._data) if len(self._data) > 1 else 0)
        # MuJoCo would write warnings into a file in the working directory. This setting is of the whole process.
        others = mujoco.get_mju_user_warning()
        if others is not _ignore:
            mujoco.set_mju_user_warning(_ignore)
        try:
            self._rollout.rollout(
                models,
                self._data,
                states,
                controls,
                skip_checks=True,
                nstep=steps,
                initial_warmstart=warmstarts,
                state=after,
                sensordata=measured,
                # With few arms, MuJoCo's own smaller chunks took a quarter longer: threads wait for each chunk.
                chunk_size=-(-arms // (len(self._data) * min(steps, 2))),
            )
        finally:
            if others is not _ignore:
                mujoco.set_mju_user_warning(others)
        return after, measured

    def stop(self) -> None:
        """End the threads; the next run starts them again."""
        self._rollout = None


def _ignore(warning: str) -> None:
    """Ignore a warning of MuJoCo: the backend finds the arms whose state diverged."""


_STEPPERS: weakref.WeakSet[Any] = weakref.WeakSet()


def _stop_all() -> None:
    for stepper in list(_STEPPERS):
        stepper.stop()


# A forked process has none of the threads, and would wait for them for ever.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_stop_all)
