"""Normal equations of records with common and individual unknowns.

The records share their first unknowns, and each has a few of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .systems.linear import Array

_UNSEEN = 1e-14  # eigenvalue of the unit-column normal matrix, relative, below which a direction is not seen


@dataclass(frozen=True, eq=False)
class Bordered:
    """J'J and J'r by blocks: time and room grow with the number of records.

    Attributes
    ----------
    common : ndarray, shape (p, p)
        Of the unknowns that all records share; they come first.
    cross : ndarray, shape (R, p, n)
        Of these with what each record feels alone.
    own : ndarray, shape (R, n, n)
        Of what each record feels alone.
    gradient : ndarray, shape (p + R n,)
        J'r.
    """

    common: Array
    cross: Array
    own: Array
    gradient: Array

    @classmethod
    def of(cls, blocks: Sequence[Array], residuals: Sequence[Array], p: int) -> Bordered:
        """Assemble the normal equations from all records.

        `blocks` holds the derivatives (rows, p + n) of each record, `residuals` its residual (rows,).
        """
        normal = np.array([block.T @ block for block in blocks])
        slope = np.array([block.T @ r for block, r in zip(blocks, residuals, strict=True)])
        gradient = np.concatenate([slope[:, :p].sum(axis=0), slope[:, p:].ravel()])
        return cls(normal[:, :p, :p].sum(axis=0), normal[:, :p, p:], normal[:, p:, p:], gradient)

    @property
    def norms(self) -> Array:
        """Norm of each column of J."""
        own = np.diagonal(self.own, axis1=1, axis2=2).ravel()
        return np.asarray(np.sqrt(np.concatenate([np.diag(self.common), own])))

    def _split(self, values: Array) -> tuple[Array, Array]:
        p = len(self.common)
        return values[:p], values[p:].reshape(self.own.shape[:2])

    def square(self, step: Array) -> float:
        """Sum of squares of J times a step."""
        first, own = self._split(step)
        return float(
            first @ self.common @ first
            + 2.0 * np.einsum("i,rij,rj", first, self.cross, own)
            + np.einsum("ri,rij,rj", own, self.own, own)
        )

    def step(self, keep: NDArray[np.bool_], damping: float) -> Array:
        """Return the damped least-squares step in some unknowns.

        The damping is relative to the square of each column.

        Directions that the rows do not determine stay where they are.
        """
        norms = self.norms
        scale = np.where(keep, 1.0 / np.where(norms > 0, norms, 1.0), 0.0)
        first, own = self._split(scale)
        g, h = self._split(self.gradient * scale)
        common = self.common * np.outer(first, first) + np.diag((first == 0).astype(float))
        cross = self.cross * first[:, None] * own[:, None, :]
        inner = self.own * own[:, :, None] * own[:, None, :]
        inner = inner + np.eye(own.shape[1]) * (own == 0)[:, None, :]
        values, vectors = np.linalg.eigh(inner)
        top = max(float(values.max(initial=0.0)), float(np.linalg.eigvalsh(common)[-1]) if g.size else 0.0)
        seen = values > _UNSEEN * top
        turned, pushed = cross @ vectors, np.einsum("rij,ri->rj", vectors, h)
        inverse, plain = (
            np.where(seen, 1.0 / np.where(seen, values + by, 1.0), 0.0) for by in (damping, 0.0)
        )
        # what the records leave of the common unknowns once their own follow
        left = common - _through(turned, plain)
        level, along = np.linalg.eigh(left)
        along = along[:, level > _UNSEEN * top]
        damped = common + damping * np.eye(g.size)
        damped -= _through(turned, inverse)
        push = along.T @ (g - np.einsum("rik,rk->i", turned, inverse * pushed))
        moved = -along @ np.linalg.solve(along.T @ damped @ along, push)
        follow = -np.einsum("rij,rj->ri", vectors, inverse * (pushed + np.einsum("rij,i->rj", turned, moved)))
        return np.concatenate([moved, follow.ravel()]) * scale

    def condensed(self) -> Array:
        """Return the normal matrix (p, p) of the common unknowns.

        The unknowns of the single records are eliminated.
        """
        norms = self.norms
        _, own = self._split(np.where(norms > 0, 1.0 / np.where(norms > 0, norms, 1.0), 0.0))
        values, vectors = np.linalg.eigh(self.own * own[:, :, None] * own[:, None, :])
        seen = values > _UNSEEN * values.max(initial=0.0)
        turned = (self.cross * own[:, None, :]) @ vectors
        inverse = np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)
        return np.asarray(self.common - _through(turned, inverse))


def _through(turned: Array, inverse: Array) -> Array:
    """Sum over the records of T diag(d) T', of T (R, p, n) and d (R, n)."""
    return np.asarray(np.tensordot(turned * inverse[:, None, :], turned, axes=((0, 2), (0, 2))))
