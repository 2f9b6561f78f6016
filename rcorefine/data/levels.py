"""Stretches of a record by the level of its excitation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy import stats

from ..systems.linear import Array
from .measurement import Measurement

__all__ = ["MOST", "stretches_by_level"]

MOST = 3  # levels of a record that are told apart
_BLOCKS = 24  # pieces of a record whose level is looked at
_RATIO = 1.6  # of the levels of two stretches that count as different
_FEWEST = 4  # blocks of a stretch


def stretches_by_level(data: Measurement) -> list[tuple[float, Measurement]]:
    """Longest stretch of a record at each level of its excitation.

    Parameters
    ----------
    data : Measurement
        Record.

    Returns
    -------
    list of (float, Measurement)
        Root mean square of the inputs about their mean, and the stretch, the lowest level first; the
        whole record where the level does not change.

    Examples
    --------
    >>> w = np.random.default_rng(0).standard_normal(4000)
    >>> w[2000:] *= 5
    >>> data = rco.Measurement(w, w, dt=0.01)
    >>> [(round(level), part.n_samples) for level, part in stretches_by_level(data)]
    [(1, 2000), (5, 2000)]
    """
    n, centered = data.n_samples, data.inputs - data.inputs.mean(axis=1, keepdims=True)
    scale = centered.std(axis=1, keepdims=True)
    relative = np.divide(centered, scale, out=np.zeros_like(centered), where=scale > 0)
    edges = np.linspace(0, n, min(_BLOCKS, max(1, n // 64)) + 1).round().astype(int)
    power = np.array([np.mean(relative[:, a:b] ** 2) for a, b in pairwise(edges)])
    whole = [(_level(data), data)]
    if power.size < 2 * _FEWEST or not (power > 0).all():
        return whole
    height = 0.5 * np.log(power)
    # the step that starts a new stretch is larger than what chance makes of one level
    jumps = np.flatnonzero(np.abs(np.diff(height)) > np.log(_RATIO)) + 1
    bounds = [0, *jumps.tolist(), power.size]
    bounds = [0] + [cut for a, b in pairwise(bounds) for cut in _thirds(height, a, b)]
    found: list[tuple[float, Measurement]] = []
    for a, b in sorted(pairwise(bounds), key=lambda pair: pair[0] - pair[1]):
        if b - a < _FEWEST:
            continue
        stop = float(data.timepts[edges[b]]) if edges[b] < n else None
        part = data.segment(float(data.timepts[edges[a]]), stop)
        level = _level(part)
        if all(max(level, other) / min(level, other) > _RATIO for other, _ in found):
            found.append((level, part))
    return sorted(found[:MOST], key=lambda pair: pair[0]) if found else whole


def _thirds(height: Array, first: int, last: int) -> list[int]:
    """Return the ends of the parts of a stretch.

    There are three parts if the level of the stretch rises or falls all the way, otherwise one.
    """
    blocks = last - first
    if blocks < 3 * _FEWEST:
        return [last]
    line = stats.linregress(np.arange(blocks), height[first:last])
    climbs = abs(line.slope) * blocks > 2 * np.log(_RATIO) and line.pvalue < 1e-4
    return [first + blocks // 3, first + 2 * blocks // 3, last] if climbs else [last]


def _level(data: Measurement) -> float:
    """Root mean square of the inputs about their mean."""
    return float(np.sqrt(np.mean(data.inputs.var(axis=1))))
