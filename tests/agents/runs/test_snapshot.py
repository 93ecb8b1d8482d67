"""Snapshots: any tree of plain values comes back, each changed byte is found, and other types are refused."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections import OrderedDict, deque
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from gym_mara.agents.runs.snapshot import decode, encode
from gym_mara.envs.statistics import EpisodeStatistics
from gym_mara.envs.streams import Streams
from gym_mara.errors import GymMaraError
from gym_mara.files import DamagedFileError
from gym_mara.state import Contact

SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
ARRAYS: Any = st.sampled_from(["<f8", "<f4", ">f8", "<i8", "|u1", "|b1"]).flatmap(
    lambda kind: arrays(np.dtype(kind), array_shapes(min_dims=0, min_side=0, max_side=3))
)
TREES = st.recursive(
    SCALARS | ARRAYS,
    lambda child: (
        st.lists(child, max_size=3)
        | st.lists(child, max_size=3).map(tuple)
        | st.dictionaries(st.text(max_size=3) | st.integers(), child, max_size=3)
        | st.lists(child, max_size=3).map(lambda items: deque(items, 7))
    ),
    max_leaves=12,
)


def same(one: Any, other: Any) -> bool:
    """Whether two trees have the same types and the same values to the bit."""
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        pairs = zip(one.items(), other.items(), strict=True)
        return len(one) == len(other) and all(same(a, b) for a, b in pairs)
    if isinstance(one, (list, tuple, deque)):
        return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
    if isinstance(one, np.ndarray):
        return (
            one.dtype == other.dtype
            and one.shape == other.shape
            and one.tobytes() == other.tobytes()
        )
    return bool(one == other)


@given(TREES)
def test_a_tree_comes_back(tree: Any) -> None:
    assert same(decode(encode(tree)), tree)


def test_a_random_generator_continues_and_spawns_as_before() -> None:
    generator = np.random.default_rng(3)
    generator.standard_normal(5)
    generator.spawn(2)
    generator.integers(9, dtype=np.int32)  # half of a 64-bit number is kept for later
    copied = decode(encode(generator))
    assert (
        copied.integers(2**31, size=4, dtype=np.int32).tolist()
        == generator.integers(2**31, size=4, dtype=np.int32).tolist()
    )
    assert copied.spawn(1)[0].random() == generator.spawn(1)[0].random()


def test_the_classes_of_an_environment_come_back() -> None:
    statistics = EpisodeStatistics(2)
    statistics.add(np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([True, False]))
    streams, copied = decode(encode((Streams.seeded(1), statistics)))
    assert type(streams) is Streams
    assert streams.goals.random() == Streams.seeded(1).goals.random()
    assert copied.of(0) == statistics.of(0)
    copied.add(np.zeros(2), np.zeros(2), np.zeros(2, np.bool_))
    assert copied.steps.tolist() == [2.0, 2.0]


def test_tensors_and_numbers_of_numpy_come_back() -> None:
    tensor = torch.arange(6.0).reshape(2, 3)
    other, number = decode(encode([tensor.T, np.float32(0.1)]))
    assert torch.equal(other, tensor.T)
    assert type(number) is np.float32


def test_decoded_arrays_can_be_changed_and_do_not_share_memory() -> None:
    one, other = decode(encode([np.zeros(3), np.zeros(3)]))
    one[0] = 1.0
    assert other[0] == 0.0


@pytest.mark.parametrize(
    "value",
    [
        {1, 2},
        b"bytes",
        OrderedDict(a=1),
        np.array(["text"]),
        np.array([None]),
        np.ma.masked_array([1.0]),
        np.random.Generator(np.random.MT19937(0)),
        1j,
        print,
    ],
)
def test_another_type_is_refused_when_it_is_written(value: Any) -> None:
    with pytest.raises(GymMaraError, match="a checkpoint cannot hold a"):
        encode({"state": [value]})


def test_each_flipped_bit_is_found() -> None:
    content = encode({"a": [1, 2.5, "text"], "q": np.arange(5.0)})
    for place in range(len(content)):
        for bit in range(8):
            changed = bytearray(content)
            changed[place] ^= 1 << bit
            with pytest.raises(DamagedFileError):
                decode(bytes(changed))


@pytest.mark.parametrize("content", [b"", b"text", pickle.dumps({}), encode([1])[:-1]])
def test_what_is_no_snapshot_is_an_error(content: bytes) -> None:
    with pytest.raises(DamagedFileError, match="no snapshot"):
        decode(content)


@pytest.mark.parametrize(
    "tree",
    [
        {"decoded": 1},
        {"__class__": []},
        {"array": ["<f8", [10**12]]},
        {"array": ["O", [1]]},
        {"array": ["<f8", [-1]]},
        {"array": ["<f8"]},
        {"dict": [[{"list": []}, 1]]},
        {"dict": [[1]]},
        {"list": 3},
        {"streams": [1]},
        {"generator": [1, 2]},
        {"generator": [{"dict": [["entropy", "x"]]}, 2]},
        {"statistics": ["<f8", []]},
        {"tensor": [">f8", [0]]},
        {},
        [],
    ],
)
def test_a_forged_snapshot_is_an_error(tree: Any) -> None:
    forged(json.dumps(tree).encode())


def test_a_deeply_nested_snapshot_is_an_error() -> None:
    forged(b'{"list":[' * 100_000)


def forged(text: bytes) -> None:
    """Decode a snapshot whose checksum is right."""
    rest = len(text).to_bytes(8, "big") + text
    first_line = encode(0).split(b"\n", 1)[0] + b"\n"
    with pytest.raises(DamagedFileError, match="no snapshot"):
        decode(first_line + hashlib.sha256(rest).digest() + rest)


def test_contacts_come_back() -> None:
    contacts = [(), (Contact(("base", "tool"), 0.001),)]
    assert decode(encode(contacts)) == contacts
    assert type(decode(encode(contacts))[1][0]) is Contact
