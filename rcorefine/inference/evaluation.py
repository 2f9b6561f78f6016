"""Residual and Jacobian of an estimation problem at one point.

The Jacobian of each record has a column for each unknown that affects the record.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bordered import Bordered
from ..systems.linear import Array
from .whitening import Whitener


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

    @property
    def by_record(self) -> list[tuple[slice, Array]]:
        """Rows of each record, and its Jacobian by what it feels alone."""
        ends = np.cumsum([len(block) for block in self.blocks])
        return [(slice(int(end) - len(b), int(end)), b) for end, b in zip(ends, self.blocks, strict=True)]

    def coefficients(self, count: int) -> Array:
        """Jacobian of all rows by the coefficients, shape (rows, count)."""
        return np.concatenate([*(block[:, :count] for block in self.blocks), self.prior[:, :count]])

    def bordered(
        self, count: int, whitener: Whitener | None, turn: Callable[[Array], Array], kept: Any = ...
    ) -> Bordered:
        """Normal equations by records.

        Parameters
        ----------
        count : int
            Coefficients.
        whitener : Whitener or None
            Metric; the rows of the priors stay as they are.
        turn : callable
            Derivatives by the point into those by its coordinates.
        kept : ndarray of int, optional
            Coefficients that move; by default all.
        """
        tail = self.residual[sum(len(block) for block in self.blocks) :]
        common = ~self.prior[:, count:].any(axis=1)
        blocks, residuals = [], []
        for k, ((rows, block), columns) in enumerate(zip(self.by_record, self.columns, strict=True)):
            held = self.prior[:, columns[count:]].any(axis=1)
            held = held | common if k == 0 else held
            residual = self.residual[rows]
            if whitener is not None:
                shape = (len(whitener.filters), -1)
                residual = whitener.apply([residual.reshape(shape)])
                block = whitener.apply([block.reshape(*shape, block.shape[1])])
            J = turn(np.concatenate([block, self.prior[np.ix_(held, columns)]]))
            blocks.append(np.hstack([J[:, :count][:, kept], J[:, count:]]))
            residuals.append(np.concatenate([residual, tail[held]]))
        return Bordered.of(blocks, residuals, blocks[0].shape[1] - self.columns[0].size + count)

    @cached_property
    def jacobian(self) -> Array:
        """All of the Jacobian, shape (rows, size)."""
        return self._stacked(self.blocks)

    @cached_property
    def condensed(self) -> tuple[Array, Array]:
        """Return the residual and the Jacobian in as few rows as unknowns.

        Each record is condensed separately; see `turned`.
        """
        return self.turned(self.residual)

    def turned(self, residual: Array) -> tuple[Array, Array]:
        """Condense a residual and the Jacobian into fewer rows.

        A QR decomposition of each record rotates its rows until all but a few are zero.

        Sums of squares, gradients and normal matrices do not change. Later steps need less time and memory,
        which no longer grow with samples times unknowns of all records. A single record stays as it is.
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
