"""Failures in frequency bands.

An output differs from the model by a factor there.
"""

from __future__ import annotations

import numpy as np

from ...systems.linear import Array
from ...words import frequency_text, phase_text
from .record import Finding, ModelOnRecord

__all__ = ["band_columns", "bands"]

_BANDS = 20
_HALF = 0.4  # share of the largest deviation that still belongs to the band


def bands(scene: ModelOnRecord) -> list[Finding]:
    """Bands in which an output is a smooth factor (complex) off the model."""
    found = []
    centers = _centers(scene)
    if centers.size < 4:
        return []
    for i in range(scene.n_outputs):
        columns = band_columns(scene, i, centers)
        found.append(_band(scene, i, centers, columns))
    return found


def _centers(scene: ModelOnRecord) -> Array:
    top = np.pi / scene.dt
    low = max(2.0 * np.pi * 4.0 / (scene.n_samples * scene.dt), 1e-3 * top)
    return np.geomspace(low, top, _BANDS)


def band_columns(scene: ModelOnRecord, i: int, centers: Array) -> list[Array]:
    """In-phase and quadrature part of an output's run in overlapping bands."""
    n = scene.n_samples
    run = scene.run[i] - scene.run[i].mean()
    size = 1 << int(n + n // 8).bit_length()
    spectrum = np.fft.rfft(run, size)
    omega = 2.0 * np.pi * np.fft.rfftfreq(size, scene.dt)
    position = np.interp(
        np.log(np.maximum(omega, 1e-3 * centers[0])), np.log(centers), np.arange(centers.size)
    )
    columns = []
    for k in range(centers.size):
        hat = np.maximum(1.0 - np.abs(position - k), 0.0)
        for factor in (1.0, -1j):
            column = np.zeros_like(scene.run)
            column[i] = np.fft.irfft(spectrum * hat * factor, size)[:n]
            columns.append(column)
    return columns


def _band(scene: ModelOnRecord, i: int, centers: Array, columns: list[Array]) -> Finding:
    """Contiguous band that explains most for its width."""
    evidence = scene.evidence
    white, target = evidence.white(columns)
    gram, along = white.T @ white, white.T @ target
    total, n = float(target @ target), target.size
    ridge = 1e-9 * np.trace(gram) / max(gram.shape[0], 1) + 1e-300
    best, where = -np.inf, (0, 1)
    for a in range(centers.size):
        for b in range(a + 1, centers.size + 1):
            part = slice(2 * a, 2 * b)
            solved = np.linalg.solve(gram[part, part] + ridge * np.eye(2 * (b - a)), along[part])
            taken = float(along[part] @ solved)
            worth = -n * np.log(max(1.0 - taken / total, 1e-12)) - 2 * (b - a) * np.log(scene.n_samples)
            if worth > best:
                best, where = worth, (a, b)
    a, b = where
    one = evidence.linear(columns[2 * a : 2 * b])
    gains = 1.0 + one.values[0::2] + 1j * one.values[1::2]
    off = np.abs(gains - 1.0)
    part = slice(2 * a, 2 * b)
    spread = np.sqrt(np.abs(np.diag(np.linalg.inv(gram[part, part] + ridge * np.eye(2 * (b - a))))))
    # most: by the factor itself, where it is sure, not by the energy that happens to be there
    sure = off - 2.0 * np.hypot(spread[0::2], spread[1::2])
    strongest = int(np.argmax(sure))
    factor = complex(gains[strongest])
    first, last = strongest, strongest
    while first > 0 and sure[first - 1] > _HALF * off[strongest]:
        first -= 1
    while last + 1 < off.size and sure[last + 1] > _HALF * off[strongest]:
        last += 1
    low = float(np.sqrt(centers[a + first] * centers[max(a + first - 1, 0)])) if a + first else 0.0
    high = float(np.sqrt(centers[a + last] * centers[min(a + last + 1, centers.size - 1)]))
    name, center, phase = scene.named(i), float(centers[a + strongest]), float(np.angle(factor))
    ends = frequency_text(low), frequency_text(high)
    return Finding(
        "frequency", f"{ends[0]} ... {ends[1]}, {name}", "band", one, 2 * (b - a), centers.size,
        f"{name} differs from the model between {ends[0]} and {ends[1]}: most near {frequency_text(center)}, "
        f"where it is {abs(factor):.3g} times as large and {phase_text(phase)} the model.",
        {"low": low, "high": high, "output": name, "center": center, "factor": abs(factor), "phase": phase,
         "kind": "band"},
    )  # fmt: skip
