"""Failures over the whole record and in stretches: drift, delay, dropout."""

from __future__ import annotations

from collections.abc import Callable
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ...data.records import coarse_noise, cut_off
from ...inference.whitening import autoregression, innovations
from ...systems.linear import Array
from ..signals import root_mean_square
from .likelihood import Explanation
from .record import Finding, ModelOnRecord

_RESTING = 0.2  # share of a record above which its extreme is where the output rests
_LEVEL = 0.1  # of its spread: what a record may rise above the level at which it is cut off
_SLOW = 6  # half-waves over the record that count as drift
_SHORTEST = 8  # samples of a stretch: less is an outlier
_TOLD = 0.1  # of a constant's energy: if initial states leave less, the record cannot tell it from them
_APART = 0.9  # of the same, from which on the initial state hardly takes part
_STILL = 0.2  # of the usual movement, below which an output hangs
_NEAR = 3  # samples around the edge of a stretch
_JUMP = 4.0  # times the usual step between samples, from which on it is a jump
_FAST = 0.3  # usual step over the spread of a signal, from which on jumps are no sign of anything
_MOST = 3  # stretches of an output
_LOUDER = 2.0  # times the error elsewhere, from which on a stretch is one


# ---------------------------------------------------------------------- drift
def drifts(scene: ModelOnRecord) -> list[Finding]:
    """Offsets and slow drifts of each output, beside what the dynamics can do."""
    found = []
    # polynomials, and half-waves for long records
    t = np.linspace(-1.0, 1.0, scene.n_samples)
    shapes = [("drift", t[None]), ("drift", np.array([t, t * t]))]
    if scene.n_samples >= 400:
        shapes.append(("slow drift", np.cos(np.outer(range(1, _SLOW + 1), 0.5 * np.pi * (t + 1.0)))))
    for i in range(scene.n_outputs):
        name, where = scene.named(i), f"whole record, {scene.named(i)}"
        tried = []
        for measure, rows in shapes:
            explanation = scene.evidence.linear([scene.only(i, row) for row in rows])
            height = float(np.ptp(explanation.values @ rows) * scene.scale[i, 0])
            text = (
                f"{name} drifts from the model by {height:.3g}{scene.unit(i)} over the record: sensor drift, "
                "or a slow disturbance."
            )
            values = {"output": name, "height": height, "kind": "drift"}
            tried.append(Finding("time", where, measure, explanation, len(rows), 3, text, values))
        found += [max(tried, key=lambda finding: finding.net(scene)), _offset(scene, i)]
    return found


def _offset(scene: ModelOnRecord, i: int) -> Finding:
    """A constant difference, judged by what leaving it in costs."""
    evidence = scene.evidence
    raw, constant = evidence.with_offset[i] - evidence.residual[i], evidence.constants[i]
    power = float(constant[i] @ constant[i])
    height = float(raw @ constant[i]) / power if power > _TOLD * scene.n_samples else 0.0
    # all rows are judged beside constant offsets, so that it explains nothing of the residual
    gain = -evidence.gain(-scene.only(i, height * constant[i]))
    explanation = Explanation(np.zeros_like(scene.residual), gain, np.array([height]), height * constant)
    size, name, unit = height * scene.scale[i, 0], scene.named(i), scene.unit(i)
    mean = float(np.mean(scene.measured[i] - scene.run[i])) * scene.scale[i, 0]
    text = f"{name} differs from the model by a constant {size:+.3g}{unit}"
    if power > _APART * scene.n_samples:
        text = f"{text}: a sensor offset, or a constant force."
    else:  # the rest of the constant is in the estimate of the initial state
        text = f"With another initial state, {text} (its mean error is {mean:+.3g}{unit}): "
        text += "a sensor offset, a constant force, or slow dynamics."
    values = {"output": name, "offset": size, "kind": "offset"}
    return Finding("time", f"whole record, {name}", "offset", explanation, 1, 1, text, values)


