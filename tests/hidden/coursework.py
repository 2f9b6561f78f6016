"""Plants of control coursework, from their physics, with records that hide none, one or two effects.

A plant is drawn as values; the model that is handed over is made of the same values, or of values that are 10
to 20 % off. Everything is integrated here, at steps that are halved until the record no longer changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import control as ct
import numpy as np
from scipy.signal import chirp

import rcorefine as rco

from .integrator import LAWS, force_of
from .plants import Array

try:
    from numba import njit
except ImportError:

    def njit(**_options):
        """Run as plain Python, slowly."""
        return lambda function: function


ROLES = ("nothing",) * 8 + ("one",) * 18 + ("two",) * 6 + ("outside",) * 8
DRIVES = ("prbs", "steps", "chirp", "multisine")
SHOWN = 2.0  # least error of the linear model over the noise
CODES = LAWS | {
    "sqrt_flow": 100, "threshold_flow": 101, "stribeck": 102, "end_stop": 103, "product": 104,
    "square product": 105, "diode": 106, "belt": 107,
}  # fmt: skip
_STEPS = (8, 256)  # least and most steps of a sample
_EXACT = 3e-4  # change of the outputs over their spread at half the step


class NoRecordError(Exception):
    """The draw runs away, or its record does not show the effect."""


# ------------------------------------------------------------------ what can be hidden
@dataclass(frozen=True)
class Site:
    """A direction in the states where a law acts: it feels d and v, and adds act f to the rates.

    `into` is the direct part of the inputs in v; laws are kinds of the library.
    """

    act: Array
    v: Array
    d: Array | None = None
    laws: tuple[str, ...] = ()
    into: Array | None = None


@dataclass(frozen=True)
class Strange:
    """An effect outside the library: what it is, its law, where it acts, and which names are right.

    `names` pairs a kind with the place of an entry, or with "" for the site itself, or for the `port` that it
    belongs to.
    """

    kind: str
    code: str
    site: Site | None
    names: tuple[tuple[str, str], ...] = ()
    port: Site | None = None


@dataclass(frozen=True)
class Plant:
    """Matrices, labels, sites, sampling time, mean and size of each input."""

    A: Array
    B: Array
    C: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    sites: tuple[Site, ...]
    dt: float
    channels: tuple[str, ...] = ("input_saturation", "input_deadzone", "input_delay", "input_lag")
    strange: tuple[Strange, ...] = ()
    builder: Callable[[], Any] | None = None
    lift: tuple[float, ...] = (0.0,)
    size: tuple[float, ...] = (1.0,)

    def model(self, plain: bool) -> Any:
        """What is handed over."""
        if not plain and self.builder is not None:
            return self.builder()
        D = np.zeros((len(self.outputs), len(self.inputs)))
        return ct.ss(self.A, self.B, self.C, D, states=list(self.states), inputs=list(self.inputs),
                     outputs=list(self.outputs))  # fmt: skip


@dataclass(frozen=True)
class Hidden:
    """An effect of a size: kind of the library or a strange one, where, and its numbers.

    `place` is a site, or a channel ("input", 0), or an entry such as "C[0,0]".
    `coefficients` holds value and rule: the power of the velocity in a force, or None for a length.
    """

    kind: str
    place: Any
    code: str = "none"
    p: tuple[float, ...] = (0.0, 1.0, 0.0, 0.0)
    coefficients: Mapping[str, tuple[float, Any]] = field(default_factory=dict)
    strange: Strange | None = None

    def named_by(self, effect: rco.Effect, model: Any) -> bool:
        """Whether an effect is this one, at this place."""
        if self.strange is not None:
            names = self.strange.names
            return (effect.kind, effect.place) in names or (
                (effect.kind, "") in names and self._at(effect.place, model)
            )
        kind, place = at_the_input(effect.kind, effect.place, model)
        return kind == self.kind and self._at(place, model)

    def _at(self, place: str, model: Any) -> bool:
        if isinstance(self.place, str):
            return place == self.place
        if isinstance(self.place, tuple):
            channel, i = self.place
            return place == labels(model)[channel][i]
        return self.scales(place, model) is not None

    def scales(self, place: str, model: Any) -> tuple[float, float] | None:
        """Of the direction of action, and of the motion, at a port that is this site; else None."""
        site = self.place if self.strange is None or self.strange.port is None else self.strange.port
        for port in rco.ports(model):
            if port.name != place:
                continue
            sensed = [(port.velocity, site.v)]
            if site.d is not None and port.position.any():
                sensed.append((port.position, site.d))
            if all(_parallel(*pair) for pair in [(port.act, site.act), *sensed]):
                return _ratio(port.act, site.act), _ratio(*sensed[-1])
        return None

    def truth(self, place: str, model: Any) -> dict[str, float]:
        """Coefficients in the units and the direction of a port."""
        if not isinstance(self.place, Site):
            return {name: value for name, (value, _) in self.coefficients.items()}
        found = self.scales(place, model)
        if found is None:
            return {}
        alpha, beta = found
        return {
            name: value * beta if rule is None else value / (alpha * np.sign(beta) * abs(beta) ** rule)
            for name, (value, rule) in self.coefficients.items()
        }


def labels(model: Any) -> dict[str, tuple[str, ...]]:
    """Names of the channels of a model."""
    linear = getattr(model, "linear", model)
    return {"input": tuple(linear.input_labels), "output": tuple(linear.output_labels)}


def at_the_input(kind: str, place: str, model: Any) -> tuple[str, str]:
    """Kind and place of an effect; of one input and one output a delay or a lag is the same at either."""
    inputs, outputs = labels(model).values()
    if kind in ("output_delay", "output_lag") and len(inputs) == len(outputs) == 1:
        return kind.replace("output", "input"), inputs[0]
    return kind, place


def _parallel(a: Array, b: Array) -> bool:
    size = np.linalg.norm(a) * np.linalg.norm(b)
    return bool(size > 0 and abs(a @ b) > 0.9999 * size)


def _ratio(a: Array, b: Array) -> float:
    return float(a @ b / (b @ b))


# ------------------------------------------------------------------ integration
@njit(cache=True)
def _law(code, p, d, v, z, inner):
    if code < 100:
        return force_of(code, p, 0.0, d, v, z, inner)
    if code == 100:
        return p[0] * math.sqrt(max(v, 0.0))
    if code == 101:
        return p[0] * max(v - p[1], 0.0)
    if code == 102:  # breakaway at p[1] times the level, faded at the speed p[2]
        return p[0] * math.tanh(v / p[3]) * (1.0 + (p[1] - 1.0) * math.exp(-((v / p[2]) ** 2)))
    if code == 103:
        return p[0] * max(d - p[1], 0.0)
    if code == 104:
        return p[0] * d * v
    if code == 105:
        return p[0] * d * d * v
    if code == 106:
        return p[0] * (math.exp(min(v / p[1], 50.0)) - 1.0)
    slip = v - p[1]  # a belt at the speed p[1], friction that falls; the mean is taken away
    here = math.tanh(slip / p[3]) * (0.6 + 0.4 * math.exp(-abs(slip) / p[2]))
    mean = math.tanh(-p[1] / p[3]) * (0.6 + 0.4 * math.exp(-abs(p[1]) / p[2]))
    return p[0] * (here - mean)


@njit(cache=True)
def _roll(A, B, w, act, sense_d, sense_v, sense_w, codes, p, h, every):
    n, laws = A.shape[0], codes.size
    x, z = np.zeros(n), np.zeros((laws, 2))
    X = np.empty((w.shape[0] // every, n))
    slope, rate_z = np.zeros((4, n)), np.zeros((4, laws, 2))
    weights = np.array([0.0, 0.5, 0.5, 1.0])
    inner = np.zeros(2)
    for step in range(w.shape[0]):
        if step % every == 0:
            X[step // every] = x
        steer = B @ w[step]
        for stage in range(4):
            trial, memory = x.copy(), z.copy()
            if stage > 0:
                trial += weights[stage] * h * slope[stage - 1]
                memory += weights[stage] * h * rate_z[stage - 1]
            slope[stage] = A @ trial + steer
            for k in range(laws):
                d = np.dot(sense_d[k], trial)
                v = np.dot(sense_v[k], trial) + np.dot(sense_w[k], w[step])
                inner[:] = 0.0
                slope[stage] += act[k] * _law(codes[k], p[k], d, v, memory[k], inner)
                rate_z[stage, k] = inner
        x = x + h / 6.0 * (slope[0] + 2.0 * slope[1] + 2.0 * slope[2] + slope[3])
        z = z + h / 6.0 * (rate_z[0] + 2.0 * rate_z[1] + 2.0 * rate_z[2] + rate_z[3])
        if not np.isfinite(x).all():
            break
    return X


@njit(cache=True)
def _followed(u, most):
    """What follows a signal by at most so much a step."""
    r, followed = 0.0, np.empty_like(u)
    for k in range(u.size):
        r += min(max(u[k] - r, -most), most)
        followed[k] = r
    return followed


def _actuated(w: Array, hidden: Hidden, h: float) -> Array:
    """Inputs (steps, n_w) behind an actuator."""
    j, p = hidden.place[1], hidden.p
    w, u = w.copy(), w[:, j]
    if hidden.kind == "input_saturation":
        w[:, j] = np.clip(u, -p[0], p[0])
    elif hidden.kind == "input_deadzone":
        w[:, j] = np.sign(u) * np.maximum(np.abs(u) - p[0], 0.0)
    elif hidden.kind == "input_delay":
        late = round(p[0] / h)
        w[:, j] = np.r_[np.zeros(late), u[: u.size - late]]
    else:
        w[:, j] = _followed(u, p[0] * h)
    return w


def _sensed(y: Array, hidden: Hidden, x: Array) -> Array:
    """Outputs (n_y, N) of a sensor."""
    p, y = hidden.p, y.copy()
    if isinstance(hidden.place, str):  # an entry of C
        i, j = map(int, hidden.place[2:-1].split(","))
        y[i] += p[0] * x[:, j]
        return y
    i = hidden.place[1]
    if hidden.kind == "output_saturation":
        y[i] = np.clip(y[i], -p[0], p[0])
    elif hidden.kind == "output_curvature":
        y[i] = y[i] + p[0] * y[i] ** 2
    else:  # play between shaft and sensor
        r = 0.0
        for k, reading in enumerate(y[i]):
            r = min(max(r, reading - p[0]), reading + p[0])
            y[i, k] = r
    return y


def run(plant: Plant, w: Array, hidden: tuple[Hidden, ...]) -> tuple[Array, Array]:
    """Outputs (n_y, N) and states (N, n) of the plant with what is hidden, inputs (n_w, N) held."""
    steps, before = _STEPS[0], None
    while True:
        y, x = _run(plant, w, hidden, steps)
        if not np.isfinite(y).all() or np.abs(y).max() > 1e9:
            raise NoRecordError("the plant with this effect runs away")
        if before is not None and (np.abs(y - before).max(axis=1) < _EXACT * y.std(axis=1)).all():
            return y, x
        before, steps = y, 2 * steps
        if steps > _STEPS[1]:
            raise NoRecordError("the effect is too stiff for these steps")


def _run(plant: Plant, w: Array, hidden: tuple[Hidden, ...], steps: int) -> tuple[Array, Array]:
    n, h = len(plant.A), plant.dt / steps
    A, B = plant.A, plant.B
    fine = np.repeat(w.T, steps, axis=0)
    for one in hidden:
        if one.kind == "input_lag":
            j, T = one.place[1], one.p[0]
            A = np.block([[A, B[:, [j]]], [np.zeros((1, n)), -np.eye(1) / T]])
            B = np.vstack([B, np.eye(len(w))[j] / T])
            B[:n, j] = 0.0
        elif isinstance(one.place, tuple) and one.place[0] == "input":
            fine = _actuated(fine, one, h)
    ported = [one for one in hidden if isinstance(one.place, Site)]
    N = len(A)

    def rows(of: list[Any], size: int) -> Array:
        found = np.zeros((max(len(of), 1), size))
        for row, values in zip(found, of, strict=False):
            if values is not None:
                row[: len(values)] = values
        return found

    x = _roll(
        A, B, fine, rows([s.place.act for s in ported], N), rows([s.place.d for s in ported], N),
        rows([s.place.v for s in ported], N), rows([s.place.into for s in ported], len(w)),
        np.array([CODES[s.code] for s in ported] or [0]), np.array([s.p for s in ported] or [[0.0] * 4]),
        h, steps,
    )[:, :n]  # fmt: skip
    y = plant.C @ x.T
    for one in hidden:
        if isinstance(one.place, str) or (isinstance(one.place, tuple) and one.place[0] == "output"):
            y = _sensed(y, one, x)
    return y, x


# ------------------------------------------------------------------ sizes
def sized(kind: str, place: Any, strange: Strange | None, s: float, seen: Mapping[str, Any]) -> Hidden:
    """An effect of a size s about 1, by the motion and the input that the linear plant shows."""
    if not isinstance(place, Site):
        return _channel(kind, place, strange, s, seen)
    code = kind if strange is None else strange.code
    d, v = seen["d"], seen["v"]
    sd, sv, width = d.std() or 1.0, v.std() or 1.0, 3e-3 * (v.std() or 1.0)
    shape: dict[str, tuple[float, float, float]] = {
        "coulomb_friction": (width, 0.0, 0.0),
        "clearance": (0.7 * sd, 0.0, 0.0),
        "end_stop": (0.8 * sd, 0.0, 0.0),
        "stribeck": (1.6, 0.3 * sv, width),
        "threshold_flow": (v.mean() + 0.2 * sv, 0.0, 0.0),
        "bouc-wen": (0.4 * sd, 0.0, 0.0),
        "diode": (0.7 * sv, 0.0, 0.0),
        "belt": (0.8 * sv, 0.5 * sv, width),
        "radiation": (6.0 * np.abs(v).max(), 0.0, 0.0),
    }
    code = {"stribeck_friction": "stribeck"}.get(code, code)
    a, b, c = shape.get(code, (1.0, 0.0, 0.0))
    alone = seen["force"](CODES[code], np.array([1.0, a, b, c]))
    f = s * 0.1 * seen["rate"] / (alone or 1.0)
    f *= float(strange is None or strange.kind not in _NEGATIVE) * 2 - 1
    coefficients: dict[str, tuple[float, Any]] = {
        "coulomb_friction": {"force": (f, 0)},
        "quadratic_damping": {"quadratic_damping": (f, 2)},
        "cubic_stiffness": {"cubic_stiffness": (f, 3)},
        "stiffness": {"stiffness": (f, 1)},
        "damping": {"damping": (f, 1)},
        "clearance": {"stiffness": (f, 1), "gap": (a, None)},
        "end_stop": {"stiffness": (f, 1), "position": (a, None)},
        "stribeck_friction": {"coulomb_force": (f, 0), "static_force": (a * f, 0), "velocity": (b, None)},
        "sqrt_flow": {"flow": (f, 0.5)},
        "threshold_flow": {"flow": (f, 1), "threshold": (a, None)},
    }.get(kind, {})
    return Hidden(kind, place, code, (f, a, b, c), coefficients, strange)


_NEGATIVE = ("gain falls with the state", "moment of both states")
_NUMBER = {
    "input_saturation": "limit", "input_deadzone": "threshold", "input_delay": "delay",
    "input_lag": "time_constant", "output_saturation": "limit", "output_curvature": "curvature",
    "coefficient": "value",
}  # fmt: skip
LINEAR = ("stiffness", "damping")


def _channel(kind: str, place: Any, strange: Strange | None, s: float, seen: Mapping[str, Any]) -> Hidden:
    u, y, dt = seen["u"], seen["y"], seen["dt"]
    value = {
        "input_saturation": np.abs(u).max() / (1.0 + 0.3 * s),
        "input_deadzone": min(0.2 * s, 1.0) * u.std(),
        "input_delay": max(round(8.0 * s) / 8.0, 0.125) * dt,
        "input_lag": s * dt,
        "output_saturation": np.abs(y).max() / (1.0 + 0.3 * s),
        "output_curvature": 0.1 * s / y.std(),
        "coefficient": 0.1 * s * y.std() / seen["x"].std(axis=0)[0],
        "rate limit": np.abs(np.diff(u)).max() / (s * dt),
        "play at the sensor": 0.1 * s * y.std(),
    }[kind]  # fmt: skip
    numbers = {_NUMBER[kind]: (float(value), None)} if kind in _NUMBER else {}
    return Hidden(kind, place, "none", (float(value), 0.0, 0.0, 0.0), numbers, strange)


# ------------------------------------------------------------------ records
@dataclass(frozen=True)
class Coursework:
    """A record, the model handed over, the one with exact numbers, and what the record hides."""

    name: str
    role: str
    model: Any
    exact: Any
    plain: bool
    off: bool
    data: rco.Measurement
    test: rco.Measurement
    hidden: tuple[Hidden, ...]
    loss: float
    noise: Array
    drive: str
    bits: int
    share: float


def drive(rng: np.random.Generator, kind: str, samples: int) -> Array:
    """Input of zero mean and unit rms, (N,)."""
    if kind == "prbs":
        hold = int(rng.integers(4, 12))
        w = np.repeat(rng.choice([-1.0, 1.0], samples // hold + 1), hold)[:samples]
    elif kind == "steps":
        hold = int(rng.integers(20, 60))
        w = np.repeat(rng.uniform(-1, 1, samples // hold + 1), hold)[:samples]
    elif kind == "chirp":
        k = np.arange(samples)
        w = chirp(k, 2e-3, samples, 0.1, method="logarithmic") * (0.4 + 0.6 * k / samples)
    else:
        period = samples // 3
        tones = np.unique(np.geomspace(1, period // 10, 25).astype(int))
        phases = rng.uniform(0, 2 * np.pi, tones.size)
        w = np.sin(2 * np.pi * np.outer(np.arange(samples), tones) / period + phases).sum(axis=1)
    w = w - w.mean()
    return w / w.std()


def coursework(seed: int) -> Coursework:
    """Record number `seed`: any 40 in a row have the composition of `ROLES`."""
    at = 7 * seed % len(ROLES)
    role, plain, off = ROLES[at], at % 2 == 0, at // 2 % 2 == 1
    for attempt in range(60):
        rng = np.random.default_rng([seed, attempt, 51])
        try:
            return _drawn(rng, role, plain, off and role in ("nothing", "one"))
        except NoRecordError:
            continue
    raise NoRecordError(f"no draw of seed {seed} shows its effect")


def _drawn(rng: np.random.Generator, role: str, plain: bool, off: bool) -> Coursework:
    name = str(rng.choice(list(PLANTS)))
    make, bounds = PLANTS[name]
    values = {key: float(rng.uniform(low, high)) for key, (low, high) in bounds.items()}
    plant = make(**values)
    if (not plain and plant.builder is None) or (role == "outside" and not plant.strange):
        raise NoRecordError(f"{name} does not fit")
    shifted = {
        key: value * (1 + (rng.choice([-1, 1]) * rng.uniform(0.1, 0.2) if off else 0.0))
        for key, value in values.items()
    }
    noise, samples = float(np.exp(rng.uniform(np.log(0.005), np.log(0.03)))), int(rng.integers(1200, 3001))
    chosen = _choice(rng, plant, role)
    kinds = [kind for kind, _, _ in chosen]
    curved = any(kind.startswith(("input_s", "input_d")) or "gain" in kind for kind in kinds)
    how = str(rng.choice(DRIVES[1:] if curved else DRIVES))  # two levels show no curve
    scales = list(zip(plant.lift, plant.size, strict=True))
    w, other = (np.array([lift + size * drive(rng, how, samples) for lift, size in scales]) for _ in range(2))
    y0, x0 = run(plant, w, ())
    goal = max(float(np.exp(rng.uniform(np.log(0.04), np.log(0.2)))), 1.3 * SHOWN * noise)
    hidden = tuple(_of_size(plant, w, y0, x0, one, goal) for one in chosen)
    y, _ = run(plant, w, hidden)
    level = noise * y.std(axis=1, keepdims=True)
    for i in range(len(hidden)):  # without any of them the record is missed
        without, _ = run(plant, w, hidden[:i] + hidden[i + 1 :])
        if (np.sqrt(((y - without) ** 2).mean(axis=1)) < SHOWN * level[:, 0]).all():
            raise NoRecordError("an effect does not show")
    bits = int(rng.integers(8, 13)) if rng.random() < 0.5 else 0
    data, _ = _shown(rng, w, y, level, bits, plant.dt)
    test, error = _shown(rng, other, run(plant, other, hidden)[0], level, bits, plant.dt)
    loss = float((np.sqrt(((y - y0) ** 2).mean(axis=1)) / y.std(axis=1)).max())
    models = make(**shifted).model(plain), plant.model(plain)
    return Coursework(name, role, *models, plain, off, data, test, hidden, loss, error, how, bits, noise)


def _shown(
    rng: np.random.Generator, w: Array, y: Array, level: Array, bits: int, dt: float
) -> tuple[rco.Measurement, Array]:
    """A record behind its sensors, and their error, (n_y,)."""
    read = y + level * rng.standard_normal(y.shape)
    if bits:
        step = 6 * y.std(axis=1, keepdims=True) / 2**bits
        read = step * np.round(read / step)
    return rco.Measurement(w, read, dt=dt, hold="zoh"), np.sqrt(((read - y) ** 2).mean(axis=1))


def _choice(rng: np.random.Generator, plant: Plant, role: str) -> list[tuple[str, Any, Strange | None]]:
    """Kinds and places of what is hidden."""
    if role == "nothing":
        return []
    if role == "outside":
        one = plant.strange[int(rng.integers(len(plant.strange)))]
        place: Any = one.site or ("input" if one.kind == "rate limit" else "output", 0)
        return [(one.kind, place, one)]
    every: list[tuple[str, Any, Strange | None]] = [(k, s, None) for s in plant.sites for k in s.laws]
    for kind in plant.channels:
        where = ("output", len(plant.outputs) - 1) if kind.startswith("output") else ("input", 0)
        every.append((kind, "C[0,0]" if kind == "coefficient" else where, None))
    first = every[int(rng.integers(len(every)))]
    if role == "one":
        return [first]
    rest = [one for one in every if one[1] is not first[1] and one[0] != first[0] and one[0] not in LINEAR]
    if first[0] in LINEAR or not rest:
        raise NoRecordError("no second effect")
    return [first, rest[int(rng.integers(len(rest)))]]


def _of_size(
    plant: Plant, w: Array, y0: Array, x0: Array, one: tuple[str, Any, Strange | None], goal: float
) -> Hidden:
    """The effect at which the linear plant loses the goal."""
    kind, place, strange = one
    zero = np.zeros(len(x0))
    seen: dict[str, Any] = {"u": w[0], "y": y0[-1], "x": x0, "dt": plant.dt}
    if isinstance(place, Site):
        d = zero if place.d is None else x0 @ place.d
        v = x0 @ place.v + (0.0 if place.into is None else place.into @ w)
        rates = (x0 @ plant.A.T + w.T @ plant.B.T) @ place.act / (place.act @ place.act)
        inner = np.zeros(2)

        def force(code: int, p: Array) -> float:
            memory = np.full(2, 0.3 * p[1])
            return float(np.std([_law(code, p, *pair, memory, inner) for pair in zip(d, v, strict=True)]))

        seen |= {"d": d, "v": v, "rate": rates.std(), "force": force}
    size = 1.0
    for _ in range(14):
        hidden = sized(kind, place, strange, size, seen)
        try:
            y, _ = run(plant, w, (hidden,))
        except NoRecordError:
            size *= 0.3
            continue
        reached = float((np.sqrt(((y - y0) ** 2).mean(axis=1)) / y.std(axis=1)).max())
        if 0.75 < reached / goal < 1.33:
            return hidden
        size *= float(np.clip((goal / max(reached, 1e-9)) ** 0.9, 0.1, 10))
    raise NoRecordError("the effect does not reach its size")


# ------------------------------------------------------------------ plants
def unit(n: int, **entries: float) -> Array:
    """A row by its entries, ``_0=1.0``."""
    e = np.zeros(n)
    for key, value in entries.items():
        e[int(key[1:])] = value
    return e


SPEED = ("coulomb_friction", "quadratic_damping")
SUSPENSION = (*SPEED, "cubic_stiffness", "clearance", "end_stop", "stiffness")
PLAY = Strange("play at the sensor", "none", None, (("output_play", ""),))


def falling(site: Site, entry: str) -> Strange:
    """Gain of an input that falls with the state."""
    return Strange("gain falls with the state", "product", site, (("state_dependent_gain", entry),))


STORE = (("state_dependent_store", ""),)


def swelling(site: Site) -> Strange:
    """An inductance that falls with the square of the current; at the port of the coil."""
    port = Site(-site.act, site.act)
    return Strange("inductance of the current", "square product", site, STORE, port)


def deflected(site: Site) -> Strange:
    """A damper that grows with the square of the deflection."""
    return Strange("damper of the deflection", "square product", site)


DIODE = (("exponential_loss", ""),)
RATE = Strange("rate limit", "none", None, (("input_rate_limit", ""),))


def dc_position(R, L, K, J, b):
    """Angle of a motor under a voltage: nothing holds it."""
    A = np.array([[0, 1.0, 0], [0, -b / J, K / J], [0, -K / L, -R / L]])
    shaft = Site(unit(3, _1=-1 / J), unit(3, _1=1.0), unit(3, _0=1.0), (*SPEED, "stribeck_friction"))
    return Plant(
        A, unit(3, _2=1 / L)[:, None], unit(3, _0=1.0)[None], ("angle", "speed", "current"), ("voltage",),
        ("angle",), (shaft,), 0.01, strange=(PLAY, RATE), size=(6.0,),
        builder=lambda: rco.dc_motor(R=R, L=L, Kt=K, J=J, b=b, sensors="angle"),
    )  # fmt: skip


def dc_speed(R, L, K, J, b):
    """Speed of a motor; its field may follow the current, its inductance saturate."""
    A = np.array([[-b / J, K / J], [-K / L, -R / L]])
    shaft = Site(unit(2, _0=-1 / J), unit(2, _0=1.0), None, SPEED)
    store = Site(unit(2, _1=1.0), A[1], unit(2, _1=1.0), into=np.array([1 / L]))
    return Plant(
        A, unit(2, _1=1 / L)[:, None], unit(2, _0=1.0)[None], ("speed", "current"), ("voltage",), ("speed",),
        (shaft,), 0.005, size=(6.0,),
        strange=(swelling(store),
                 RATE),
        builder=lambda: rco.dc_motor(R=R, L=L, Kt=K, J=J, b=b),
    )  # fmt: skip


def car(ms, mu, k, c, kt):
    """Quarter car on the speed of the road."""
    A = np.array(
        [
            [0, 0, 1.0, -1.0],
            [0, 0, 0, 1.0],
            [-k / ms, 0, -c / ms, c / ms],
            [k / mu, -kt / mu, c / mu, -c / mu],
        ]
    )
    strut = unit(4, _2=-1 / ms, _3=1 / mu), unit(4, _2=1.0, _3=-1.0), unit(4, _0=1.0)
    return Plant(
        A, unit(4, _1=-1.0)[:, None], np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]]),
        ("suspension", "tire", "body_velocity", "wheel_velocity"), ("road",), ("deflection", "speed"),
        (Site(*strut, SUSPENSION),), 0.006, channels=(), size=(0.5,),
        strange=(Strange("bouc-wen", "bouc-wen", Site(*strut)),
                 deflected(Site(*strut))),
        builder=lambda: rco.quarter_car(ms, mu, k, c, kt, sensors=("suspension_deflection", "body_velocity")),
    )  # fmt: skip


def servo(J1, J2, b1, k, c):
    """Two inertias on a soft shaft, both speeds measured."""
    M, D = np.diag([J1, J2]), np.array([[b1 + c, -c], [-c, c]])
    K = k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    act = unit(4, _2=-1 / J1, _3=1 / J2)
    shaft = Site(act, unit(4, _2=1.0, _3=-1.0), unit(4, _0=1.0, _1=-1.0), ("clearance", "cubic_stiffness"))
    motor = Site(unit(4, _2=-1 / J1), unit(4, _2=1.0), unit(4, _0=1.0), (*SPEED, "stribeck_friction"))
    load = Site(unit(4, _3=-1 / J2), unit(4, _3=1.0), unit(4, _1=1.0), SPEED)
    return Plant(
        A, unit(4, _2=1 / J1)[:, None], np.eye(4)[2:], ("phi1", "phi2", "omega1", "omega2"), ("torque",),
        ("speed1", "speed2"), (shaft, motor, load), 0.01, size=(0.3,),
        strange=(Strange("bouc-wen", "bouc-wen", Site(act, shaft.v, shaft.d)),),
        builder=lambda: rco.mechanical(M, D, K, sensors=[("velocity", 1), ("velocity", 2)],
                                       position_unit="rad", force_unit="N m"),
    )  # fmt: skip


def rlc(R, L, C):
    """Series circuit, its current measured."""
    A = np.array([[0, 1.0], [-1 / (L * C), -R / L]])
    act, i, q = unit(2, _1=-1 / L), unit(2, _1=1.0), unit(2, _0=1.0)
    store = Site(unit(2, _1=1.0), A[1], i, into=np.array([1 / L]))
    return Plant(
        A, unit(2, _1=1 / L)[:, None], i[None], ("charge", "current"), ("voltage",), ("current",),
        (Site(act, i, q, (*SPEED, "cubic_stiffness")),), 0.01, size=(5.0,),
        strange=(Strange("diode", "diode", Site(act, i), DIODE),
                 swelling(store)),
        builder=lambda: rco.series_rlc(R, L, C, sensors="current"),
    )  # fmt: skip


def coil(R, L):
    """A coil: current under a voltage."""
    A, one = np.array([[-R / L]]), np.ones(1)
    store = Site(one, A[0], one, into=np.array([1 / L]))
    return Plant(
        A, np.array([[1 / L]]), np.eye(1), ("current",), ("voltage",), ("i",),
        (Site(-one / L, one, None, (*SPEED, "damping")),), 0.004, size=(5.0,),
        strange=(swelling(store),
                 Strange("diode", "diode", Site(-one / L, one), DIODE)),
    )  # fmt: skip


def tanks(A1, A2, k1, k2):
    """Two tanks, one behind the other, levels from empty."""
    A = np.array([[-k1 / A1, 0], [k1 / A2, -k2 / A2]])
    h1, h2 = np.eye(2)
    through = Site(unit(2, _0=-1 / A1, _1=1 / A2), h1, None, ("sqrt_flow",))
    laws = ("sqrt_flow", "threshold_flow", "quadratic_damping")
    cone = Site(h2, A[1], h2)
    pump = Site(unit(2, _0=1 / A1), np.zeros(2), h1, into=np.ones(1))
    return Plant(
        A, unit(2, _0=1 / A1)[:, None], np.eye(2), ("level1", "level2"), ("pump",), ("y1", "y2"),
        (through, Site(-h2 / A2, h2, None, laws)), 2.0, lift=(4.0,),
        channels=("input_delay", "input_lag"),
        strange=(falling(pump, "B[0,0]"),
                 Strange("area of the level", "product", cone, STORE, Site(-h2, h2))),
        builder=lambda: rco.two_tanks([A1, A2], [k1, k2], sensors=[1, 2]),
    )  # fmt: skip


def house(C1, C2, R1, R2):
    """Air and walls of a house against the surroundings, which are at zero."""
    A = np.array([[-1 / (R1 * C1), 1 / (R1 * C1)], [1 / (R1 * C2), -(1 / R1 + 1 / R2) / C2]])
    air, wall = np.eye(2)
    between = Site(unit(2, _0=-1 / C1, _1=1 / C2), unit(2, _0=1.0, _1=-1.0), None, ("quadratic_damping",))
    heater = Site(unit(2, _0=1 / C1), np.zeros(2), air, into=np.ones(1))
    return Plant(
        A, unit(2, _0=1 / C1)[:, None], np.eye(2), ("T_air", "T_wall"), ("heat",), ("air", "wall"),
        (between, Site(-air / C1, air, None, ("damping", "quadratic_damping"))), 300.0, lift=(2.0,),
        channels=("input_delay", "input_lag", "input_saturation"),
        strange=(falling(heater, "B[0,0]"),
                 Strange("radiation", "radiation", Site(-wall / C2, wall), (("radiation", ""),))),
        builder=lambda: rco.thermal_network([C1, C2], {(1, 2): R1, (2, 0): R2}, ambient_input=False),
    )  # fmt: skip


def buck(L, C, R, V):
    """Averaged converter: duty to voltage; the capacitor may have a series resistance."""
    A = np.array([[0, -1 / L], [1 / C, -1 / (R * C)]])
    i, v = np.eye(2)
    source = Site(i / L, np.zeros(2), i, into=np.ones(1))
    return Plant(
        A, unit(2, _0=V / L)[:, None], v[None], ("iL", "vC"), ("duty",), ("v",),
        (Site(-i / L, i, None, ("coulomb_friction", "damping")),), 2e-5, size=(0.1,), lift=(0.0,),
        channels=("input_saturation", "input_delay", "coefficient", "coefficient", "output_saturation"),
        strange=(falling(source, "B[0,0]"),
                 Strange("diode", "diode", Site(-v / C, v), DIODE)),
    )  # fmt: skip


def cart(m, c, k):
    """A cart on a spring."""
    A = np.array([[0, 1.0], [-k / m, -c / m]])
    act, v, d = unit(2, _1=-1 / m), unit(2, _1=1.0), unit(2, _0=1.0)
    gain = Site(unit(2, _1=1 / m), np.zeros(2), d, into=np.ones(1))
    return Plant(
        A, unit(2, _1=1 / m)[:, None], d[None], ("position", "velocity"), ("force",), ("y",),
        (Site(act, v, d, (*SUSPENSION, "stribeck_friction")),), 0.03, size=(10.0,),
        strange=(Strange("bouc-wen", "bouc-wen", Site(act, v, d)), PLAY,
                 falling(gain, "B[1,0]")),
        builder=lambda: rco.mass_spring_damper([m], [c], [k]),
    )  # fmt: skip


def belt(m, c, k):
    """A mass on a spring and a belt that runs below."""
    made = cart(m, c, k)
    site = made.sites[0]
    rubbed = Site(site.act, site.v, site.d, ("coulomb_friction", "stribeck_friction", "cubic_stiffness"))
    alone = Site(site.act, site.v, site.d)
    return Plant(
        made.A, made.B, made.C, ("x", "v"), ("F",), ("x_mm",), (rubbed,), 0.025, size=(8.0,),
        strange=(Strange("belt", "belt", alone), deflected(alone)),
        builder=lambda: rco.mass_spring_damper([m], [c], [k]),
    )  # fmt: skip


def furuta(J, m, r, l, b1, b2, k):
    """Rotary pendulum that hangs, its arm held by a weak spring; small angles."""
    M = np.array([[J + m * r * r, m * r * l], [m * r * l, 4 / 3 * m * l * l]])
    D, K = np.diag([b1, b2]), np.diag([k, m * 9.81 * l])
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ K, -inverse @ D]])
    zero = np.zeros(2)
    arm = Site(np.r_[zero, -inverse[0]], unit(4, _2=1.0), unit(4, _0=1.0), SPEED)
    joint = Site(np.r_[zero, -inverse[1]], unit(4, _3=1.0), unit(4, _1=1.0), (*SPEED, "cubic_stiffness"))
    return Plant(
        A, np.r_[zero, inverse[0]][:, None], np.eye(4)[:2], ("theta", "alpha", "dtheta", "dalpha"), ("tau",),
        ("arm", "pendulum"), (arm, joint), 0.02, size=(0.02,),
        strange=(deflected(Site(joint.act, joint.v, joint.d)), PLAY),
        builder=lambda: rco.mechanical(M, D, K, links={"arm": (1, 0), "joint": (2, 0)}, position_unit="rad",
                                       force_unit="N m"),
    )  # fmt: skip


def exchanger(Ch, Cc, U, Wh, Wc):
    """Two streams; the inlet temperature of the hot one and the flow of the cold one are driven."""
    A = np.array([[-(U + Wh) / Ch, U / Ch], [U / Cc, -(U + Wc) / Cc]])
    hot, cold = np.eye(2)
    carried = Site(-cold / Cc, np.zeros(2), cold, into=np.array([0.0, 1.0]))
    return Plant(
        A, np.array([[Wh / Ch, 0], [0, -20.0 / Cc]]), np.eye(2), ("Th", "Tc"), ("T_in", "flow"),
        ("hot", "cold"),
        (Site(unit(2, _0=-1 / Ch, _1=1 / Cc), hot - cold, None, ("quadratic_damping", "damping")),), 0.7,
        channels=("input_delay", "input_lag", "input_saturation", "output_curvature"),
        lift=(0.0, 0.0), size=(5.0, 0.3),
        strange=(Strange("gain of the state", "product", carried, (("state_dependent_gain", "B[1,1]"),)),),
    )  # fmt: skip


def screw(m1, m2, k, c, b1, b2):
    """Ball screw: nut and table, both on guides, the table's position measured."""
    n1, n2 = unit(4, _2=1.0), unit(4, _3=1.0)
    A = np.array(
        [[0, 0, 1.0, 0], [0, 0, 0, 1.0], [-k / m1, k / m1, -(c + b1) / m1, c / m1],
         [k / m2, -k / m2, c / m2, -(c + b2) / m2]]
    )  # fmt: skip
    act, v, d = unit(4, _2=-1 / m1, _3=1 / m2), n1 - n2, unit(4, _0=1.0, _1=-1.0)
    guide = Site(unit(4, _3=-1 / m2), n2, unit(4, _1=1.0), (*SPEED, "stribeck_friction"))
    return Plant(
        A, unit(4, _2=1 / m1)[:, None], np.array([[0, 1.0, 0, 0], [0, 0, 1.0, 0]]),
        ("x_nut", "x_table", "v_nut", "v_table"), ("force",), ("table", "nut_speed"),
        (Site(act, v, d, ("clearance", "cubic_stiffness")), guide), 0.004, size=(20.0,),
        strange=(Strange("bouc-wen", "bouc-wen", Site(act, v, d)), RATE),
    )  # fmt: skip


