"""Joint estimate with exact sensitivities, some candidates held at zero."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.measurement import Measurement
from ..engine.observer import observer_gain
from ..engine.structure import Structure
from ..gauss_newton import Rows, gauss_newton
from ..inference.autoregression import autoregression
from ..inference.covariance import colored, covariance, pseudo_inverse
from ..inference.outcome import output_weights
from ..inference.problem import Problem
from ..inference.search import starting_states
from ..inference.starts import far_starts
from ..inference.whitening import Whitener
from ..systems.linear import Array
from .spectrum import sparse_starts, spectral_starts

__all__ = ["Information", "Joint", "log_likelihood"]

_RATIOS = (1.0, 0.1, 0.01)  # observer gains of the first pass, high to low
_SHORT = 4000  # samples of the first pass
_WHITE = 0.6  # innovation over residual power above which a free run has found its valley
_ROUNDING = 1e-22  # residual over signal power that is rounding
_HOPELESS = 0.5  # whiteness against that of the present fit
_EXACT = 1e-6  # residual over signal power that needs no further search
_MOST_EVALUATIONS = 40
_SETTLED = 1e-3  # of a standard deviation


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """Information of the record at a point, all candidates included.

    Attributes
    ----------
    gradient : ndarray, shape (p,)
        J' r.
    normal : ndarray, shape (p, p)
        J' J with the priors.
    middle : ndarray, shape (p, p)
        Covariance of the gradient under the colour of the residual.
    """

    gradient: Array
    normal: Array
    middle: Array

    def covariance(self, columns: NDArray[np.int64]) -> Array:
        """Return the covariance of an estimate of these columns.

        It is infinite where the record holds no information.
        """
        block = np.ix_(columns, columns)
        return covariance(self.normal[block], self.middle[block])

    def step(self, columns: NDArray[np.int64]) -> Array:
        """Gauss-Newton step in these columns."""
        inverse, _, _ = pseudo_inverse(self.normal[np.ix_(columns, columns)])
        return np.asarray(-inverse @ self.gradient[columns])


class Joint:
    """All candidates and nuisances on the records; some of them held at zero.

    Parameters
    ----------
    problem : Problem
        Model with every candidate and nuisance on the records, each with an initial state of its own.
    noise : float or sequence of float, optional
        Declared sensor noise; estimated where None.
    n_changes : int
        The first so many effects are candidates, the others nuisances.
    """

    def __init__(
        self, problem: Problem, noise: float | Sequence[float] | None, *, n_changes: int = 0
    ) -> None:
        self.problem, self.noise, self.n_changes = problem, noise, n_changes
        self.point = np.zeros(problem.size)
        self.converged = False
        self._information: Information | None = None

    @property
    def structure(self) -> Structure:
        """Model with every candidate and nuisance."""
        return self.problem.structure

    @property
    def records(self) -> list[Measurement]:
        """Segments."""
        return self.problem.records

    @property
    def theta(self) -> Array:
        """Coefficients at the present point."""
        return self.problem.unpack(self.point)[0]

    def columns(self, active: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the columns of the point that are estimated.

        These are the active coefficients and all initial states.
        """
        rest = np.arange(self.structure.n_parameters, self.problem.size)
        return np.concatenate([np.flatnonzero(active), rest])

    # ------------------------------------------------------------------ estimates
    def start(self) -> None:
        """Find the valley on the first samples, all coefficients free.

        Observer-held fits from high to low gain, each polished as a free run; then starts
        from the measured frequency response; last scans over decades.
        The first that leaves a white residual ends the search.
        """
        short = [self.records[0]._part(slice(0, _SHORT)), *self.records[1:2]]
        trial = self.problem.like(records=short)
        level = 0.5 * sum(float(np.sum((trial.weights[:, None] * r.outputs) ** 2)) for r in short)
        columns = np.arange(trial.size)
        best: tuple[float, Array] | None = None
        for theta in self._starts(trial):
            free = trial.inside(trial.pack(theta, starting_states(trial, theta)))
            point, cost, _ = _descend(trial, free, columns, _MOST_EVALUATIONS)
            if best is None or cost < best[0]:
                best = cost, point
                if cost < _EXACT * level or _whiteness(trial, point) > _WHITE:
                    break
        assert best is not None
        self.point = self._lengthened(trial, best[1])

    def _lengthened(self, trial: Problem, point: Array) -> Array:
        """Extend a point on shortened records to the whole records.

        The first records keep the initial states of the short ones.
        """
        theta, known = trial.unpack(point)
        if not trial.free_start:
            return np.array(theta)
        if len(self.records) > len(known):
            states = starting_states(self.problem, theta)
            states[: len(known)] = known
            return self.problem.pack(theta, states)
        return self.problem.pack(theta, known)

    def _starts(self, trial: Problem) -> Iterator[Array]:
        """Yield starting values for the coefficients.

        Each is computed only after the previous ones have failed.
        """
        start = self.structure.start()
        yield start
        yield from self._held(trial, start, _RATIOS)
        for far in spectral_starts(self.structure, start, self.records[0]):
            yield far
            yield from self._held(trial, far, _RATIOS[1:])
        yield from far_starts(trial, self.structure, start)

    def _held(self, trial: Problem, theta: Array, ratios: Sequence[float]) -> Iterator[Array]:
        """Fits of the innovations of an observer, gain after gain."""
        held = trial.inside(trial.pack(theta, np.zeros((len(trial.records), trial.n_states))))
        for ratio in ratios:
            gain = observer_gain(self.structure, held[: trial.n_theta], trial.records[0], ratio)
            if np.isfinite(gain).all():
                held = trial.minimize(held, max_nfev=12, tol=1e-6, gain=gain).x
                yield held[: trial.n_theta]

    def sparser(self, active: NDArray[np.bool_], size: int) -> NDArray[np.bool_] | None:
        """Search for fewer changes that explain the record equally well.

        The search covers points far from the present one.

        Parameters
        ----------
        active : ndarray of bool, shape (p,)
            Present coefficients.
        size : int
            Candidates among them; fewer are looked for.

        Returns
        -------
        ndarray of bool, or None
            The sparser set, to which the point has moved; None where there is none.
        """
        reference = self.point.copy()
        cost = self.fit(active)
        scale = 2.0 * cost / self.problem.n_points
        start = self.structure.start()
        short = [self.records[0]._part(slice(0, _SHORT)), *self.records[1:2]]
        trial = self.problem.like(records=short)
        for members, theta in sparse_starts(self.structure, start, self.records[0], size - 1):
            few = np.ones(active.size, dtype=bool)
            few[[i for i, q in enumerate(self.structure.parameters) if q.effect < self.n_changes]] = False
            few[list(members)] = True
            columns = np.concatenate([np.flatnonzero(few), np.arange(trial.n_theta, trial.size)])
            free = trial.inside(trial.pack(theta, starting_states(trial, theta)))
            point, _, _ = _descend(trial, free, columns, 20)
            if _whiteness(trial, point) < _HOPELESS * _whiteness(self.problem, reference):
                continue
            self.point = self._lengthened(trial, point)
            reached = self.fit(few)
            price = (size - len(members)) * np.log(self.problem.n_points)
            if 2.0 * (reached - cost) / scale < price:
                return few
        self.point = reference
        self._information = None
        return None

    def fit(self, active: NDArray[np.bool_], *, reweigh: bool = False) -> float:
        """Minimize over the active coefficients and the initial states.

        Parameters
        ----------
        active : ndarray of bool, shape (p,)
            Coefficients that move; the others stay where they are.
        reweigh : bool
            Whether to take the noise levels from the residual, and fit once more.

        Returns
        -------
        float
            Cost, half the weighted sum of squares.
        """
        columns = self.columns(active)
        for _ in range(3 if reweigh and self.noise is None else 1):
            self.point, cost, self.converged = _descend(self.problem, self.point, columns, _MOST_EVALUATIONS)
            self._information = None
            if not reweigh or self.noise is not None:
                break
            before, weights = (
                self.problem.weights,
                output_weights(self.records, None, self.problem, self.point),
            )
            self.problem = self.problem.like(weights=weights)
            if np.allclose(before, weights, rtol=0.02):
                break
        return cost

    def information(self) -> Information:
        """Return the information of the record at the present point.

        It covers every coefficient.
        """
        if self._information is None:
            residuals, slopes, columns = zip(*self.problem.own_blocks(self.point), strict=True)
            normal, middle = colored(residuals, slopes, self.problem.precision, columns=columns)
            r, J = self.problem.evaluate(self.point).condensed
            gradient = J.T @ r
            self._information = Information(gradient, normal, middle)
        return self._information

    @property
    def residual(self) -> Array:
        """Return model minus record in units of the outputs, shape (n_y, N).

        All records are joined.
        """
        blocks = self.problem.own_blocks(self.point)
        return np.concatenate([r for r, _, _ in blocks], axis=1) / self.problem.weights[:, None]

    @property
    def orders(self) -> tuple[int, ...]:
        """Order of the autoregressive model of each output's residual (0: white)."""
        return Whitener.fit([self.residual]).orders


