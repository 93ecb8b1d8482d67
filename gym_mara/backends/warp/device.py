"""The device that MuJoCo Warp runs on: its choice, its memory, its streams, and the compilation of kernels for it."""

from __future__ import annotations

import dataclasses
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gym_mara.errors import GymMaraError, unknown
from gym_mara.extras import needs

with needs("the backend 'warp'", "warp"):
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # it lists the devices, and each kernel that it loads
    import mujoco_warp as mjw

_SCRATCH_OF_CONTACT, _SCRATCH_OF_ROW = 8000, 32
"""What MuJoCo Warp allocates for each contact and each row of constraints while it steps, bytes."""
_SAMPLE = 16
WORKING = threading.RLock()
"""Is held by the thread that works with Warp, which has one current device and one capture for all threads of a process."""


def choose_device(name: str | None) -> wp.Device:
    """The device with a name: "cpu", "cuda", "cuda:0" and so on; None for the first GPU.

    Raises:
        GymMaraError: the name is unknown, or there is no GPU.
    """
    with WORKING:
        gpus = [device.alias for device in wp.get_cuda_devices()]
    if name is None or (isinstance(name, str) and name.split(":")[0] == "cuda" and not gpus):
        if not gpus:
            raise GymMaraError(
                "the backend 'warp' found no GPU of NVIDIA with its driver (nvidia-smi lists them); with device='cpu' it "
                "runs without one, but slowly: for tests"
            )
        name = gpus[0]
    name = "cuda:0" if name == "cuda" else name
    if name not in ["cpu", *gpus]:
        raise unknown("device", name, ["cpu", "cuda", *gpus])
    return wp.get_device(name)


def bytes_per_arm(model: Any, rows: int, contacts: int) -> int:
    """How much memory an arm takes, with so many rows of constraints and so many contacts."""
    with wp.ScopedDevice("cpu"):
        data = mjw.make_data(model, _SAMPLE, njmax=rows, nconmax=contacts)
    return _size(data) // _SAMPLE + contacts * _SCRATCH_OF_CONTACT + rows * _SCRATCH_OF_ROW


def _size(value: Any) -> int:
    """The memory of an array, or of all arrays of a dataclass, bytes."""
    if isinstance(value, wp.array):
        return int(value.capacity)
    if not dataclasses.is_dataclass(value):
        return 0
    return sum(_size(getattr(value, field.name)) for field in dataclasses.fields(value))


def check_memory(device: wp.Device, num_envs: int, bytes_per_arm: int) -> None:
    """Check that the free memory of a GPU is enough for N arms.

    Raises:
        GymMaraError: it is not. It says how many arms fit.
    """
    if device.is_cuda and (fitting := device.free_memory // bytes_per_arm) < num_envs:
        raise GymMaraError(
            f"{num_envs} arms need {num_envs * bytes_per_arm / 1e9:.1f} GB of memory, and {device.free_memory / 1e9:.1f} GB "
            f"are free on {device.alias}: at most {fitting} arms fit"
        )


@contextmanager
def capturing(device: wp.Device) -> Iterator[wp.ScopedCapture]:
    """Capture the kernels that are launched; on a GPU in a stream of its own, because torch's own cannot capture."""
    if device.is_cpu:
        with wp.ScopedCapture() as capture:
            yield capture
        return
    with wp.ScopedStream(wp.Stream(device)), wp.ScopedCapture() as capture:
        yield capture


@contextmanager
def compiling() -> Iterator[None]:
    """Print one line if kernels are compiled, not if they come from the cache, and nothing else of Warp's messages."""
    before = wp.get_logger(), wp.config.log_level
    wp.set_logger(_CompileLogger())
    wp.config.log_level = wp.LOG_INFO
    try:
        yield
    finally:
        wp.set_logger(before[0])
        wp.config.log_level = before[1]


class _CompileLogger:
    """Waits for the first message that a kernel was compiled."""

    def __init__(self) -> None:
        self._printed = False

    def debug(self, message: str) -> None:
        """Ignore it."""

    def info(self, message: str) -> None:
        """Print that kernels are compiled, once."""
        if "(compiled)" in message and not self._printed:
            self._printed = True
            print(
                "compiling Warp's kernels, which takes about 90 s the first time; they are kept in "
                f"{wp.config.kernel_cache_dir}",
                file=sys.stderr,
                flush=True,
            )

    def warning(self, message: str, **options: Any) -> None:
        """Print it."""
        print(message, file=sys.stderr)

    error = warning
