"""Optimization coordinates in which every constraint is a bound.

In these coordinates the size of a force law does not depend on its exponent.
"""

from __future__ import annotations

import numpy as np

from ..engine.structure import Structure
from ..systems.linear import Array

__all__ = ["Coordinates"]


class Coordinates:
    """Coefficients and initial states, as a descent takes them.

    A coefficient that exceeds another becomes the excess. The size of a power of the motion becomes that at
    the usual motion: at unit motion, which may be far off, it changes by decades with the power, and a
    descent creeps along that valley.

    Attributes
    ----------
    ordered : list of (int, int)
        Columns of theta of which the first is never below the second.
    powers : list of (int, int, float)
        Columns of theta of a size and of its power, with the logarithm of the usual motion.
    """

    def __init__(self, structure: Structure) -> None:
        self.ordered: list[tuple[int, int]] = []
        self.powers: list[tuple[int, int, float]] = []
        for index, effect in enumerate(structure.effects):
            for names in effect.spec.order:
                pair = structure.position(index, names[0]), structure.position(index, names[1])
                self.ordered += [pair] if min(pair) >= 0 else []
            usual = structure.constants.get(index, 0.0) / (effect.spec.width_share or np.inf)
            for names in effect.spec.powers if 0.0 < usual < np.inf else ():
                pair = structure.position(index, names[0]), structure.position(index, names[1])
                self.powers += [(*pair, float(np.log(usual)))] if min(pair) >= 0 else []

    def of(self, point: Array) -> Array:
        """The coordinates of a point."""
        box = point.copy()
        for size, power, usual in self.powers:
            box[size] *= np.exp(usual * point[power])
        for larger, smaller in self.ordered:
            box[larger] -= point[smaller]
        return box

    def point(self, box: Array) -> Array:
        """The point of these coordinates."""
        point = box.copy()
        for larger, smaller in self.ordered:
            point[larger] += box[smaller]
        for size, power, usual in self.powers:
            point[size] *= np.exp(-usual * point[power])
        return point

    def columns(self, jacobian: Array, point: Array) -> Array:
        """Convert derivatives at a point into those by its coordinates.

        The shape is (rows, size).
        """
        if not self.ordered and not self.powers:
            return jacobian
        turned = jacobian.copy()
        for size, power, usual in self.powers:
            turned[:, power] -= usual * point[size] * jacobian[:, size]
            turned[:, size] *= np.exp(-usual * point[power])
        for larger, smaller in self.ordered:
            turned[:, smaller] += jacobian[:, larger]
        return turned
