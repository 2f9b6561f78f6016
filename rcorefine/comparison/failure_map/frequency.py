"""Failures in frequency: modes and corners that lie elsewhere, bands in which the gain is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import control as ct
import numpy as np
from numpy.typing import NDArray

from ...systems.linear import Array, LinearModel
from .likelihood import Explanation
from .record import Finding, Scene

__all__ = ["bands", "frequency_text", "modes", "modes_together"]

_BANDS = 20
_MOST_TOGETHER = 8
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
        """Whether it is one of a pair."""
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
    values, right = np.linalg.eig(model.A)
    if np.linalg.cond(right) > 1e10:
        # a double pole has no modes of its own; those that lie apart still have
        left = np.linalg.pinv(right)
    else:
        left = np.linalg.inv(right)
    found: list[Mode] = []
    order = np.argsort(np.abs(values))
    for i in order:
        pole = complex(values[i])
        if pole.imag < 0 or pole.real > -1e-9 * abs(pole) or abs(pole) < 1e-9 * np.abs(values).max():
            continue
        others = np.delete(values, i)
        if others.size and np.min(np.abs(others - pole)) < 1e-6 * abs(pole):
            continue
        residue = np.outer(model.C @ right[:, i], left[i] @ model.B)
        found.append(Mode(len(found) + 1, pole, residue, model.C @ right[:, i]))
    return found


class Shift:
    """What a mode would add to the outputs if it lay elsewhere."""

    def __init__(self, scene: Scene, mode: Mode) -> None:
        self.scene, self.mode = scene, mode
        self.before = self._motion(mode.pole) if not self._fast(mode.pole) else np.zeros_like(scene.run)
        self.seen = not self._fast(mode.pole) and bool(np.any(np.abs(self.before) > 1e-9))

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
        move = np.exp(pole * scene.dt)
        held = np.expm1(pole * scene.dt) / pole
        end = (held - scene.dt) / (pole * scene.dt) if scene.hold == "foh" else 0.0
        out = np.zeros_like(scene.run)
        for j, w in enumerate(scene.data.inputs):
            if np.any(residue[:, j]) and np.any(w):
                motion = scene.section(np.array([end, held - end]), np.array([1.0, -move]), w)
                out += np.outer(residue[:, j].real, motion.real) - np.outer(residue[:, j].imag, motion.imag)
        return np.asarray(out / scene.scale)

    def pole(self, point: Array) -> complex:
        """Pole at relative changes: log frequency and log damping ratio, or log corner."""
        if not self.mode.paired:
            return complex(self.mode.pole.real * np.exp(np.clip(point[0], -5, 5)))
        omega = self.mode.omega * np.exp(np.clip(point[0], -1.5, 1.5))
        zeta = min(self.mode.zeta * float(np.exp(np.clip(point[1], -6, 6))), 0.999)
        return complex(-zeta * omega, omega * np.sqrt(1.0 - zeta**2))

    @property
    def size(self) -> int:
        """Number of unknowns: place of the pole, and the mode's size."""
        return 3 if self.mode.paired else 2

    def __call__(self, point: Array) -> Array:
        """Change of the outputs at a point."""
        pole = self.pole(point)
        if self._fast(pole):
            return np.zeros_like(self.before)
        factor = np.exp(np.clip(point[-1], -3, 3))
        change = factor * self._motion(pole) - self.before
        return np.asarray(change + self._free(pole, change))

    def _free(self, pole: complex, change: Array) -> Array:
        """Free motion of the moved mode that serves the residual best."""
        scene = self.scene
        if not scene.begins_moving or len(scene.starts) > 1:
            return np.zeros_like(change)
        motion = np.exp(pole * scene.dt * np.arange(scene.n_samples))
        waves = (self.mode.shape[:, None] * motion[None]) / scene.scale
        columns = [waves.real, waves.imag] if self.mode.paired else [waves.real]
        left = [scene.evidence.without_nuisance(c).ravel() for c in columns]
        target = (scene.residual - scene.evidence.without_nuisance(change)).ravel()
        basis = np.array(left).T
        size = np.linalg.norm(basis, axis=0)
        if not np.all(size > 1e-9):
            return np.zeros_like(change)
        best = np.linalg.lstsq(basis / size, target, rcond=1e-6)[0] / size
        return np.asarray(np.tensordot(best, np.array(columns), 1))


def shifts(scene: Scene) -> list[Shift]:
    """Modes that the inputs reach."""
    model = scene.continuous
    if model is None or not np.any(scene.data.inputs):
        return []
    return [shift for shift in (Shift(scene, mode) for mode in find_modes(model)) if shift.seen]


def modes(scene: Scene, found: Sequence[Shift]) -> list[Finding]:
    """Each mode moved on its own."""
    findings = []
    for shift in found:
        one = _searched(scene, shift)
        findings.append(_finding(scene, [shift], [one.values], one, len(found)))
    return findings


def _searched(scene: Scene, shift: Shift) -> Explanation:
    evidence = scene.evidence
    known = scene.known.get(shift.mode.number)
    if known is not None:
        places = [known, np.zeros(shift.size)]
    elif shift.mode.paired:
        steps = np.array([0.004, 0.01, 0.02, 0.035, 0.06, 0.1, 0.18, 0.3])
        places = [
            np.array([df, dz, 0.0])
            for df in np.concatenate([-steps[::-1], [0.0], steps])
            for dz in np.log([0.4, 1.0, 2.5])
        ]
    else:
        places = [np.array([dp, 0.0]) for dp in np.log([0.2, 0.35, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2, 3, 5])]
    costs = [evidence.misfit(shift(p)) for p in places]
    best = evidence.descended(shift, places[int(np.argmin(costs))])
    scene.known[shift.mode.number] = best.values
    return best


