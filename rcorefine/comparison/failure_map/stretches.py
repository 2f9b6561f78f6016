"""Failures in stretches of time.

An output deviates by more than elsewhere, or hangs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...inference.autoregression import autoregression
from ...inference.whitening import innovations
from ...systems.linear import Array
from .likelihood import Explanation
from .record import Finding, ModelOnRecord

__all__ = ["stretches"]

_SHORTEST = 8  # samples of a stretch: less is an outlier
_STILL = 0.2  # of the usual movement, below which an output hangs
_NEAR = 3  # samples around the edge of a stretch
_JUMP = 4.0  # times the usual step between samples, from which on it is a jump
_FAST = 0.3  # usual step over the spread of a signal, from which on jumps are no sign of anything
_MOST = 3  # stretches of an output
_LOUDER = 2.0  # times the error elsewhere, from which on a stretch is one


def stretches(scene: ModelOnRecord) -> list[Finding]:
    """Stretches in which an output is off by more than the rest explains."""
    found = []
    for i in range(scene.n_outputs):
        masked = np.zeros(scene.n_samples, dtype=bool)
        for _ in range(_MOST):
            one = _stretch(scene, i, masked)
            if one is None:
                break
            found.append(one)
            a, b = one.values["span"]
            masked[max(a - 2, 0) : b + 2] = True
    return found


def _stretch(scene: ModelOnRecord, i: int, masked: NDArray[np.bool_]) -> Finding | None:
    N, order = scene.n_samples, scene.evidence.order
    r = scene.residual[i]
    best: tuple[float, int, int, Array] | None = None
    for energy in (r**2, innovations(scene.evidence.whitener.filters[i], r) ** 2):
        a0, b0 = _loudest(np.where(masked, np.nan, energy))
        for _ in range(3):
            inside = np.zeros((scene.n_outputs, N), dtype=bool)
            inside[i] = masked
            inside[i, a0:b0] = True
            # what happened there must not bend the initial state, nor the noise model
            left = scene.evidence.outside(inside)[i]
            own, _ = autoregression(np.where(inside[i], 0.0, left), order=order)
            edges = _edges(np.where(masked, np.nan, _both_ways(own, left)), a0, b0)
            if edges == (a0, b0):
                break
            a0, b0 = edges
        worth = _worth(r, left, masked, a0, b0, order)
        if best is None or worth > best[0]:
            best = worth, a0, b0, left
    assert best is not None
    worth, a0, b0, left = best
    if worth <= 0 or b0 - a0 < _SHORTEST or b0 - a0 > 0.9 * N:
        return None
    inside_level = float(np.sqrt(np.mean(left[a0:b0] ** 2)))
    outside_level = float(np.sqrt(np.mean(np.delete(left, slice(a0, b0)) ** 2)))
    fit = r - left
    # the stretch is brought down to the level of the rest, not to nothing
    fit[a0:b0] += left[a0:b0] * max(1.0 - outside_level / max(inside_level, 1e-300), 0.0)
    fits = np.zeros_like(scene.residual)
    fits[i] = fit
    seen = scene.measured[i]
    hangs = _jumps(seen, a0, b0)
    stuck = _stuck(scene, i, a0, b0) if hangs else None
    gain, dof, measure = worth, 3, "error level"
    text = "the error is larger than anywhere else: a disturbance or a change"
    if stuck is not None and stuck.gain > gain:
        gain, dof, fits = stuck.gain, 4, stuck.fit
    if stuck is not None or (hangs and seen[a0:b0].std() < _STILL * np.delete(seen, slice(a0, b0)).std()):
        measure = "dropout"
        text = "the output does not follow the model at all: the record dropped out or was stuck"
    start, stop = scene.time(a0), scene.time(b0)
    times = inside_level / max(outside_level, 1e-300)
    if measure == "error level" and times < _LOUDER:
        return None  # an error that goes with the motion is a little larger where the motion is
    larger = "more than 1000" if times > 1e3 else f"{times:.0f}" if times > 10 else f"{times:.2g}"
    return Finding(
        "time", f"{start:.4g} ... {stop:.4g} s, {scene.named(i)}", measure,
        Explanation(fits, gain, np.array([inside_level])), dof, _tried(N),
        f"From {start:.4g} to {stop:.4g} s {text} ({larger} times the error elsewhere).",
        {"start": start, "stop": stop, "output": scene.named(i), "span": (a0, b0), "ratio": times},
    )  # fmt: skip


def _both_ways(own: Array, left: Array) -> Array:
    """Return the smaller squared innovations, forward or backward in time.

    So the memory of the filter does not reach over both edges of a stretch.
    """
    forwards, backwards = innovations(own, left), innovations(own, left[::-1])[::-1]
    return np.asarray(np.minimum(forwards**2, backwards**2))


def _tried(n: int) -> int:
    """Stretches that do not overlap much, of all lengths."""
    return 4 * n // _SHORTEST


def _sums(energy: Array) -> tuple[Array, Array]:
    """Running sum of squares and of counts, gaps left out."""
    good = np.isfinite(energy)
    total = np.concatenate([[0.0], np.cumsum(np.where(good, energy, 0.0))])
    return total, np.concatenate([[0.0], np.cumsum(good)])


def _ratio(total: Array, count: Array, a: NDArray[np.int_], b: NDArray[np.int_]) -> Array:
    """Return twice the log-likelihood ratio of a level of its own in a..b.

    It is minus infinity where the level in a..b is lower.
    """
    n, m = count[-1], count[b] - count[a]
    inside = (total[b] - total[a]) / np.maximum(m, 1)
    outside = (total[-1] - total[b] + total[a]) / np.maximum(n - m, 1)
    tiny = 1e-14 * total[-1] / n + 1e-300
    whole = total[-1] / n + tiny
    value = n * np.log(whole) - m * np.log(inside + tiny) - (n - m) * np.log(outside + tiny)
    return np.where((inside > outside) & (m >= _SHORTEST) & (n - m >= _SHORTEST), value, -np.inf)


def _loudest(energy: Array) -> tuple[int, int]:
    """Loudest stretch of all lengths."""
    total, count = _sums(energy)
    n, best, where = energy.size, -np.inf, (0, _SHORTEST)
    length = float(_SHORTEST)
    while length <= 0.9 * n:
        size = round(length)
        a = np.arange(0, n - size + 1, max(1, size // 8))
        a = np.append(a, n - size)
        value = _ratio(total, count, a, a + size)
        k = int(np.argmax(value))
        if value[k] > best:
            best, where = float(value[k]), (int(a[k]), int(a[k]) + size)
        length *= 1.25
    return where


def _edges(energy: Array, a: int, b: int) -> tuple[int, int]:
    """Move one edge, then the other, to where it fits best."""
    total, count = _sums(energy)
    n = energy.size
    for _ in range(3):
        before = a, b
        starts = np.arange(0, max(b - _SHORTEST, 0) + 1)
        a = int(starts[np.argmax(_ratio(total, count, starts, np.full(starts.size, b)))])
        stops = np.arange(min(a + _SHORTEST, n), n + 1)
        b = int(stops[np.argmax(_ratio(total, count, np.full(stops.size, a), stops))])
        if (a, b) == before:
            break
    return a, b


def _worth(r: Array, left: Array, masked: NDArray[np.bool_], a: int, b: int, order: int) -> float:
    """Return twice the log-likelihood gain of a level of its own in a..b.

    Heavy tails are bounded.
    """
    inside = np.zeros(r.size, dtype=bool)
    inside[a:b] = True
    own, _ = autoregression(np.where(inside | masked, 0.0, left), order=order)
    e = innovations(own, np.where(masked, 0.0, left))
    keep = np.arange(r.size) >= order
    keep[b : b + order] = False  # there the filter still remembers the stretch
    if (keep & inside & ~masked).sum() < 4 or (keep & ~inside).sum() < 4 * order:
        return -np.inf
    quiet, loud = e[keep & ~inside & ~masked], e[keep & inside & ~masked]
    # single outliers must not make a stretch: the loud level is taken from its middle too
    level = min(float(np.mean(loud**2)), 3.0 * float(np.median(loud**2)) / 0.455)
    own_levels = quiet.size * np.log(np.mean(quiet**2) + 1e-300) + loud.size * np.log(max(level, 1e-300))
    rest = np.where(masked, 0.0, r)
    whole, _ = autoregression(rest, order=order)
    total = innovations(whole, rest)[keep & ~masked]
    return float(total.size * np.log(np.mean(total**2) + 1e-300) - own_levels)


def _jumps(seen: Array, a: int, b: int) -> bool:
    """Return whether a record jumps where a stretch begins or ends.

    An output that hangs must catch up. A signal that moves fast relative to the sampling jumps anywhere, but
    it does not rest by itself.
    """
    steps = np.abs(np.diff(seen))
    near = np.zeros(steps.size, dtype=bool)
    for edge in (a, b):
        near[max(edge - _NEAR, 0) : edge + _NEAR] = 0 < edge < seen.size
    if not near.any() or near.all():
        return False
    usual = float(np.sqrt(np.mean(steps[~near] ** 2)))
    return usual > _FAST * seen.std() or float(steps[near].max()) > _JUMP * usual


def _stuck(scene: ModelOnRecord, i: int, a: int, b: int) -> Explanation | None:
    """Within a..b the record shows a constant instead of the output."""
    run = np.zeros_like(scene.residual)
    flat = np.zeros_like(scene.residual)
    run[i, a:b] = scene.run[i, a:b]
    flat[i, a:b] = 1.0
    found = scene.evidence.linear([run, flat])
    return found if -1.25 < found.values[0] < -0.75 else None
