"""The pytest fixture `check_rewards`, which detects changes of a reward function. pytest finds it by an entry point."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

pytest.register_assert_rewrite("gym_mara.testing")


@pytest.fixture
def check_rewards() -> Callable[..., None]:
    """Fails the test if the rewards differ from a record: `check_rewards(file, backend=…, tolerance=…)`.

    To write a record, run `gym-mara rewards --env ENV --record FILE`.
    """
    # Imported here, because pytest loads this module in every project where gym_mara is installed.
    from gym_mara import regression

    def check(file: Path | str, backend: str | None = None, tolerance: float = 1e-9) -> None:
        moved = regression.check(Path(file), backend, tolerance)
        if moved:
            shown = "\n".join(map(str, moved[:20]))
            pytest.fail(
                f"{len(moved)} values differ from the record {file}:\n{shown}", pytrace=False
            )

    return check
