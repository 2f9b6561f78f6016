"""Black-box model of a record: the fit that its data allow at all."""

from __future__ import annotations

import control as ct
import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter

from ..arguments import as_whole
from ..data.measurement import Measurement
from ..data.records import as_record
from ..exceptions import DataError, ModelError
from ..systems.linear import Array

_ITERATIONS = 30


def black_box(data: Measurement, order: int = 4) -> ct.StateSpace:
    """Estimate a linear black-box model, as a yardstick for physical ones.

    Parameters
    ----------
    data : Measurement
        Record. A constant offset and the initial state are estimated, too, and left out of the model.
    order : int
        Number of states for each output.

    Returns
    -------
    StateSpace
        Discrete-time model with the sampling time and the labels of the record. `compare` takes it beside
        physical models.

    Raises
    ------
    DataError
        If the record has no input, a signal that never changes, or too few samples for this order.
    ModelError
        If no stable model of this order is found.

    Notes
    -----
    Each output is an output-error model y = (B / A) u with one denominator, found by the iteration of
    Steiglitz and McBride (IEEE Trans. Automatic Control 10 (1965) 461): least squares on signals that are
    filtered by 1 / A of the step before. Of all steps the one with the smallest simulation error is taken.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> force = np.random.default_rng(0).standard_normal(2000)
    >>> y = rco.simulate(model, rco.Measurement(force, np.zeros(2000), dt=0.02), "zero").outputs
    >>> box = rco.black_box(rco.Measurement(force, y, dt=0.02, input_labels="force"), order=2)
    >>> bool(np.allclose(np.log(box.poles()) / 0.02, model.system.poles(), rtol=1e-6))
    True
    """
    data, order = as_record(data), as_whole(order, "order", least=1, most=20)
    n_inputs, n_samples = data.inputs.shape
    labels = (*data.input_labels, *data.output_labels)
    for label, row in zip(labels, (*data.inputs, *data.outputs), strict=True):
        if not np.ptp(row):
            raise DataError(f"{label} never changes: a black box needs inputs and outputs that move")
    unknowns = order + (order + 1) * n_inputs + order + 1
    if not n_inputs or n_samples < 5 * unknowns:
        raise DataError(
            f"a black box of order {order} has {unknowns} coefficients for each output; it needs an input "
            f"and {5 * unknowns} samples, the record has {n_inputs} and {n_samples}"
        )
    # one output-error model per output: y = B(q)/A(q) u
    blocks = [output_error(y, data.inputs, order)[0] for y in data.outputs]
    if any(block is None for block in blocks):
        y = data.output_labels[[block is None for block in blocks].index(True)]
        raise ModelError(f"no stable black box of order {order} describes {y}; try another order")
    b, a = (np.array([block[i] for block in blocks if block is not None]) for i in (0, 1))
    states = [np.column_stack([-ai[1:], np.eye(order, order - 1)]) for ai in a]  # observer form
    A, C = block_diag(*states), np.kron(np.eye(len(a)), np.eye(1, order))
    B = np.vstack([bi[:, 1:].T - np.outer(ai[1:], bi[:, 0]) for bi, ai in zip(b, a, strict=True)])
    D = b[:, :, 0]
    names = {"inputs": list(data.input_labels), "outputs": list(data.output_labels)}
    return ct.ss(A, B, C, D, data.dt, name=f"black box, order {order}", **names)


def output_error(y: Array, inputs: Array, order: int) -> tuple[tuple[Array, Array] | None, float]:
    """Return the black-box model of one output, and its simulation error.

    Parameters
    ----------
    y : ndarray, shape (N,)
        Output.
    inputs : ndarray, shape (n_w, N)
        Inputs.
    order : int
        Number of states.

    Returns
    -------
    model : tuple of ndarray, or None
        Numerators (n_w, order + 1) and denominator; None if none is stable.
    error : float
        Norm of the simulation error, inf without a model.
    """
    start = np.zeros((order, y.size))
    np.fill_diagonal(start, 1.0)  # pulses at the first samples: the initial state
    # columns: lagged inputs, the initial state, and an offset
    fixed = [lag for u in inputs for lag in _lags(u, range(order + 1))] + [*start, np.ones(y.size)]
    a, least = np.eye(1, order + 1)[0], np.inf
    best: tuple[Array, Array] | None = None
    # Steiglitz-McBride: prefilter with 1/A, then least squares for A and B
    for _ in range(_ITERATIONS):
        past = _lags(lfilter([1.0], a, y), range(1, order + 1))
        columns = np.array([*(-row for row in past), *(lfilter([1.0], a, row) for row in fixed)]).T
        size = np.linalg.norm(columns, axis=0)
        found = np.linalg.lstsq(columns / size, lfilter([1.0], a, y), rcond=1e-12)[0] / size
        roots = np.roots(np.append(1.0, found[:order]))
        outside = np.abs(roots) > 1.0
        roots[outside] = 1.0 / roots[outside].conj()  # mirrored into the unit circle
        a = np.asarray(np.poly(roots).real)
        # numerator, initial state and offset again for the stable A, by the simulation error
        driven = np.array([lfilter([1.0], a, row) for row in fixed]).T
        gains = np.linalg.lstsq(driven, y, rcond=1e-12)[0]
        error = float(np.linalg.norm(y - driven @ gains))
        # keep the iterate with the smallest simulation error
        if error < least and np.abs(np.roots(a)).max(initial=0.0) < 1.0:
            least, best = error, (gains[: (order + 1) * len(inputs)].reshape(len(inputs), -1), a)
    return best, least


def _lags(row: Array, lags: range) -> list[Array]:
    """Return a signal that was zero before the record, later by some samples."""
    return [np.concatenate([np.zeros(k), row[: row.size - k]]) for k in lags]
