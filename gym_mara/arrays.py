"""The libraries of arrays: NumPy, and torch for a backend whose states are tensors.

Tasks are written in the terms of the array API standard, with the functions of `namespace`, so that the same lines compute
on the CPU and on a GPU. Torch is not imported here: a tensor exists only if its user has imported torch.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy import ndarray  # the name alone: these functions are called several times per step
from numpy.typing import ArrayLike, NDArray

from gym_mara.types import Array


def namespace(array: Array) -> Any:
    """The functions for an array in the names of the array API standard: `numpy`, or torch's of `array_api_compat`."""
    if type(array) is ndarray:
        return np
    if not is_tensor(array):
        return np
    import array_api_compat.torch

    return array_api_compat.torch


def is_tensor(value: Any) -> bool:
    """Whether a value is a tensor of torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def host(array: Array) -> NDArray[Any]:
    """A NumPy array with the values of an array; a tensor is copied to the CPU."""
    if is_tensor(array):
        return np.array(array.detach().cpu().numpy())
    return np.asarray(array)


def contiguous(array: Array) -> Array:
    """The same values in C order."""
    return array.contiguous() if is_tensor(array) else np.ascontiguousarray(array)


def zeros_like(array: Array) -> Array:
    """Zeros of the shape, the type and the device of an array; on one row NumPy's own function takes six times as long."""
    if type(array) is ndarray:
        return np.zeros(array.shape, array.dtype)
    return namespace(array).zeros_like(array)


def like(values: NDArray[Any], array: Array) -> Array:
    """Floats of NumPy as an array of the library, the float type and the device of another array."""
    return _tensor(values, array.dtype, array.device) if is_tensor(array) else values


class Constants:
    """Fixed values, as arrays of the library, the float type and the device of another array.

    A number becomes an array without dimensions: a NumPy ufunc on one row takes twice as long with a Python number. Tensors
    are made once, because a GPU waits for each copy.

    Args:
        *values: numbers and arrays. Floats get the type of the other array, and integers stay integers.
    """

    def __init__(self, *values: ArrayLike) -> None:
        self._values: tuple[Any, ...] = (np, *map(np.array, values))
        self._tensors: dict[Any, tuple[Array, ...]] = {}

    def like(self, array: Array) -> tuple[Any, ...]:
        """The `namespace` of an array, and the constants as arrays like it; one call, because it is made at every step."""
        if type(array) is ndarray:
            return self._values
        return self._tensors_like(array) if is_tensor(array) else self._values

    def _tensors_like(self, tensor: Array) -> tuple[Any, ...]:
        form = tensor.dtype, tensor.device
        if form not in self._tensors:
            tensors = [_tensor(value, *form) for value in self._values[1:]]
            self._tensors[form] = namespace(tensor), *tensors
        return self._tensors[form]


def _tensor(values: NDArray[Any], dtype: Any, device: Any) -> Array:
    import torch

    with torch.inference_mode(False):  # they are also used outside of it
        return torch.tensor(
            values, dtype=dtype if values.dtype.kind == "f" else None, device=device
        )
