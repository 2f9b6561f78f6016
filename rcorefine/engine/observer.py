"""Observer gains, also for models that have no free run over a record."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from ..data.measurement import Measurement
from ..data.records import FreeRun
from ..data.signals import spreads
from ..exceptions import ModelError
from ..models.physical_model import PhysicalModel
from ..systems.discretization import exponential
from ..systems.linear import Array, balance
from .controlled import integrates, open_loop, own_states, runs_away
from .engine import Engine
from .point import about_point
from .structure import Kept, Structure

_ROUNDS = 100
_HORIZON = 300  # samples of the Riccati recursion, where no steady solution exists


def observer_gain(
    structure: Structure,
    theta: Array,
    data: Measurement,
    ratio: float,
    *,
    at: str = "everywhere",
    noise: float = 0.03,
) -> Array:
    """Steady Kalman gain (filter form) for unknown forces at inputs and ports.

    Parameters
    ----------
    structure : Structure
        Model with effects; linearized at rest.
    theta : ndarray, shape (p,)
        Coefficients.
    data : Measurement
        Record, for the levels of inputs and outputs.
    ratio : float
        Unknown force over the measured one, rms. A low ratio gives a low gain, which
        distinguishes candidates; a high one follows the record whatever the model says.
    at : str
        "everywhere" for forces at inputs and ports, "inputs" for forces at the inputs alone.
    noise : float
        Sensor noise over the rms of each output.

    Returns
    -------
    ndarray, shape (n, n_y)
        Gain K of ``x = x + K (y - y_model)`` at each sample; not finite where there is no observer.
    """
    if structure.model.controller is not None:
        # predictions use the recorded inputs, so the controller has no gain
        gain = np.zeros((structure.n_states, structure.n_outputs))
        gain[own_states(structure)] = observer_gain(
            open_loop(structure), theta, data, ratio, at=at, noise=noise
        )
        return gain
    # linearize about the operating point
    A, B, C, _ = about_point(structure, theta.astype(float))
    nw, n = structure.n_inputs, structure.n_states
    if not n:  # a static gain
        return np.zeros((0, structure.n_outputs))
    # sizes of inputs and outputs: rms and standard deviation of the record
    level = np.sqrt(np.mean(data.inputs**2, axis=1))
    level = np.where(level > 0, level, 1.0)
    spread = spreads(data.outputs)
    G, C = B[:, :nw] * level, C / spread[:, None]
    units = _units(A * data.dt, G, C)  # units of the user may differ by orders of magnitude
    A, G, C = A * units / units[:, None], G / units[:, None], C * units
    drives = list(G.T)
    top = max((np.linalg.norm(d) for d in drives), default=1.0) or 1.0
    acts = [] if at == "inputs" and drives else [port.act for port in structure.model.ports]
    # unknown forces at the places, as large as the largest input
    for act in acts:
        padded = np.zeros(n)
        padded[: act.size] = act
        padded /= units
        size = np.linalg.norm(padded)
        if size > 0:
            drives.append(padded * (top / size))
    G = np.column_stack(drives) * ratio
    # matrix of Van Loan: its exponential holds Phi and the process noise Q
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -A, G @ G.T, A.T
    # Van Loan: exact covariance of white noise of this density over a sample
    scale = data.dt
    with np.errstate(over="ignore", invalid="ignore"):
        F = exponential((block * scale)[None])[0]
        Phi = F[n:, n:].T
        Q = Phi @ F[:n, n:]
    diagonal = np.diag(Q)
    if not np.isfinite(Q).all() or diagonal.min(initial=0.0) < -1e-9 * diagonal.max(initial=0.0):
        # fast poles make that form overflow or cancel: take a force that is held over the sample
        held = exponential((np.block([[A, G], [np.zeros((G.shape[1], n + G.shape[1]))]]) * scale)[None])[0]
        Phi, gamma = held[:n, :n], held[:n, n:]
        Q = gamma @ gamma.T
    else:
        Q = Q * data.dt
    R = noise**2 * np.eye(spread.size)
    size = np.sqrt(np.maximum(np.diag(Q), 1e-12 * np.trace(Q) / n + 1e-300))
    A = Phi * size / size[:, None]  # unit-size states keep the Riccati equation well scaled
    Qs = Q / np.outer(size, size) + 1e-12 * np.eye(n)
    return np.asarray(steady_filter(A, C * size, Qs, R).gain * (units * size)[:, None] / spread)


def _units(A: Array, G: Array, C: Array) -> Array:
    """Return units in which all states have about the same size.

    They are balanced along the way from the drives to the outputs. The method is that of Osborne, J. ACM 7
    (1960) 338, without rounding to powers of two: gains must not depend on units.
    """
    reached, seen = np.abs(G).max(axis=1, initial=0.0), np.abs(C).max(axis=0, initial=0.0)
    between = np.abs(A) * (1.0 - np.eye(len(A)))  # the diagonal has no unit
    size = np.block([[between, reached[:, None]], [seen, np.zeros(1)]])
    units = balance(size)
    for _ in range(_ROUNDS):
        now = size * units / units[:, None]
        rows, columns = np.linalg.norm(now, axis=1), np.linalg.norm(now, axis=0)
        both = (rows > 0) & (columns > 0)
        change = np.where(both, rows, 1.0) / np.where(both, columns, 1.0)
        units = units * change**0.25
        if np.abs(change - 1.0).max() < 1e-8:
            break
    return np.asarray(units[:-1] / units[-1])


def existing_gain(
    structure: Structure, theta: Array, data: Measurement, ratio: float, *, at: str = "everywhere"
) -> Array:
    """Return the gain of `observer_gain`, or raise an error if none exists.

    Raises
    ------
    ModelError
        If no observer leads the model along the record.
    """
    gain = observer_gain(structure, theta, data, ratio, at=at)
    if not np.isfinite(gain).all():
        raise ModelError(
            f"no observer leads the model along a record sampled every {data.dt:g} s: a motion grows beyond "
            "floating point that the outputs do not tell from others; check the signs and units of A"
        )
    return gain


class SteadyFilter(NamedTuple):
    """Kalman filter of a time-invariant system, long after its start."""

    gain: Array  #: (n, n_y), of ``x = x + K (y - H x)`` at each sample
    predicted: Array  #: (n, n), covariance of the state before the sample's measurement
    innovation: Array  #: (n_y, n_y), covariance of the innovation

    @property
    def filtered(self) -> Array:
        """Covariance of the state after the sample's measurement, shape (n, n)."""
        return self.predicted - self.gain @ (self.innovation @ self.gain.T)


