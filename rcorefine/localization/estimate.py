"""Joint estimate with exact sensitivities, and its starting values.

Far from the solution a simulation is wrong by whole periods. Starting values then come from the measured
frequency response.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares

from ..comparison.signals import fit_percent
from ..data.measurement import Measurement
from ..effects.springs import Stiffness
from ..engine.structure import Structure
from ..exceptions import DataError
from ..inference.covariance import colored, covariance, pseudo_inverse, standard_deviations
from ..inference.fit import Fit
from ..inference.outcome import output_weights
from ..inference.parameters import weak_priors
from ..inference.problem import Problem, descend
from ..inference.search import starting_states
from ..inference.starts import Motion
from ..inference.whitening import Whitener, autoregression, readings
from ..systems.linear import Array

_POINTS = 250
_WIDTHS = (4.0, 1.5)  # of the smoothing along the frequencies, wide to narrow
_SINGLE = (-0.2, -0.4, -0.6, -0.75, -0.9)
_DOUBLE = (-0.35, -0.7)
_MOST_PAIRS = 600
_BEST = 6  # points of the grid from which the descent starts
_BEAM = 5  # sets of each size that grow on
_LEAST_COHERENCE = 0.4  # of noise, in 99 of 100 frequencies: the record makes about ten averages


class _Spectrum:
    """Log magnitudes of the record and of the model, smoothed alike.

    Raises DataError where the record has no spectrum.
    """

    def __init__(self, structure: Structure, theta: Array, record: Measurement) -> None:
        # columns: stiffnesses with a nominal value
        nominal = {(q.kind, q.place): q.value for q in structure.model.parameters}
        effects = [structure.effects[parameter.effect] for parameter in structure.parameters]
        sizes = np.array([nominal.get((e.kind, e.place), 0.0) * (e.kind == Stiffness.name) for e in effects])
        self.structure, self.theta = structure, theta
        self.columns = np.flatnonzero(sizes > 0)
        self.sizes = sizes[self.columns]
        if not self.columns.size or not structure.is_linear:
            raise DataError("only a linear model with stiffnesses can be compared by its spectrum")
        # frequency response of the record by Welch's method, six segments
        measured = record.frequency_response(segment_length=max(record.n_samples // 6, 16))
        assert measured.coherence is not None  # it comes from a record
        # below the Nyquist frequency with a margin, and coherent
        usable = np.flatnonzero(
            (measured.omega < 0.6 * np.pi / record.dt) & (measured.coherence.max(axis=0) > _LEAST_COHERENCE)
        )
        if usable.size > _POINTS:  # evenly on the logarithmic axis, each once
            grid = np.geomspace(measured.omega[usable[0]], measured.omega[usable[-1]], _POINTS)
            usable = np.unique(usable[np.searchsorted(measured.omega[usable], grid).clip(0, usable.size - 1)])
        if usable.size < 4 * self.columns.size:
            raise DataError("the spectrum has too few points for so many stiffnesses")
        self.omega = measured.omega[usable]
        # log magnitudes, weighted by the root of the coherence, (n_y, n_w, K)
        self.log = np.log(np.abs(measured.response[:, :, usable]) + 1e-300)
        self.weight = np.sqrt(np.clip(measured.coherence[:, usable], 0.0, 0.999))[:, None, :]

    def moved(self, scaled: Array) -> Array:
        """Coefficients at the stiffness ``nominal * exp(scaled)``."""
        theta = self.theta.copy()
        # log scale: stiffness stays positive, zero is no change
        theta[self.columns] = self.sizes * np.expm1(scaled)
        return theta

    def misfit(self, scaled: Array, width: float) -> Array:
        """Weighted difference at the stiffness ``nominal * exp(scaled)``."""
        matrices = self.structure.matrices(self.moved(scaled))
        nw = self.structure.n_inputs
        # modal form: one eigenvalue problem for all frequencies
        poles, right = np.linalg.eig(matrices.A)
        try:
            drive = np.linalg.solve(right, matrices.B[:, :nw].astype(complex))
        except np.linalg.LinAlgError:
            return np.full(self.log.size, 12.0)
        # G = C V (jw - Lambda)^-1 V^-1 B + D
        gains = np.einsum(
            "ym,mw,mk->ywk", matrices.C @ right, drive, 1.0 / (1j * self.omega - poles[:, None])
        )
        level = np.log(np.abs(gains + matrices.D[:, :nw, None]) + 1e-300)
        # clipped difference of log magnitudes, smoothed so that shifted resonances still overlap
        difference = self.weight * np.clip(level - self.log, -12.0, 12.0)
        smooth = gaussian_filter1d(difference, width, axis=2, mode="nearest")
        return np.asarray(smooth).ravel()

    def level(self, scaled: Array) -> float:
        """Sum of squares of the widest smoothing."""
        return float(np.sum(self.misfit(scaled, _WIDTHS[0]) ** 2))

    def minimize(self, scaled: Array, members: Sequence[int], evaluations: int) -> tuple[float, Array]:
        """Return cost and point of a descent with less and less smoothing."""
        free, point, cost = list(members), scaled.copy(), np.inf

        def misfit(part: Array, width: float) -> Array:
            point[free] = part
            return self.misfit(point, width)

        # wide smoothing first, for a wide region of attraction
        for width in _WIDTHS:
            found = least_squares(
                misfit, point[free], args=(width,), bounds=(-6.0, 3.0), max_nfev=evaluations, x_scale=0.3
            )
            point[free], cost = found.x, float(found.cost)
        return cost, point


def _losses(n: int, members: Sequence[int], losses: Sequence[float]) -> Array:
    """Return a point with some losses of stiffness."""
    point = np.zeros(n)
    point[list(members)] = np.log1p(losses)
    return point


def spectral_starts(structure: Structure, theta: Array, record: Measurement, most: int = 3) -> list[Array]:
    """Return stiffness changes whose smoothed response fits the measured one.

    The search is a grid over single and double losses, then descents on log magnitudes with less and less
    smoothing, so that a resonance that moved far is found, too.

    Parameters
    ----------
    structure : Structure
        Model with candidates.
    theta : ndarray, shape (p,)
        Coefficients to start from; only stiffness moves.
    record : Measurement
        Record.
    most : int
        Number of starts to return.

    Returns
    -------
    list of ndarray
        The best first; empty where the record gives no frequency response.
    """
    try:
        spectrum = _Spectrum(structure, theta, record)
    except DataError:
        return []
    n = spectrum.columns.size
    # grid: no change, one loss of 20 to 90 %, two losses of 35 or 70 %
    grid = [np.zeros(n), *(_losses(n, [i], [loss]) for i, loss in product(range(n), _SINGLE))]
    pairs = list(combinations(range(n), 2))[: _MOST_PAIRS // len(_DOUBLE) ** 2]
    grid += [_losses(n, pair, losses) for pair, losses in product(pairs, product(_DOUBLE, repeat=2))]
    # descend from the best six of the grid
    levels = [spectrum.level(u) for u in grid]
    reached = [spectrum.minimize(grid[k], range(n), 15) for k in np.argsort(levels)[:_BEST]]
    kept: list[Array] = []
    # different minima only, the best first
    for _, u in sorted(reached, key=lambda pair: pair[0]):
        if len(kept) < most and all(np.abs(u - other).max() > 0.02 for other in kept):
            kept.append(u)
    return [spectrum.moved(u) for u in kept]


def sparse_starts(
    structure: Structure, theta: Array, record: Measurement, largest: int, most: int = 4
) -> list[tuple[tuple[int, ...], Array]]:
    """Return few stiffness changes that explain the frequency response.

    The sets with the fewest changes come first. With few sensors several structures can have the same
    response (all the natural frequencies of a chain determine its stiffnesses only up to a finite choice);
    among them the one with the fewest changes is the most plausible.

    Parameters
    ----------
    structure : Structure
        Model with candidates.
    theta : ndarray, shape (p,)
        Coefficients to start from; only stiffness moves.
    record : Measurement
        Record.
    largest : int
        Changes at most.
    most : int
        Number of sets of each size to return.

    Returns
    -------
    list of (tuple of int, ndarray)
        Columns of theta that moved, and the coefficients.
    """
    try:
        spectrum = _Spectrum(structure, theta, record)
    except DataError:
        return []
    n = spectrum.columns.size
    found: list[tuple[tuple[int, ...], Array]] = []
    # beam search over sets of changed stiffnesses
    beam: list[tuple[float, tuple[int, ...], Array]] = [(np.inf, (), np.zeros(n))]
    for _ in range(min(largest, n)):
        wider: dict[tuple[int, ...], tuple[float, tuple[int, ...], Array]] = {}
        # add one stiffness to each set, started at the best of three losses
        for (_, members, u), i in product(beam, range(n)):
            if i not in members:
                group = tuple(sorted((*members, i)))
                start = min((u + _losses(n, [i], [loss]) for loss in (0.0, *_DOUBLE)), key=spectrum.level)
                level, reached = spectrum.minimize(start, group, 8)
                if group not in wider or level < wider[group][0]:
                    wider[group] = level, group, reached
        # keep the best five sets of this size
        beam = sorted(wider.values(), key=lambda entry: entry[0])[:_BEAM]
        for _, members, u in beam[:most]:
            found.append((tuple(int(spectrum.columns[i]) for i in members), spectrum.moved(u)))
    return found


_WHITE = 0.6  # innovation over residual power above which a free run has found its valley
_MOST_EVALUATIONS, _FEW_EVALUATIONS = 40, 12
_HOPELESS = 4.0  # times the present cost, above which fewer changes are not followed further
# until a thousandth of a standard deviation is left
_minimize = partial(descend, tolerance=0.0, unnoticed=5e-7)


class Information(NamedTuple):
    """Information of the record at a point, all candidates included."""

    gradient: Array  #: J' r, (p,)
    normal: Array  #: J' J with the priors, (p, p)
    middle: Array  #: covariance of the gradient under the color of the residual, (p, p)

    def covariance(self, columns: NDArray[np.int64]) -> Array:
        """Return the covariance of an estimate of these columns.

        It is infinite where the record holds no information.
        """
        # sandwich covariance N^-1 M N^-1 for colored residuals
        block = np.ix_(columns, columns)
        return covariance(self.normal[block], self.middle[block])

    def step(self, columns: NDArray[np.int64]) -> Array:
        """Gauss-Newton step in these columns."""
        # -N^+ g
        inverse, _, _ = pseudo_inverse(self.normal[np.ix_(columns, columns)])
        return np.asarray(-inverse @ self.gradient[columns])


class Joint:
    """All candidates and nuisances on the records; some of them held at zero.

    Parameters
    ----------
    fit : Fit
        With every candidate and nuisance free.
    """

    def __init__(self, fit: Fit) -> None:
        self.problem, self.noise, self.weak = fit.problem, fit.noise, weak_priors(fit.table)
        self.point, self.converged = fit.result.point, fit.result.converged
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
        return np.flatnonzero(_moving(self.problem, active))

    def sparser(self, active: NDArray[np.bool_], candidates: NDArray[np.int64]) -> bool:
        """Search for fewer changes that explain the record as well, also far off.

        Parameters
        ----------
        active : ndarray of bool, shape (p,)
            Present coefficients; the sparser ones on return.
        candidates : ndarray of int
            Columns of the changes.

        Returns
        -------
        bool
            Whether the point has moved to fewer changes.
        """
        # reference: cost and size of the present set
        reference, cost, size = self.point.copy(), self.fit(active), int(active[candidates].sum())
        scale, start = 2.0 * cost / self.problem.n_points, self.structure.start()
        # sets in order of size: fit briefly, then fully where the cost is comparable
        for members, theta in sparse_starts(self.structure, start, self.records[0], size - 1):
            few = active.copy()
            few[candidates] = False
            few[list(members)] = True
            self.point = self.problem.pack(theta, starting_states(self.problem, theta))
            if self.fit(few, evaluations=_FEW_EVALUATIONS) > _HOPELESS * cost:
                continue
            # Schwarz's penalty decides between fewer changes and a better fit
            price = (size - len(members)) * np.log(self.problem.n_points)
            if 2.0 * (self.fit(few) - cost) / scale < price:
                active[:] = few
                return True
        self.point, self._information = reference, None
        return False

    def fit(
        self, active: NDArray[np.bool_], *, reweigh: bool = False, evaluations: int = _MOST_EVALUATIONS
    ) -> float:
        """Minimize over the active coefficients and the initial states.

        Parameters
        ----------
        active : ndarray of bool, shape (p,)
            Coefficients that move; the others stay where they are.
        reweigh : bool
            Whether to take the noise levels from the residual, and fit once more.
        evaluations : int
            Simulations at most.

        Returns
        -------
        float
            Cost, half the weighted sum of squares.
        """
        again = reweigh and self.noise is None
        # iteratively reweighted: weights of the outputs from their residuals
        for _ in range(3 if again else 1):
            free = _moving(self.problem, active)
            found = _minimize(self.problem, self.point, free=free, evaluations=evaluations)
            self.point, self.converged, self._information = found.point, found.converged, None
            if again:
                before = self.problem.weights
                weights = output_weights(self.records, None, self.problem, self.point)
                self.problem = self.problem.like(weights=weights)
                if np.allclose(before, weights, rtol=0.02):
                    break
        return found.cost

    def information(self) -> Information:
        """Return the information of the record at the present point.

        It covers every coefficient.
        """
        if self._information is None:
            # residual and sensitivities of each record; weak priors hold no information
            residuals, slopes, columns = zip(*self.problem.own_blocks(self.point), strict=True)
            precision = self.problem.precision
            precision[: self.weak.size][self.weak] = 0.0
            normal, middle = colored(residuals, slopes, precision, columns=columns)
            _, gradient = self.problem.evaluate(self.point).normal()
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
    def fit_percent(self) -> Array:
        """Fit of each output in percent; NaN where it is constant."""
        measured = np.concatenate([record.outputs for record in self.records], axis=1)
        return fit_percent(measured, measured + self.residual)

    def spread(self, active: NDArray[np.bool_]) -> Array:
        """Return the standard deviations of `columns` at the present point."""
        return standard_deviations(self.information().covariance(self.columns(active)))

    @property
    def orders(self) -> tuple[int, ...]:
        """Order of the autoregressive model of each output's residual (0: white)."""
        return Whitener.fit([self.residual]).orders


def _moving(problem: Problem, active: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which unknowns move: active coefficients, initial states."""
    return np.pad(active, (0, problem.size - active.size), constant_values=True)


def best_fit(fit: Callable[[], Fit], motion: Motion) -> Fit:
    """Fit all changes, from the spectrum too where the residual is not white.

    Parameters
    ----------
    fit : callable
        Makes the fit.
    motion : Motion
        Motion of the undamaged model.

    Returns
    -------
    Fit
        The one that is closest to the record.
    """
    found = fit()
    found.run(motion, None)
    # a white residual means that the fit has found its minimum
    residual, _ = readings([r for r, _, _ in found.problem.own_blocks(found.result.point)])
    powers = [(float(np.nanmean(row**2)), row) for row in residual]
    # innovation variance over residual power, the smallest of all outputs
    whitest = min([1.0, *(autoregression(row)[1] / power for power, row in powers if power > 0)])
    if whitest > _WHITE or not found.structure.is_linear:
        return found
    # otherwise start from the frequency response, too
    starts = spectral_starts(found.structure, found.structure.start(), found.segments[0])
    if not starts:
        return found
    other = fit()
    other.run(motion, None, starts=starts)
    return min(found, other, key=lambda fit: fit.cost)
