"""The statistics of pictures are those of their values."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from gym_mara.datasets.statistics import of_pictures, of_values


@pytest.mark.parametrize("size", [1, 2, 7, 32])
@pytest.mark.parametrize("values", [1, 3, 256])
def test_statistics_of_pictures_are_those_of_their_values(size: int, values: int) -> None:
    drawn = np.random.default_rng(size).integers(256 - values, 256, (3, size, size, 3))
    pictures = drawn.astype(np.uint8)
    expected = of_values(pictures.reshape(-1, 3) / 255.0)
    found = of_pictures(pictures)
    assert found.keys() == expected.keys()
    assert found.pop("count").tolist() == [3]
    for name, each in found.items():
        assert each.shape == (3, 1, 1)
        np.testing.assert_allclose(each.reshape(3), expected[name], atol=1e-12, err_msg=name)


def test_they_need_less_memory_than_the_pictures() -> None:
    pictures = np.zeros((100, 64, 64, 3), np.uint8)
    tracemalloc.start()
    try:
        of_pictures(pictures)
        assert tracemalloc.get_traced_memory()[1] < pictures.nbytes
    finally:
        tracemalloc.stop()