def level(area, k, T):
    """A level behind a valve with a lag."""
    A = np.array([[-k / area, 1 / area], [0, -1 / T]])
    h, valve = np.eye(2)
    product = Site(h / area, valve, h)
    return Plant(
        A, unit(2, _1=1 / T)[:, None], np.eye(2)[:1], ("h", "q_valve"), ("command",), ("level",),
        (Site(-h / area, h, None, ("sqrt_flow", "threshold_flow", "quadratic_damping")),), 1.0, lift=(3.0,),
        channels=("input_delay", "input_saturation"),
        strange=(Strange("gain falls with the state", "product", product, (("product_of_states", "A[0,1]"),)),
                 RATE),
    )  # fmt: skip


def short_period(Za, Ma, Mq, Zd, Md):
    """Angle of attack and pitch rate of an aircraft under its elevator."""
    A, (alpha, q) = np.array([[-Za, 1.0], [-Ma, -Mq]]), np.eye(2)
    both = (("product_of_states", "A[1,0]"),)
    elevator = Site(-Md * q, np.zeros(2), q, into=np.ones(1))
    return Plant(
        A, np.array([[-Zd], [-Md]]), np.eye(2), ("alpha", "q"), ("elevator",), ("y_alpha", "y_q"),
        (Site(-q, q, None, ("damping", "quadratic_damping")),), 0.05, size=(0.05,),
        strange=(Strange("moment of both states", "product", Site(-q, alpha, q), both),
                 falling(elevator, "B[1,0]"),
                 Strange("cubic moment", "cubic_stiffness", Site(-q, alpha, alpha))),
    )  # fmt: skip