def modes_together(scene: Scene, found: Sequence[Shift], single: Sequence[Finding]) -> list[Finding]:
    """All modes moved at once, where there are several."""
    worth = sorted(zip(found, single, strict=True), key=lambda pair: -pair[1].explanation.gain)
    chosen = [pair for pair in worth if pair[1].explanation.gain > 0][:_MOST_TOGETHER]
    if len(chosen) < 2:
        return []
    used = [shift for shift, _ in chosen]
    cuts = np.cumsum([shift.size for shift in used])[:-1]

    def shape(point: Array) -> Array:
        parts = np.split(point, cuts)
        every = [shift(part) for shift, part in zip(used, parts, strict=True)]
        return np.asarray(np.sum(every, axis=0))

    starts = [
        np.concatenate([finding.explanation.values for _, finding in chosen]),
        np.zeros(sum(s.size for s in used)),
    ]
    start = min(starts, key=lambda point: scene.evidence.misfit(shape(point)))
    best = scene.evidence.descended(shape, start, evaluations=15)
    return [_finding(scene, used, np.split(best.values, cuts), best, 1)]


def _finding(
    scene: Scene, used: Sequence[Shift], points: Sequence[Array], one: Explanation, tried: int
) -> Finding:
    energy = [
        float(np.sum(scene.evidence.without_nuisance(s(p)) ** 2)) for s, p in zip(used, points, strict=True)
    ]
    order = np.argsort(energy)[::-1]
    texts, rows = [], []
    for k in order:
        shift, point = used[k], points[k]
        new = shift.pole(point)
        rows.append(
            {
                "mode": shift.mode.number,
                "omega_model": shift.mode.omega,
                "omega": abs(new),
                "zeta_model": shift.mode.zeta,
                "zeta": -new.real / abs(new),
                "size": float(np.exp(point[-1])),
            }
        )
        texts.append(_moved(rows[-1], shift.mode.paired))
    lead = rows[0]
    half = 3.0 * max(lead["zeta"] * lead["omega"], abs(lead["omega"] - lead["omega_model"]))
    low = max(min(lead["omega"], lead["omega_model"]) - half, 0.0)
    high = max(lead["omega"], lead["omega_model"]) + half
    paired = used[order[0]].mode.paired
    if not paired:
        low, high = 0.2 * lead["omega"], 5.0 * lead["omega"]
    name = "mode" if paired else "corner"
    where = f"{name} {lead['mode']} at {frequency_text(lead['omega'])}"
    if len(rows) > 1:
        where = f"{where} and {len(rows) - 1} more"
    return Finding(
        "frequency",
        where,
        name if len(rows) == 1 else "modes",
        one,
        sum(s.size for s in used),
        25 * tried,
        "; ".join(texts[:3]) + (f"; {len(texts) - 3} more" if len(texts) > 3 else "") + ".",
        {"low": low, "high": high, "modes": rows, "kind": "modes" if len(rows) > 1 else "mode"},
    )


def _moved(row: dict[str, float], paired: bool) -> str:
    share = 100.0 * (row["omega"] / row["omega_model"] - 1.0)
    if not paired:
        return (
            f"the corner at {frequency_text(row['omega_model'])} lies at {frequency_text(row['omega'])} in "
            f"the record ({share:+.2g} %), its size is {row['size']:.3g} times the model's"
        )
    return (
        f"mode {row['mode']} ({frequency_text(row['omega_model'])}) lies {abs(share):.2g} % "
        f"{'higher' if share > 0 else 'lower'} in the record, its damping ratio is {row['zeta']:.2g} instead "
        f"of {row['zeta_model']:.2g}, its size {row['size']:.3g} times the model's"
    )


def frequency_text(omega: float) -> str:
    """Frequency in the unit of python-control's plots.

    Examples
    --------
    >>> frequency_text(6.2832)
    '6.283 rad/s'
    """
    if ct.defaults["freqplot.Hz"]:
        return f"{omega / (2 * np.pi):.4g} Hz"
    return f"{omega:.4g} rad/s"


# ---------------------------------------------------------------------- bands
def bands(scene: Scene) -> list[Finding]:
    """Bands in which an output is a smooth factor (complex) off the model."""
    found = []
    centers = _centers(scene)
    if centers.size < 4:
        return []
    for i in range(scene.n_outputs):
        columns = band_columns(scene, i, centers)
        found.append(_band(scene, i, centers, columns))
    return found


def _centers(scene: Scene) -> Array:
    top = np.pi / scene.dt
    low = max(2.0 * np.pi * 4.0 / (scene.n_samples * scene.dt), 1e-3 * top)
    return np.geomspace(low, top, _BANDS)


def band_columns(scene: Scene, i: int, centers: Array) -> list[Array]:
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


def _band(scene: Scene, i: int, centers: Array, columns: list[Array]) -> Finding:
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
    name = scene.named(i)
    return Finding(
        "frequency",
        f"{frequency_text(low)} ... {frequency_text(high)}, {name}",
        "band",
        one,
        2 * (b - a),
        centers.size,
        f"{name} differs from the model between {frequency_text(low)} and {frequency_text(high)}: most near "
        f"{frequency_text(float(centers[a + strongest]))}, where it is {abs(factor):.3g} times as large and "
        f"{np.degrees(np.angle(factor)):+.2g} deg ahead.",
        {
            "low": low,
            "high": high,
            "output": name,
            "center": float(centers[a + strongest]),
            "factor": abs(factor),
            "phase": float(np.angle(factor)),
            "kind": "band",
        },
    )
