"""Nonlinear distortion under a periodic input.

It appears at frequencies that the input does not contain.
"""

from __future__ import annotations

import numpy as np

from ...systems.linear import Array
from .likelihood import Explanation
from .record import Finding, ModelOnRecord

__all__ = ["distortions", "period_of"]

_LEAST = 3  # periods, the first of which settles


def period_of(signals: Array) -> int | None:
    """Return the shortest period of all inputs, in samples.

    The inputs (n_w, N) repeat it at least twice. None if there is no such period.

    Examples
    --------
    >>> period_of(np.sin(2 * np.pi * np.arange(100) / 20)[None])
    20
    """
    n = signals.shape[1]
    moving = [row for row in signals if np.ptp(row) > 0]
    if not moving:
        return None
    for period in range(4, n // _LEAST + 1):
        if all(
            abs(row[period] - row[0]) <= 1e-9 * np.ptp(row)
            and np.abs(row[period:] - row[:-period]).max() <= 1e-9 * np.ptp(row)
            for row in moving
        ):
            return period
    return None


def distortions(scene: ModelOnRecord) -> list[Finding]:
    """Find distortion at harmonics that the input does not contain.

    Even and odd harmonics are separate findings (Pintelon and Schoukens).
    """
    period = period_of(scene.data.inputs)
    if period is None or len(scene.starts) > 1:
        return []
    sent = np.abs(np.fft.rfft(scene.data.inputs[:, -period:], axis=1)) ** 2
    excited = (sent > 1e-12 * sent.max()).any(axis=0)
    lines = np.flatnonzero(excited)
    lines = lines[lines > 0]
    if lines.size == 0:
        return []
    base = int(np.gcd.reduce(lines))
    harmonic = np.arange(excited.size) / base
    found = []
    for name, parity, word in (("even distortion", 0, "even"), ("odd distortion", 1, "odd")):
        wanted = (harmonic % 2 == parity) & ~excited & (harmonic > 0) & (harmonic <= 5 * lines.max() / base)
        if not wanted.any():
            continue
        for i in range(scene.n_outputs):
            found.append(_distortion(scene, i, period, wanted, name, word))
    return found


def _distortion(scene: ModelOnRecord, i: int, period: int, wanted: Array, name: str, word: str) -> Finding:
    r = scene.residual[i]
    whole = r.size // period
    last = r[r.size - (whole - 1) * period :].reshape(whole - 1, period)  # the first period settles
    spectrum = np.fft.rfft(last.mean(axis=0))
    wave = np.fft.irfft(np.where(wanted, spectrum, 0.0), period)
    shift = (r.size - (whole - 1) * period) % period
    fit = np.zeros_like(scene.residual)
    fit[i] = np.tile(wave, whole + 2)[period - shift : period - shift + r.size]
    output = scene.named(i)
    level = 20.0 * np.log10(max(float(wave.std() / max(scene.measured[i].std(), 1e-300)), 1e-12))
    shape = "is asymmetric" if word == "even" else "is the same on both sides"
    return Finding(
        "amplitude",
        f"{word} harmonics at {output}",
        name,
        Explanation(fit, scene.evidence.gain(fit), np.array([level])),
        2 * int(wanted.sum()),
        2,
        f"{output} contains {word} harmonics that the input does not ({level:.0f} dB of its level): a "
        f"nonlinearity that {shape}.",
        {"output": output, "level_dB": level, "kind": "distortion", "parity": word},
    )
