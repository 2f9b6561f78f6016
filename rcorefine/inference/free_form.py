"""Unknown force at a place, or unknown static curve of a channel.

A force is a curve f(d) + g(v) + v h(d) in displacement and velocity, piecewise linear. Neighboring values
are correlated, as in a random walk that returns to zero. The record determines the size of the curve, and
the evidence penalizes its freedom (MacKay, Neural Computation 4 (1992) 415).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from ..data.measurement import Measurement
from ..data.signals import over_time
from ..effects.effect import Effect
from ..effects.given import OutputCurve, Table, Tabulated
from ..engine.smoother import Smoothed, smooth
from ..engine.structure import Structure
from ..exceptions import ModelError
from ..gauss_newton import Rows, gauss_newton
from ..models.ports import Port, felt
from ..systems.discretization import discretize
from ..systems.linear import Array, LinearModel
from .f_tests import project, rank_basis
from .fitted import FittedModel
from .refinement import Refinement
from .sensitivities import force_responses
from .whitening import Whitener

_COUNT = 15  # knots along each signal
_ALIKE = 2.0  # correlation length of the curve over the rms of the motion
_SIZES = np.logspace(0.0, 10.0, 31)  # candidate variances of the curve over that of the noise
_SHARES = 10.0 ** (np.arange(-199, 1) / 40.0 - 1.0 / 80.0)  # sizes up to 1, midpoints of equal steps
_SETTLED = 1e-3  # relative change of the residual that ends the iteration
_EVALUATIONS = 6
_STIFF = 1e6  # inverse prior standard deviation of held coefficients, in typical sizes


class Curve(NamedTuple):
    """Knots of a curve at a place, and what it is made of.

    Attributes
    ----------
    place : str
        Port, input or output.
    d, v : ndarray
        Knots; empty where the port does not sense it.
    scale : float
        Rms velocity, the unit of v h(d).
    root : ndarray, shape (k, k)
        Root of the prior covariance of its coefficients, up to their size.
    kind : str
        Kind of its effect; a curve of a channel is added to a straight line of slope 1.
    """

    place: str
    d: Array
    v: Array
    scale: float
    root: Array
    kind: str = Tabulated.name

    @classmethod
    def along(cls, place: str, d: Array, v: Array, kind: str = Tabulated.name) -> Curve:
        """Knots where a motion d, v (N,) spends its time."""
        rms = float(np.sqrt(np.mean(v**2))) or 1.0
        at_d, at_v = _knots(d), _knots(v)
        # prior covariance, block diagonal: f(d), g(v), v h(d)
        blocks = [_prior_covariance(x) for x in (at_d, at_v) if x.size]
        if at_d.size and at_v.size:
            blocks.append(_prior_covariance(at_d))
        return cls(place, at_d, at_v, rms, np.linalg.cholesky(block_diag(*blocks)), kind)

    def columns(self, d: Array, v: Array) -> Array:
        """Force (N, k) of a unit of each coefficient along a motion."""
        hats = [_hats(knots, x) for knots, x in ((self.d, d), (self.v, v)) if knots.size]
        return np.hstack([*hats, v[:, None] / self.scale * hats[0]] if len(hats) > 1 else hats)

    def table(self, values: Array) -> Table:
        """The curve as a table."""
        n, m = self.d.size, self.v.size
        d, v = (knots if knots.size else np.zeros(1) for knots in (self.d, self.v))
        at = np.array([(x, y) for x in d for y in v])
        force = self.columns(at[:, 0], at[:, 1]) @ values
        if self.kind != Tabulated.name:
            force = force + at[:, 0]
        return Table(self.d, self.v, force.reshape(max(n, 1), max(m, 1)))


def _knots(x: Array) -> Array:
    """Return knots midway between quantiles of a motion and even spacing.

    There are none where nothing moves.
    """
    spread = np.ptp(x)
    if spread <= 1e-9 * max(float(np.abs(x).max(initial=0.0)), 1e-300):
        return np.zeros(0)
    levels = np.linspace(0.0, 1.0, _COUNT)
    return np.asarray(0.5 * (np.quantile(x, levels) + x.min() + spread * levels))


def _prior_covariance(knots: Array) -> Array:
    """Prior covariance of the values at knots."""
    rms = float(np.sqrt(np.mean((knots - knots.mean()) ** 2)))
    return np.exp(-np.abs(knots[:, None] - knots) / (_ALIKE * rms))


def _hats(knots: Array, x: Array) -> Array:
    """Return the share of each knot in a piecewise linear function.

    The shape is (N, n). The function is extrapolated beyond the outer knots.
    """
    i = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, knots.size - 2)
    share = (x - knots[i]) / (knots[i + 1] - knots[i])
    hats = np.zeros((x.size, knots.size))
    rows = np.arange(x.size)
    hats[rows, i], hats[rows, i + 1] = 1.0 - share, share
    return hats


class Evidence(NamedTuple):
    """Evidence for a curve of unknown size.

    Attributes
    ----------
    gain : float
        Log of the evidence for the curve over none, at the likeliest size.
    variance : float
        That size: variance of the coefficients in units of their prior.
    price : float
        Half the log determinant: what its freedom costs.
    dof : float
        Coefficients that the record determines.
    """

    gain: float
    variance: float
    price: float
    dof: float


def evidence(residual: Array, columns: Array) -> Evidence:
    """Evidence for a normal force of unknown size behind a white residual.

    Parameters
    ----------
    residual : ndarray, shape (N,)
        White, of unit variance.
    columns : ndarray, shape (N, k)
        What the coefficients would do, each of unit variance but for the common size.

    Returns
    -------
    Evidence
    """
    values, along = _spectrum(residual, columns)
    # sizes to try, relative to the best determined direction
    sizes = _SIZES / values[-1]
    gain, price, seen = _at_sizes(values, along, sizes)
    best = int(np.argmax(gain))
    dof = float(np.sum(seen[best] / (1.0 + seen[best])))
    return Evidence(float(gain[best]), float(sizes[best]), float(price[best]), dof)


def averaged_evidence(residual: Array, columns: Array) -> float:
    """Return the log evidence for a force, averaged over its size.

    It compares a normally distributed force with none; all rms sizes from 0 to 1 are equally likely.

    Parameters
    ----------
    residual, columns : ndarray
        As in `evidence`.

    Returns
    -------
    float
        Near 0 where the record would not show a force of size 1, far below where it would and shows none.
    """
    values, along = _spectrum(residual, columns)
    # numerical integral over the sizes
    gain = _at_sizes(values, along, _SHARES**2)[0]
    return float(np.logaddexp.reduce(gain + np.log(_SHARES)) + np.log(np.log(_SHARES[1] / _SHARES[0])))


def _spectrum(residual: Array, columns: Array) -> tuple[Array, Array]:
    """Return the squared gain of each curve direction on the residual.

    Also return the square of the residual along each direction. Both have shape (k,).
    """
    # eigenvalues of X'X: how much each direction of the curve moves the residual
    values, vectors = np.linalg.eigh(columns.T @ columns)
    values = np.maximum(values, 1e-300)
    return values, (vectors.T @ (columns.T @ residual)) ** 2 / values


def _at_sizes(values: Array, along: Array, sizes: Array) -> tuple[Array, Array, Array]:
    """Return the gain and the price at given variances of a curve.

    Both have shape (s,). Also return how well the data determine each direction, shape (s, k).
    """
    seen = sizes[:, None] * values
    # log evidence of a normal prior: sum of a s / (1 + s) less log(1 + s), each over two
    price = 0.5 * np.sum(np.log1p(seen), axis=1)
    return 0.5 * np.sum(along * seen / (1.0 + seen), axis=1) - price, price, seen


@dataclass(eq=False)
class FreeForm:
    """A model with a free curve at a place, at its best point.

    Attributes
    ----------
    curve : Curve
        Knots.
    values : ndarray, shape (k,)
        Coefficients.
    fitted : FittedModel
        Model with the table, its coefficient held.
    whitener : Whitener
        Filter of its own residual.
    penalty : float
        Twice what prior and freedom cost in log-likelihood.
    dof : float
        Coefficients that the record determines.
    """

    curve: Curve
    values: Array
    fitted: FittedModel
    whitener: Whitener
    penalty: float
    dof: float

    @cached_property
    def table(self) -> Table:
        """The curve."""
        return self.curve.table(self.values)

    def log_likelihood(self, whitener: Whitener, ratio: float = 0.0) -> float:
        """Under a common filter, its freedom paid."""
        white = whitener.apply(self.fitted.residuals(ratio))
        return -0.5 * (float(white @ white) + self.penalty)


def fit_free_form(
    fitted: FittedModel,
    curve: Curve,
    whitener: Whitener,
    ratio: float = 0.0,
    *,
    start: FreeForm | None = None,
    rounds: int = 6,
) -> FreeForm:
    """Fit a free curve together with all that is free in a model.

    Parameters
    ----------
    fitted : FittedModel
        Model without a force there.
    curve : Curve
        Knots.
    whitener : Whitener
        Metric.
    ratio : float
        Unmeasured force to allow for.
    start : FreeForm, optional
        Where to go on; by default from no force.
    rounds : int
        Descents at most, each in the metric that the one before left; fewer at a minimum.

    Returns
    -------
    FreeForm
    """
    n, k = fitted.point.size, len(curve.root)
    point, values = (fitted.point, np.zeros(k)) if start is None else (start.fitted.point, start.values)
    held = np.sqrt(fitted.problem.precision)
    # hold a constant before a free curve, which would only shift its knots
    if curve.kind == OutputCurve.name:
        s = fitted.structure
        constant = [s.effects[q.effect].spec.holds_constant for q in s.parameters]
        held[: len(constant)][constant] = _STIFF / fitted.problem.sizes_at(point)[: len(constant)][constant]
    mean = np.pad(fitted.problem.prior_mean, (0, n - fitted.problem.n_theta))
    mean = np.where(held > 0, mean, 0.0)
    inverse = np.linalg.inv(curve.root)
    for _ in range(rounds):
        # linearize about the present point and curve
        model = _with_curve(fitted, curve, point, values)
        white, J, X = _linearize(model, fitted.at(point), curve, whitener, ratio)
        # basis of all other unknowns with their priors, to be projected off
        basis = rank_basis(np.vstack([J, np.diag(held)]))
        # residual without the curve, and the columns of the curve, outside of the basis
        both = np.vstack([np.column_stack([white - X @ values, X @ curve.root]), np.zeros((n, 1 + k))])
        both = project(both, basis)
        found = evidence(both[:, 0], both[:, 1:])
        prior = inverse / np.sqrt(found.variance)

        def rows(at: Array, prior: Array = prior, whitener: Whitener = whitener) -> Rows:
            try:
                models = _with_curve(fitted, curve, at[:n], at[n:]), fitted.at(at[:n])
                white, J, X = _linearize(*models, curve, whitener, ratio)
            except ModelError:  # the linear model diverges within one sample
                return Rows(np.full(n + k, np.inf), np.zeros((n + k, n + k)))
            zeros = np.zeros((n, k))
            jacobian = np.block([[J, X], [np.diag(held), zeros], [zeros.T, prior]])
            return Rows(np.concatenate([white, held * (at[:n] - mean), prior @ at[n:]]), jacobian)

        # Gauss-Newton in the point and the values of the curve
        sizes = np.append(fitted.problem.sizes_at(point), np.sqrt(found.variance) * np.ones(k))
        done = gauss_newton(
            rows, np.append(point, values), sizes=sizes, evaluations=_EVALUATIONS, tolerance=1e-4
        )
        point, values = done.point[:n], done.point[n:]
        model = _with_curve(fitted, curve, point, values)
        # whiten anew with the residual that is left
        before, whitener = whitener, fitted.problem.whitener(model.residuals(ratio))
        if done.converged and np.allclose(before.scales, whitener.scales, rtol=_SETTLED):
            break
    penalty = float(np.sum((prior @ values) ** 2)) + 2.0 * found.price
    return FreeForm(curve, values, model, whitener, penalty, found.dof)


def _with_curve(fitted: FittedModel, curve: Curve, point: Array, values: Array) -> FittedModel:
    """Return the model with a curve of the given values added.

    `point` is a point of the model without the curve.
    """
    effect = Effect(curve.kind, curve.place, law=curve.table(values), fixed={"scale": 1.0})
    base = fitted.structure
    structure = Structure(base.model, [*base.effects, effect], constants=base.constants)
    problem = fitted.problem.like(structure, substeps=fitted.refinement.substeps)
    return FittedModel(fitted.refinement, problem, point, fitted.tolerance, fitted.force_at)


def _linearize(
    model: FittedModel, without: FittedModel, curve: Curve, whitener: Whitener, ratio: float
) -> tuple[Array, Array, Array]:
    """Return the white residual and its derivatives.

    The derivatives are those by the point, then those by the values of the curve.
    """
    blocks, judged = model.blocks(ratio), model.problem.judged(model.theta)
    columns = zip(judged, curve_responses(model, without, curve, ratio), strict=True)
    return (
        whitener.apply([r for r, _ in blocks]),
        whitener.apply(model.problem.whole([j for _, j in blocks])),
        whitener.apply([weight[:, :, None] * block for weight, block in columns]),
    )


def curve_responses(model: FittedModel, without: FittedModel, curve: Curve, ratio: float) -> list[Array]:
    """Return the output change for a unit of each coefficient of a curve.

    The list holds an array of shape (n_y, N, k) for each record. `without` is the model at the same point
    without the curve: it shows the signal of a sensor before its curve.
    """
    found, weights = [], model.problem.weights
    labels = list(model.structure.linear_model.output_labels)
    for i in range(len(model.problem.records)):
        if curve.kind == Tabulated.name:
            columns = curve.columns(*model.port(curve.place, ratio, i))
        else:
            x = channel_signal(without, curve.place, i)
            columns = curve.columns(x, np.zeros(x.size))
        if curve.kind == OutputCurve.name:
            found.append((weights * (np.array(labels) == curve.place))[:, None, None] * columns)
            continue
        forces = [(curve.place, column) for column in columns.T]
        found.append(force_responses(model, i, forces, model.gain(ratio)))
    return found


def channel_signal(fitted: FittedModel, label: str, i: int) -> Array:
    """Return an input of a record, or an output of the model there.

    The output of the model includes the samples that a delay hides: they have no weight in the residual.
    """
    model, problem = fitted.structure.linear_model, fitted.problem
    if label in model.input_labels:
        return np.asarray(problem.records[i].inputs[list(model.input_labels).index(label)])
    theta, starts = problem.unpack(fitted.point)
    run = problem.engines[i].run(theta, starts[i], sensitivity=False, gain=fitted.gain(0.0), check=False)
    return np.asarray(run.outputs[list(model.output_labels).index(label)])


_LEVELS = np.logspace(-3, 1, 9)  # candidate levels of the noise that drives the force
_MEMORY = (3.0, 12.0, 50.0)  # candidate correlation times in samples
_TRIED_ON = 1000  # samples for the likelihood


def estimated_force(
    model: Refinement, noise: Array, port: Port, record: Measurement
) -> tuple[Array, Array, float]:
    """Estimate the missing force at a place, and the motion.

    The estimate uses the record and the model as it is; it assumes no force law.

    The force is one more state of a Kalman smoother, driven by noise. The likelihood chooses the noise
    level and the correlation time. The mean of the force is not estimated.

    Parameters
    ----------
    model : Refinement
        Model as it is, the linear part of which moves.
    noise : ndarray, shape (n_y,)
        Standard deviation of what the sensors add.
    port : Port
        Where the force acts.
    record : Measurement
        Record, channels in the order of the model.

    Returns
    -------
    force : ndarray, shape (N,)
        Resisting force.
    states : ndarray, shape (n, N)
        States of the linear model.
    std : float
        Standard deviation of the force, far from both ends of the record.
    """
    linear = LinearModel.from_statespace(model.system)
    n = linear.n_states
    act = np.zeros(n)
    act[: port.act.size] = port.act
    B = np.vstack([linear.B, np.zeros((1, linear.n_inputs))])
    C = np.column_stack([linear.C, felt(port, model.physical_model.output_rate)])
    hold = "zoh" if record.hold == "zoh" else "foh"
    w = record.inputs
    R = np.diag(np.maximum(noise, 1e-6 * over_time(np.std, record.outputs)) ** 2)
    y = record.outputs - linear.D @ w
    y = y - over_time(np.mean, y)[:, None]
    runs = []
    for memory in _MEMORY:
        # the force is a state with a correlation time: df/dt = -f / memory + noise
        A = np.zeros((n + 1, n + 1))
        A[:n, :n], A[:n, n], A[n, n] = linear.A, act, -1.0 / (memory * record.dt)
        F, G0, G1 = discretize(A, B, record.dt, hold)
        drive = (G0 @ w + G1 @ np.hstack([w[:, 1:], w[:, -1:]])).T
        # unit: the force that changes the output by its own size within a sample
        reach = np.linalg.norm(C @ F[:, -1]) + np.linalg.norm(C[:, -1]) + 1e-300
        unit = float(np.linalg.norm(over_time(np.std, y))) / reach
        runs += [_Walk(F, C, R, y.T, drive, share * unit) for share in _LEVELS]
    # choose level and correlation time by the likelihood on the first samples
    likelihoods = [run.smoothed(_TRIED_ON).log_likelihood for run in runs]
    if not np.isfinite(likelihoods).any():
        return np.zeros(record.n_samples), np.zeros((n, record.n_samples)), np.inf
    best = runs[int(np.nanargmax(likelihoods))]
    # Kalman smoother over the whole record
    smoothed = best.smoothed()
    states = (smoothed.states * best.size).T
    std = best.size[n] * np.sqrt(max(smoothed.covariance[n, n], 0.0))
    return states[n], states[:n], float(std)


class _Walk(NamedTuple):
    """A model whose last state is a force, driven by noise of a certain level."""

    F: Array
    C: Array
    R: Array
    outputs: Array  # (N, n_y)
    drive: Array  # (N, n + 1)
    level: float

    @property
    def size(self) -> Array:
        """Of each state."""
        return np.append(np.ones(self.F.shape[0] - 1), self.level)

    def smoothed(self, most: int | None = None) -> Smoothed:
        """States in their sizes, over the first samples or all."""
        size = self.size
        Q = 1e-12 * np.mean(np.diag(self.R)) * np.eye(size.size)  # a little process noise in every direction
        Q[-1, -1] += 1.0
        # states in units of their sizes
        F, C, drive = self.F * size / size[:, None], self.C * size, self.drive[:most] / size
        return smooth(F, C, Q, self.R, self.outputs[:most], drive=drive)
