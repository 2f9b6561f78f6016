"""A record of a plant with a hidden effect, by an integrator with steps below the sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import StateSpace, cont2discrete, lfilter, lsim

import rcorefine as rco

from .integrator import LAWS, MEMORY, force_of, march
from .plants import PLANTS, Array, Place, Plant

SECOND_ORDER = {
    "stiffness": lambda d, v, e: d,
    "damping": lambda d, v, e: v,
    "cubic_stiffness": lambda d, v, e: d**3,
    "quadratic_stiffness": lambda d, v, e: d * d,
    "bilinear_stiffness": lambda d, v, e: max(d, 0.0),
    "coulomb_friction": lambda d, v, e: np.tanh(v / e),
    "quadratic_damping": lambda d, v, e: v * abs(v),
    "cubic_damping": lambda d, v, e: v**3,
}
FIRST_ORDER = {
    kind: SECOND_ORDER[kind] for kind in ("damping", "coulomb_friction", "quadratic_damping", "cubic_damping")
}
OUTSIDE = ("clearance", "jenkins", "bouc-wen", "dahl", "hidden mass", "input saturation", "ramp")
NOISES = ("white", "ar", "resonant", "t3", "reading", "spikes", "dropouts", "hum")
DRIVES = ("steady", "bursts", "hammer")


@dataclass
class Law:
    """A force law and its numbers, the first of which scales it."""

    kind: str
    p: Array


@dataclass
class Hidden:
    """A record, what hides in it, and what the estimator may be offered."""

    plant: Plant
    data: rco.Measurement
    kind: str | None
    place: str | None
    strength: float
    loss: float
    noise: float
    coefficient: float  # of the law, in the model's units

    def at_scale(self, factor: float, seed: int = 0) -> Array:
        """Outputs of the same plant with the same law under a scaled input, fresh noise."""
        plant, w = self.plant, factor * self.data.inputs
        place = next(p for p in plant.places if p.name == self.place)
        width = 0.003 * float(np.std(place.v @ linear_states(plant, self.data.inputs)))
        law = Law(str(self.kind), np.array([self.coefficient, width, 0.0]))
        x = integrate(plant, w, law, place)
        y = outputs(plant, x, w, forces(plant, x, law, place), place)
        rng = np.random.default_rng([seed, 78])
        return y + self.noise * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)

    @property
    def candidates(self) -> list[rco.Effect]:
        """All laws at all places."""
        found = []
        for place in self.plant.places:
            laws = place.laws or tuple(SECOND_ORDER if place.d is not None else FIRST_ORDER)
            found += [rco.Effect(kind, place.name) for kind in laws]
        return found


def linear_states(plant: Plant, w: Array) -> Array:
    """States (n, N) of the plant alone."""
    n = plant.A.shape[0]
    t = np.arange(w.shape[1]) * plant.dt
    whole = StateSpace(plant.A, plant.B, np.eye(n), np.zeros((n, w.shape[0])))
    return lsim(whole, w.T, t)[2].reshape(t.size, n).T


def integrate(
    plant: Plant, w: Array, law: Law, place: Place, *more: tuple[Law, Place], rtol: float = 1e-7
) -> Array:
    """States (n + memory, N) for inputs (n_w, N) that are linear between samples; `more` without memory."""
    n, memory = plant.A.shape[0], MEMORY.get(law.kind, 0)
    x0 = linear_states(plant, w)
    size = x0.std(axis=1)
    at_place = [float(np.std(row @ x0)) for row in (place.d, place.v) if row is not None]
    inner = {"hidden mass": at_place}.get(law.kind, [float(law.p[1])])[:memory]
    atol = 1e-7 * np.concatenate([np.where(size > 0, size, 1.0), inner])
    every = [(law, place), *more]
    x = march(
        plant.A, np.ascontiguousarray((plant.B @ w).T), np.array([at.act for _, at in every]),
        np.array([at.d if at.d is not None else np.zeros(n) for _, at in every]),
        np.array([at.v for _, at in every]), np.array([LAWS[one.kind] for one, _ in every]),
        np.array([one.p for one, _ in every]), memory, plant.dt, rtol, atol, 400 * w.shape[1],
        False, np.zeros(n + memory),
    )  # fmt: skip
    if not np.isfinite(x).all() or np.abs(x[:, :n]).max() > 1e3 * np.abs(x0).max():
        raise FloatingPointError("the plant with this effect runs away")
    return x.T


def held_motion(
    A: Array,
    steer: Array,
    dt: float,
    laws: Sequence[tuple[Law, Array, Array, Array]] = (),
    start: Array | None = None,
) -> Array:
    """States (N, n) from rest, or from `start`, under rates `steer` (N, n) that are held over each sample.

    Each law comes with the rates that its resisting force makes, and the rows that sense
    displacement and velocity. A thousand samples take milliseconds where `solve_ivp`, called
    for each, takes seconds.
    """
    n = len(A)
    rows = [np.array([law[i] for law in laws], dtype=float).reshape(-1, n) for i in (1, 2, 3)]
    codes = np.array([LAWS[law.kind] for law, *_ in laws], dtype=np.int64)
    numbers = np.array([law.p for law, *_ in laws], dtype=float).reshape(-1, 3)
    x = march(
        np.asarray(A, dtype=float), np.ascontiguousarray(steer, dtype=float), *rows, codes, numbers, 0, dt,
        1e-7, np.full(n, 1e-9), 4000 * len(steer), True,
        np.zeros(n) if start is None else start,
    )  # fmt: skip
    assert np.isfinite(x).all()
    return x


def forces(plant: Plant, x: Array, law: Law, place: Place) -> Array:
    """The law's force (N,) along a motion."""
    n, inner = plant.A.shape[0], np.zeros(2)
    d = place.d @ x[:n] if place.d is not None else np.zeros(x.shape[1])
    v = place.v @ x[:n]
    return np.array(
        [
            force_of(LAWS[law.kind], law.p, k * plant.dt, d[k], v[k], x[n:, k], inner)
            for k in range(x.shape[1])
        ]
    )


