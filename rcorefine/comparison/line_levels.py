"""Noise and nonlinear distortion under a periodic input, line by line.

Distortion appears at lines that the input does not contain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..data.measurement import Measurement
from ..results import Row
from ..systems.linear import Array

_LEAST = 3  # periods: the first one settles, and noise takes two to be seen
_SENT = 1e-12  # of the strongest line's power: less was not sent
_REACH = 5  # times the highest line sent, up to which distortion is looked for


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


def excited_lines(inputs: Array) -> tuple[int, NDArray[np.bool_], int] | None:
    """Return period, excited spectral lines and base line of the inputs.

    The period is in samples, the lines are those of one period, the base is the number of the line of which
    all are harmonics. None if no input is periodic.
    """
    period = period_of(inputs)
    if period is None:
        return None
    sent = np.abs(np.fft.rfft(inputs[:, -period:], axis=1)) ** 2
    excited = (sent > _SENT * sent.max()).any(axis=0)
    excited[0] = False
    return (period, excited, int(np.gcd.reduce(np.flatnonzero(excited)))) if excited.any() else None


@dataclass(frozen=True, slots=True, eq=False)
class LineLevels(Row):
    """Spectral lines of a record with a periodic input.

    The method is that of Pintelon and Schoukens, System Identification, ch. 4.

    Attributes
    ----------
    omega : ndarray, shape (n_omega,)
        Frequencies in rad/s.
    kind : ndarray of str, shape (n_omega,)
        "sent" (the input holds the line), "odd" or "even" harmonics that it does not hold.
    amplitude : ndarray, shape (n_y, n_omega)
        Peak of each output's line without its noise: at lines not sent the distortion.
    noise : ndarray, shape (n_y, n_omega)
        Standard deviation of the line, from how it scatters from period to period.
    n_periods : int
        Periods that count; the first one of the record settles.
    """

    omega: Array
    kind: NDArray[np.str_]
    amplitude: Array
    noise: Array
    n_periods: int

    def level(self, kind: str) -> float:
        """Return the RMS of some lines relative to that of the sent lines, in dB.

        It is taken over all outputs. The `kind` of the noise is "noise". Each output is scaled by its own
        size. -inf if there are no such lines.
        """
        sent = np.sqrt(np.mean(self.amplitude[:, self.kind == "sent"] ** 2, axis=1))
        rows = self.noise if kind == "noise" else self.amplitude[:, self.kind == kind]
        if not rows.size or not sent.all():
            return float("-inf")
        ratio = np.sqrt(np.mean(np.mean(rows**2, axis=1) / sent**2))
        return float(20.0 * np.log10(ratio)) if ratio > 0 else float("-inf")

    def sentence(self) -> str:
        """Levels in words."""
        parts = [f"noise {self.level('noise'):.0f} dB"]
        for kind in ("even", "odd"):
            if (self.kind == kind).any():
                parts.append(f"{kind} distortion {self.level(kind):.0f} dB")
        hidden = "" if len(parts) == 3 else "; distortion is visible only at lines that the input leaves out"
        return (
            f"Rms at the frequency lines of {self.n_periods} periods, relative to the excited lines: "
            f"{', '.join(parts)}{hidden} (line_levels)"
        )


def line_levels(data: Measurement) -> LineLevels | None:
    """Return noise and distortion at each line of a record.

    None if no input is periodic.

    Examples
    --------
    >>> t = np.arange(400) * 2 * np.pi / 100
    >>> found = line_levels(rco.Measurement(np.cos(t), np.cos(t) + 0.1 * np.cos(t) ** 2, dt=0.01))
    >>> print(found.kind[:3], found.amplitude[0, :3].round(6))
    ['sent' 'even' 'odd'] [1.   0.05 0.  ]
    """
    found = excited_lines(data.inputs)
    if found is None:
        return None
    period, excited, base = found
    count = data.n_samples // period - 1
    last = np.s_[:, data.n_samples - count * period :]
    kept = np.arange(base, min(_REACH * np.flatnonzero(excited)[-1], (period - 1) // 2) + 1, base)
    whole = data.outputs[last].reshape(data.n_outputs, count, period)
    spectra = 2.0 / period * np.fft.rfft(whole, axis=2)[:, :, kept]
    noise = spectra.std(axis=1, ddof=1) / np.sqrt(count)
    amplitude = np.sqrt(np.maximum(np.abs(spectra.mean(axis=1)) ** 2 - noise**2, 0.0))
    kind = np.where(excited[kept], "sent", np.where(kept // base % 2 == 1, "odd", "even"))
    return LineLevels(2 * np.pi * kept / (period * data.dt), kind, amplitude, noise, count)
