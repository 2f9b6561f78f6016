"""Observer for models that have no free run over a record.

It corrects the states as weakly as possible.
"""

from __future__ import annotations

import numpy as np

from ..data.measurement import Measurement
from ..models.physical_model import PhysicalModel
from ..systems.discretization import exponential
from ..systems.linear import Array
from .controlled import open_loop
from .engine import Engine
from .free_runs import integrates, runs_away
from .observer import observer_gain
from .structure import Structure

#: Unknown force over the measured one: at less, what sticks and slips would count to its last digit.
_QUIET = 0.03
_REGULAR = 4.0  # log: a regular motion drifts in phase, and gains one or two; over the top it is five or more
_FORCES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)  # unknown over measured: the least that holds the motion
_DIES_OUT = 1e-3  # share of its largest effect to which an error of the start is to fall
_FOLLOWS = 5.0  # times the error of the strongest observer: more, and the motion is lost
_LARGEST = 30.0  # log of a growth: beyond, nothing more is learned
_KEPT = 64
_KNOWN: dict[tuple[int, float, bytes, bytes], tuple[object, float | None]] = {}


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

    It is None for a model that has a free run. Under a controller, a model that integrates also gets an
    observer, since it would need windows otherwise. The free run of the loop is unbiased as well, but its
    residual is noise that the loop has colored and made stronger.
    """
    if runs_away(model.linear, data) or (model.controller is not None and integrates(model.linear, data)):
        return _QUIET
    if model.operating_point is None or model.operating_point.field is None:
        return None
    return steadying_ratio(model, data)


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
    point = model.operating_point
    field = None if point is None else point.field
    key = (id(field), record.dt, record.inputs.tobytes(), record.outputs.tobytes())
    known = _KNOWN.get(key)
    if known is None:
        while len(_KNOWN) >= _KEPT:
            _KNOWN.pop(next(iter(_KNOWN)), None)  # threads may do the same
        # the field is kept, so that its id stays its own
        known = _KNOWN[key] = (field, _sought(open_loop(Structure(model)), record))
    return known[1]


def _sought(bare: Structure, record: Measurement) -> float | None:
    engine, theta = Engine(bare, record, substeps=2), np.zeros(0)
    gains = {ratio: observer_gain(bare, theta, record, ratio) for ratio in _FORCES}
    run = engine.run(theta, sensitivity=False, gain=gains[_FORCES[-1]], histories=True, check=False)
    if run.blew_up >= 0 or growth(bare.model, run.states, record) < _REGULAR:
        return None
    missed = np.std(run.outputs - engine.data.outputs)
    for ratio, gain in gains.items():
        run = engine.run(theta, sensitivity=False, initial_state=True, gain=gain, check=False)
        felt = np.abs(run.sensitivity).max(axis=(0, 2))
        holds = run.blew_up < 0 and np.std(run.outputs - engine.data.outputs) < _FOLLOWS * missed
        if holds and felt[felt.size // 2 :].max() < _DIES_OUT * felt.max():
            return ratio
    return _FORCES[-1]


def growth(model: PhysicalModel, states: Array, record: Measurement) -> float:
    """Return the logarithm of the largest growth of a state error.

    The error grows from one sample to a later one, along given states.

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
    error, total, least, most = np.eye(n), 0.0, 0.0, 0.0
    for step in exponential((model.linear.A + np.nan_to_num(slopes)) * record.dt):
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
