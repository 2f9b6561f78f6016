"""Likelihood gain when a part of the residual is explained."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ...gauss_newton import Rows, gauss_newton
from ...inference.whitening import Whitener, highest_order
from ...systems.linear import Array

# Differences below this share of an output are rounding, not evidence.
_FLOOR = 1e-7
_ROUNDING = 1e-10  # of a signal, below which what is left of it says nothing
_STEP = 1e-3  # of a shape's unknowns, for differences
_FAR = 2.0  # from the start of a search: shapes beyond are not trusted
_MASKED = 0.03  # weight of samples that are set aside


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """A part of the residual that a hypothesis explains.

    Attributes
    ----------
    fit : ndarray of shape (n_y, N)
        The part, in units of the outputs' spreads.
    gain : float
        Twice the log-likelihood that it adds.
    values : ndarray
        What was fitted: coefficients, then what was searched for.
    level : ndarray of shape (n_y, N), or 0
        What it says about constant offsets, of which `fit` is free.
    """

    fit: Array
    gain: float
    values: Array
    level: Array | float = 0.0


class ResidualLikelihood:
    """A residual, and what is taken out of everything before it is judged.

    The initial state (where compare estimated it) and a constant offset of each
    output are nuisances: they are projected off residual and explanations alike.
    The noise is an autoregressive process, estimated anew from what each
    explanation leaves, so that coloured noise is nobody's failure.

    Parameters
    ----------
    residual : ndarray of shape (n_y, N)
        Measured minus simulated, over the spread of each output.
    starts : sequence of int
        First sample of each free run.
    initial : ndarray of shape (L, n_y, n) or None
        Responses to unit initial states, the longest run; None where the
        initial state was not estimated.
    """

    def __init__(self, residual: Array, starts: Sequence[int], initial: Array | None) -> None:
        self.n_outputs, self.n_samples = residual.shape
        self.edges = [*starts, self.n_samples]
        self._bases: dict[int, Array] = {}
        # orthonormal bases of the nuisances: free motions and constants
        if initial is not None:
            for length in {b - a for a, b in pairwise(self.edges)}:
                rows = np.moveaxis(initial[:length], 0, 1).reshape(self.n_outputs * length, -1)
                u, s, _ = np.linalg.svd(rows, full_matrices=False)
                self._bases[length] = u[:, s > 1e-8 * s.max(initial=0.0)]
        self.order = highest_order(self.n_samples)
        ones = np.eye(self.n_outputs)[:, :, None] * np.ones(self.n_samples)
        self.constants = self._initial_out(ones)
        u, s, _ = np.linalg.svd(self.constants.reshape(self.n_outputs, -1).T, full_matrices=False)
        self._constant_basis = u[:, s > 1e-6 * np.sqrt(self.n_samples)]
        self._begin(self.without_nuisance(residual), self._initial_out(residual))

    def _begin(self, residual: Array, with_offset: Array) -> None:
        self.residual, self.with_offset = residual, with_offset
        self.use(residual)
        self.base = self.log_likelihood(residual)

    @property
    def is_rounding(self) -> bool:
        """Return whether the residual is below the floor of the noise."""
        return bool(np.all(np.abs(self.residual) <= _FLOOR))

    # ------------------------------------------------------------------ nuisances
    def _initial_out(self, signals: Array) -> Array:
        """Take the best initial states out of (..., n_y, N)."""
        if not self._bases:
            return signals.copy()
        out = np.empty_like(signals)
        for a, b in pairwise(self.edges):
            part, q = signals[..., a:b], self._bases[b - a]
            flat = part.reshape(*part.shape[:-2], -1)
            # subtract the projection Q Q' on the free motions, window by window
            out[..., a:b] = (flat - flat @ q @ q.T).reshape(part.shape)
        return out

    def without_nuisance(self, signals: Array) -> Array:
        """Return signals (..., n_y, N) without initial states and offsets."""
        left, q = self._initial_out(signals), self._constant_basis
        flat = left.reshape(*left.shape[:-2], -1)
        flat = flat - flat @ q @ q.T
        # of what a nuisance is, only rounding is left
        seen = np.linalg.norm(flat, axis=-1) > _ROUNDING * np.linalg.norm(signals, axis=(-2, -1))
        return np.where(seen[..., None, None], flat.reshape(left.shape), 0.0)

    def outside(self, mask: NDArray[np.bool_]) -> Array:
        """Return the residual with nuisances that are fitted outside a mask.

        The residual has shape (n_y, N). The nuisances are initial states and offsets. The masked samples keep
        a little weight, because the other samples may not determine an initial state.
        """
        # weighted least squares: the masked samples count little
        out = self.residual.copy()
        for a, b in pairwise(self.edges):
            level = np.repeat(np.eye(self.n_outputs), b - a, axis=0)
            basis = np.hstack([self._bases[b - a], level]) if self._bases else level
            weight = np.where(mask[:, a:b].reshape(-1), _MASKED, 1.0)[:, None]
            flat = out[:, a:b].reshape(-1)
            best = np.linalg.lstsq(basis * weight, flat * weight[:, 0], rcond=1e-8)[0]
            out[:, a:b] = (flat - basis @ best).reshape(self.n_outputs, b - a)
        return out

    def after(self, fit: Array, whole: Array) -> ResidualLikelihood:
        """Return the likelihood of the residual that an explanation leaves.

        The explanation is given without constant offsets (`fit`) and with them (`whole`).
        """
        rest = copy.copy(self)
        rest._begin(self.residual - fit, self.with_offset - whole)
        return rest

    # ------------------------------------------------------------------ noise
    def use(self, remainder: Array) -> None:
        """Take the noise model from this remainder."""
        self.whitener = self._noise(remainder)
        self._white = self._whiten(self.residual)

    def use_white(self) -> None:
        """Weight all frequencies equally.

        This is right where a failure is far above the noise.
        """
        self.whitener = Whitener((np.ones(1),) * self.n_outputs, np.ones(self.n_outputs))
        self._white = self._whiten(self.residual)

    def _noise(self, remainder: Array) -> Whitener:
        """One order for all remainders: their likelihoods are compared."""
        return Whitener.fit([remainder], order=self.order, floor=_FLOOR)

    def log_likelihood(self, remainder: Array) -> float:
        """Return the log-likelihood of a remainder under its own noise model.

        A constant is left out.
        """
        return self._noise(remainder).log_likelihood([remainder[:, self.order :]])

    def _whiten(self, signals: Array) -> Array:
        return self.whitener.apply([signals])

    def white(self, columns: Sequence[Array] | Array) -> tuple[Array, Array]:
        """Return whitened columns (rows, k) and residual (rows,).

        Nuisance parameters are removed from both.
        """
        return np.array(
            [self._whiten(left) for left in self.without_nuisance(np.array(columns))]
        ).T, self._white

    # ------------------------------------------------------------------ explanations
    def linear(self, columns: Sequence[Array]) -> Explanation:
        """Fit columns (n_y, N) to the residual by least squares.

        The result includes the gain in log-likelihood.
        """
        # whitened least squares
        values = least_squares(*self.white(columns))
        return self._explanation(np.tensordot(values, np.array(columns), 1), values)

    def best_of(self, groups: Sequence[Sequence[Array]], most: int = 3) -> list[tuple[int, Explanation]]:
        """Return the groups of columns that explain the most, with their fits.

        The groups are ranked under the present noise model.
        """
        taken = []
        for group in groups:
            white, target = self.white(group)
            # residual sum of squares with Schwarz's penalty
            left = float(np.sum((target - white @ least_squares(white, target)) ** 2))
            taken.append(left + target.size / self.n_samples * len(group) * np.log(self.n_samples))
        order = np.argsort(taken, kind="stable")[:most]
        return [(int(k), self.linear(groups[k])) for k in order]

    def gain(self, fit: Array) -> float:
        """Twice the log-likelihood that an explanation adds to the residual."""
        # likelihood ratio; each remainder has a noise model of its own
        return 2.0 * (self.log_likelihood(self.residual - fit) - self.base)

    def misfits(self, shapes: Array, *, scaled: bool = False) -> Array:
        """Return the whitened sum of squares that each of several shapes leaves.

        Where `scaled`, each shape is multiplied by its best factor.
        """
        # sum of squares of the difference, or after the best factor
        white, target = self.white(shapes)
        if not scaled:
            return np.asarray(np.sum((target[:, None] - white) ** 2, axis=0))
        power, along = np.sum(white**2, axis=0), target @ white
        return np.asarray(target @ target - along**2 / np.maximum(power, 1e-300))

    def searched(self, shapes: Callable[[Array], Array], grid: Array, *, scaled: bool = False) -> Explanation:
        """Find the best shape of a family with one unknown.

        The family returns shapes (k, n_y, N) of k values. Where `scaled`, the shape is multiplied by its
        best factor.
        """
        # grid first, then a bounded search between the neighbors
        points = np.unique(grid)
        costs = self.misfits(shapes(points), scaled=scaled)
        k = int(np.argmin(costs))
        best, low, high = points[k], points[max(k - 1, 0)], points[min(k + 1, points.size - 1)]
        if high > low:
            found = minimize_scalar(
                lambda g: self.misfits(shapes(np.array([g])), scaled=scaled)[0],
                bounds=(low, high),
                method="bounded",
                options={"maxiter": 25, "xatol": 1e-3 * (high - low)},
            )
            if found.fun < costs[k]:
                best = found.x
        (shape,), value = shapes(np.array([best])), np.array([best])
        if scaled:
            factor = least_squares(*self.white([shape]))
            return self._explanation(factor * shape, np.append(factor, value))
        return self._explanation(shape, value)

    def descended(
        self, shape: Callable[[Array], Array], start: Array, *, evaluations: int = 12
    ) -> Explanation:
        """Find the best shape of a family with several unknowns.

        The search stays near a start. The unknowns are relative changes or logarithms.
        """

        def left(point: Array) -> Array:
            return self._white - self._whiten(self.without_nuisance(shape(point)))

        # Jacobian by forward differences of the whitened residual
        def rows(point: Array) -> Rows:
            here = left(point)
            slopes = [(left(point + _STEP * e) - here) / _STEP for e in np.eye(point.size)]
            return Rows(here, np.array(slopes).T)

        near = np.asarray(start, dtype=float)
        # Gauss-Newton within bounds about the start
        found = gauss_newton(rows, near, lower=near - _FAR, upper=near + _FAR, evaluations=evaluations)
        return self._explanation(shape(found.point), found.point)

    def _explanation(self, shape: Array, values: Array) -> Explanation:
        fit = self.without_nuisance(shape)
        return Explanation(fit, self.gain(fit), values, self._initial_out(shape) - fit)

    def whole(self, explanation: Explanation) -> Array:
        """Return the part of the error that an explanation removes.

        The constant offset is included where that fits better.
        """
        return max(
            explanation.fit,
            explanation.fit + explanation.level,
            key=lambda part: -float(np.sum((self.with_offset - part) ** 2)),
        )

    def share_of_error(self, part: Array) -> float:
        """Return the share of the error's energy that a part removes, 0 to 1.

        The error includes constant offsets.
        """
        return _share(self.with_offset, part)

    def share(self, fit: Array) -> float:
        """Return the share of the residual's energy that a fit removes, 0 to 1.

        Constant offsets are left out.
        """
        return _share(self.residual, fit)


def _share(error: Array, part: Array) -> float:
    total = float(np.sum(error**2))
    return float(np.clip(1.0 - np.sum((error - part) ** 2) / total, 0.0, 1.0)) if total > 0 else 0.0


def least_squares(columns: Array, target: Array) -> Array:
    """Return least-squares coefficients of columns (rows, k).

    A column that is nearly zero is left out.
    """
    size = np.linalg.norm(columns, axis=0)
    keep = size > 1e-12 * max(float(size.max(initial=0.0)), 1e-300)
    values = np.zeros(columns.shape[1])
    # normal equations of unit columns, without directions of rounding size
    if keep.any():
        unit = columns[:, keep] / size[keep]
        weights, vectors = np.linalg.eigh(unit.T @ unit)
        good = weights > 1e-10 * weights[-1]
        along = vectors[:, good].T @ (unit.T @ target)
        values[keep] = vectors[:, good] @ (along / weights[good]) / size[keep]
    return values
