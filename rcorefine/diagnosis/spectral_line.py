"""Spectral line in a residual: a disturbance at a single frequency.

Noise has no such line.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..inference.levels import levels
from ..systems.linear import Array

__all__ = ["spectral_line"]

_LOBE, _BESIDE = 2, 12  # bins of a Hann window's line on either side, and of what is compared with it
_PARTS = 8  # of the record, in each of which the line stands
_SHORTEST = 200  # samples


def spectral_line(residuals: Sequence[Array], dt: float) -> tuple[float, float] | None:
    """Frequency of the line that makes up most of a residual, if there is one.

    Parameters
    ----------
    residuals : sequence of ndarray of shape (n_y, N)
        Of each record; the longest is looked at.
    dt : float
        Sampling time (s).

    Returns
    -------
    frequency, share : float
        In Hz, and of the power of that output; None where no line stands out that keeps its phase.
    """
    longest = max(residuals, key=lambda block: block.shape[1])
    found = [line for row in longest if (line := _line(row - row.mean(), dt)) is not None]
    return max(found, key=lambda line: line[1], default=None)


def _line(row: Array, dt: float) -> tuple[float, float] | None:
    n = row.size
    if n < _SHORTEST or not row.any():
        return None
    window = np.hanning(n)
    power = np.abs(np.fft.rfft(window * row)) ** 2
    k = int(np.argmax(power[_LOBE + 1 : -_BESIDE])) + _LOBE + 1
    near = slice(k - _LOBE, k + _LOBE + 1)
    beside = np.concatenate([power[max(k - _BESIDE, 1) : near.start], power[near.stop : k + _BESIDE + 1]])
    level = levels()
    if power[k] < level.line * beside.mean() or power[near].sum() < level.line_share * power.sum():
        return None
    bins = k + np.linspace(-1.0, 1.0, 81)
    waves = np.exp(-2j * np.pi * np.outer(bins, np.arange(n)) / n)
    best = int(np.argmax(np.abs(waves @ (window * row))))
    parts = np.array([part.mean() for part in np.array_split(waves[best] * row, _PARTS)])
    if np.abs(parts - parts.mean()).max() > level.line_drift * abs(parts.mean()):
        return None
    return float(bins[best] / (n * dt)), float(power[near].sum() / power.sum())