MOTOR = {"R": (0.8, 2.0), "L": (0.01, 0.03), "K": (0.05, 0.12), "J": (3e-4, 1e-3), "b": (2e-4, 1e-3)}
CART = {"m": (0.6, 1.8), "c": (0.4, 1.5), "k": (40.0, 120.0)}
PLANTS: dict[str, tuple[Callable[..., Plant], dict[str, tuple[float, float]]]] = {
    "motor position": (dc_position, MOTOR),
    "motor speed": (dc_speed, MOTOR),
    "quarter car": (car, {"ms": (250, 400), "mu": (30, 50), "k": (12e3, 2e4), "c": (700, 1500),
                          "kt": (1.3e5, 2e5)}),
    "two-mass servo": (servo, {"J1": (0.002, 0.006), "J2": (0.003, 0.01), "b1": (0.01, 0.03), "k": (2.0, 6.0),
                               "c": (0.003, 0.01)}),
    "RLC": (rlc, {"R": (0.8, 2.0), "L": (0.1, 0.3), "C": (0.004, 0.02)}),
    "coil": (coil, {"R": (1.0, 3.0), "L": (0.03, 0.15)}),
    "tank pair": (tanks, {"A1": (2.0, 4.0), "A2": (2.0, 4.0), "k1": (0.1, 0.3), "k2": (0.1, 0.3)}),
    "house": (house, {"C1": (800.0, 1500.0), "C2": (8e3, 2e4), "R1": (0.5, 1.5), "R2": (2.0, 5.0)}),
    "buck": (buck, {"L": (1e-4, 3e-4), "C": (5e-5, 2e-4), "R": (2.0, 6.0), "V": (12.0, 24.0)}),
    "cart": (cart, CART),
    "rotary pendulum": (furuta, {"J": (1e-3, 3e-3), "m": (0.1, 0.2), "r": (0.1, 0.2), "l": (0.1, 0.2),
                                 "b1": (5e-3, 1e-2), "b2": (3e-4, 1e-3), "k": (0.05, 0.15)}),
    "heat exchanger": (exchanger, {"Ch": (30, 80), "Cc": (30, 80), "U": (1.0, 3.0), "Wh": (2.0, 5.0),
                                   "Wc": (2.0, 5.0)}),
    "ball screw": (screw, {"m1": (3.0, 8.0), "m2": (10.0, 25.0), "k": (4e4, 1e5), "c": (50, 150),
                           "b1": (20.0, 60.0), "b2": (40.0, 120.0)}),
    "level and valve": (level, {"area": (1.0, 3.0), "k": (0.1, 0.3), "T": (2.0, 5.0)}),
    "mass on a belt": (belt, CART),
    "short period": (short_period, {"Za": (0.5, 1.2), "Ma": (3.0, 8.0), "Mq": (0.8, 2.0), "Zd": (0.05, 0.2),
                                    "Md": (4.0, 9.0)}),
}  # fmt: skip
