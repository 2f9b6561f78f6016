"""Residual and Jacobian of an estimation problem at one point, each record by what it feels alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array

__all__ = ["Evaluation"]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Weighted residual and Jacobian at one point.

    Attributes
    ----------
    residual : ndarray, shape (rows,)
        Of one record after the other, then of the priors.
    blocks : list of ndarray
        Jacobian of the rows of each record, by what they feel alone.
    columns : list of ndarray of int
        Unknowns that these are: the coefficients and the initial state of that record.
    prior : ndarray, shape (., size)
        Jacobian of the rows of the priors.
    finite : bool
        Whether no simulation blew up.
    """

    residual: Array
    blocks: list[Array]
    columns: list[NDArray[np.intp]]
    prior: Array
    finite: bool

    @cached_property
    def jacobian(self) -> Array:
        """All of the Jacobian, shape (rows, size)."""
        return self._stacked(self.blocks)

    @cached_property
    def condensed(self) -> tuple[Array, Array]:
        """Residual and Jacobian turned, record by record, into as few rows as unknowns: `turned`."""
        return self.turned(self.residual)

    def turned(self, residual: Array) -> tuple[Array, Array]:
        """A residual and the Jacobian, the rows of each record turned until all but a few are zero.

        Sums of squares, gradients and normal matrices are as before; what is done with them no longer
        costs time and room for samples times unknowns of all records. One record alone stays as it is.
        """
        if len(self.blocks) == 1:
            return residual, self.jacobian
        rows, blocks, at = [], [], 0
        for block in self.blocks:
            both = np.column_stack([block, residual[at : at + len(block)]])
            found: Any = np.linalg.qr(both, mode="r")
            rows.append(found[:, -1])
            blocks.append(found[:, :-1])
            at += len(block)
        return np.concatenate([*rows, residual[at:]]), self._stacked(blocks)

    def _stacked(self, blocks: list[Array]) -> Array:
        count = sum(len(block) for block in blocks)
        found = np.zeros((count + len(self.prior), self.prior.shape[1]))
        at = 0
        for block, columns in zip(blocks, self.columns, strict=True):
            found[at : at + len(block), columns] = block
            at += len(block)
        found[count:] = self.prior
        return found