def log_likelihood(residual: Array) -> tuple[float, int]:
    """Return the Gaussian log-likelihood of a whitened residual.

    An autoregression per output whitens the residual.

    Parameters
    ----------
    residual : ndarray, shape (n_y, N)
        Residual of a free run.

    Returns
    -------
    value : float
        Log-likelihood up to a constant.
    count : int
        Coefficients that the autoregressions took.
    """
    whitener = Whitener.fit([residual], floor=1e-150)
    return whitener.log_likelihood(residual.shape[1]), sum(whitener.orders)


def _descend(
    problem: Problem, point: Array, columns: NDArray[np.int64], evaluations: int
) -> tuple[Array, float, bool]:
    """Lower the cost in some columns; the others stay where they are."""
    box = problem.coordinates.of(problem.inside(point))
    low, high = (bound[columns] for bound in problem.box())

    def at(x: Array) -> Array:
        whole = box.copy()
        whole[columns] = x
        return problem.coordinates.point(whole)

    def rows(x: Array) -> Rows:
        point = at(x)
        found = problem.evaluate(point)
        turn: Callable[[Array], Array] = lambda J: problem.coordinates.columns(J, point)  # noqa: E731
        if len(problem.records) == 1:
            J: Any = turn(found.jacobian)[:, columns]
        else:
            J = found.bordered(problem.n_theta, None, turn, columns[columns < problem.n_theta])
        return Rows(found.residual if found.finite else np.full(1, np.inf), J)

    level = sum(float(np.sum((problem.weights[:, None] * r.outputs) ** 2)) for r in problem.records)
    tolerance = max(_SETTLED**2 / problem.n_points, 1e-10)
    run = gauss_newton(
        rows,
        box[columns],
        lower=low,
        upper=high,
        sizes=problem.sizes[columns],
        evaluations=evaluations,
        settled=lambda cost, gain: gain <= tolerance * cost or cost < _ROUNDING * level,
        damping=0.0,
    )
    return at(run.point), run.cost, run.converged


def _whiteness(problem: Problem, point: Array) -> float:
    """Return the smallest ratio of innovation power to residual power.

    The minimum is over the outputs. It is 1 for a white residual.
    """
    blocks = problem.own_blocks(point)
    share = 1.0
    for row in np.concatenate([r for r, _, _ in blocks], axis=1):
        power = float(np.mean(row**2))
        if power > 0:
            share = min(share, autoregression(row)[1] / power)
    return share
