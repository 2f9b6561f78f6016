"""Starting values from the measured frequency response.

They are needed far from the solution, where a simulation is wrong by whole periods.
"""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares

from ..data.measurement import Measurement
from ..effects.springs import Stiffness
from ..engine.structure import Structure
from ..exceptions import DataError
from ..systems.linear import Array

__all__ = ["sparse_starts", "spectral_starts"]

_POINTS = 250
_WIDTHS = (4.0, 1.5)  # of the smoothing along the frequencies, wide to narrow
_SINGLE = (-0.2, -0.4, -0.6, -0.75, -0.9)
_DOUBLE = (-0.35, -0.7)
_MOST_PAIRS = 600
_BEST = 6  # of the grid are descended from
_BEAM = 5  # sets of each size that grow on
_LEAST_COHERENCE = 0.1


class _Spectrum:
    """Log magnitudes of the record and of the model, smoothed alike."""

    def __init__(self, structure: Structure, theta: Array, columns: Array, record: Measurement) -> None:
        measured = record.frequency_response(segment_length=max(record.n_samples // 6, 16))
        assert measured.coherence is not None  # it comes from a record
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

    def moved(self, scaled: Array) -> Array:
        """Coefficients at the stiffness ``nominal * exp(scaled)``."""
        theta = self.theta.copy()
        for u, (column, size) in zip(scaled, self.columns, strict=True):
            theta[int(column)] = size * np.expm1(u)
        return theta

    def misfit(self, scaled: Array, width: float) -> Array:
        """Weighted difference at the stiffness ``nominal * exp(scaled)``."""
        theta = self.moved(scaled)
        matrices = self.structure.matrices(theta)
        nw = self.structure.n_inputs
        # modal form: one eigenvalue problem for all frequencies
        poles, right = np.linalg.eig(matrices.A)
        try:
            drive = np.linalg.solve(right, matrices.B[:, :nw].astype(complex))
        except np.linalg.LinAlgError:
            return np.full(self.log.size, 12.0)
        gains = np.einsum(
            "ym,mw,mk->ywk", matrices.C @ right, drive, 1.0 / (1j * self.omega - poles[:, None])
        )
        level = np.log(np.abs(gains + matrices.D[:, :nw, None]) + 1e-300)
        difference = self.weight * np.clip(level - self.log, -12.0, 12.0)
        smooth = gaussian_filter1d(difference, width, axis=2, mode="nearest")
        return np.asarray(smooth).ravel()


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
    spectrum = _spectrum(structure, theta, record)
    if spectrum is None:
        return []
    columns = spectrum.columns
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
            starts.append(spectrum.moved(u))
    return starts


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
    spectrum = _spectrum(structure, theta, record)
    if spectrum is None:
        return []
    n = len(spectrum.columns)
    found: list[tuple[tuple[int, ...], Array]] = []
    beam: list[tuple[float, tuple[int, ...], Array]] = [(np.inf, (), np.zeros(n))]
    for _ in range(min(largest, n)):
        wider: dict[tuple[int, ...], tuple[float, tuple[int, ...], Array]] = {}
        for _, members, u in beam:
            for i in range(n):
                group = tuple(sorted((*members, i)))
                if i in members:
                    continue
                level, reached = _descent(spectrum, u, i, group)
                if group not in wider or level < wider[group][0]:
                    wider[group] = level, group, reached
        beam = sorted(wider.values(), key=lambda entry: entry[0])[:_BEAM]
        for _, members, u in beam[:most]:
            columns = tuple(int(spectrum.columns[i][0]) for i in members)
            found.append((columns, spectrum.moved(u)))
    return found


def _descent(spectrum: _Spectrum, u: Array, added: int, group: tuple[int, ...]) -> tuple[float, Array]:
    """Descend in the members of a group, the added one from several losses."""
    free = np.array(group)

    def misfit(part: Array, width: float) -> Array:
        point = np.zeros_like(u)
        point[free] = part
        return spectrum.misfit(point, width)

    trials = []
    for loss in (0.0, *_DOUBLE):
        point = u.copy()
        point[added] = np.log1p(loss)
        trials.append((float(np.sum(misfit(point[free], _WIDTHS[0]) ** 2)), point[free]))
    part = min(trials, key=lambda pair: pair[0])[1]
    cost = np.inf
    for width in _WIDTHS:
        result = least_squares(misfit, part, args=(width,), bounds=(-6.0, 3.0), max_nfev=8, x_scale=0.3)
        part, cost = result.x, float(result.cost)
    reached = np.zeros_like(u)
    reached[free] = part
    return cost, reached


def _spectrum(structure: Structure, theta: Array, record: Measurement) -> _Spectrum | None:
    """Return the spectra of record and model, or None.

    None is returned where the record or the model has no spectrum.
    """
    nominal = {(q.kind, q.place): q.value for q in structure.model.parameters}
    columns = []
    for i, parameter in enumerate(structure.parameters):
        effect = structure.effects[parameter.effect]
        size = nominal.get((effect.kind, effect.place), 0.0)
        if effect.kind == Stiffness.name and size > 0:
            columns.append((i, size))
    if not columns or not structure.is_linear:
        return None
    try:
        spectrum = _Spectrum(structure, theta, np.array(columns), record)
    except DataError:
        return None
    return spectrum if spectrum.omega.size >= 4 * len(columns) else None