# ---------------------------------------------------------------------- delay, sign, clipping
def delays(scene: ModelOnRecord) -> list[Finding]:
    """A constant delay of all outputs, or of one."""
    found = []
    # whole and fractional delays in samples, both signs
    grid = np.concatenate([np.arange(-3.0, 3.01, 0.25), np.arange(4.0, 13.0), [16.0, 20.0, 25.0, 32.0]])
    grid = grid[np.abs(grid) > 1e-9]
    every = list(range(scene.n_outputs))
    for chosen in [every, *([i] for i in every if len(every) > 1)]:
        mask = np.isin(every, chosen)[:, None]

        def late(values: Array, mask: NDArray[np.bool_] = mask) -> Array:
            return np.array([mask * (scene.late(v) - scene.run) for v in values])

        explanation = scene.evidence.searched(late, grid)
        samples = float(explanation.values[0])
        seconds, word, cause = samples * scene.dt, "later", "a delay in the signal path"
        if samples < 0:
            word, cause = "earlier", "different clocks"
        who, come = "all outputs", "come"
        if len(chosen) == 1:
            who, come = scene.named(chosen[0]), "comes" if len(every) > 1 else "come"
        text = (
            f"{who} {come} {abs(seconds):.3g} s ({abs(samples):.2f} samples) {word} than in the model: "
            f"{cause}, or other dynamics."
        )
        values = {"delay": seconds, "samples": samples, "output": who, "kind": "delay"}
        found.append(
            Finding("time", f"whole record, {who}", "delay", explanation, 1, grid.size, text, values)
        )
    return found


def signs(scene: ModelOnRecord) -> list[Finding]:
    """An output of the wrong sign or scale."""
    found = []
    for i in range(scene.n_outputs):
        # the initial state was estimated with this output as it is: it may be another one
        columns = [scene.only(i, scene.run[i]), *scene.free(i)]
        explanation, name = scene.evidence.linear(columns), scene.named(i)
        factor = 1.0 + float(explanation.values[0])
        values: dict[str, object] = {"output": name, "factor": factor}
        if -1.3 < factor < -0.7:
            dimension, where, measure = "time", f"whole record, {name}", "sign"
            text = f"{name} has the wrong sign: it is {factor:.3g} times the model output."
        else:
            dimension, where, measure = "frequency", f"all frequencies, {name}", "gain"
            text = f"{name} is {factor:.4g} times the model output at all frequencies: a gain is wrong."
            values |= {"low": 0.0, "high": np.inf}
        values["kind"] = measure
        found.append(Finding(dimension, where, measure, explanation, len(columns), 1, text, values))
    return found


def pinned(scene: ModelOnRecord) -> list[Finding]:
    """Find samples that rest at the top or bottom of the record.

    The range was exceeded there.
    """
    found = []
    for i, y in enumerate(scene.data.outputs):
        still = np.count_nonzero(np.diff(y) == 0.0)
        for limit, side in ((float(y.max()), "above"), (float(y.min()), "below")):
            at = y == limit
            runs = int(np.sum(at[1:] & at[:-1]))
            # how often neighbors are equal elsewhere, as in a coarse or resting record
            usual = max((still - runs + 1) / y.size, 1.0 / y.size)
            if runs < 4 or runs < 3.0 * usual * at.sum() or at.mean() > _RESTING or not cut_off(y, limit):
                continue
            chance = float(stats.binom.logsf(runs - 1, int(at.sum()), min(usual, 1.0)))
            explanation = Explanation(scene.only(i, scene.residual[i] * at), -2.0 * chance, np.array([limit]))
            name, level = scene.named(i), f"{limit:.4g}{scene.unit(i)}"
            text = (
                f"{name} is constant at {level} in {at.sum()} samples: the record is clipped at the end of "
                "its range."
            )
            values = {"output": name, "limit": limit, "side": side, "kind": "pinned"}
            where = f"where {name} reaches {level}"
            found.append(Finding("time", where, "clipping", explanation, 1, 2, text, values))
    return found


