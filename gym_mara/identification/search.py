"""The search for the parameters with which a backend follows a log best, by least squares."""

from __future__ import annotations

import math

import numpy as np

from gym_mara.identification.following import Follower
from gym_mara.identification.parameters import Space
from gym_mara.identification.start import FRICTIONS
from gym_mara.types import Floats

_STEP, _ROUGH_STEP = 3e-4, 1e-2
"""Of finite differences, in the coordinates of the search. Friction that sticks and slips makes larger ones miss the valleys;
the latency needs the larger one, a motor at its limit feels it only by whole physics steps."""
_SMALLEST_ERROR = 1e-6
"""The precision of encoders at best, rad (m)."""
_NEAR = np.array([0.4, 0.6, 0.75, 0.87, 0.95, 1.05, 1.15, 1.3])
"""Parts of the present friction that are tried."""
_SEEN = 10.0
"""An effort limit was reached if a higher one makes the sum of squares, in units of its variance, this much larger."""


class Search:
    """Improves a parameter vector.

    Args:
        space: the parameters.
        follower: what follows the log.
        vector: where the search begins (P,).
    """

    def __init__(self, space: Space, follower: Follower, vector: Floats) -> None:
        self.space, self.vector = space, vector
        self._follower = follower
        self.searched = list(range(len(vector)))
        """The entries that are still searched; the others stay."""
        self.deviation = np.ones(0)
        """The root mean square error of each joint (J,), rad (m)."""
        self.physics_step = follower.arms(1).physics_step

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
            return self._residuals(self._vectors(coordinates[None]), segment)[0]

        def jacobian(coordinates: Floats) -> Floats:
            return self.jacobian(self._vectors(coordinates[None])[0], segment, rough=rough)

        low, high = space.stretched(space.low)[own], space.stretched(space.high)[own]
        result = least_squares(
            residuals,
            np.clip(space.stretched(space.inside(self.vector))[own], low, high),
            jacobian,
            bounds=(low, high),
            x_scale=0.1,
            ftol=1e-4,
            xtol=1e-5,
            loss="soft_l1" if rough else "linear",
            max_nfev=evaluations,
        )
        self.vector = self._vectors(result.x[None])[0]

    def measure(self, segment: float = math.inf) -> None:
        """Note the error of each joint."""
        errors = self._follower.errors(self.vector[None], segment)[0]
        self.deviation = np.maximum(np.sqrt((errors**2).mean(axis=0)), _SMALLEST_ERROR)

    def jacobian(self, vector: Floats, segment: float = math.inf, *, rough: bool = False) -> Floats:
        """The derivatives of the residuals ((T - 1) J, S) by the S coordinates that are searched.

        Args:
            vector: where (P,).
            segment: as in `Follower.errors`.
            rough: whether servos and friction of a joint are taken to move that joint alone. It takes a fifth of the time.
        """
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
        joints = len(self.deviation)
        residuals = self._residuals(self._vectors(moved), segment).reshape(len(moved), -1, joints)
        jacobian = np.zeros((*residuals.shape[1:], len(own)))
        for row, columns in enumerate(groups.values(), 1):
            for column in columns:
                joint = space.entries[own[column]][1]
                seen = slice(None) if len(columns) == 1 or joint is None else joint
                change = residuals[row, :, seen] - residuals[0, :, seen]
                jacobian[:, seen, column] = change / steps[column]
        return jacobian.reshape(-1, len(own))

    def residuals(self) -> Floats:
        """The errors of the arm by their deviations ((T - 1) J,)."""
        return self._residuals(self.vector[None], math.inf)[0]

    def _residuals(self, vectors: Floats, segment: float) -> Floats:
        errors = self._follower.errors(vectors, segment) / self.deviation
        return errors.reshape(len(vectors), -1)

    def _vectors(self, coordinates: Floats) -> Floats:
        """Whole vectors (M, P) from the coordinates (M, S) that are searched."""
        whole = np.zeros((len(coordinates), len(self.vector)))
        whole[:, self.searched] = coordinates
        vectors = np.tile(self.vector, (len(coordinates), 1))
        vectors[:, self.searched] = self.space.natural(whole)[:, self.searched]
        return vectors

    def try_frictions(self, *, near: bool = False) -> None:
        """Give each joint the best joint friction for which effort limit - friction stays.

        A motor that speeds up shows only that difference, so least squares may end far away on this line.

        Args:
            near: whether frictions near the present one are tried, and not all.
        """
        space, tried, changed = self.space, [self.vector], [(0, 0)]
        for effort in space.of("effort_limit"):
            for friction in space.of("joint_friction"):
                limit = space.effort_limit(friction)
                net = self.vector[effort] * limit - self.vector[friction]
                same = space.entries[effort][1] == space.entries[friction][1]
                if not same or effort not in self.searched or net <= 0.0:
                    continue
                now = self.vector[friction] / (net + self.vector[friction])
                for part in now * _NEAR if near else FRICTIONS:
                    vector = self.vector.copy()
                    vector[effort] = net / (1.0 - part) / limit
                    vector[friction] = part * net / (1.0 - part)
                    tried.append(space.inside(vector))
                    changed.append((effort, friction))
        errors = self._follower.errors(np.array(tried))
        # The likelihood, for errors of each joint whose deviation is not known.
        costs = np.log((errors**2).sum(axis=1) + _SMALLEST_ERROR**2).sum(axis=1)
        for pair in set(changed[1:]):
            own = [0, *(index for index, other in enumerate(changed) if index and other == pair)]
            best = own[int(costs[own].argmin())]
            self.vector[list(pair)] = tried[best][list(pair)]

    def leave_out_unreached(self) -> list[int]:
        """Leave out the effort limits that were not reached: higher ones explain the log as well; returns these entries.

        The friction of such a joint does not show either, and is left out with it.
        """
        own = [index for index in self.space.of("effort_limit") if index in self.searched]
        if not own:
            return []
        self.measure()
        tried = np.tile(self.vector, (1 + len(own), 1))
        for row, index in enumerate(own, 1):
            higher = max(1.0, 2.0 * self.vector[index])
            tried[row, index] = min(higher, self.space.high[index])
        squares = (self._residuals(tried, math.inf) ** 2).sum(axis=1)
        unreached = []
        for row, index in enumerate(own, 1):
            if squares[row] - squares[0] < _SEEN:
                self.vector[index] = tried[row, index]
                joint = self.space.entries[index][1]
                friction = [
                    i for i in self.space.of("joint_friction") if self.space.entries[i][1] == joint
                ]
                for each in (index, *friction):
                    self.searched.remove(each)
                    unreached.append(each)
        return unreached
