"""How speeds are measured and printed: what is compared runs in turn, and the best of several turns counts."""

from __future__ import annotations

import time
from collections.abc import Callable

REPETITIONS = 15
SECONDS = 0.2


def rates(
    functions: dict[str, Callable[[], int]], seconds: float = REPETITIONS * SECONDS
) -> dict[str, float]:
    """Steps per second of each function, the best of several turns that take `seconds` in all; a function returns its number of steps."""
    best = dict.fromkeys(functions, 0.0)
    for function in functions.values():
        function()  # warm up
    for _ in range(REPETITIONS):
        for name, function in functions.items():
            steps, start = 0, time.perf_counter()
            while (elapsed := time.perf_counter() - start) < seconds / REPETITIONS:
                steps += function()
            best[name] = max(best[name], steps / elapsed)
    return best


def row(*cells: object) -> None:
    """Print a row of a Markdown table."""
    print("|", " | ".join(str(cell) for cell in cells), "|", flush=True)
