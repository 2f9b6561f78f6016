"""By how much outputs come later than a free run, once or more and more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data.measurement import Measurement
from ..engine.engine import Engine
from ..engine.structure import Structure
from ..systems.linear import Array

__all__ = ["common_lag", "growing_lags"]

_MOST_DRIFT, _DRIFTS = 0.02, 300  # share by which clocks may run apart, and how many are tried on each side
_SLIP = 0.5  # radians at the end of the record from one to the next


def growing_lags(structure: Structure, records: Sequence[Measurement]) -> list[float]:
    """Return the share of time by which outputs precede the simulation.

    A fit has no gradient beyond a phase error of half a period, so a scan tries every share.

    Parameters
    ----------
    structure : Structure
        Model.
    records : sequence of Measurement
        Records.

    Returns
    -------
    list of float
        Empty where the free run does not move, or has no bounds.
    """
    pairs = []
    for record in records:
        run = Engine(structure, record).run(np.zeros(structure.n_parameters), sensitivity=False, check=False)
        if run.blew_up >= 0 or not np.isfinite(run.outputs).all():
            return []
        passed = record.elapsed + record.dt * np.arange(record.n_samples)
        pairs += [(passed, y, free) for y, free in zip(record.outputs, run.outputs, strict=True)]
    slips = [float(t[-1] * np.std(np.gradient(x, t)) / np.std(x)) for t, _, x in pairs if np.ptp(x) > 0]
    if not slips:
        return []
    step = _SLIP / max(slips)
    most = min(int(_MOST_DRIFT / step), _DRIFTS)
    tried = step * np.arange(-most, most + 1)
    alike = [sum(_correlation(y, np.interp(t * (1 + s), t, x)) for t, y, x in pairs) for s in tried]
    return [float(tried[int(np.argmax(alike))])]


def common_lag(structure: Structure, record: Measurement) -> float:
    """Return the time [s] by which the outputs lag behind the simulation.

    It is the lag of the highest correlation, and at most a third of the record.

    Parameters
    ----------
    structure : Structure
        Model.
    record : Measurement
        Record.

    Returns
    -------
    float
        0 where the free run does not move, or has no bounds.
    """
    run = Engine(structure, record).run(np.zeros(structure.n_parameters), sensitivity=False, check=False)
    if run.blew_up >= 0 or not np.isfinite(run.outputs).all():
        return 0.0
    n = record.n_samples
    pairs = [pair for pair in zip(record.outputs, run.outputs, strict=True) if np.ptp(pair[1]) > 0]
    alike = [sum(abs(_correlation(y[k:], x[: n - k])) for y, x in pairs) for k in range(n // 3)]
    return record.dt * int(np.argmax(alike)) if pairs else 0.0


def _correlation(one: Array, other: Array) -> float:
    one, other = one - one.mean(), other - other.mean()
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(one @ other) / max(size, 1e-300)
