"""A viewer whose program steps in a thread of its own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.viewer.stepping import Loop


@pytest.fixture
def loop() -> Iterator[Loop]:
    stepping = Loop()
    stepping.start()
    try:
        yield stepping
    finally:
        stepping.stop()
