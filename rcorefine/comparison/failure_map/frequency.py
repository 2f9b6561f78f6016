"""Failures in frequency: modes and corners that lie elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...systems.linear import Array, LinearModel
from ...words import frequency_text
from .likelihood import Explanation
from .record import Finding, ModelOnRecord

__all__ = ["modes", "modes_together", "shifts"]

_MOST_TOGETHER = 8


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
        if pole.imag < 0 or pole.real >= -1e-9 * abs(pole) or abs(pole) < 1e-9 * np.abs(values).max():
            continue
        others = np.delete(values, i)
        if others.size and np.min(np.abs(others - pole)) < 1e-6 * abs(pole):
            continue
        residue = np.outer(model.C @ right[:, i], left[i] @ model.B)
        found.append(Mode(len(found) + 1, pole, residue, model.C @ right[:, i]))
    return found


class Shift:
    """Change of the outputs if a mode had another pole."""

    def __init__(self, scene: ModelOnRecord, mode: Mode) -> None:
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
        """Return the pole after relative changes.

        The changes are of log frequency and log damping ratio, or of the log corner frequency.
        """
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


def shifts(scene: ModelOnRecord) -> list[Shift]:
    """Modes that the inputs reach."""
    model = scene.continuous
    if model is None or not np.any(scene.data.inputs):
        return []
    return [shift for shift in (Shift(scene, mode) for mode in find_modes(model)) if shift.seen]


def modes(scene: ModelOnRecord, found: Sequence[Shift]) -> list[Finding]:
    """Each mode moved on its own."""
    findings = []
    for shift in found:
        one = _searched(scene, shift)
        findings.append(_finding(scene, [shift], [one.values], one, len(found)))
    return findings


def _searched(scene: ModelOnRecord, shift: Shift) -> Explanation:
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


def modes_together(scene: ModelOnRecord, found: Sequence[Shift], single: Sequence[Finding]) -> list[Finding]:
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
    scene: ModelOnRecord, used: Sequence[Shift], points: Sequence[Array], one: Explanation, tried: int
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
    more = f"{share:+.2g}" if abs(share) < 100 else f"{share:+.0f}"
    there, here = frequency_text(row["omega_model"]), frequency_text(row["omega"])
    what = f"Mode {row['mode']}" if paired else "The corner"
    damping = f"its damping ratio is {row['zeta']:.2g} instead of {row['zeta_model']:.2g}, "
    return (
        f"{what} at {there} is at {here} in the record ({more} %), {damping if paired else ''}its amplitude "
        f"is {row['size']:.3g} times that of the model"
    )
