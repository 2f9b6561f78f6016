"""Error of a model: over frequency, and over its prediction horizon.

The horizon ranges from one step ahead to the simulation from the initial state (free run).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ..data.signals import check_whole, spreads
from ..data.welch import estimate_frequency_response
from ..engine.linear import observed
from ..engine.observer import steady_filter
from ..exceptions import DataError
from ..results import Row
from ..systems.linear import Array
from ..systems.response import as_sampled, frequency_response
from .failure_map.record import ModelOnRecord
from .signals import root_mean_square

if TYPE_CHECKING:
    from .result import Comparison


_NOISE = 0.02
_LEVELS = tuple(10.0 ** np.arange(-3.0, 3.1, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class ErrorResponse(Row):
    """Response from the inputs to the residual of a model.

    Attributes
    ----------
    name : str
        Model.
    omega : ndarray of shape (n_omega,)
        Frequencies in rad/s.
    error : complex ndarray of shape (n_y, n_w, n_omega)
        Measured response minus the model's, estimated from the residual, so
        that what the model explains leaks into no neighboring frequency.
    model : complex ndarray of shape (n_y, n_w, n_omega)
        Response of the model as the record sees it.
    band : ndarray of shape (n_y, n_w, n_omega)
        Radius within which the error of a correct model stays at each
        frequency with 95 %.
    simultaneous : ndarray of shape (n_y, n_w, n_omega)
        Radius within which it stays at all frequencies together with 95 %.
    """

    name: str
    omega: Array
    error: NDArray[np.complex128]
    model: NDArray[np.complex128]
    band: Array
    simultaneous: Array

    @property
    def relative(self) -> Array:
        """Size of the error over that of the model, shape (n_y, n_w, n_omega)."""
        # |error| / |model|, NaN where the model is zero
        size = np.abs(self.model)
        ratio = np.divide(np.abs(self.error), size, out=np.full(size.shape, np.nan), where=size > 0)
        return np.asarray(ratio)

    @property
    def differs(self) -> NDArray[np.bool_]:
        """Points at which the error leaves the simultaneous band.

        Shape (n_y, n_w, n_omega).
        """
        return np.asarray(np.abs(self.error) > self.simultaneous)


def model_error(
    comparison: Comparison, model: int = 0, *, segment_length: int | None = None
) -> ErrorResponse:
    """Estimate the response from inputs to residual, with 95 % bands.

    Parameters
    ----------
    comparison : Comparison
        Models on a record.
    model : int
        Which of the models.
    segment_length : int, optional
        Samples per averaged segment; default about N/8.

    Returns
    -------
    ModelError

    Raises
    ------
    DataError
        If the record is too short or an input does not vary.

    Notes
    -----
    The error of an H1 estimate over its standard deviation is distributed as
    the root of F with 2 and 2 (m - n_w) degrees of freedom, m the effective
    number of averages (Bendat and Piersol, Random Data, ch. 9).

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> w = rng.standard_normal(4000)
    >>> plant = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0)
    >>> y = rco.simulate(plant, rco.Measurement(w, w, dt=0.1), "zero").outputs[0]
    >>> data = rco.Measurement(w, y + 0.02 * rng.standard_normal(4000), dt=0.1)
    >>> bool(model_error(rco.compare(plant, data)).differs.any())
    False
    """
    # frequency response from the inputs to the residual, with its standard deviation
    data = comparison.seen_by(model)
    residual = data._changed(outputs=data.outputs - comparison.runs[model])
    found = estimate_frequency_response(residual, segment_length=segment_length)
    free = 2.0 * (found.n_averages - data.n_inputs)
    # std is that of one component: the squared radius over 2 std^2 follows F
    rounding = np.spacing(spreads(data.outputs)[:, None] / spreads(data.inputs))  # of a response
    std = np.asarray(found.std).clip(rounding[:, :, None])
    radius = std * np.sqrt(2.0 * stats.f.ppf(0.95, 2, free))
    count = found.response.size
    # simultaneous band: Sidak's correction over all points
    wide = std * np.sqrt(2.0 * stats.f.isf(1.0 - 0.95 ** (1.0 / count), 2, free))
    seen = as_sampled(comparison.models[model], data.dt, data.hold)
    response = frequency_response(seen, found.omega)
    return ErrorResponse(comparison.names[model], found.omega, found.response, response, radius, wide)


@dataclass(frozen=True, slots=True, eq=False)
class HorizonError(Row):
    """Error against prediction horizon.

    Attributes
    ----------
    names : tuple of str
        Models.
    steps : ndarray of shape (n_horizons,)
        Horizons in samples.
    seconds : ndarray of shape (n_horizons,)
        The same in s.
    rmse : ndarray of shape (n_models, n_y, n_horizons)
        Error of predictions so many samples ahead, in output units.
    free_run : ndarray of shape (n_models, n_y)
        Error of the free run, which the curves end in.
    """

    names: tuple[str, ...]
    steps: Array
    seconds: Array
    rmse: Array
    free_run: Array


def horizon_error(comparison: Comparison, steps: Any = None) -> HorizonError:
    """Error of predictions one, two, ... samples ahead.

    At each sample the record corrects the state of the model (steady Kalman
    gain for unknown input of the likeliest level); from there it runs
    free. A correct model with noisy sensors has a flat curve; one whose
    curve rises has wrong dynamics over the time in which it does.

    Parameters
    ----------
    comparison : Comparison
        Models on a record.
    steps : array_like of int, optional
        Horizons in samples; default 12 from one to a quarter of the record,
        evenly spaced on a logarithmic axis.

    Returns
    -------
    HorizonError
    """
    data = comparison.data
    check_whole(data, "horizon_error")
    # up to a quarter of the longest free run
    longest = int(max(np.diff([*comparison.starts, data.n_samples])))
    if steps is None:
        steps = np.unique(np.geomspace(1, max(longest // 4, 1), 12).round().astype(int))
    ahead = np.atleast_1d(np.asarray(steps, dtype=np.int64))
    if ahead.ndim != 1 or ahead.size == 0 or (ahead < 1).any() or (ahead >= data.n_samples).any():
        raise DataError(f"steps must be whole numbers of samples from 1 to {data.n_samples - 1}, not {steps}")
    # error of each model at each horizon, beside that of the free run
    rmse = np.array([_errors(comparison, i, ahead) for i in range(len(comparison.names))])
    free = root_mean_square(data.outputs[None] - comparison.runs)
    return HorizonError(
        comparison.names, ahead.astype(float), np.asarray(ahead * data.dt, dtype=float), rmse, free
    )


def _errors(comparison: Comparison, index: int, ahead: NDArray[np.int64]) -> Array:
    """Return the errors (n_y, n_horizons) of one model.

    The linear part of the model carries the correction on.
    """
    scene = ModelOnRecord(comparison, index, searched=False)
    residual = (scene.measured - scene.run).T.copy()
    # residual in units of the outputs' scale; transition matrix of the linear part
    Phi, C = np.ascontiguousarray(scene.transition), scene.model.C / scene.scale
    gain = _gain(Phi, scene.drive, C, residual, scene)
    # the error is carried on by the linear part: what a correction takes off now fades as it does
    total, count = _prediction_errors(Phi, C, gain, residual, scene.reset, ahead)
    with np.errstate(all="ignore"):
        error = np.sqrt(total / np.maximum(count, 1)[:, None])
    error[count == 0] = np.nan
    return np.asarray((error * scene.scale[:, 0]).T)


def _gain(Phi: Array, drive: Array, C: Array, residual: Array, scene: ModelOnRecord) -> Array:
    """Return the Kalman gain that predicts the residual best.

    It assumes an unknown input, whose level is chosen.
    """
    n, ny = Phi.shape[0], C.shape[0]
    if n == 0:
        return np.zeros((0, ny))
    # every direction of the state may be disturbed a little: an integrator must not escape
    size = root_mean_square(scene.states)
    size = np.where(size > 0, size, max(float(size.max(initial=0.0)), 1.0))
    # noise covariances: unknown input of this level, and a little on every state
    moved = drive * spreads(scene.data.inputs)
    best: tuple[float, Array] | None = None
    for level in _LEVELS:
        Q = level**2 * (moved @ moved.T) + (1e-3 * level) ** 2 * np.diag(size**2)
        R = _NOISE**2 * np.eye(ny)
        # steady-state Kalman gain of the scaled system
        scaled = steady_filter(Phi * size / size[:, None], C * size, Q / np.outer(size, size), R)
        K = scaled.gain * size[:, None]
        if not np.isfinite(K).all():
            continue
        # keep the gain with the smallest one-step error
        error = float(_prediction_errors(Phi, C, K, residual, scene.reset, np.array([1]))[0].sum())
        if np.isfinite(error) and (best is None or error < best[0]):
            best = error, K
    return np.zeros((n, ny)) if best is None else best[1]


def _prediction_errors(
    Phi: Array, C: Array, K: Array, residual: Array, reset: NDArray[np.uint8], ahead: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Return sums of squared prediction errors by horizon, and their counts."""
    N = len(residual)
    # filter the residual: states (n, N) after each correction
    states = observed(Phi, C, K, residual, reset)
    ends = np.append(np.flatnonzero(reset)[1:], N)
    last = ends[np.cumsum(reset) - 1]  # the end of the free run that a sample belongs to
    total, count = np.zeros((ahead.size, len(C))), np.zeros(ahead.size)
    # prediction h samples ahead: C Phi^h x
    for j, h in enumerate(ahead):
        at = np.flatnonzero(np.arange(h, N) < last[: N - h])
        error = residual[at + h] - (C @ np.linalg.matrix_power(Phi, int(h)) @ states[:, at]).T
        total[j], count[j] = np.sum(error**2, axis=0), at.size
    return total, count
