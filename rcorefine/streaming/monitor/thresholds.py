"""How high the statistic may climb by chance: thresholds for a stated rate of false alarms."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq

from ...systems.linear import Array

__all__ = ["crossing_rate", "threshold"]


def crossing_rate(level: float, keep: float) -> float:
    """Rate per sample at which one windowed statistic crosses a level by chance.

    Parameters
    ----------
    level : float
        Level of the absolute value of the statistic, which has unit variance.
    keep : float
        Share that the window keeps per sample, so that the correlation of the
        statistic over a lag of h samples is ``keep**h``.

    Returns
    -------
    float
        Expected number of crossings (clusters of them) per sample.

    Notes
    -----
    The statistic is a sampled Ornstein-Uhlenbeck process; a high level b is
    crossed at the rate ``2 c b phi(b)`` with c = -ln(keep) (Pickands), thinned by
    Siegmund's ``exp(-0.583 b sqrt(2 c))`` because the process is not seen between
    samples, and never more often than single samples lie above it.

    References
    ----------
    D. Siegmund, Sequential Analysis, Springer 1985, chapters IV and VIII.

    Examples
    --------
    >>> 0.9 < crossing_rate(4.0, 0.99) / 7.1e-6 < 1.1
    True
    """
    c = -math.log(keep)
    density = math.exp(-0.5 * level * level) / math.sqrt(2 * math.pi)
    clusters = 2 * c * level * density * math.exp(-0.583 * level * math.sqrt(2 * c))
    return min(clusters, math.erfc(level / math.sqrt(2)))


def threshold(rate: float, keep: Array, columns: int) -> Array:
    """Levels of the statistic for each window, the rate shared out evenly.

    Parameters
    ----------
    rate : float
        Expected false alarms per sample, all columns and windows together.
    keep : ndarray, shape (M,)
        Share that each window keeps per sample.
    columns : int
        Number of columns; their rates add up at most (Bonferroni).

    Returns
    -------
    ndarray, shape (M,)
        Levels.
    """
    goal = math.log(rate / (columns * keep.size))

    def excess(level: float, share: float) -> float:
        return math.log(max(crossing_rate(level, share), 1e-300)) - goal

    return np.array([brentq(excess, 1.5, 30.0, args=(float(share),), xtol=1e-6) for share in keep])
