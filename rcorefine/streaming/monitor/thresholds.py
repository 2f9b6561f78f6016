"""Windows of the test, and how high the statistic may climb in each by chance."""

from __future__ import annotations

import math

import control as ct
import numpy as np
from scipy.optimize import brentq

from ...arguments import as_list
from ...systems.linear import Array
from ..checks import as_size

__all__ = ["crossing_rate", "threshold", "window_lengths"]

_LONGEST = 200  # periods in the longest window


def window_lengths(windows: tuple[int, int] | None, period: int) -> Array:
    """Samples in each window, doubled from one to the next; `period` is that of the first mode."""
    if windows is None:
        shortest, longest = max(8, period // 4), _LONGEST * period
    else:
        pair = as_list(windows, "windows", "two sizes, the shortest first")
        if len(pair) != 2:
            raise ct.ControlDimension(f"windows has {len(pair)} entries; give the shortest and the longest")
        shortest = as_size(pair[0], "windows[0]", 4, "samples in the shortest window")
        longest = as_size(pair[1], "windows[1]", shortest, "samples in the longest window")
    count = max(1, round(math.log2(longest / shortest)) + 1)
    return np.asarray(shortest * 2.0 ** np.arange(count))


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
