"""The arrays that callers give and get: NumPy's on the host, or tensors of torch that share the device with the engine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gym_mara.backends.warp.device import WORKING
from gym_mara.extras import needs
from gym_mara.types import Array

with needs("the backend 'warp'", "warp"):
    import warp as wp


class NumpyExchange:
    """NumPy's arrays, in double precision.

    Args:
        device: Warp's device.
    """

    takes = "arrays of NumPy"

    def __init__(self, device: wp.Device) -> None:
        self._device = device

    @contextmanager
    def scope(self) -> Iterator[None]:
        """Let Warp work on the device; one thread at a time."""
        with WORKING, wp.ScopedDevice(self._device):
            yield

    def fits(self, values: Any) -> bool:
        """Whether these are arrays that a caller may give."""
        return isinstance(values, np.ndarray)

    def give(self, values: Any, array: wp.array) -> None:
        """Copy a caller's values to an array of the engine."""
        array.assign(values.astype(wp.dtype_to_numpy(array.dtype), copy=False))

    def read(self, array: wp.array) -> Array:
        """A copy of an array of the engine."""
        values = array.numpy()
        return values.copy() if values.dtype == np.bool_ else values.astype(np.float64)

    def asarray(self, values: ArrayLike) -> Array:
        """Values of the host as an array of a caller."""
        array = np.asarray(values)
        return array if array.dtype == np.bool_ else array.astype(np.float64, copy=False)


class TorchExchange(NumpyExchange):
    """Tensors on the device, in single precision. Warp works in the current stream of torch."""

    def __init__(self, device: wp.Device) -> None:
        import torch

        super().__init__(device)
        self.device = torch.device(wp.device_to_torch(device))
        self.takes = f"tensors of torch on {self.device}"
        self._views: dict[int, torch.Tensor] = {}
        """Tensors that share the memory of arrays of the engine, by address."""

    @contextmanager
    def scope(self) -> Iterator[None]:
        import torch

        with ExitStack() as stack:
            stack.enter_context(super().scope())
            if self._device.is_cuda:
                stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
                stack.enter_context(wp.ScopedStream(stream))
            yield

    def fits(self, values: Any) -> bool:
        import torch

        return isinstance(values, torch.Tensor) and values.device == self.device

    def give(self, values: Any, array: wp.array) -> None:
        self._view(array).copy_(values)

    def read(self, array: wp.array) -> Array:
        return self._view(array).clone()

    def _view(self, array: wp.array) -> Array:
        if array.ptr not in self._views:
            self._views[array.ptr] = wp.to_torch(array)
        return self._views[array.ptr]

    def asarray(self, values: ArrayLike) -> Array:
        import torch

        array = np.asarray(values)
        dtype = torch.bool if array.dtype == np.bool_ else torch.float32
        return torch.tensor(array, dtype=dtype, device=self.device)


def make_exchange(arrays: str, device: wp.Device) -> NumpyExchange:
    """The exchange of "numpy" or "torch"."""
    return TorchExchange(device) if arrays == "torch" else NumpyExchange(device)
