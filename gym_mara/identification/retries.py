"""Other effort limits and frictions, where least squares end in a local minimum."""

from __future__ import annotations

import numpy as np

from gym_mara.identification.search import Search
from gym_mara.identification.start import FRICTIONS
from gym_mara.types import Floats

_NEAR = np.array([0.5, 0.75, 0.9, 1.1, 1.3])
"""Parts of the present friction that are tried."""
_NETS = np.geomspace(0.15, 1.4, 6)
"""What is left of the effort limit without friction, in parts of the robot's, that is tried where none was reached."""
_NET_FRICTION = 0.15
"""The friction that is tried with these, in parts of the effort limit."""
SEEN = 10.0
"""A change shows in the log if it changes the sum of squares, in units of their variance, by more than this."""
_REACHED = 2.0
"""An effort limit was reached if without it the squared error of a joint is this many times as large. Friction that sticks
and slips fits smaller errors by chance, at wrong values."""


def retry(search: Search, *, near: bool = False, unreached: bool = False) -> bool:
    """Give each joint a better effort limit and friction, if there are; returns whether there were.

    A motor that speeds up shows only the difference of the two, so least squares may end far away on the line on which it
    is the same. A joint that seemed not to reach its limit, while the others were far off, may reach it after all.

    Args:
        search: where it is, and what is changed.
        near: whether frictions near the present one are tried, and not all.
        unreached: whether joints that seemed not to reach their limits are tried as well.
    """
    tried, owners = [search.vector], [-1]
    joints = [own for own in _joints(search) if unreached or own[0] in search.searched]
    for number, own in enumerate(joints):
        for values in _others(search, own, near):
            vector = search.vector.copy()
            vector[own] = values[: len(own)]
            tried.append(search.space.inside(vector))
            owners.append(number)
    if not joints:
        return False
    errors = search.errors(np.array(tried))
    costs, ticks = _costs(errors), errors.shape[1]
    better = False
    for number, own in enumerate(joints):
        rows = np.flatnonzero(np.array(owners) == number)
        best = rows[costs[rows].argmin()] if len(rows) else 0
        enough = ticks * np.log(_REACHED) if own[0] in search.left_out else SEEN
        if costs[best] < costs[0] - enough:
            better = True
            search.vector[own] = tried[best][own]
            _search_again(search, own)
    return better


def _joints(search: Search) -> list[list[int]]:
    """The entries of effort limit and, if it is identified, of friction, of each joint."""
    space = search.space
    frictions = space.of("joint_friction")
    return [
        [effort, *(i for i in frictions if space.entries[i][1] == space.entries[effort][1])]
        for effort in space.of("effort_limit")
    ]


def _others(search: Search, own: list[int], near: bool) -> list[tuple[float, float]]:
    """Effort limits (scales) and frictions, Nm (N), of a joint that may be better."""
    limit, friction = search.space.effort_limit(own[0]), search.vector[own[1:]].sum()
    net = search.vector[own[0]] * limit - friction
    if own[0] in search.left_out:
        parts = [(part * limit, _NET_FRICTION if own[1:] else 0.0) for part in _NETS.tolist()]
    elif net <= 0.0 or not own[1:]:
        return []
    else:
        now = friction / (net + friction)
        parts = [(net, part) for part in (now * _NEAR if near else FRICTIONS).tolist()]
    return [(net / (1.0 - part) / limit, part * net / (1.0 - part)) for net, part in parts]


def _costs(errors: Floats) -> Floats:
    """Twice the negative logarithm of the likelihood (M,) of errors of each joint whose deviation is not known (M, T, J)."""
    squares = (errors**2).mean(axis=1) + 1e-12
    return np.asarray(errors.shape[1] * np.log(squares).sum(axis=1))


def _search_again(search: Search, entries: list[int]) -> None:
    search.left_out = [index for index in search.left_out if index not in entries]
    search.searched = sorted({*search.searched, *entries})


def leave_out_unreached(search: Search) -> None:
    """Leave out the effort limits that were not reached: higher ones explain the log nearly as well.

    The friction of such a joint does not show either, and is left out with it.
    """
    space = search.space
    own = [index for index in space.of("effort_limit") if index in search.searched]
    if not own:
        return
    search.measure()
    tried = np.tile(search.vector, (1 + len(own), 1))
    for row, index in enumerate(own, 1):
        tried[row, index] = min(max(1.0, 2.0 * search.vector[index]), space.high[index])
    errors = search.errors(tried)
    squares = ((errors / search.deviation) ** 2).sum(axis=(1, 2))
    for row, index in enumerate(own, 1):
        if squares[row] - squares[0] < (_REACHED - 1.0) * errors.shape[1]:
            search.vector[index] = tried[row, index]
            joint = space.entries[index][1]
            friction = [i for i in space.of("joint_friction") if space.entries[i][1] == joint]
            for each in (index, *friction):
                search.searched.remove(each)
                search.left_out.append(each)