def steady_filter(F: Array, H: Array, Q: Array, R: Array) -> SteadyFilter:
    """Solve the filter's Riccati equation.

    Parameters
    ----------
    F : ndarray, shape (n, n)
        Transition of the state over one sample.
    H : ndarray, shape (n_y, n)
        Outputs by the state.
    Q : ndarray, shape (n, n)
        Covariance of what is added to the state in one sample. Bring states to sizes near 1 first.
    R : ndarray, shape (n_y, n_y)
        Covariance of the sensor noise.

    Returns
    -------
    SteadyFilter
        Where there is no steady filter, the one after a few hundred samples: its gain may not be
        finite.

    Examples
    --------
    A random walk seen in noise of its own size has the golden ratio as gain.

    >>> one = np.eye(1)
    >>> print(steady_filter(one, one, one, one).gain.round(4))
    [[0.618]]
    """
    n = F.shape[0]
    if n == 0:
        return SteadyFilter(np.zeros((0, H.shape[0])), np.zeros((0, 0)), R)
    Q = 0.5 * (Q + Q.T)
    # P = F P F' - F P H' (H P H' + R)^-1 H P F' + Q
    try:  # without scipy's balancing, which scales rounding errors up
        P = solve_discrete_are(F.T, H.T, Q, R, balanced=False)
        if not np.isfinite(P).all():
            raise LinAlgError
    except (LinAlgError, ValueError):
        P = _finite_horizon(F, H, Q, R)  # a state that the outputs cannot see has no steady covariance
    # innovation covariance and Kalman gain
    S = H @ P @ H.T + R
    return SteadyFilter(_gain(P, H, S), P, S)


def _gain(P: Array, H: Array, S: Array) -> Array:
    try:
        return P @ H.T @ np.linalg.inv(S)
    except LinAlgError:  # the sensor noise is rounding beside a diverged covariance
        return np.full((len(P), len(H)), np.nan)


def _finite_horizon(F: Array, H: Array, Q: Array, R: Array) -> Array:
    P = Q.copy()
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_HORIZON):
            # Kalman filter: update of the covariance, then prediction
            K = _gain(P, H, H @ P @ H.T + R)
            P = F @ (P - K @ H @ P) @ F.T + Q
            P = 0.5 * (P + P.T)
    return P


#: Unknown force over the measured one; with less, stick-slip would have to be predicted exactly.
_QUIET = 0.03
_REGULAR = 2.0  # log of the growth of an error: up to one in regular motion, three or more in chaotic motion
# unknown over measured force; the smallest that keeps the model on the record is used
_FORCES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
_DIES_OUT = 1e-3  # share of its largest effect to which an error of the initial state must decay
_FOLLOWS = 5.0  # multiple of the error of the strongest observer above which the observer lost the motion
_BALANCED = 30  # sweeps over the states
_LARGEST = 30.0  # log of a growth at which the sum can stop
_RATIOS = Kept(64)  # by model and record


