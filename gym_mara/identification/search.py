"""The search for the parameters with which a backend follows a log best, by least squares."""

from __future__ import annotations

import math

import numpy as np

from gym_mara.identification.following import Followers
from gym_mara.identification.parameters import Space
from gym_mara.types import Floats

_STEP, _ROUGH_STEP = 3e-4, 1e-2
"""Of finite differences, in the coordinates of the search. Friction that sticks and slips makes larger ones miss the valleys;
the latency needs the larger one, a motor at its limit feels it only by whole physics steps."""
_TOLERANCE, _ROUGH_TOLERANCE = 1e-4, 1e-2
"""Least squares end where the sum of squares decreases by less than this part."""
_CLOSE = 2e-3
"""Derivatives are used again where no coordinate is this far from where they were computed."""
_SMALLEST_ERROR = 1e-6
"""The precision of encoders at best, rad (m)."""


class Search:
    """Improves a parameter vector.

    Args:
        space: the parameters.
        followers: what follows the log.
        vector: where the search begins (P,).
    """

    def __init__(self, space: Space, followers: Followers, vector: Floats) -> None:
        self.space, self.vector = space, vector
        self.searched = list(range(len(vector)))
        """The entries that are still searched; the others stay."""
        self.left_out: list[int] = []
        """The entries that do not show in the log."""
        self.deviation = np.ones(0)
        """The root mean square error of each joint (J,), rad (m)."""
        self.physics_step = followers.physics_step
        self.errors = followers.errors
        self._known: tuple[object, Floats, Floats] | None = None
        """Derivatives of the errors: what they are of, where, and themselves ((T - 1), J, S)."""

    def descend(self, segment: float, evaluations: int, *, rough: bool = False) -> None:
        """Least squares, in which each joint counts by its error before.

        Args:
            segment: as in `Follower.errors`.
            evaluations: at most so many.
            rough: whether to be fast, and not to mind outliers.
        """
        from scipy.optimize import least_squares  # it takes a moment

        space, own = self.space, self.searched
        self.measure(segment)

        def residuals(coordinates: Floats) -> Floats:
            return self.residuals(self.vectors(coordinates[None])[0], segment)

        def jacobian(coordinates: Floats) -> Floats:
            return self.jacobian(self.vectors(coordinates[None])[0], segment, rough=rough)

        low, high = space.stretched(space.low)[own], space.stretched(space.high)[own]
        result = least_squares(
            residuals,
            np.clip(space.stretched(space.inside(self.vector))[own], low, high),
            jacobian,
            bounds=(low, high),
            x_scale=0.1,
            ftol=_ROUGH_TOLERANCE if rough else _TOLERANCE,
            xtol=1e-5,
            loss="soft_l1" if rough else "linear",
            max_nfev=evaluations,
        )
        self.vector = self.vectors(result.x[None])[0]

    def measure(self, segment: float = math.inf) -> None:
        """Note the error of each joint."""
        errors = self.errors(self.vector[None], segment)[0]
        self.deviation = np.maximum(np.sqrt((errors**2).mean(axis=0)), _SMALLEST_ERROR)

    def residuals(self, vector: Floats, segment: float = math.inf) -> Floats:
        """The errors of an arm with these parameters (P,) by their deviations ((T - 1) J,)."""
        return (self.errors(vector[None], segment)[0] / self.deviation).ravel()

    def jacobian(self, vector: Floats, segment: float = math.inf, *, rough: bool = False) -> Floats:
        """The derivatives of the residuals ((T - 1) J, S) by the S coordinates that are searched.

        They may be those of parameters that are very close, which the search computed last.

        Args:
            vector: where (P,).
            segment: as in `Follower.errors`.
            rough: whether servos and friction of a joint are taken to move that joint alone. It takes a fifth of the time.
        """
        where = self.space.stretched(vector)
        what = segment, rough, tuple(self.searched)
        if (
            self._known is None
            or self._known[0] != what
            or np.abs(self._known[1] - where).max() > _CLOSE
        ):
            self._known = what, where, self._derivatives(vector, segment, rough)
        derivatives = self._known[2] / self.deviation[:, None]
        return derivatives.reshape(-1, len(self.searched))

    def _derivatives(self, vector: Floats, segment: float, rough: bool) -> Floats:
        """The derivatives of the errors ((T - 1), J, S), by finite differences of arms that follow at the same time."""
        space, own = self.space, self.searched
        coordinates = space.stretched(vector)[own]
        fine = [name != "latency" and not rough for name, _ in space.entries]
        step = np.where(fine, _STEP, _ROUGH_STEP)[own]
        steps = np.where(coordinates + step > space.stretched(space.high)[own], -step, step)
        groups: dict[object, list[int]] = {}
        for column, index in enumerate(own):
            name, joint = space.entries[index]
            together = rough and joint is not None and name != "mass"
            groups.setdefault(name if together else index, []).append(column)
        moved = np.tile(coordinates, (1 + len(groups), 1))
        for row, columns in enumerate(groups.values(), 1):
            moved[row, columns] += steps[columns]
        errors = self.errors(self.vectors(moved), segment)
        derivatives = np.zeros((*errors.shape[1:], len(own)))
        for row, columns in enumerate(groups.values(), 1):
            for column in columns:
                joint = space.entries[own[column]][1]
                seen = slice(None) if len(columns) == 1 or joint is None else joint
                change = errors[row, :, seen] - errors[0, :, seen]
                derivatives[:, seen, column] = change / steps[column]
        return derivatives

    def vectors(self, coordinates: Floats) -> Floats:
        """Whole vectors (M, P) from the coordinates (M, S) that are searched."""
        whole = np.zeros((len(coordinates), len(self.vector)))
        whole[:, self.searched] = coordinates
        vectors = np.tile(self.vector, (len(coordinates), 1))
        vectors[:, self.searched] = self.space.natural(whole)[:, self.searched]
        return vectors
