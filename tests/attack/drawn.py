"""Linear plants drawn at random, far from what anybody builds, and their motion in closed form.

A plant is a sum of small blocks whose motion between samples is known: lags, oscillators, integrators, rigid
bodies, poles that repeat. What is handed to the package is that plant in ugly coordinates and units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm
from scipy.signal import lfilter

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)


@dataclass
class Block:
    """A part of the plant of one or a few states in its own time, and its motion."""

    A: Array
    pole: complex
    steps: tuple[Array, Array, Array]  # over one sample: state, held input, rise of the input

    def states(self, force: Array, hold: str, start: Array) -> Array:
        """States (n, N) under forces (n, N)."""
        Phi, held, rising = self.steps
        drive = held @ force
        if hold == "foh":
            drive = drive + rising @ np.diff(force, append=force[:, -1:])
        if len(Phi) == 2 and self.pole.imag:  # an oscillator is one complex lag
            factor, own = complex(Phi[0, 0], Phi[1, 0]), drive[0] + 1j * drive[1]
            z = lfilter([1.0], [1.0, -factor], np.r_[complex(*start), own[:-1]])
            return np.array([z.real, z.imag])
        found = np.empty_like(drive)
        for i in reversed(range(len(Phi))):  # upper triangular: the last state moves alone
            push = drive[i] + Phi[i, i + 1 :] @ found[i + 1 :]
            found[i] = lfilter([1.0], [1.0, -Phi[i, i]], np.r_[start[i], push[:-1]])
        return found


def _phi(z: complex) -> tuple[complex, complex]:
    """(e^z - 1) / z and (e^z - 1 - z) / z^2."""
    if abs(z) < 1e-2:
        series = [1.0 / math.factorial(k) for k in range(1, 12)]
        return sum(c * z**k for k, c in enumerate(series)), sum(c * z**k for k, c in enumerate(series[1:]))
    first = np.expm1(z) / z
    return first, (first - 1) / z


def scalar(pole: complex, dt: float) -> Block:
    """A lag, an integrator, or an oscillator as one complex lag."""
    z = pole * dt
    first, second = _phi(z)
    numbers = np.array([pole, np.exp(z), dt * first, dt * second])
    if np.iscomplexobj(pole) or isinstance(pole, complex):
        A, *steps = (np.array([[c.real, -c.imag], [c.imag, c.real]]) for c in numbers)
    else:
        A, *steps = (np.array([[c.real]]) for c in numbers)
    return Block(A, complex(pole), tuple(steps))


def repeated(pole: float, order: int, rate: float, dt: float) -> Block:
    """A pole that stands `order` times; at 0 a rigid body."""
    A = pole * np.eye(order) + rate * np.diag(np.ones(order - 1), 1)
    none, one = np.zeros((order, order)), np.eye(order)
    whole = expm(np.block([[A * dt, one, none], [none, none, one], [none, none, none]]))
    Phi, held, rising = whole[:order].reshape(order, 3, order).transpose(1, 0, 2)
    return Block(A, complex(pole), (Phi, held * dt, rising * dt))


@dataclass
class Case:
    """A model in ugly coordinates, its inputs, and the motion that it must have."""

    words: list[str]
    system: ct.StateSpace
    w: Array
    y: Array
    dt: float
    hold: str
    x0: Array
    tolerance: float  # of the output, relative to its largest value


def _blocks(rng: np.random.Generator, size: int, rate: float, dt: float, words: list[str]) -> list[Block]:
    """Blocks of `size` states in all, of rates about `rate`."""
    found: list[Block] = []
    stiff = rng.random() < 0.3
    if stiff:
        words.append("stiff")
    while (left := size - sum(len(b.A) for b in found)) > 0:
        own = rate * 10 ** (rng.uniform(-6, 6) if stiff else rng.uniform(-0.5, 0.5))
        kind = rng.choice(["lag", "oscillator", "oscillator", "integrator", "rigid", "repeated", "unstable"])
        fast = own * dt
        if kind == "oscillator" and left > 1:
            zeta = 10 ** rng.uniform(-6, -0.1)
            found.append(scalar(complex(-zeta * own, own * math.sqrt(1 - zeta**2)), dt))
        elif kind in ("rigid", "repeated") and left > 1 and 1e-3 < fast < 10:
            order = int(rng.integers(2, min(left, 3) + 1))
            found.append(repeated(0.0 if kind == "rigid" else -own, order, own, dt))
        elif kind == "integrator" and not any(b.pole == 0 for b in found):
            found.append(scalar(0.0, dt))
        elif kind == "unstable" and rng.random() < 0.15 and not any(b.pole.real > 0 for b in found):
            words.append("unstable")
            found.append(scalar(own * 1e-3, dt))
        else:
            found.append(scalar(-own, dt))
    return found


def draw(
    rng: np.random.Generator,
    *,
    states: int = 50,
    signals: int = 8,
    samples: float = 1e5,
    least: float = 10.0,
    stable: bool = False,
) -> Case:
    """A plant and a run of it."""
    while True:
        with np.errstate(all="ignore"):  # what grows beyond all numbers is not taken
            case = _draw(rng, states, signals, (least, samples))
        if case is not None and not (stable and {"unstable", "drifts"} & set(case.words)):
            return case


def _draw(rng: np.random.Generator, states: int, signals: int, samples: tuple[float, float]) -> Case | None:
    words: list[str] = []
    n = round(10 ** rng.uniform(0, math.log10(states)))
    n_w, n_y = (round(10 ** rng.uniform(0, math.log10(signals))) for _ in range(2))
    N = int(10 ** rng.uniform(*np.log10(samples)))
    time = 10.0 ** rng.integers(-15, 16)
    rate = 1.0 / time
    dt = time * 10 ** (rng.uniform(-5, 4) if rng.random() < 0.25 else rng.uniform(-2, 0.5))
    blocks = _blocks(rng, n, rate, dt, words)
    if max(b.pole.real for b in blocks) * dt * N > 12:
        return None
    B, C = rng.standard_normal((n, n_w)), rng.standard_normal((n_y, n))
    D = rng.standard_normal((n_y, n_w)) * (rng.random() < 0.3)
    if rng.random() < 0.2:
        words.append("hardly seen")
        C[:, : len(blocks[0].A)] *= 1e-9
    hold = str(rng.choice(["zoh", "foh"]))
    w, start = _inputs(rng, n_w, N), rng.standard_normal(n) * (rng.random() < 0.5)
    # each block at unit size, so that none is lost beside the others
    x, sizes, at = [], [], 0
    for block in blocks:
        rows = slice(at, at + len(block.A))
        at = rows.stop
        own = block.states(B[rows] @ w, hold, 0 * start[rows])
        size = np.abs(own).max() or 1.0
        B[rows] /= size
        x.append(block.states(B[rows] @ w, hold, start[rows]))
        sizes.append(size)
    x = np.vstack(x)
    if not np.isfinite(x).all() or np.abs(x).max() > 1e6:
        return None
    if any(b.pole == 0 for b in blocks):
        words.append("drifts")
    y = C @ x + D @ w
    A = block_diag(*(b.A for b in blocks))
    light = max(min(N, 1 / max(-b.pole.real * dt, 1e-300)) * abs(b.pole) * dt for b in blocks)
    most = max(np.abs(C) @ np.abs(x).max(axis=1) / np.abs(y).max(axis=1))
    A, B, C, start, worse = _ugly(rng, A, B, C, start, words)
    fastest = max(abs(b.pole) for b in blocks) * dt  # no exponential of a whole matrix knows better
    tolerance = 1e-6 + 300 * EPS * (light + 10) * most * worse + 3 * EPS * fastest * N
    if tolerance > 1e-3:
        return None
    per_w, per_y = (
        10.0 ** rng.integers(-15, 16, k) if rng.random() < 0.5 else np.ones(k) for k in (n_w, n_y)
    )
    system = ct.ss(A, B / per_w, C * per_y[:, None], D * per_y[:, None] / per_w, name="drawn")
    words += [f"n {n}", f"{n_w}x{n_y}", f"N {N}", f"time {time:.0e}", f"dt {dt / time:.0e}", hold]
    if (per_w != 1).any() or (per_y != 1).any():
        words.append("units")
    return Case(words, system, w * per_w[:, None], y * per_y[:, None], dt, hold, start, tolerance)


def _inputs(rng: np.random.Generator, n_w: int, N: int) -> Array:
    every = int(rng.choice([1, 1, 5, 20]))
    return np.repeat(rng.standard_normal((n_w, N // every + 1)), every, axis=1)[:, :N]


def _ugly(rng, A, B, C, start, words):
    """Other coordinates: turned, permuted, in other units; and by how much more rounding weighs then."""
    n, worse = len(A), 1.0
    if "stiff" not in words and rng.random() < 0.3:
        words.append("turned")
        T = np.linalg.qr(rng.standard_normal((n, n)))[0]
        A, B, C, start, worse = T @ A @ T.T, T @ B, C @ T.T, T @ start, 1e3
    if rng.random() < 0.5:
        words.append("permuted")
        p = rng.permutation(n)
        A, B, C, start = A[np.ix_(p, p)], B[p], C[:, p], start[p]
    if rng.random() < 0.5:
        words.append("state units")
        s = 10.0 ** rng.integers(-15, 16, n)
        A, B, C, start = A * (s[:, None] / s), s[:, None] * B, C / s, s * start
    return A, B, C, start, worse


def sampled(case: Case) -> ct.StateSpace:
    """The model as discrete, in units that scipy's exponential gets right."""
    A, B = case.system.A, case.system.B
    n, s = len(A), np.ones(len(A))
    for _ in range(40):  # rows and columns of one size
        size = np.abs(A) * s / s[:, None] * (1 - np.eye(n))
        row, column = size.sum(axis=1) + 1e-300, size.sum(axis=0) + 1e-300
        both = (row > 1e-290) & (column > 1e-290)
        s *= np.sqrt(np.where(both, row, 1.0) / np.where(both, column, 1.0))
    per_w = np.abs(B / s[:, None]).max(axis=0) * case.dt
    block = np.block([[A * s / s[:, None], B / s[:, None] / per_w], [np.zeros((len(B.T), n + len(B.T)))]])
    whole = expm(block * case.dt)[:n]
    Phi, held = whole[:, :n] * s[:, None] / s, whole[:, n:] * s[:, None] * per_w
    return ct.ss(Phi, held, case.system.C, case.system.D, case.dt)