def leading_gain(structure: Structure, data: Measurement) -> Array | None:
    """Return the observer gain for an unstable model.

    It is None if the model has a free run. With sensor noise alone, the steady filter of an unstable system
    mirrors its unstable poles: what it predicts is the best prediction there is, and under a controller an
    unbiased one.

    Parameters
    ----------
    structure : Structure
        Model with effects; the gain is that of the initial model, so all candidates have the same.
    data : Measurement
        Record.

    Returns
    -------
    ndarray of shape (n, n_y), or None
    """
    ratio = leading_ratio(structure.model, data)
    if ratio is None:
        return None
    bare = Structure(structure.model)
    gain = observer_gain(bare, np.zeros(bare.n_parameters), data, ratio)
    return np.pad(gain, ((0, structure.n_states - gain.shape[0]), (0, 0)))


def leading_ratio(model: PhysicalModel, data: Measurement) -> float | None:
    """Return the ratio of `observer_gain` for a model without a free run.

    It is None for a model that has a free run, and for a chaotic one whose free run was asked for. Under a
    controller, a model that integrates also gets an observer, since it would need windows otherwise. The
    free run of the loop is unbiased as well, but its residual is noise that the loop has colored and made
    stronger.
    """
    if runs_away(model.linear, data) or (model.controller is not None and integrates(model.linear, data)):
        return _QUIET
    chaotic = model.operating_point is not None and model.operating_point.field is not None
    return steadying_ratio(model, data) if chaotic and not isinstance(data, FreeRun) else None


def steadying_ratio(model: PhysicalModel, record: Measurement) -> float | None:
    """Return the ratio of `observer_gain` that stabilizes a chaotic model.

    The observer keeps the model on its record. The ratio is None if the model has a free run.

    Parameters
    ----------
    model : PhysicalModel
        With a field.
    record : Measurement
        Channels in the order of the model, values above its operating point.
    """
    key = (id(model), record.dt, record.hold, record.inputs.tobytes(), record.outputs.tobytes())
    # the model is kept as well, so that its id is not used again
    return _RATIOS(key, lambda: (model, _find_ratio(open_loop(Structure(model)), record)))[1]


def _find_ratio(bare: Structure, record: Measurement) -> float | None:
    engine, theta = Engine(bare, record, substeps=2), np.zeros(0)
    gains = {ratio: observer_gain(bare, theta, record, ratio) for ratio in _FORCES}
    # motion along the record by the strongest observer; is it chaotic?
    run = engine.run(theta, sensitivity=False, gain=gains[_FORCES[-1]], histories=True, check=False)
    if run.blew_up >= 0 or growth(bare.model, run.states, record) < _REGULAR:
        return None
    missed = np.nanstd(run.outputs - engine.data.outputs)
    # weakest observer that follows the record and forgets its initial state
    for ratio, gain in gains.items():
        run = engine.run(theta, sensitivity=False, initial_state=True, gain=gain, check=False)
        felt = np.abs(run.sensitivity).max(axis=(0, 2))
        holds = run.blew_up < 0 and np.nanstd(run.outputs - engine.data.outputs) < _FOLLOWS * missed
        if holds and felt[felt.size // 2 :].max() < _DIES_OUT * felt.max():
            return ratio
    return _FORCES[-1]


def growth(model: PhysicalModel, states: Array, record: Measurement) -> float:
    """Return the logarithm of the largest growth of a state error.

    The error grows from one sample to a later one, along given states. The states are scaled so that the mean
    of their slopes is balanced (Osborne, J. ACM 7 (1960) 338): their units do not matter.

    Parameters
    ----------
    model : PhysicalModel
        With a field.
    states : ndarray, shape (n, N)
        Motion, above the operating point.
    record : Measurement
        Inputs, above it as well.
    """
    field, n = Structure(model).field, model.linear.n_states
    assert field is not None
    along = np.vstack([states[:n], record.inputs]).T
    slopes = np.array([field.slopes(field.nominal, z)[:n, :n] for z in along])
    A = model.linear.A + np.nan_to_num(slopes)
    scale = _balancing(np.sqrt(np.mean(A**2, axis=0)))
    error, total, least, most = np.eye(n), 0.0, 0.0, 0.0
    # propagate an error of the state, scaled to one after each sample; sum up the logarithms
    for step in exponential(A / scale[:, None] * scale * record.dt):
        error = step @ error
        size = float(np.linalg.norm(error, 2))
        if not 0.0 < size < np.inf:
            break
        error, total = error / size, total + float(np.log(size))
        least = min(least, total)
        most = max(most, total - least)
        if most > _LARGEST:
            break
    return most


def _balancing(A: Array) -> Array:
    """Return units of the states that make rows and columns equally large."""
    scale, size = np.ones(len(A)), A - np.diag(np.diag(A))
    for _ in range(_BALANCED):
        for i in range(len(A)):
            row, column = np.linalg.norm(size[i]), np.linalg.norm(size[:, i])
            if row > 0.0 and column > 0.0:
                factor = np.sqrt(row / column)
                size[i] /= factor
                size[:, i] *= factor
                scale[i] *= factor
    return scale
