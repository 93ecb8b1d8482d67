"""Fixtures of the rendering tests."""

from __future__ import annotations

import pytest

from gym_mara.rendering import RENDERERS


@pytest.fixture(params=RENDERERS)
def renderer(request: pytest.FixtureRequest) -> str:
    """The name of each renderer."""
    return str(request.param)
