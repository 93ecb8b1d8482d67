"""Snapshots of a training as bytes that hold values only: reading them runs no code.

A snapshot is a tree of plain values, arrays and random generators. Its form: a first line, the SHA-256 of the rest, the length
of a JSON text, the JSON text of the tree, and the contents of all arrays.
"""

from __future__ import annotations

import hashlib
import json
from collections import deque
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gym_mara.envs.statistics import EpisodeStatistics
from gym_mara.envs.streams import Streams
from gym_mara.errors import GymMaraError
from gym_mara.files import DamagedFileError
from gym_mara.state import Contact

_FIRST_LINE = b"gym_mara snapshot 1\n"
_KINDS = "biuf"
"""The kinds of arrays: truth values, whole numbers, real numbers."""


def encode(tree: Any) -> bytes:
    """Encode a tree of these types, and of no subclass of them.

    None, bool, int, float, str; list, tuple, dict, deque; numpy's numbers, arrays and PCG64 generators; torch's tensors;
    Streams, EpisodeStatistics and Contact.

    Raises:
        GymMaraError: a value has another type.
    """
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_encoded(tree, arrays)).encode()
    rest = len(text).to_bytes(8, "big") + text + b"".join(array.tobytes() for array in arrays)
    return _FIRST_LINE + hashlib.sha256(rest).digest() + rest


def decode(content: bytes) -> Any:
    """The tree that `encode` was given.

    Raises:
        DamagedFileError: a byte has changed, or it is no snapshot.
    """
    start = len(_FIRST_LINE) + 32
    digest, rest = content[len(_FIRST_LINE) : start], content[start:]
    if not content.startswith(_FIRST_LINE) or hashlib.sha256(rest).digest() != digest:
        raise DamagedFileError("it is no snapshot, or its contents have changed")
    length = int.from_bytes(rest[:8], "big")
    try:
        reader = _Reader(rest[8 + length :])
        return reader.decoded(json.loads(rest[8 : 8 + length]))
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, RecursionError) as e:
        raise DamagedFileError(f"it is no snapshot: {e}") from e


def _encoded(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """A value as JSON; its arrays are appended to the list."""

    def items(values: Any) -> list[Any]:
        return [_encoded(each, arrays) for each in values]

    kind = type(value)
    if value is None or kind in (bool, int, float, str):
        return value
    if kind is list:
        return {"list": items(value)}
    if kind is tuple:
        return {"tuple": items(value)}
    if kind is dict:
        return {"dict": [items(pair) for pair in value.items()]}
    if kind is deque:
        return {"deque": [value.maxlen, items(value)]}
    if kind is Streams:
        return {"streams": items(value)}
    if kind is Contact:
        return {"contact": items(value)}
    if kind is EpisodeStatistics:
        return {"statistics": _array(value.__reduce__()[1][0], arrays)}
    if kind is np.ndarray and value.dtype.kind in _KINDS:
        return {"array": _array(value, arrays)}
    if isinstance(value, np.generic) and value.dtype.kind in _KINDS:
        return {"number": _array(np.asarray(value), arrays)}
    if kind is torch.Tensor:
        return {"tensor": _array(value.detach().cpu().numpy(), arrays)}
    if kind is np.random.Generator and type(value.bit_generator) is np.random.PCG64:
        return {"generator": items(_generator_state(value))}
    raise GymMaraError(
        f"a checkpoint cannot hold a {kind.__module__}.{kind.__qualname__}: "
        "the snapshot of an environment and its backend must consist of plain values and arrays"
    )


def _array(value: NDArray[Any], arrays: list[NDArray[Any]]) -> list[Any]:
    arrays.append(value)
    return [value.dtype.str, list(value.shape)]


def _generator_state(generator: np.random.Generator) -> list[Any]:
    seeds: Any = generator.bit_generator.seed_seq
    about = {name: getattr(seeds, name) for name in ("entropy", "spawn_key", "pool_size")}
    about["n_children_spawned"] = seeds.n_children_spawned
    return [about, generator.bit_generator.state]


class _Reader:
    """Decodes JSON in the order in which it was encoded, which is that of the arrays."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._position = 0

    def decoded(self, value: Any) -> Any:
        if not isinstance(value, dict):
            if value is None or type(value) in (bool, int, float, str):
                return value
            raise ValueError(f"a value is {value!r:.60}")
        ((kind, about),) = value.items()
        return getattr(self, f"_{kind}")(about) if kind in _FORMS else _unknown(kind)

    def _list(self, about: Any) -> list[Any]:
        return [self.decoded(each) for each in about]

    def _tuple(self, about: Any) -> tuple[Any, ...]:
        return tuple(self._list(about))

    def _dict(self, about: Any) -> dict[Any, Any]:
        return dict(self._list(pair) for pair in about)

    def _deque(self, about: Any) -> deque[Any]:
        maxlen, items = about
        return deque(self._list(items), maxlen)

    def _streams(self, about: Any) -> Streams:
        return Streams(*self._list(about))

    def _contact(self, about: Any) -> Contact:
        return Contact(*self._list(about))

    def _statistics(self, about: Any) -> EpisodeStatistics:
        array = self._array(about)
        restored = EpisodeStatistics(array.shape[1])
        build, _ = restored.__reduce__()
        return build(array)  # type: ignore[no-any-return]

    def _array(self, about: Any) -> NDArray[Any]:
        name, shape = about
        kind = np.dtype(name)
        if kind.kind not in _KINDS or any(type(size) is not int or size < 0 for size in shape):
            raise ValueError(f"an array is {about!r:.60}")
        count = 1
        for size in shape:
            count *= size
        end = self._position + count * kind.itemsize
        if end > len(self._content):
            raise ValueError("an array is missing")
        array = np.frombuffer(self._content[self._position : end], kind).reshape(shape)
        self._position = end
        return array.copy()

    def _number(self, about: Any) -> Any:
        return self._array(about)[()]

    def _tensor(self, about: Any) -> torch.Tensor:
        return torch.from_numpy(self._array(about))

    def _generator(self, about: Any) -> np.random.Generator:
        seeds, state = self._list(about)
        generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(**seeds)))
        generator.bit_generator.state = state
        return generator


_FORMS = (
    "list",
    "tuple",
    "dict",
    "deque",
    "streams",
    "contact",
    "statistics",
    "array",
    "number",
    "tensor",
    "generator",
)


def _unknown(kind: str) -> Any:
    raise ValueError(f"unknown type {kind!r:.60}")
