"""Frequency responses of arrays and the distance between two of them.

All frequencies are computed in one batch.
"""

from __future__ import annotations

import math

import control as ct
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import as_array
from ..exceptions import ModelError
from .conversion import to_discrete
from .discretization import check_sampling_time
from .linear import Array, LinearModel

# Complex numbers that one batch may hold (32 MB).
_BATCH = 2_000_000


def frequency_response(model: LinearModel, omega: ArrayLike) -> NDArray[np.complex128]:
    """Evaluate the transfer function at real frequencies, all in one batch.

    Parameters
    ----------
    model : LinearModel
        Continuous model, evaluated at ``j omega``, or discrete model,
        evaluated at ``exp(j omega dt)``. As in python-control, ``dt =
        True`` counts as 1 s and ``dt = None`` as continuous.
    omega : array_like
        Frequencies in rad/s, shape (n_omega,).

    Returns
    -------
    ndarray of complex
        Response of shape (n_y, n_w, n_omega); ``inf + nan j`` where a pole
        lies exactly on the point.

    Raises
    ------
    control.ControlDimension
        If `omega` is not one-dimensional.
    ModelError
        If a frequency is not finite.

    Examples
    --------
    >>> import control as ct
    >>> from rcorefine.systems.linear import LinearModel
    >>> lag = LinearModel.from_statespace(ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]))
    >>> print(frequency_response(lag, [0.0, 1.0])[0, 0])
    [1. +0.j  0.5-0.5j]
    """
    points = _check_omega(omega)
    # on the imaginary axis, or on the unit circle
    if model.dt is None or model.is_continuous:
        z = np.asarray(1j * points, dtype=np.complex128)
    else:
        z = np.asarray(np.exp(1j * points * float(model.dt)), dtype=np.complex128)
    n = model.n_states
    response = np.empty((points.size, model.n_outputs, model.n_inputs), dtype=complex)
    # blocks of frequencies bound the memory
    batch = max(1, _BATCH // max(1, n * (n + model.n_inputs)))
    for start in range(0, points.size, batch):
        part = slice(start, start + batch)
        # G(z) = C (z I - A)^-1 B + D
        states = _resolvent_times(model.A, model.B, z[part])
        at_pole = np.isnan(states).any(axis=(1, 2))
        states[at_pole] = 0.0
        response[part] = model.C @ states + model.D
        response[part][at_pole] = complex(np.inf, np.nan)
    return np.moveaxis(response, 0, -1)


def bode_error(
    true: ct.StateSpace | LinearModel,
    estimate: ct.StateSpace | LinearModel,
    omega: ArrayLike | None = None,
    *,
    dt: float | None = None,
) -> float:
    """Return the relative error of an estimated frequency response.

    The error is ``||G_hat - G|| / ||G||``, the norm taken over all channels and frequencies: 0 is a perfect
    estimate, 1 is no better than an estimate of zero.

    Parameters
    ----------
    true, estimate : StateSpace or LinearModel
        Systems with the same numbers of inputs and outputs, each evaluated
        in its own timebase.
    omega : array_like, optional
        Frequencies in rad/s, shape (n_omega,). Default: 200 points, evenly
        spaced on the logarithmic axis, from 0.1 rad/s up to the Nyquist
        frequency ``pi / dt``.
    dt : float, optional
        Sampling time in seconds that sets the Nyquist frequency; default
        that of the systems. Two continuous systems need it, or `omega`.

    Returns
    -------
    float
        Relative error, without unit.

    Raises
    ------
    control.ControlDimension
        If the systems have different numbers of inputs or outputs.
    ModelError
        If the range of frequencies is not known, or the true response is
        zero or infinite at the frequencies asked for.

    Examples
    --------
    >>> import control as ct
    >>> true = ct.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)
    >>> print(round(bode_error(true, 0.9 * true), 6))
    0.1
    """
    g, g_hat = _arrays(true), _arrays(estimate)
    if (g.n_inputs, g.n_outputs) != (g_hat.n_inputs, g_hat.n_outputs):
        raise ct.ControlDimension(
            f"the systems must have the same channels: the true one has {g.n_inputs} inputs and "
            f"{g.n_outputs} outputs, the estimate {g_hat.n_inputs} and {g_hat.n_outputs}"
        )
    # norm of the difference over the norm of the true response
    points = default_omega(_common_dt(g, g_hat, dt)) if omega is None else _check_omega(omega)
    reference = frequency_response(g, points)
    size = float(np.linalg.norm(reference))
    if not math.isfinite(size) or size == 0.0:
        raise ModelError(
            f"the true response is {'zero' if size == 0.0 else 'not finite'} at the frequencies asked for, "
            "so a relative error has no meaning; choose other frequencies"
        )
    return float(np.linalg.norm(frequency_response(g_hat, points) - reference)) / size


def default_omega(dt: float) -> Array:
    """Return logarithmically spaced frequencies up to the Nyquist frequency.

    Parameters
    ----------
    dt : float
        Sampling time in seconds.

    Returns
    -------
    ndarray
        200 frequencies in rad/s, from 0.1 (a thousandth of the Nyquist frequency where that is smaller)
        to ``pi / dt``.

    Examples
    --------
    >>> omega = default_omega(0.01)
    >>> print(omega.size, round(omega[-1], 3))
    200 314.159
    """
    nyquist = math.pi / check_sampling_time(dt)
    return np.geomspace(min(0.1, nyquist / 1000), nyquist, 200)


def _resolvent_times(a: Array, b: Array, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Solve (z I - A) X = B for every z; a pole hit exactly gives NaN."""
    # one batched solution of (z I - A) X = B
    shifted = z[:, None, None] * np.eye(a.shape[0]) - a
    right = np.broadcast_to(b.astype(complex), (z.size, *b.shape))
    try:
        return np.asarray(np.linalg.solve(shifted, right))
    except np.linalg.LinAlgError:
        if z.size == 1:
            return np.full(right.shape, complex(np.nan, np.nan))
    # a pole lies on a frequency: halve the batch until it is alone
    half = z.size // 2
    return np.concatenate([_resolvent_times(a, b, z[:half]), _resolvent_times(a, b, z[half:])])


def _check_omega(omega: ArrayLike) -> Array:
    points = as_array(omega, "omega", error=ModelError)
    if points.ndim != 1:
        raise ct.ControlDimension(f"omega must be one-dimensional, not of shape {points.shape}")
    return points


def _arrays(system: ct.StateSpace | LinearModel) -> LinearModel:
    return system if isinstance(system, LinearModel) else LinearModel.from_statespace(system)


def _common_dt(g: LinearModel, g_hat: LinearModel, dt: float | None) -> float:
    """Sampling time that sets the Nyquist frequency: the slower of two."""
    if dt is not None:
        return check_sampling_time(dt)
    known = [float(m.dt) for m in (g, g_hat) if m.dt is not None and m.dt is not True and m.dt > 0]
    if not known:
        raise ModelError(
            "neither system has a sampling time, so there is no Nyquist frequency to go up to; "
            "give dt= (seconds) or omega= (rad/s)"
        )
    return max(known)


def as_sampled(model: LinearModel, dt: float, hold: str) -> LinearModel:
    """Continuous model as a record with this dt and hold sees it.

    Parameters
    ----------
    model : LinearModel
        Returned as it is where it is discrete already.
    dt : float
        Sampling time in s.
    hold : {"zoh", "foh", "bandlimited"}
        Behind a band-limited input the samples follow G(j omega) itself, so
        the model stays continuous.

    Returns
    -------
    LinearModel
        Model whose frequency response is that of the sampled signals.
    """
    return to_discrete(model, dt, hold) if model.is_continuous and hold != "bandlimited" else model


def hold_factor(omega: Array, dt: float, hold: str) -> NDArray[np.complex128]:
    """Return the complex gain of a hold at the fundamental of a sine.

    Parameters
    ----------
    omega : ndarray, shape (n,)
        Frequencies in rad/s.
    dt : float
        Sampling time in s, 0 for none.
    hold : {"zoh", "foh", "bandlimited"}
        How the input runs between samples.

    Returns
    -------
    complex ndarray, shape (n,)
        1 for a band-limited input.

    Examples
    --------
    >>> abs(hold_factor(np.array([1e-9]), 0.1, "zoh"))
    array([1.])
    """
    # zoh: sinc(omega dt / 2) with a delay of dt / 2; foh: sinc^2 without one
    half = 0.5 * omega * dt
    if hold == "bandlimited" or dt == 0:
        return np.ones(omega.shape, complex)
    size = np.sinc(half / np.pi)
    return size * np.exp(-1j * half) if hold == "zoh" else (size**2).astype(complex)
