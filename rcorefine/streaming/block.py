"""The one fit of a stream: coefficients and initial state of a stretch.

Engine, Gauss-Newton and derivatives are those of `refine` and `diagnose`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..data.measurement import Measurement
from ..engine.engine import Engine
from ..engine.structure import Structure
from ..gauss_newton import Rows, gauss_newton
from ..inference.covariance import covariance, standard_deviations
from ..inference.problem import natural_sizes
from ..inference.whitening import Whitener, innovations
from ..systems.linear import Array

_ENOUGH = 5e-3  # of the log-likelihood, that a last step may still add
_REACH = (
    8.0  # times its start, by which a gap, a limit or a fading speed may move: beyond, the law is another
)
_HUGE = 1e100  # errors and slopes beyond which the model has blown up


class Whitening(NamedTuple):
    """Whitening of a stretch with gaps.

    Attributes
    ----------
    whitener : Whitener
        Filters.
    use : ndarray of bool, shape (n_y, N)
        Which outputs count.
    scale : ndarray, shape (n_y, N)
        By how much the noise is larger at each sample.
    """

    whitener: Whitener
    use: NDArray[np.bool_]
    scale: Array

    def __call__(self, errors: Array, /) -> Array:
        """Rows of unit variance, of samples with a whole past."""
        rows = []
        for i, (a, size) in enumerate(zip(self.whitener.filters, self.whitener.scales, strict=True)):
            q, shape = a.size - 1, (-1, *[1] * (errors.ndim - 2))
            judged = sliding_window_view(self.use[i], q + 1).all(axis=1) if self.use.shape[1] > q else [False]
            white = innovations(a, np.where(self.use[i].reshape(shape), errors[i], 0.0))[q:]
            rows.append((white / (size * self.scale[i, q:].reshape(shape)))[np.asarray(judged)])
        return np.concatenate(rows)


class Stretch(NamedTuple):
    """Samples to fit, and how the model is led through them.

    Attributes
    ----------
    data : Measurement
        Samples; where an output is missing, any number.
    use : ndarray of bool, shape (N, n_y)
        Which outputs count.
    whiten : Whitening
        Makes errors (n_y, N) or (n_y, N, p) independent rows of unit variance.
    x0 : ndarray, shape (n,)
        State at the first sample, before its correction.
    known_start : bool
        Whether that state is known; otherwise it is fitted too.
    gain : ndarray, shape (n, n_y)
        Gain of the observer.
    substeps : int
        Substeps per sample.
    """

    data: Measurement
    use: NDArray[np.bool_]
    whiten: Whitening
    x0: Array
    known_start: bool
    gain: Array
    substeps: int


@dataclass(frozen=True, slots=True, eq=False)
class BlockFit:
    """Coefficients and states that were fitted.

    Attributes
    ----------
    theta : ndarray, shape (p,)
        Coefficients.
    covariance : ndarray, shape (f, f)
        Of those that were free.
    x0, last : ndarray, shape (n,)
        State at the first sample and, corrected, at the last one.
    doubt : ndarray, shape (n, n)
        Covariance of x0; zero where it was known.
    cost : float
        Sum of the whitened squares, without those of the prior.
    points : int
        Their number.
    outputs : ndarray, shape (n_y, N)
        Outputs of the model.
    """

    theta: Array
    covariance: Array
    x0: Array
    last: Array
    doubt: Array
    cost: float
    points: int
    outputs: Array

    @property
    def std(self) -> Array:
        """Standard deviations of the free coefficients, shape (f,)."""
        return standard_deviations(self.covariance)


def fit_block(
    structure: Structure,
    stretch: Stretch,
    theta: Array,
    *,
    free: NDArray[np.intp] | None = None,
    prior: tuple[Array, Array] | None = None,
    evaluations: int = 20,
) -> BlockFit:
    """Minimize the whitened squares, and those of the prior.

    Parameters
    ----------
    structure : Structure
        Model with effects. States that `stretch` does not know begin at zero.
    stretch : Stretch
        Samples.
    theta : ndarray, shape (p,)
        Start.
    free : ndarray of int, shape (f,), optional
        Coefficients that move; default all.
    prior : tuple of ndarray, optional
        Mean (f,) of these, and a root U (f, f) of their covariance U U'.
    evaluations : int
        Simulations at most.

    Returns
    -------
    BlockFit
        With an infinite cost where the model blows up.
    """
    free = np.arange(structure.n_parameters) if free is None else free
    data, use, f, n = stretch.data, stretch.use, free.size, structure.n_states
    # states and gain of the healthy model; those that a candidate adds begin at zero
    extra = n - stretch.x0.size
    x0, K = np.pad(stretch.x0, (0, extra)), np.pad(stretch.gain, ((0, extra), (0, 0)))
    engine, s = Engine(structure, data, substeps=stretch.substeps), 0 if stretch.known_start else n
    columns = np.concatenate([free, structure.n_parameters + np.arange(s)]).astype(np.intp)
    mean, root = (np.zeros(0), np.zeros((0, f))) if prior is None else (prior[0], np.linalg.inv(prior[1]))
    held = np.hstack([root, np.zeros((len(root), s))])

    def rows(point: Array) -> Rows:
        at = theta.copy()
        at[free] = point[:f]
        run = engine.run(
            at, x0 + np.pad(point[f:], (0, n - s)), gain=K if K.any() else None, use=use, histories=True,
            initial_state=s > 0, check=False,
        )  # fmt: skip
        with np.errstate(all="ignore"):  # what overflows is refused below
            r = stretch.whiten(run.outputs - data.outputs)
            J = stretch.whiten(run.sensitivity[:, :, columns])
        sound = run.blew_up < 0 and np.abs(r).max(initial=0.0) < _HUGE and np.abs(J).max(initial=0.0) < _HUGE
        # no more points than unknowns tell nothing
        if not sound or r.size <= (0 if prior else point.size):
            return Rows(np.full(1, np.inf), np.zeros((1, point.size)), run)
        # the prior as rows: U^-1 (theta - mean)
        return Rows(np.r_[r, root @ (point[:f] - mean) if len(root) else mean], np.vstack([J, held]), run)

    lower, upper = _bounds(structure, theta, free, data.dt)
    sizes = np.r_[natural_sizes(structure, [data])[free], engine.state_sizes(theta) if s else np.zeros(0)]
    beyond = np.full(s, np.inf)
    best = gauss_newton(
        rows, np.r_[np.clip(theta[free], lower, upper), np.zeros(s)], lower=np.r_[lower, -beyond],
        upper=np.r_[upper, beyond], sizes=sizes, evaluations=evaluations if f + s else 1,
        settled=lambda cost, gain: gain < _ENOUGH,
    )  # fmt: skip
    found, (r, J, run) = theta.copy(), best.rows
    found[free], begin = best.point[:f], x0 + np.pad(best.point[f:], (0, n - s))
    points = r.size - len(root)
    if not math.isfinite(best.cost):
        nowhere = np.diag(np.full(f, np.inf))
        return BlockFit(found, nowhere, begin, begin, np.zeros((n, n)), math.inf, 0, run.outputs)
    J = J[:points]
    P, doubt = _uncertainty(J, f, None if prior is None else prior[1])
    doubt = doubt if s else np.zeros((n, n))
    cost = float(r[:points] @ r[:points])
    return BlockFit(found, P, begin, run.states[:, -1], doubt, cost, points, run.outputs)


def _uncertainty(J: Array, f: int, U: Array | None) -> tuple[Array, Array]:
    """Return the covariances of f coefficients and of the states behind them."""
    if U is None:
        whole = covariance(J.T @ J) if J.shape[1] else np.zeros((0, 0))
        return whole[:f, :f], whole[f:, f:]
    # in units of the prior every direction has a variance of 1 or less: none is lost beside strong data
    felt, state = J[:, :f] @ U, J[:, f:]
    left = felt - state @ np.linalg.lstsq(state, felt, rcond=None)[0]
    _, sizes, ways = np.linalg.svd(np.vstack([left, np.eye(f)]), full_matrices=False)
    wide = U @ (ways.T / sizes)
    P = wide @ wide.T
    doubt = covariance(state.T @ state) if state.shape[1] else np.zeros((0, 0))
    return P, doubt


def _bounds(structure: Structure, theta: Array, free: NDArray[np.intp], dt: float) -> tuple[Array, Array]:
    """Return bounds of the free coefficients, just inside those of physics."""
    of = [structure.parameters[i] for i in free]
    lower, upper = np.array([q.lower for q in of]), np.array([q.upper for q in of])
    lower = lower + 0.02 * np.abs(
        np.where(np.isfinite(lower), lower, 0.0)
    )  # a spring that is gone has no slope
    upper = upper - 1e-3 * np.abs(np.where(np.isfinite(upper), upper, 0.0))
    lags = np.array([q.name == "time_constant" for q in of], dtype=bool)
    lower = np.where(lags, np.maximum(lower, 1e-3 * dt), lower)
    shaping = np.array([q.name in structure.effects[q.effect].spec.shaping for q in of], dtype=bool)
    shaping &= theta[free] > 0
    lower = np.where(shaping, np.maximum(lower, theta[free] / _REACH), lower)
    return lower, np.where(shaping, np.minimum(upper, theta[free] * _REACH), upper)
