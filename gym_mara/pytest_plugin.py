"""A pytest fixture that guards reward functions; installed with gym_mara, found by pytest."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

pytest.register_assert_rewrite("gym_mara.testing")


@pytest.fixture
def check_rewards() -> Callable[..., None]:
    """Fails a test where the rewards are not what a record says: `check_rewards(file, backend=…, tolerance=…)`.

    Write the record with `gym-mara rewards --env ENV --record FILE`.
    """
    # Imported here: pytest loads this module wherever gym_mara is installed.
    from gym_mara import regression

    def check(file: Path | str, backend: str | None = None, tolerance: float = 1e-9) -> None:
        moved = regression.check(Path(file), backend, tolerance)
        if moved:
            shown = "\n".join(map(str, moved[:20]))
            pytest.fail(f"{len(moved)} values moved from {file}:\n{shown}", pytrace=False)

    return check
