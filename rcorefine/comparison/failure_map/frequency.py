"""Failures in frequency: modes, corners and bands; levels of lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from ...data.measurement import Measurement
from ...exceptions import RCOError, unheard
from ...results import Row, frequency_text, phase_text
from ...systems.conversion import d2c
from ...systems.linear import Array, LinearModel
from ..signals import root_mean_square
from .likelihood import Explanation, least_squares
from .record import Finding, ModelOnRecord

_MOST_TOGETHER = 8
_BANDS = 20
_HALF = 0.4  # share of the largest deviation that still belongs to the band


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """A pole, or pair of poles, and how it reaches the outputs.

    Attributes
    ----------
    number : int
        From 1, by frequency.
    pole : complex
        Pole in 1/s, with a positive imaginary part where it is one of a pair.
    residue : ndarray of shape (n_y, n_w)
        Residues of the pole.
    shape : ndarray of shape (n_y,)
        Outputs in its free motion.
    """

    number: int
    pole: complex
    residue: NDArray[np.complex128]
    shape: NDArray[np.complex128]

    @property
    def paired(self) -> bool:
        """Return whether the mode is one of a complex pair."""
        return self.pole.imag > 0

    @property
    def omega(self) -> float:
        """Natural frequency in rad/s, or the corner."""
        return abs(self.pole)

    @property
    def zeta(self) -> float:
        """Damping ratio."""
        return -self.pole.real / abs(self.pole)


def find_modes(model: LinearModel) -> list[Mode]:
    """Stable modes of a continuous model that lie apart from the others."""
    if model.n_states == 0:
        return []
    # modes: eigenvalues, with right and left eigenvectors
    values, right = np.linalg.eig(model.A)
    # a double pole has no modes of its own; those that lie apart still have
    left = np.linalg.pinv(right) if np.linalg.cond(right) > 1e10 else np.linalg.inv(right)
    found: list[Mode] = []
    for i in np.argsort(np.abs(values)):
        # stable modes only, one of each conjugate pair, no integrators
        pole = complex(values[i])
        if pole.imag < 0 or pole.real >= -1e-9 * abs(pole) or abs(pole) < 1e-9 * np.abs(values).max():
            continue
        others = np.delete(values, i)
        if others.size and np.min(np.abs(others - pole)) < 1e-6 * abs(pole):
            continue
        # residue matrix of the mode: C v w' B
        residue = np.outer(model.C @ right[:, i], left[i] @ model.B)
        found.append(Mode(len(found) + 1, pole, residue, model.C @ right[:, i]))
    return found


class Shift:
    """Change of the outputs if a mode had another pole."""

    def __init__(self, scene: ModelOnRecord, mode: Mode) -> None:
        self.scene, self.mode = scene, mode
        # contribution of the mode to the simulated output
        self.before = np.zeros_like(scene.run) if self._fast(mode.pole) else self._motion(mode.pole)
        self.seen = bool(np.any(np.abs(self.before) > 1e-9))
        #: number of unknowns: place of the pole, and the mode's size
        self.size = 3 if mode.paired else 2

    def _fast(self, pole: complex) -> bool:
        return bool(abs(pole) * self.scene.dt > np.pi)

    def _motion(self, pole: complex) -> Array:
        """Outputs through the mode with its numerator as it is and this pole."""
        scene, mode = self.scene, self.mode
        if mode.paired:
            # 2 Re(R) s - 2 Re(R conj(p)) over (s - pole) (s - conj(pole))
            over = 2.0 * mode.residue.real * pole - 2.0 * (mode.residue * np.conj(mode.pole)).real
            residue = 2.0 * over / (pole - np.conj(pole))
        else:
            residue = mode.residue
        # discretized with the hold of the record, then a recursive filter of first order
        move = np.exp(pole * scene.dt)
        held = np.expm1(pole * scene.dt) / pole
        end = (held - scene.dt) / (pole * scene.dt) if scene.hold == "foh" else 0.0
        out = np.zeros_like(scene.run)
        for j, w in enumerate(scene.data.inputs):
            if np.any(residue[:, j]) and np.any(w):
                parts = np.split(w, scene.starts[1:])  # begun anew with each free run
                motion = np.concatenate([lfilter([end, held - end], [1.0, -move], part) for part in parts])
                out += np.outer(residue[:, j].real, motion.real) - np.outer(residue[:, j].imag, motion.imag)
        return np.asarray(out / scene.scale)

    def pole(self, point: Array) -> complex:
        """Return the pole after relative changes.

        The changes are of log frequency and log damping ratio, or of the log corner frequency.
        """
        if not self.mode.paired:
            return complex(self.mode.pole.real * np.exp(np.clip(point[0], -5, 5)))
        # relative changes, limited to a factor of 4.5 in frequency
        omega = self.mode.omega * np.exp(np.clip(point[0], -1.5, 1.5))
        zeta = min(self.mode.zeta * float(np.exp(np.clip(point[1], -6, 6))), 0.999)
        return complex(-zeta * omega, omega * np.sqrt(1.0 - zeta**2))

    def __call__(self, point: Array) -> Array:
        """Change of the outputs at a point."""
        pole = self.pole(point)
        if self._fast(pole):
            return np.zeros_like(self.before)
        # new contribution minus the old one
        factor = np.exp(np.clip(point[-1], -3, 3))
        change = factor * self._motion(pole) - self.before
        return np.asarray(change + self._free(pole, change))

    def _free(self, pole: complex, change: Array) -> Array:
        """Free motion of the moved mode that serves the residual best."""
        scene = self.scene
        if not scene.begins_moving or len(scene.starts) > 1:
            return np.zeros_like(change)
        # initial condition of the moved mode by least squares, where it was estimated
        motion = np.exp(pole * scene.dt * np.arange(scene.n_samples))
        waves = (self.mode.shape[:, None] * motion[None]) / scene.scale
        columns = np.array([waves.real, waves.imag] if self.mode.paired else [waves.real])
        *left, target = scene.evidence.without_nuisance(np.array([*columns, scene.residual - change]))
        best = least_squares(np.reshape(left, (len(columns), -1)).T, target.ravel())
        return np.asarray(np.tensordot(best, columns, 1))


def modes(scene: ModelOnRecord) -> list[Finding]:
    """Each mode that the inputs reach moved on its own, and several at once."""
    model: LinearModel | None = scene.model
    if not scene.model.is_continuous:
        # discrete models: modes of the continuous equivalent
        try:
            with unheard():
                model = LinearModel.from_statespace(d2c(scene.model.with_arrays(dt=scene.dt).to_statespace()))
        except (RCOError, np.linalg.LinAlgError):
            model = None
    if model is None or not np.any(scene.data.inputs):
        return []
    # move each mode alone, then the best ones together
    shifts = [shift for shift in (Shift(scene, mode) for mode in find_modes(model)) if shift.seen]
    single = [(shift, _search_shift(scene, shift)) for shift in shifts]
    found = [
        _finding(scene, [shift], [explanation.values], explanation, len(shifts))
        for shift, explanation in single
    ]
    used = [pair for pair in sorted(single, key=lambda pair: -pair[1].gain) if pair[1].gain > 0][
        :_MOST_TOGETHER
    ]
    return found + (_together(scene, used) if len(used) > 1 else [])


def _search_shift(scene: ModelOnRecord, shift: Shift) -> Explanation:
    evidence = scene.evidence
    known = scene.known.get(shift.mode.number)
    if known is not None:
        places = [known, np.zeros(shift.size)]
    elif shift.mode.paired:
        # grid over frequency and damping, then Gauss-Newton
        steps = np.array([0.004, 0.01, 0.02, 0.035, 0.06, 0.1, 0.18, 0.3])
        places = [
            np.array([df, dz, 0.0])
            for df in np.concatenate([-steps[::-1], [0.0], steps])
            for dz in np.log([0.4, 1.0, 2.5])
        ]
    else:
        places = [np.array([dp, 0.0]) for dp in np.log([0.2, 0.35, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2, 3, 5])]
    costs = [evidence.misfits(shift(p)[None])[0] for p in places]
    best = evidence.descended(shift, places[int(np.argmin(costs))])
    scene.known[shift.mode.number] = best.values
    return best


def _together(scene: ModelOnRecord, chosen: Sequence[tuple[Shift, Explanation]]) -> list[Finding]:
    used = [shift for shift, _ in chosen]
    cuts = np.cumsum([shift.size for shift in used])[:-1]

    def shape(point: Array) -> Array:
        parts = np.split(point, cuts)
        return np.asarray(np.sum([shift(part) for shift, part in zip(used, parts, strict=True)], axis=0))

    # start from the single fits, or from no change
    point = np.concatenate([explanation.values for _, explanation in chosen])
    starts = [point, np.zeros(point.size)]
    costs = scene.evidence.misfits(np.array([shape(start) for start in starts]))
    best = scene.evidence.descended(shape, starts[int(np.argmin(costs))], evaluations=15)
    return [_finding(scene, used, np.split(best.values, cuts), best, 1)]


def _finding(
    scene: ModelOnRecord, used: Sequence[Shift], points: Sequence[Array], explanation: Explanation, tried: int
) -> Finding:
    shapes = np.array([shift(point) for shift, point in zip(used, points, strict=True)])
    # sort the modes by the energy that their shift explains
    energy = np.sum(scene.evidence.without_nuisance(shapes) ** 2, axis=(1, 2))
    texts, rows = [], []
    for k in np.argsort(energy)[::-1]:
        mode, new = used[k].mode, used[k].pole(points[k])
        row = {"mode": mode.number, "omega_model": mode.omega, "zeta_model": mode.zeta}
        row |= {"omega": abs(new), "zeta": -new.real / abs(new), "size": float(np.exp(points[k][-1]))}
        rows.append(row)
        texts.append(_sentence(row, mode.paired))
    lead, paired = rows[0], used[int(np.argmax(energy))].mode.paired
    # region of the finding: both frequencies and three half-widths
    ends = sorted([lead["omega"], lead["omega_model"]])
    half = 3.0 * max(lead["zeta"] * lead["omega"], ends[1] - ends[0])
    low, high = max(ends[0] - half, 0.0), ends[1] + half
    if not paired:
        low, high = 0.2 * lead["omega"], 5.0 * lead["omega"]
    name, more = "mode" if paired else "corner", len(rows) - 1
    where = f"{name} {lead['mode']} at {frequency_text(lead['omega'])}" + (
        f" and {more} more" if more else ""
    )
    text = "; ".join(texts[:3]) + (f"; {len(texts) - 3} more" if len(texts) > 3 else "") + "."
    values = {"low": low, "high": high, "modes": rows, "kind": "modes" if more else "mode"}
    dof = sum(shift.size for shift in used)
    return Finding("frequency", where, "modes" if more else name, explanation, dof, 25 * tried, text, values)


def _sentence(row: dict[str, float], paired: bool) -> str:
    share = 100.0 * (row["omega"] / row["omega_model"] - 1.0)
    more = f"{share:+.2g}" if abs(share) < 100 else f"{share:+.0f}"
    there, here = frequency_text(row["omega_model"]), frequency_text(row["omega"])
    what = f"Mode {row['mode']}" if paired else "The corner"
    damping = f"its damping ratio is {row['zeta']:.2g} instead of {row['zeta_model']:.2g}, "
    return (
        f"{what} at {there} is at {here} in the record ({more} %), {damping if paired else ''}its amplitude "
        f"is {row['size']:.3g} times that of the model"
    )


def bands(scene: ModelOnRecord) -> list[Finding]:
    """Bands in which an output is a smooth factor (complex) off the model."""
    # bands from four periods over the record to the Nyquist frequency
    top = np.pi / scene.dt
    centers = np.geomspace(max(8.0 * np.pi / (scene.n_samples * scene.dt), 1e-3 * top), top, _BANDS)
    return [_band(scene, i, centers) for i in range(scene.n_outputs)]


def band_columns(scene: ModelOnRecord, i: int, centers: Array) -> list[Array]:
    """In-phase and quadrature part of an output's run in overlapping bands."""
    n = scene.n_samples
    run = scene.run[i] - scene.run[i].mean()
    size = 1 << int(n + n // 8).bit_length()
    # zero padding: the bands do not wrap around in time
    spectrum = np.fft.rfft(run, size)
    omega = 2.0 * np.pi * np.fft.rfftfreq(size, scene.dt)
    # overlapping triangular bands over log frequency; factor -j: in quadrature
    position = np.interp(
        np.log(np.maximum(omega, 1e-3 * centers[0])), np.log(centers), np.arange(centers.size)
    )
    columns = []
    for k in range(centers.size):
        hat = np.maximum(1.0 - np.abs(position - k), 0.0)
        columns += [scene.only(i, np.fft.irfft(spectrum * hat * factor, size)[:n]) for factor in (1.0, -1j)]
    return columns


def _band(scene: ModelOnRecord, i: int, centers: Array) -> Finding:
    """Contiguous band that explains most for its width."""
    columns = band_columns(scene, i, centers)
    # normal equations of all bands once; blocks of them for each range
    white, target = scene.evidence.white(columns)
    gram, along = white.T @ white, white.T @ target
    total, n = float(target @ target), target.size
    gram += (1e-9 * np.trace(gram) / len(gram) + 1e-300) * np.eye(len(gram))
    # best contiguous range by log-likelihood with Schwarz's penalty
    best, where = -np.inf, (0, 1)
    for a in range(centers.size):
        for b in range(a + 1, centers.size + 1):
            part = slice(2 * a, 2 * b)
            taken = float(along[part] @ np.linalg.solve(gram[part, part], along[part]))
            worth = -n * np.log(max(1.0 - taken / total, 1e-12)) - 2 * (b - a) * np.log(scene.n_samples)
            if worth > best:
                best, where = worth, (a, b)
    a, b = where
    part = slice(2 * a, 2 * b)
    # complex factor of each band in the range
    explanation = scene.evidence.linear(columns[part])
    gains = 1.0 + explanation.values[0::2] + 1j * explanation.values[1::2]
    off = np.abs(gains - 1.0)
    spread = np.sqrt(np.abs(np.diag(np.linalg.inv(gram[part, part]))))
    # most: by the factor itself, where it is sure, not by the energy that happens to be there
    sure = off - 2.0 * np.hypot(spread[0::2], spread[1::2])
    strongest = int(np.argmax(sure))
    factor = complex(gains[strongest])
    # extent: neighbors with at least 40 % of the largest deviation
    first, last = strongest, strongest
    while first > 0 and sure[first - 1] > _HALF * off[strongest]:
        first -= 1
    while last + 1 < off.size and sure[last + 1] > _HALF * off[strongest]:
        last += 1
    low = float(np.sqrt(centers[a + first] * centers[max(a + first - 1, 0)])) if a + first else 0.0
    high = float(np.sqrt(centers[a + last] * centers[min(a + last + 1, centers.size - 1)]))
    name, center, phase = scene.named(i), float(centers[a + strongest]), float(np.angle(factor))
    ends = frequency_text(low), frequency_text(high)
    text = (
        f"{name} differs from the model between {ends[0]} and {ends[1]}: most near {frequency_text(center)}, "
        f"where it is {abs(factor):.3g} times as large and {phase_text(phase)} the model."
    )
    values: dict[str, Any] = {"output": name, "kind": "band", "low": low, "high": high}
    values |= {"center": center, "factor": abs(factor), "phase": phase}
    region = f"{ends[0]} ... {ends[1]}, {name}"
    return Finding("frequency", region, "band", explanation, 2 * (b - a), centers.size, text, values)


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
    n, moving = signals.shape[1], signals[np.ptp(signals, axis=1) > 0]
    if not moving.size:
        return None
    rounding = 1e-9 * np.ptp(moving, axis=1, keepdims=True)

    def repeats(period: int, first: int) -> bool:
        """Return whether the first samples come again after a period."""
        later = moving[:, period : period + first]
        return bool((np.abs(later - moving[:, : later.shape[1]]) <= rounding).all())

    # candidate periods: the first sample comes again
    likely = 4 + np.flatnonzero(
        (np.abs(moving[:, 4 : n // _LEAST + 1] - moving[:, :1]) <= rounding).all(axis=0)
    )
    # most periods fail in their first samples: no more are compared
    return next((p for p in likely.tolist() if all(repeats(p, first) for first in (50, 1000, n))), None)


def excited_lines(inputs: Array) -> tuple[int, NDArray[np.bool_], int] | None:
    """Return period, excited spectral lines and base line of the inputs.

    The period is in samples, the lines are those of one period, the base is the number of the line of which
    all are harmonics. None if no input is periodic.
    """
    period = period_of(inputs)
    if period is None:
        return None
    # spectrum of the last period: lines above rounding were sent
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
        sent = root_mean_square(self.amplitude[:, self.kind == "sent"])
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
    # leave out the first period, in which the system settles
    count = data.n_samples // period - 1
    last = np.s_[:, data.n_samples - count * period :]
    kept = np.arange(base, min(_REACH * np.flatnonzero(excited)[-1], (period - 1) // 2) + 1, base)
    whole = data.outputs[last].reshape(data.n_outputs, count, period)
    # spectrum of each period: the mean is the response, the scatter is noise
    spectra = 2.0 / period * np.fft.rfft(whole, axis=2)[:, :, kept]
    noise = spectra.std(axis=1, ddof=1) / np.sqrt(count)
    # amplitude without the part that noise adds
    amplitude = np.sqrt(np.maximum(np.abs(spectra.mean(axis=1)) ** 2 - noise**2, 0.0))
    # excited lines, odd and even harmonics of the base line
    kind = np.where(excited[kept], "sent", np.where(kept // base % 2 == 1, "odd", "even"))
    return LineLevels(2 * np.pi * kept / (period * data.dt), kind, amplitude, noise, count)
