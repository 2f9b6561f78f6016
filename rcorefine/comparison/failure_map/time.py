"""Failures in time: stretches, drift, delay, clipping, wrong sign."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ...data.range_ends import cut_off
from ...inference.autoregression import autoregression
from ...inference.whitening import innovations
from ...systems.linear import Array
from .likelihood import Explanation
from .record import Finding, Scene

__all__ = ["clipping", "delays", "drifts", "pinned", "signs", "stretches"]

_SHORTEST = 8  # samples of a stretch: less is an outlier
_RESTING = 0.2  # share of a record above which its extreme is where the output rests
_STILL = 0.2  # of the usual movement, below which an output hangs
_NEAR = 3  # samples around the edge of a stretch
_JUMP = 4.0  # times the usual step between samples, from which on it is a jump
_FAST = 0.3  # usual step over the spread of a signal, from which on jumps are no sign of anything
_LOUDER = 2.0  # times the error elsewhere, from which on a stretch is one
_SLOW = 6  # half-waves over the record that count as drift


# ---------------------------------------------------------------------- stretches
def stretches(scene: Scene, most: int = 3) -> list[Finding]:
    """Stretches in which an output is off by more than the rest explains."""
    found = []
    for i in range(scene.n_outputs):
        masked = np.zeros(scene.n_samples, dtype=bool)
        for _ in range(most):
            one = _stretch(scene, i, masked)
            if one is None:
                break
            found.append(one)
            a, b = one.values["span"]
            masked[max(a - 2, 0) : b + 2] = True
    return found


def _stretch(scene: Scene, i: int, masked: NDArray[np.bool_]) -> Finding | None:
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
        text = "the output does not follow the model at all: the record dropped out or hung"
    start, stop = scene.time(a0), scene.time(b0)
    times = inside_level / max(outside_level, 1e-300)
    if measure == "error level" and times < _LOUDER:
        return None  # an error that goes with the motion is a little larger where the motion is
    return Finding(
        "time",
        f"{start:.4g} ... {stop:.4g} s, {scene.named(i)}",
        measure,
        Explanation(fits, gain, np.array([inside_level])),
        dof,
        _tried(N),
        f"From {start:.4g} to {stop:.4g} s {text} ({times:.2g} times the error elsewhere).",
        {"start": start, "stop": stop, "output": scene.named(i), "span": (a0, b0), "ratio": times},
    )


def _both_ways(own: Array, left: Array) -> Array:
    """Squared innovations, forwards or backwards in time: the memory of neither reaches over both edges."""
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
    """Twice the log-likelihood ratio of a level of its own within a..b; minus where it is lower."""
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
    """Twice the log-likelihood that a level of its own within a..b adds, heavy tails bounded."""
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
    """Whether a record jumps where a stretch begins or ends: one that hangs must catch up.

    What moves fast against the sampling jumps anywhere, but does not rest by itself either.
    """
    steps = np.abs(np.diff(seen))
    near = np.zeros(steps.size, dtype=bool)
    for edge in (a, b):
        near[max(edge - _NEAR, 0) : edge + _NEAR] = 0 < edge < seen.size
    if not near.any() or near.all():
        return False
    usual = float(np.sqrt(np.mean(steps[~near] ** 2)))
    return usual > _FAST * seen.std() or float(steps[near].max()) > _JUMP * usual


def _stuck(scene: Scene, i: int, a: int, b: int) -> Explanation | None:
    """Within a..b the record shows a constant instead of the output."""
    run = np.zeros_like(scene.residual)
    flat = np.zeros_like(scene.residual)
    run[i, a:b] = scene.run[i, a:b]
    flat[i, a:b] = 1.0
    found = scene.evidence.linear([run, flat])
    return found if -1.25 < found.values[0] < -0.75 else None


# ---------------------------------------------------------------------- drift
def drifts(scene: Scene) -> list[Finding]:
    """Offsets and slow drifts of each output, beside what the dynamics can do."""
    found = []
    t = np.linspace(-1.0, 1.0, scene.n_samples)
    for i in range(scene.n_outputs):
        best: Finding | None = None
        shapes: list[tuple[str, list[Array]]] = [("drift", [t]), ("drift", [t, t * t])]
        if scene.n_samples >= 400:
            phase = 0.5 * np.pi * (t + 1.0)
            shapes.append(("slow drift", [np.cos(k * phase) for k in range(1, _SLOW + 1)]))
        for name, rows in shapes:
            columns = []
            for row in rows:
                column = np.zeros_like(scene.residual)
                column[i] = row
                columns.append(column)
            one = scene.evidence.linear(columns)
            height = float(np.ptp(np.tensordot(one.values, np.array(rows), 1)) * scene.scale[i, 0])
            finding = Finding(
                "time",
                f"whole record, {scene.named(i)}",
                name,
                one,
                len(rows),
                3,
                f"{scene.named(i)} drifts away from the model by {height:.3g}"
                f"{_unit(scene, i)} over the record: a sensor that creeps, or a slow disturbance.",
                {"output": scene.named(i), "height": height, "kind": "drift"},
            )
            if best is None or _net(finding, scene) > _net(best, scene):
                best = finding
        assert best is not None
        found += [best, _offset(scene, i)]
    return found


def _offset(scene: Scene, i: int) -> Finding:
    """A constant difference, judged by what leaving it in costs."""
    evidence = scene.evidence
    raw, constant = evidence.with_offset[i] - evidence.residual[i], evidence.constants[i]
    power = float(constant[i] @ constant[i])
    height = float(raw @ constant[i]) / power if power > 1e-6 * scene.n_samples else 0.0
    kept = evidence.residual.copy()
    kept[i] += height * constant[i]
    gain = -evidence.gain(evidence.residual - kept)
    nothing = np.zeros_like(scene.residual)  # all rows are judged beside constant offsets
    size = height * scene.scale[i, 0]
    return Finding(
        "time",
        f"whole record, {scene.named(i)}",
        "offset",
        Explanation(nothing, gain, np.array([height]), height * constant),
        1,
        1,
        f"{scene.named(i)} lies {size:+.3g}{_unit(scene, i)} off the model throughout: zero of the sensor, "
        "or a constant force.",
        {"output": scene.named(i), "offset": size, "kind": "offset"},
    )


def _net(finding: Finding, scene: Scene) -> float:
    return finding.explanation.gain - finding.dof * float(np.log(scene.n_samples))


def _unit(scene: Scene, i: int) -> str:
    unit = scene.data.output_units[i]
    return f" {unit}" if unit else ""


# ---------------------------------------------------------------------- delay, sign, clipping
def delays(scene: Scene) -> list[Finding]:
    """A constant delay of all outputs, or of one."""
    found = []
    grid = np.concatenate([np.arange(-3.0, 3.01, 0.25), np.arange(4.0, 13.0), [16.0, 20.0, 25.0, 32.0]])
    grid = grid[np.abs(grid) > 1e-9]
    rows = [list(range(scene.n_outputs))]
    if scene.n_outputs > 1:
        rows += [[i] for i in range(scene.n_outputs)]
    for chosen in rows:

        def late(delay: float, chosen: list[int] = chosen) -> Array:
            shape = np.zeros_like(scene.run)
            shape[chosen] = (scene.late(delay) - scene.run)[chosen]
            return shape

        one = scene.evidence.searched(late, grid)
        samples = float(one.values[0])
        seconds = samples * scene.dt
        who = "all outputs" if len(chosen) == scene.n_outputs else scene.named(chosen[0])
        word = "later" if samples > 0 else "earlier"
        found.append(
            Finding(
                "time",
                f"whole record, {who}",
                "delay",
                one,
                1,
                grid.size,
                f"{who} come{'s' if len(chosen) == 1 and scene.n_outputs > 1 else ''} {abs(seconds):.3g} s "
                f"({abs(samples):.2f} samples) {word} than in the model: a delay in the signal path.",
                {"delay": seconds, "samples": samples, "output": who, "kind": "delay"},
            )
        )
    return found


def signs(scene: Scene) -> list[Finding]:
    """An output of the wrong sign or scale."""
    found = []
    for i in range(scene.n_outputs):
        column = np.zeros_like(scene.run)
        column[i] = scene.run[i]
        # the initial state was estimated with this output as it is: it may be another one
        starts = scene.free(i)
        one = scene.evidence.linear([column, *starts])
        factor = 1.0 + float(one.values[0])
        name = scene.named(i)
        if -1.3 < factor < -0.7:
            found.append(
                Finding(
                    "time",
                    f"whole record, {name}",
                    "sign",
                    one,
                    1 + len(starts),
                    1,
                    f"{name} has the wrong sign: it is {factor:.3g} times the model's throughout.",
                    {"output": name, "factor": factor, "kind": "sign"},
                )
            )
        else:
            found.append(
                Finding(
                    "frequency",
                    f"all frequencies, {name}",
                    "gain",
                    one,
                    1 + len(starts),
                    1,
                    f"{name} is {factor:.4g} times the model's at all frequencies: a gain is wrong.",
                    {"output": name, "factor": factor, "kind": "gain", "low": 0.0, "high": np.inf},
                )
            )
    return found


def pinned(scene: Scene) -> list[Finding]:
    """Samples of the record that stand still at its very top or bottom: the range was exceeded."""
    found = []
    for i, y in enumerate(scene.data.outputs):
        still = np.flatnonzero(np.diff(y) == 0.0)
        for limit, side in ((float(y.max()), "above"), (float(y.min()), "below")):
            at = y == limit
            runs = int(np.sum(at[1:] & at[:-1]))
            # how often neighbors are equal elsewhere, as in a coarse or resting record
            usual = max((still.size - runs + 1) / y.size, 1.0 / y.size)
            if runs < 4 or runs < 3.0 * usual * at.sum() or at.mean() > _RESTING or not cut_off(y, limit):
                continue
            chance = float(stats.binom.logsf(runs - 1, int(at.sum()), min(usual, 1.0)))
            fit = np.zeros_like(scene.residual)
            fit[i, at] = scene.residual[i, at]
            name, unit = scene.named(i), _unit(scene, i)
            found.append(
                Finding(
                    "time",
                    f"where {name} reaches {limit:.4g}{unit}",
                    "clipping",
                    Explanation(fit, -2.0 * chance, np.array([limit])),
                    1,
                    2,
                    f"{name} stands still at {limit:.4g}{unit} in {at.sum()} samples: the end of its "
                    "range, so the record itself is cut off.",
                    {"output": name, "limit": limit, "side": side, "kind": "pinned"},
                )
            )
    return found


def clipping(scene: Scene) -> list[Finding]:
    """Tops of an output cut off, or bottoms, or both."""
    found = []
    for i in range(scene.n_outputs):
        run = scene.run[i]
        shapes: list[tuple[str, Callable[[Array, float], Array]]] = [
            ("above", lambda y, g: -np.maximum(y - g, 0.0)),
            ("below", lambda y, g: np.maximum(g - y, 0.0)),
            ("on both sides of", lambda y, g: np.clip(y, -g, g) - y),
        ]
        for side, cut in shapes:
            reach = np.abs(run) if side.startswith("on") else run
            quantiles = np.linspace(0.5, 0.999, 26) if side != "below" else np.linspace(0.001, 0.5, 26)
            grid = np.quantile(reach, quantiles)

            def shape(g: float, cut: Callable[[Array, float], Array] = cut, i: int = i) -> Array:
                column = np.zeros_like(scene.run)
                column[i] = cut(scene.run[i], g)
                return column

            one = scene.evidence.searched(shape, grid)
            limit = float(one.values[-1]) * scene.scale[i, 0]
            name, unit = scene.named(i), _unit(scene, i)
            text = f"+-{limit:.3g}" if side.startswith("on") else f"{limit:.3g}"
            held = float(np.mean(np.any(one.fit != 0, axis=0) & (cut(run, float(one.values[-1])) != 0)))
            found.append(
                Finding(
                    "time",
                    f"where {name} reaches {text}{unit}",
                    "clipping",
                    one,
                    1,
                    26,
                    f"{name} is cut off {'at' if side != 'below' else 'below'} {text}{unit} "
                    f"({100 * held:.2g} % of the time): the sensor or its range is exceeded.",
                    {"output": name, "limit": limit, "side": side, "kind": "clipping"},
                )
            )
    return found
