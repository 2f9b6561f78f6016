"""Failures over the whole record: drift, delay, clipping, wrong sign."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ...data.range_ends import coarse_noise, cut_off
from ...systems.linear import Array
from .likelihood import Explanation
from .record import Finding, ModelOnRecord

__all__ = ["clipping", "delays", "drifts", "pinned", "signs"]

_RESTING = 0.2  # share of a record above which its extreme is where the output rests
_LEVEL = 0.1  # of its spread: what a record may rise above the level at which it is cut off
_SLOW = 6  # half-waves over the record that count as drift


# ---------------------------------------------------------------------- drift
def drifts(scene: ModelOnRecord) -> list[Finding]:
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
                f"{scene.named(i)} drifts from the model by {height:.3g}{_unit(scene, i)} over the record: "
                "sensor drift, or a slow disturbance.",
                {"output": scene.named(i), "height": height, "kind": "drift"},
            )
            if best is None or finding.net(scene) > best.net(scene):
                best = finding
        assert best is not None
        found += [best, _offset(scene, i)]
    return found


def _offset(scene: ModelOnRecord, i: int) -> Finding:
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
        f"{scene.named(i)} differs from the model by a constant {size:+.3g}{_unit(scene, i)}: a sensor "
        "offset, or a constant force.",
        {"output": scene.named(i), "offset": size, "kind": "offset"},
    )


def _unit(scene: ModelOnRecord, i: int) -> str:
    unit = scene.data.output_units[i]
    return f" {unit}" if unit else ""


# ---------------------------------------------------------------------- delay, sign, clipping
def delays(scene: ModelOnRecord) -> list[Finding]:
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


def signs(scene: ModelOnRecord) -> list[Finding]:
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
                    f"{name} has the wrong sign: it is {factor:.3g} times the model output.",
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
                    f"{name} is {factor:.4g} times the model output at all frequencies: a gain is wrong.",
                    {"output": name, "factor": factor, "kind": "gain", "low": 0.0, "high": np.inf},
                )
            )
    return found


def pinned(scene: ModelOnRecord) -> list[Finding]:
    """Find samples that rest at the top or bottom of the record.

    The range was exceeded there.
    """
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
                    f"{name} is constant at {limit:.4g}{unit} in {at.sum()} samples: the record is clipped "
                    "at the end of its range.",
                    {"output": name, "limit": limit, "side": side, "kind": "pinned"},
                )
            )
    return found


def clipping(scene: ModelOnRecord) -> list[Finding]:
    """Tops of an output cut off, or bottoms, or both."""
    found = []
    shapes: tuple[tuple[str, Callable[[Array, float], Array]], ...] = (
        ("above", lambda y, g: -np.maximum(y - g, 0.0)),
        ("below", lambda y, g: np.maximum(g - y, 0.0)),
        ("on both sides", lambda y, g: np.clip(y, -g, g) - y),
    )
    for i, (run, y) in enumerate(zip(scene.run, scene.measured, strict=True)):
        for side, cut in shapes:
            reach = np.abs(run) if side == "on both sides" else run
            quantiles = np.linspace(0.5, 0.999, 26) if side != "below" else np.linspace(0.001, 0.5, 26)

            def shape(g: float, cut: Callable[[Array, float], Array] = cut, i: int = i) -> Array:
                column = np.zeros_like(scene.run)
                column[i] = cut(scene.run[i], g)
                return column

            one = scene.evidence.searched(shape, np.quantile(reach, quantiles))
            taken = cut(run, float(one.values[-1]))
            ends = [s * _flat(s * y, s * run, s * taken < 0) for s in (-1, 1) if np.any(s * taken < 0)]
            if not ends or not np.isfinite(ends).all():
                continue
            limits = [end * scene.scale[i, 0] for end in ends]
            name, text = scene.named(i), " and ".join(f"{one:.3g}" for one in limits) + _unit(scene, i)
            found.append(
                Finding(
                    "time", f"where {name} reaches {text}", "clipping", one, 1, 26,
                    f"{name} is clipped at {text} ({100 * np.mean(taken != 0):.2g} % of the time): the "
                    "range of the sensor is exceeded.",
                    {"output": name, "limit": limits[-1], "side": side, "kind": "clipping"},
                )
            )  # fmt: skip
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
