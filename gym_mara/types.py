"""The types of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Real numbers. With a backend whose `arrays` are "torch", tensors stand in their place, and in that of every Mask."""
Mask = NDArray[np.bool_]
"""One flag per arm (N,), unless stated otherwise."""
Array = Any
"""An array of NumPy or a tensor of torch: for functions of both, which no type describes (`gym_mara.arrays`)."""


class UnitActions(np.ndarray[Any, np.dtype[np.float32]]):
    """Actions in [-1, 1] of a policy that was trained on scaled actions; the environments refuse them as joint targets.

    Views, slices, copies and stacks are UnitActions as well. The result of arithmetic is a plain array.
    """

    __array_priority__ = 1.0  # for np.stack and np.concatenate

    def __array_wrap__(  # type: ignore[override]
        self, array: NDArray[Any], context: Any = None, return_scalar: bool = False
    ) -> Any:
        plain = np.asarray(array)
        return plain[()] if return_scalar else plain