_Cut = Callable[[Array, float], Array]
_CUTS: tuple[tuple[str, _Cut], ...] = (
    ("above", lambda y, g: np.minimum(y, g) - y),
    ("below", lambda y, g: np.maximum(y, g) - y),
    ("on both sides", lambda y, g: np.clip(y, -g, g) - y),
)


def clipping(scene: ModelOnRecord) -> list[Finding]:
    """Tops of an output cut off, or bottoms, or both."""
    found = []
    for i, (run, y) in enumerate(zip(scene.run, scene.measured, strict=True)):
        for side, cut in _CUTS:
            reach = np.abs(run) if side == "on both sides" else run
            quantiles = np.linspace(0.5, 0.999, 26) if side != "below" else np.linspace(0.001, 0.5, 26)

            def flattened(values: Array, i: int = i, cut: _Cut = cut) -> Array:
                return np.array([scene.only(i, cut(scene.run[i], g)) for g in values])

            explanation = scene.evidence.searched(flattened, np.quantile(reach, quantiles))
            taken = cut(run, explanation.values[-1])
            ends = [s * _flat(s * y, s * run, s * taken < 0) for s in (-1, 1) if np.any(s * taken < 0)]
            if not ends or not np.isfinite(ends).all():
                continue
            limits = [end * scene.scale[i, 0] for end in ends]
            name, level = scene.named(i), " and ".join(f"{limit:.3g}" for limit in limits) + scene.unit(i)
            text = (
                f"{name} is clipped at {level} ({100 * np.mean(taken != 0):.2g} % of the time): the range of "
                "the sensor is exceeded."
            )
            values = {"output": name, "limit": limits[-1], "side": side, "kind": "clipping"}
            where = f"where {name} reaches {level}"
            found.append(Finding("time", where, "clipping", explanation, 1, 26, text, values))
    return found


def _flat(y: Array, run: Array, at: NDArray[np.bool_]) -> float:
    """Return the level at which a record stays below the simulation.

    NaN if the record follows the simulation.
    """
    level = float(np.median(y[at]))
    beyond = level + _LEVEL + 4.0 * coarse_noise(y)
    above = run[at] - run[at].mean()
    follows = float(above @ y[at]) > 0.5 * float(above @ above) > 0.0
    return np.nan if follows or np.sum(y > beyond) > 0.05 * at.sum() else level


# ---------------------------------------------------------------------- stretches
def stretches(scene: ModelOnRecord) -> list[Finding]:
    """Stretches in which an output is off by more than the rest explains."""
    found = []
    for i in range(scene.n_outputs):
        masked = np.zeros(scene.n_samples, dtype=bool)
        for _ in range(_MOST):
            finding = _stretch(scene, i, masked)
            if finding is None:
                break
            found.append(finding)
            a, b = finding.values["span"]
            masked[max(a - 2, 0) : b + 2] = True
    return found