def outputs(plant: Plant, x: Array, w: Array, force: Array | None, place: Place | None) -> Array:
    """Sensors, the accelerometers' share of the force included."""
    n = plant.A.shape[0]
    y = plant.C @ x[:n] + plant.D @ w
    if plant.rates.any():
        rate = plant.A @ x[:n] + plant.B @ w
        if force is not None and place is not None:
            rate = rate + np.outer(place.act, force)
        y = y + plant.rates @ rate
    return y


def excitation(rng: np.random.Generator, plant: Plant, N: int, drive: str = "steady") -> Array:
    """Broadband up to a quarter of the sampling rate: all the time, in five bursts, or six blows."""
    w = lfilter([1.0], [1.0, -0.6], rng.standard_normal((plant.B.shape[1], N)))
    if drive == "bursts":
        w = w * (np.arange(N) % (N // 5) < N // 25)
    elif drive == "hammer":
        blow = np.zeros(N)
        blow[10 :: N // 6] = rng.uniform(0.5, 1.5, blow[10 :: N // 6].size)
        w = np.tile(lfilter(np.sin(np.pi * np.arange(1, 5) / 5), [1.0], blow), (plant.B.shape[1], 1))
    return plant.amplitude[:, None] * (w / w.std(axis=1, keepdims=True) + plant.lift)


def coloured(rng: np.random.Generator, what: str, shape: tuple[int, int]) -> Array:
    """Unit-variance sensor noise."""
    e = rng.standard_normal(shape)
    if what == "ar":
        e = lfilter([1.0], [1.0, -0.9], e)
    elif what == "resonant":
        e = lfilter([1.0], [1.0, -1.85, 0.95], e)
        drift = np.cumsum(rng.standard_normal(shape), axis=1)
        e = e / e.std(axis=1, keepdims=True) + 0.5 * drift / drift.std(axis=1, keepdims=True)
    elif what == "t3":
        e = rng.standard_t(3, shape)
    return e / e.std(axis=1, keepdims=True)


def disturbed(rng: np.random.Generator, what: str, truth: Array, noise: float) -> Array:
    """What a sensor shows of the truth (n_y, N); noise is a share of its rms, or of the reading."""
    level = truth.std(axis=1, keepdims=True)
    if what == "reading":
        return truth + (noise * np.abs(truth) + 1e-3 * level) * rng.standard_normal(truth.shape)
    if what not in ("spikes", "dropouts", "hum"):
        return truth + noise * level * coloured(rng, what, truth.shape)
    shown = truth + noise * level * rng.standard_normal(truth.shape)
    if what == "spikes":  # one sample in a hundred, as large as the signal
        return shown + level * rng.standard_normal(truth.shape) * (rng.random(truth.shape) < 0.01)
    if what == "hum":
        omega = rng.uniform(0.3, 2.8, (len(truth), 1))
        return shown + noise * level * np.sqrt(2) * np.sin(omega * np.arange(truth.shape[1]) + 1.0)
    for row in shown:  # a few samples read nothing, once in a thousand
        for first in rng.integers(0, row.size - 5, max(row.size // 1000, 1)):
            row[first : first + int(rng.integers(1, 5))] = 0.0
    return shown


def fed_back(seed: int, *, samples: int = 2000, noise: float = 0.03, unmeasured: float = 0.1) -> Hidden:
    """Nothing is missing, but the held input is u(k) = r(k) - g y(k), beside an unmeasured force."""
    rng = np.random.default_rng([seed, 81])
    made = PLANTS["chain"](rng, 1)
    while made.rates.any() or made.D.any():
        made = PLANTS["chain"](rng, 1)
    held = cont2discrete((made.A, made.B, made.C, made.D), made.dt, "zoh")
    n = len(made.A)
    circle = np.exp(1j * np.linspace(0.0, np.pi, 500))
    g = 0.1 / max(np.abs(made.C @ np.linalg.solve(z * np.eye(n) - held[0], held[1])).max() for z in circle)
    while np.abs(np.linalg.eigvals(held[0] - 2.4 * g * held[1] @ made.C)).max() < 1.0:
        g *= 1.2  # up to half of what the loop bears
    r = excitation(rng, made, samples)
    force = unmeasured * r.std() * rng.standard_normal(r.shape)
    level = noise * float(lsim((made.A, made.B, made.C, made.D), r[0], np.arange(samples) * made.dt)[1].std())
    u, y, x = np.zeros_like(r), np.zeros((1, samples)), np.zeros(n)
    for k in range(samples):
        y[:, k] = made.C @ x + level * rng.standard_normal(1)
        u[:, k] = r[:, k] - g * y[0, k]
        x = held[0] @ x + held[1] @ (u[:, k] + force[:, k])
    return Hidden(made, rco.Measurement(u, y, dt=made.dt), None, None, 0.0, 0.0, noise, np.nan)


def hidden_record(
    seed: int,
    *,
    plant: str = "chain",
    effect: str | None = "any",
    loss: float = 0.05,
    noise: float = 0.03,
    noise_kind: str = "white",
    sensors: int = 1,
    samples: int = 2000,
    unmeasured: float = 0.0,
    detuned: float = 0.0,
    scale: float = 1.0,
    drive: str = "steady",
) -> Hidden:
    """A record with one hidden effect.

    Parameters
    ----------
    seed : int
        Draws plant, place, law, input and noise.
    plant : str
        Key of `PLANTS`.
    effect : str or None
        "any" for one of the library, a kind, one of `OUTSIDE`, or None for nothing.
    loss : float
        Free-run loss of the nominal model that the strength is set to, over the output.
    noise, noise_kind : float, str
        Sensor noise over the rms of the output ("reading": over its size in the sample); one
        of `NOISES`.
    sensors, samples : int
        Outputs and length.
    unmeasured : float
        Rms of an unmeasured force over that of the input, at the input's place.
    detuned : float
        Relative sd of the plant's A entries about the model's (places scaled).
    scale : float
        Factor on the input, for a second record of the same plant.
    drive : str
        One of `DRIVES`.
    """
    rng = np.random.default_rng([seed, 77])
    made = PLANTS[plant](rng, sensors)
    if detuned:
        made = _detuned(made, rng, detuned)
    place = made.places[int(rng.integers(len(made.places)))]
    laws = place.laws or tuple(SECOND_ORDER if place.d is not None else FIRST_ORDER)
    kind = str(rng.choice(laws)) if effect == "any" else effect
    w = scale * excitation(rng, made, samples, drive)
    quiet = w if not unmeasured else w + unmeasured * np.std(w) * rng.standard_normal(w.shape)
    x0 = linear_states(made, w)
    y0 = outputs(made, x0, w, None, None)
    spread = np.linalg.norm(y0 - y0.mean(axis=1, keepdims=True))
    truth, strength, reached, where = (
        outputs(made, linear_states(made, quiet), quiet, None, None),
        0.0,
        0.0,
        None,
    )
    if kind is not None:
        where = None if kind == "input saturation" else place
        strength, truth = _calibrated(made, quiet, kind, place, x0, y0, loss)
        reached = float(np.linalg.norm(truth - y0) / spread)
    coefficient = _unit(made, place, x0, kind) * strength if kind in SECOND_ORDER else np.nan
    measured = disturbed(rng, noise_kind, truth, noise)
    data = rco.Measurement(w, measured, dt=made.dt, hold="foh")
    return Hidden(
        made, data, kind, None if where is None else where.name, strength, reached, noise, coefficient
    )


def _detuned(plant: Plant, rng: np.random.Generator, share: float) -> Plant:
    """Stiffness and damping of every place off by a draw; the model keeps its numbers."""
    n = plant.A.shape[0] // 2
    senses = [(p.act, s) for p in plant.places if p.d is not None for s in (p.d, p.v)]
    basis = np.array([np.outer(act, sense).ravel() for act, sense in senses]).T
    target = plant.A.copy()
    target[:n] = 0
    sizes = np.linalg.lstsq(basis, target.ravel(), rcond=None)[0]
    change = basis @ (share * rng.standard_normal(sizes.size) * sizes)
    return replace(plant, A=plant.A + change.reshape(plant.A.shape))


def _calibrated(
    plant: Plant, w: Array, kind: str, place: Place, x0: Array, y0: Array, goal: float
) -> tuple[float, Array]:
    """Strength at which the nominal model loses the goal, tried on a short part first."""
    strength, N = 0.05, w.shape[1]
    sizes = [min(400, N)] * 6 + [N] * 4
    i = 0
    while i < len(sizes):
        part = slice(0, sizes[i])
        try:
            y = _with(plant, w[:, part], kind, place, strength, x0)
        except FloatingPointError:
            strength, i = 0.3 * strength, i + 1
            continue
        about = np.linalg.norm(y0[:, part] - y0[:, part].mean(axis=1, keepdims=True))
        loss = float(np.linalg.norm(y - y0[:, part]) / about)
        close = 0.8 < loss / goal < 1.25
        if close and part.stop == N:
            return strength, y
        if not close:
            strength *= float(np.clip((goal / max(loss, 1e-9)) ** 0.9, 0.05, 20))
        i = 6 if close and i < 6 else i + 1
    return strength, _with(plant, w, kind, place, strength, x0)


def _motion(plant: Plant, place: Place, x0: Array) -> tuple[float, float, float]:
    """Rms displacement and velocity at a place, and the force that moves it as it moves."""
    n = plant.A.shape[0]
    v = place.v @ x0[:n]
    d_rms = float(np.std(place.d @ x0[:n])) if place.d is not None else 1.0
    return d_rms, float(np.std(v)), float(np.std(np.gradient(v, plant.dt))) / abs(float(place.v @ place.act))


def _unit(plant: Plant, place: Place, x0: Array, kind: str) -> float:
    d_rms, v_rms, unit = _motion(plant, place, x0)
    return unit / (abs(SECOND_ORDER[kind](d_rms, v_rms, 1e-3 * v_rms)) or 1.0)


def _with(plant: Plant, w: Array, kind: str, place: Place, strength: float, x0: Array) -> Array:
    """Outputs with the effect; strength is relative to the force that the plant itself has there."""
    if kind == "input saturation":
        limit = np.quantile(np.abs(w), 1 - min(0.9 * strength, 0.9))
        cut = np.clip(w, -limit, limit)
        return outputs(plant, linear_states(plant, cut), cut, None, None)
    law = _law(plant, place, x0, kind, strength, w.shape[1])
    x = integrate(plant, w, law, place)
    return outputs(plant, x, w, forces(plant, x, law, place), place)


def _law(plant: Plant, place: Place, x0: Array, kind: str, strength: float, samples: int) -> Law:
    d_rms, v_rms, unit = _motion(plant, place, x0)
    level, slip = strength * unit, 0.5 * d_rms
    if kind in SECOND_ORDER:
        at = abs(SECOND_ORDER[kind](d_rms, v_rms, 1e-3 * v_rms)) or 1.0
        return Law(kind, np.array([level / at, 0.003 * v_rms, 0.0]))
    if kind == "hidden mass":  # on a spring and damper at the place, tuned to a mode of the plant
        m = 0.5 * strength / abs(float(place.v @ place.act))
        modes = np.abs(np.linalg.eigvals(plant.A))
        omega = float(np.sort(modes)[modes.size // 2])
        return Law(kind, np.array([m * omega**2, 2 * 0.03 * m * omega, m]))
    second = {"clearance": 0.7 * d_rms, "ramp": samples * plant.dt}.get(kind, slip)
    first = level / d_rms if kind in ("clearance", "ramp") else level
    return Law(kind, np.array([first, second, 0.0]))


def several_hidden(
    seed: int,
    count: int,
    *,
    loss: tuple[float, float] = (0.05, 0.2),
    noise: float = 0.03,
    samples: int = 4000,
) -> tuple[Plant, rco.Measurement, set[tuple[str, str]]]:
    """A chain of 2 to 6 masses with effects at different links, each of a loss drawn at random.

    Returns
    -------
    plant, data, hidden
        Hidden holds (kind, place) of each effect.
    """
    rng = np.random.default_rng([seed, 79])
    made = PLANTS["chain"](rng, 1)
    while len(made.places) < max(count, 2) or len(made.B) < 4:
        made = PLANTS["chain"](rng, 1)
    w = excitation(rng, made, samples)
    x0 = linear_states(made, w)
    y0 = outputs(made, x0, w, None, None)
    chosen = rng.permutation(len(made.places))[:count]
    every = []
    for index in chosen:
        place = made.places[int(index)]
        kind = str(rng.choice(list(SECOND_ORDER)))
        strength, _ = _calibrated(made, w, kind, place, x0, y0, float(rng.uniform(*loss)))
        every.append((_law(made, place, x0, kind, strength, samples), place))
    x = integrate(made, w, *every[0], *every[1:])
    y = made.C @ x + made.D @ w
    if made.rates.any():
        rate = made.A @ x + made.B @ w
        for law, place in every:
            rate = rate + np.outer(place.act, forces(made, x, law, place))
        y = y + made.rates @ rate
    y = y + noise * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    return made, rco.Measurement(w, y, dt=made.dt, hold="foh"), {(law.kind, at.name) for law, at in every}
