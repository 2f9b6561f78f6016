"""What a residual is as noise: colored, heavy-tailed, in proportion to the signal, or rounded."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import gammaln, ndtr

from rcorefine.inference.autoregression import autoregression, highest_order
from rcorefine.inference.whitening import Whitener, innovations

ORDERS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 20)
DOF = (2.5, 4.0, 8.0)
SHARES = (0.5, 1.0, 2.0, 4.0, 8.0)


class Noise(NamedTuple):
    """Noise of all outputs: filters, weights of the samples, log likelihood less its price."""

    whitener: Whitener
    weights: list  # (n_y, N) per record: one over the relative standard deviation of each sample
    log_likelihood: float
    names: tuple

    @property
    def uneven(self) -> bool:
        """Whether the samples differ in their noise."""
        return any(np.ptp(w) > 0 for w in self.weights)


def colored(row):
    """(value, filter, variance) of the autoregressive model by Schwarz's criterion."""
    n, best = row.size, None
    for order in ORDERS:
        if order > highest_order(n):
            break
        a, variance = autoregression(row, order=order)
        variance = max(variance, 1e-300)
        value = -0.5 * n * (np.log(2 * np.pi * variance) + 1.0) - 0.5 * order * np.log(n)
        if best is None or value > best[0]:
            best = value, a, variance
    return best


def student(e, dof):
    """Log likelihood and weights of innovations under Student's distribution, scale profiled."""
    s2 = np.median(e**2) / 0.45 + 1e-300
    for _ in range(30):
        w = (dof + 1) / (dof + e**2 / s2)
        new = float(np.mean(w * e**2)) + 1e-300
        if abs(new - s2) < 1e-6 * s2:
            break
        s2 = new
    c = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * np.pi * s2)
    return e.size * c - 0.5 * (dof + 1) * np.sum(np.log1p(e**2 / (dof * s2))), np.sqrt(w), s2


def step_of(values):
    """Step of rounded values, 0 where they are not rounded."""
    distinct = np.unique(values)
    if distinct.size < 3 or distinct.size > 0.6 * values.size:
        return 0.0
    gaps = np.diff(distinct)
    step = float(np.median(gaps[gaps > 1e-9 * np.ptp(distinct)]))
    found, times = np.unique(values, return_counts=True)
    counts = (values - found[np.argmax(times)]) / step
    off = np.abs(counts - np.round(counts))
    return step if np.mean(off < 0.01) > 0.9 else 0.0


def rounded(r, step):
    """Log likelihood of residuals of rounded values, the standard deviation before rounding profiled."""
    best = -np.inf
    for s in step * np.logspace(-1.5, 1.5, 25):
        p = ndtr((r + step / 2) / s) - ndtr((r - step / 2) / s)
        best = max(best, float(np.sum(np.log(np.maximum(p, 1e-30)))) - r.size * np.log(step))
    return best


def noise_of(residuals, outputs, steps):
    """The likeliest noise.

    residuals: (n_y, N) per record in units of the weights; outputs: measured, same units and shape;
    steps: rounding step of each output in the same units.
    """
    lengths = [r.shape[1] for r in residuals]
    R, Y = np.concatenate(residuals, axis=1), np.concatenate(outputs, axis=1)
    n = R.shape[1]
    price = 0.5 * np.log(n)
    filters, scales, weights, total, names = [], [], [], 0.0, []
    for row, y, step in zip(R, Y, steps, strict=True):
        value, a, variance = colored(row)
        best = (value, a, variance, np.ones(n), "")
        e = innovations(a, row - row.mean())
        for dof in DOF:
            v, w, s2 = student(e[a.size - 1 :], dof)
            v = v * n / max(e.size - a.size + 1, 1) - 0.5 * (a.size - 1) * np.log(n) - price
            if v > best[0]:
                full = np.concatenate([np.full(a.size - 1, 1.0), w])
                best = (v, a, s2, full, f"t{dof:g}")
        level = np.abs(y + row)  # what the model says
        level = level / (np.sqrt(np.mean(level**2)) or 1.0)
        for share in SHARES:
            w = 1.0 / np.sqrt(1.0 + (share * level) ** 2)
            w /= np.exp(np.mean(np.log(w)))
            v, b, variance = colored(row * w)
            v -= price
            if v > best[0]:
                best = (v, b, variance, w, f"proportional {share:g}")
        if step > 0:
            v = rounded(row - 0.0, step) - price
            if v > best[0]:
                best = (v, np.ones(1), float(np.mean(row**2)), np.ones(n), "rounded")
        total += best[0]
        filters.append(best[1])
        scales.append(np.sqrt(best[2]))
        weights.append(best[3])
        names.append(best[4] or f"ar{best[1].size - 1}")
    W = np.array(weights)
    ends = np.cumsum(lengths)[:-1]
    return Noise(Whitener(tuple(filters), np.array(scales)), np.split(W, ends, axis=1), total, tuple(names))