def _stretch(scene: ModelOnRecord, i: int, masked: NDArray[np.bool_]) -> Finding | None:
    N, r = scene.n_samples, scene.residual[i]
    # loudest stretch of the residual, and of its innovations
    energies = r**2, innovations(scene.evidence.whitener.filters[i], r) ** 2
    found = [_located(scene, i, masked, energy) for energy in energies]
    worth, a, b, left = max(found, key=itemgetter(0))
    if worth <= 0 or b - a < _SHORTEST or b - a > 0.9 * N:
        return None
    inside, outside = (float(root_mean_square(part)) for part in (left[a:b], np.delete(left, slice(a, b))))
    times = inside / max(outside, 1e-300)
    # the stretch is brought down to the level of the rest, not to nothing
    fit = r - left
    fit[a:b] += left[a:b] * max(1.0 - outside / max(inside, 1e-300), 0.0)
    explanation, dof = Explanation(scene.only(i, fit), worth, np.array([inside])), 3
    stuck, hangs = _dropout(scene, i, a, b)
    if stuck is not None and stuck.gain > worth:
        explanation, dof = Explanation(stuck.fit, stuck.gain, explanation.values), 4
    measure, text = "error level", "the error is larger than anywhere else: a disturbance or a change"
    if stuck is not None or hangs:
        measure = "dropout"
        text = "the output does not follow the model at all: the record dropped out or was stuck"
    elif times < _LOUDER:
        return None  # an error that goes with the motion is a little larger where the motion is
    start, stop, name = scene.time(a), scene.time(b), scene.named(i)
    larger = "more than 1000" if times > 1e3 else f"{times:.0f}" if times > 10 else f"{times:.2g}"
    text = f"From {start:.4g} to {stop:.4g} s {text} ({larger} times the error elsewhere)."
    values = {"start": start, "stop": stop, "output": name, "span": (a, b), "ratio": times}
    # stretches that do not overlap much, of all lengths, are chosen from
    where, tried = f"{start:.4g} ... {stop:.4g} s, {name}", 4 * N // _SHORTEST
    return Finding("time", where, measure, explanation, dof, tried, text, values)


def _located(
    scene: ModelOnRecord, i: int, masked: NDArray[np.bool_], energy: Array
) -> tuple[float, int, int, Array]:
    """Return the worth of the loudest stretch, its ends, and a residual.

    Its nuisances are fitted outside of the stretch: what happened there must bend neither the initial state
    nor the noise model.
    """
    order = scene.evidence.order
    a, b = _loudest(np.where(masked, np.nan, energy))
    for _ in range(3):
        inside = np.zeros((scene.n_outputs, scene.n_samples), dtype=bool)
        inside[i] = masked
        inside[i, a:b] = True
        left = scene.evidence.outside(inside)[i]
        own, _ = autoregression(np.where(inside[i], 0.0, left), order=order)
        # the smaller innovations, forward or backward in time: the memory of the filter does not reach over
        # both edges of the stretch
        forwards, backwards = innovations(own, left), innovations(own, left[::-1])[::-1]
        edges = _edges(np.where(masked, np.nan, np.minimum(forwards**2, backwards**2)), a, b)
        if edges == (a, b):
            break
        a, b = edges
    return _likelihood_gain(scene.residual[i], left, masked, a, b, order), a, b, left


def _dropout(scene: ModelOnRecord, i: int, a: int, b: int) -> tuple[Explanation | None, bool]:
    """Return the fit of a constant to an output, and whether it rests."""
    seen = scene.measured[i]
    if not _jumps(seen, a, b):
        return None, False
    flat = np.zeros(scene.n_samples)
    flat[a:b] = 1.0
    stuck = scene.evidence.linear([scene.only(i, scene.run[i] * flat), scene.only(i, flat)])
    rests = bool(seen[a:b].std() < _STILL * np.delete(seen, slice(a, b)).std())
    return stuck if -1.25 < stuck.values[0] < -0.75 else None, rests


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
    # lengths grow by a quarter, starts move by an eighth of the length
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


def _likelihood_gain(r: Array, left: Array, masked: NDArray[np.bool_], a: int, b: int, order: int) -> float:
    """Return twice the log-likelihood gain of a level of its own in a..b.

    Heavy tails are bounded.
    """
    inside = np.zeros(r.size, dtype=bool)
    inside[a:b] = True
    own, _ = autoregression(np.where(inside | masked, 0.0, left), order=order)
    e = innovations(own, np.where(masked, 0.0, left))
    keep = np.arange(r.size) >= order
    keep[b : b + order] = False  # there the filter still remembers the stretch
    quiet, loud = e[keep & ~inside & ~masked], e[keep & inside & ~masked]
    if loud.size < 4 or quiet.size < 4 * order:
        return -np.inf
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
    usual = float(root_mean_square(steps[~near]))
    return usual > _FAST * seen.std() or float(steps[near].max()) > _JUMP * usual
