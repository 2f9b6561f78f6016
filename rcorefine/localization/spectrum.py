"""Far-off starts from the measured frequency response, where a free run slips by whole periods."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares

from ..exceptions import DataError
from ..measurement import Measurement
from ..physics.structure import Structure
from ..systems.linear import Array
from ..systems.response import frequency_response

__all__ = ["spectral_starts"]

_POINTS = 250
_WIDTHS = (4.0, 1.5)  # of the smoothing along the frequencies, wide to narrow
_SINGLE = (-0.2, -0.4, -0.6, -0.75, -0.9)
_DOUBLE = (-0.35, -0.7)
_MOST_PAIRS = 600
_BEST = 6  # of the grid are descended from
_LEAST_COHERENCE = 0.1


class _Spectrum:
    """Log magnitudes of the record and of the model, smoothed alike."""

    def __init__(self, structure: Structure, theta: Array, columns: Array, record: Measurement) -> None:
        measured = record.frequency_response(segment_length=max(record.n_samples // 6, 16))
        usable = np.flatnonzero(
            (measured.omega < 0.6 * np.pi / record.dt) & (measured.coherence.max(axis=0) > _LEAST_COHERENCE)
        )
        if usable.size > _POINTS:  # evenly on the logarithmic axis, each once
            grid = np.geomspace(measured.omega[usable[0]], measured.omega[usable[-1]], _POINTS)
            usable = np.unique(usable[np.searchsorted(measured.omega[usable], grid).clip(0, usable.size - 1)])
        self.structure, self.theta, self.columns = structure, theta, columns
        self.omega = measured.omega[usable]
        self.log = np.log(np.abs(measured.response[:, :, usable]) + 1e-300)
        seen = np.clip(measured.coherence[:, usable], 0.0, 0.999)
        self.weight = np.sqrt(seen)[:, None, :]

    def misfit(self, scaled: Array, width: float) -> Array:
        """Weighted difference at the stiffness ``nominal * exp(scaled)``."""
        theta = self.theta.copy()
        for u, (column, size) in zip(scaled, self.columns, strict=True):
            theta[int(column)] = size * np.expm1(u)
        matrices = self.structure.matrices(theta)
        nw = self.structure.n_inputs
        model = self.structure.linear_model.with_arrays(
            A=matrices.A, B=matrices.B[:, :nw], C=matrices.C, D=matrices.D[:, :nw],
            state_labels=tuple(self.structure.state_labels()),
        )  # fmt: skip
        level = np.log(np.abs(frequency_response(model, self.omega)) + 1e-300)
        difference = self.weight * np.clip(level - self.log, -12.0, 12.0)
        smooth = gaussian_filter1d(difference, width, axis=2, mode="nearest")
        return np.asarray(smooth).ravel()


def spectral_starts(structure: Structure, theta: Array, record: Measurement, most: int = 3) -> list[Array]:
    """Stiffness changes whose smoothed frequency response comes near the measured one.

    A grid over single and double losses, then descents on log magnitudes with less and
    less smoothing: a resonance that moved far pulls from far away.

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
    nominal = {(q.kind, q.place): q.value for q in structure.model.parameters}
    columns = []
    for i, parameter in enumerate(structure.parameters):
        effect = structure.effects[parameter.effect]
        size = nominal.get((effect.kind, effect.place), 0.0)
        if effect.kind == "stiffness" and size > 0:
            columns.append((i, size))
    if not columns:
        return []
    try:
        spectrum = _Spectrum(structure, theta, np.array(columns), record)
    except DataError:
        return []
    if spectrum.omega.size < 4 * len(columns):
        return []
    grid = [np.zeros(len(columns))]
    for i, loss in product(range(len(columns)), _SINGLE):
        grid.append(np.zeros(len(columns)))
        grid[-1][i] = np.log1p(loss)
    pairs = list(combinations(range(len(columns)), 2))[: _MOST_PAIRS // len(_DOUBLE) ** 2]
    for (i, j), (first, second) in product(pairs, product(_DOUBLE, repeat=2)):
        grid.append(np.zeros(len(columns)))
        grid[-1][[i, j]] = np.log1p([first, second])
    levels = [float(np.sum(spectrum.misfit(u, _WIDTHS[0]) ** 2)) for u in grid]
    reached = []
    for k in np.argsort(levels)[:_BEST]:
        u = grid[int(k)]
        for width in _WIDTHS:
            found = least_squares(
                spectrum.misfit, u, args=(width,), bounds=(-6.0, 3.0), max_nfev=15, x_scale=0.3
            )
            u = found.x
        reached.append((float(found.cost), u))
    reached.sort(key=lambda pair: pair[0])
    starts: list[Array] = []
    kept: list[Array] = []
    for _, u in reached:
        if len(kept) < most and all(np.abs(u - other).max() > 0.02 for other in kept):
            kept.append(u)
            start = theta.copy()
            for value, (column, size) in zip(u, columns, strict=True):
                start[column] = size * np.expm1(value)
            starts.append(start)
    return starts
