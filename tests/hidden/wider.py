"""Records off the chains: plants that people bring as a plain `StateSpace`, laws no library has, odd inputs.

Each plant is written out from its physics; where a law acts is a direction in its states, so that a name is
judged by the place it means and not by what it is called.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import control as ct
import numpy as np
from scipy.linalg import block_diag
from scipy.signal import chirp, lfilter

import rcorefine as rco

from .generator import linear_states
from .integrator import LAWS, MEMORY, force_of, march
from .plants import Array

SPRINGS = ("stiffness", "cubic_stiffness", "bilinear_stiffness", "clearance")
DAMPERS = ("damping", "coulomb_friction", "quadratic_damping")
FLOWS = ("damping", "quadratic_damping", "cubic_damping")
OUTSIDE = (
    "smooth friction", "v^1.5", "sqrt v", "soft dead zone", "lugre", "bouc-wen", "sine", "quintic",
    "impact damper", "backlash", "valve", "soft saturation", "inverse square", "ramp", "radiation",
)  # fmt: skip
STATIC = ("smooth friction", "v^1.5", "sqrt v", "soft dead zone", "sine", "quintic", "impact damper", "valve",
          "soft saturation", "inverse square", "radiation")  # fmt: skip
DRIVES = ("steady", "steps", "hammer", "sweep", "prbs", "multisine")


@dataclass(frozen=True)
class Site:
    """A direction in the states where a law acts; `d` is None where there is no displacement."""

    name: str
    d: Array | None
    v: Array
    act: Array
    laws: tuple[str, ...]


@dataclass(frozen=True)
class Plant:
    """Matrices, state names, sites and sampling time of a plant."""

    name: str
    A: Array
    B: Array
    C: Array
    states: tuple[str, ...]
    sites: tuple[Site, ...]
    dt: float
    lift: float = 0.0

    @property
    def model(self) -> ct.StateSpace:
        """What a user brings."""
        n_y, n_w = self.C.shape[0], self.B.shape[1]
        return ct.ss(
            self.A, self.B, self.C, np.zeros((n_y, n_w)), states=list(self.states),
            inputs=[f"u{i + 1}" for i in range(n_w)], outputs=[f"y{i + 1}" for i in range(n_y)],
        )  # fmt: skip


@dataclass(frozen=True)
class Wider:
    """A record, the truth in it, and the outputs without noise."""

    plant: Plant
    data: rco.Measurement
    test: rco.Measurement
    site: Site | None
    kind: str | None
    loss: float
    noise: float

    def at_truth(self, place: str, model: object) -> bool:
        """Whether a place of the model is the direction where the law acts."""
        if self.site is None:
            return False
        for port in rco.ports(model):
            if port.name == place:
                return _parallel(port.act, self.site.act) and _parallel(
                    port.velocity if self.site.d is None else port.position,
                    self.site.v if self.site.d is None else self.site.d,
                )
        return False


def _parallel(a: Array, b: Array) -> bool:
    size = np.linalg.norm(a) * np.linalg.norm(b)
    return bool(size > 0 and abs(a @ b) > 0.9999 * size)


# ------------------------------------------------------------------ plants
def second_order(
    name: str,
    M: Array,
    links: dict[str, tuple[Array, float, float]],
    force: Array,
    senses: Array,
    points: float = 12.0,
    laws: tuple[str, ...] = (*SPRINGS, *DAMPERS),
    ground: float = 0.0,
) -> Plant:
    """Masses and links: each a direction, a stiffness and a damping."""
    n = M.shape[0]
    inverse = np.linalg.inv(M)
    K = sum(k * np.outer(e, e) for e, k, _ in links.values()) + ground * np.eye(n)
    D = sum(c * np.outer(e, e) for e, _, c in links.values()) + 0.0 * np.eye(n)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ K, -inverse @ D]])
    zero = np.zeros(n)
    sites = tuple(
        Site(key, np.r_[e, zero], np.r_[zero, e], np.r_[zero, -inverse @ e], laws)
        for key, (e, _, _) in links.items()
    )
    B = np.r_[zero, inverse @ force][:, None]
    C = np.hstack([senses, np.zeros_like(senses)])
    fast = np.abs(np.linalg.eigvals(A)).max() / (2 * np.pi)
    states = tuple([f"q{i + 1}" for i in range(n)] + [f"s{i + 1}" for i in range(n)])
    return Plant(name, A, B, C, states, sites, 1 / (points * fast))


def unit(n: int, *ends: tuple[int, float]) -> Array:
    """A direction by its entries."""
    e = np.zeros(n)
    for i, value in ends:
        e[i] = value
    return e


def servo(rng: np.random.Generator) -> Plant:
    """Angle of a motor: nothing holds it."""
    J, b = rng.uniform(0.005, 0.02), rng.uniform(0.03, 0.1)
    A, B = np.array([[0, 1.0], [0, -b / J]]), np.array([[0.0], [0.1 / J]])
    site = Site("shaft", None, np.array([0, 1.0]), np.array([0, -1 / J]), DAMPERS)
    return Plant("servo", A, B, np.array([[1.0, 0]]), ("angle", "speed"), (site,), 0.08 * J / b)


def motor(rng: np.random.Generator) -> Plant:
    """Speed of a motor, with the current."""
    R, L, K, J, b = rng.uniform([1, 2e-3, 0.04, 1e-4, 5e-5], [3, 8e-3, 0.08, 3e-4, 2e-4])
    A, B = np.array([[-b / J, K / J], [-K / L, -R / L]]), np.array([[0.0], [1 / L]])
    shaft = Site("shaft", None, np.array([1.0, 0]), np.array([-1 / J, 0]), DAMPERS)
    return Plant("motor", A, B, np.array([[1.0, 0]]), ("speed", "current"), (shaft,), 1.5e-3)


def gear(rng: np.random.Generator) -> Plant:
    """Two inertias over a gear and an elastic shaft."""
    N, J1, J2 = rng.uniform(3, 8), rng.uniform(0.002, 0.006), rng.uniform(0.05, 0.15)
    k = rng.uniform(10, 30)
    links = {
        "shaft": (np.array([1 / N, -1.0]), k, 0.01 * np.sqrt(k * J2)),
        "motor bearing": (np.array([1.0, 0]), 0.0, 0.01),
        "load bearing": (np.array([0, 1.0]), 0.5 * k, 0.01 * np.sqrt(k * J2)),
    }
    plant = second_order(
        "geared drive", np.diag([J1, J2]), links, np.array([1.0, 0]), np.array([[1.0, 0]]), 20
    )
    sites = (plant.sites[0], *(replace(s, laws=DAMPERS) for s in plant.sites[1:]))
    return replace(plant, sites=sites)


def half_car(rng: np.random.Generator) -> Plant:
    """Bounce and pitch of a body on two suspensions."""
    m, J = rng.uniform(500, 800), rng.uniform(700, 1300)
    a, b = rng.uniform(0.9, 1.2), rng.uniform(1.3, 1.7)
    k = rng.uniform(15e3, 25e3, 2)
    c = rng.uniform(600, 1200, 2)
    links = {
        "front": (np.array([1.0, -a]), k[0], c[0]),
        "rear": (np.array([1.0, b]), k[1], c[1]),
    }
    return second_order(
        "half car",
        np.diag([m, J]),
        links,
        1e3 * np.array([1.0, -0.4 * a]),
        np.array([[1.0, 0], [0, 1.0]]),
        20,
    )


def truss(rng: np.random.Generator) -> Plant:
    """Twelve bars in a plane, on two fixed joints."""
    joints = np.array([[0, 0], [0, 1], [1, 0], [1, 1], [2, 0], [2, 1], [3, 0.5]], float)
    bars = [(0, 2), (1, 3), (0, 3), (1, 2), (2, 3), (2, 4), (3, 5), (2, 5), (3, 4), (4, 5), (4, 6), (5, 6)]
    free = {j: i for i, j in enumerate(range(2, 7))}
    n = 2 * len(free)
    links = {}
    for i, j in bars:
        along = joints[j] - joints[i]
        along = along / np.linalg.norm(along)
        e = np.zeros(n)
        for joint, sign in ((i, -1.0), (j, 1.0)):
            if joint in free:
                e[2 * free[joint] : 2 * free[joint] + 2] += sign * along
        k = rng.uniform(800, 1500)
        links[f"bar {i}-{j}"] = (e, k, 0.002 * k / 10)
    senses = np.zeros((2, n))
    senses[0, n - 1] = senses[1, 2] = 1.0
    return second_order(
        "truss", np.diag(rng.uniform(0.8, 1.2, n // 2).repeat(2)), links, unit(n, (n - 1, 1.0)), senses, 8,
        laws=SPRINGS,
    )  # fmt: skip


def beam(rng: np.random.Generator) -> Plant:
    """A cantilever of three elements, a spring and a damper at its tip."""
    EI, mass, h, n = rng.uniform(3, 6), rng.uniform(0.3, 0.6), 0.4, 3
    size = 2 * (n + 1)
    K, M = np.zeros((size, size)), np.zeros((size, size))
    ke = EI / h**3 * np.array(
        [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2], [-12, -6 * h, 12, -6 * h],
         [6 * h, 2 * h**2, -6 * h, 4 * h**2]]
    )  # fmt: skip
    me = mass * h / 420 * np.array(
        [[156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2], [54, 13 * h, 156, -22 * h],
         [-13 * h, -3 * h**2, -22 * h, 4 * h**2]]
    )  # fmt: skip
    for i in range(n):
        at = slice(2 * i, 2 * i + 4)
        K[at, at] += ke
        M[at, at] += me
    K, M = K[2:, 2:], M[2:, 2:]
    m = K.shape[0]
    tip = unit(m, (m - 2, 1.0))
    K = K + 0.3 * K[m - 2, m - 2] * 0.02 * np.outer(tip, tip)
    inverse = np.linalg.inv(M)
    D = 2e-4 * K + 0.3 * M
    A = np.block([[np.zeros((m, m)), np.eye(m)], [-inverse @ K, -inverse @ D]])
    zero = np.zeros(m)
    site = Site("tip", np.r_[tip, zero], np.r_[zero, tip], np.r_[zero, -inverse @ tip], (*SPRINGS, *DAMPERS))
    senses = np.r_[tip, zero][None, :]
    slow = np.sort(np.abs(np.linalg.eigvals(A)))[2] / (2 * np.pi)
    states = tuple([f"q{i + 1}" for i in range(m)] + [f"s{i + 1}" for i in range(m)])
    return Plant("beam", A, np.r_[zero, inverse @ tip][:, None], senses, states, (site,), 1 / (14 * slow))


def modal_beam(rng: np.random.Generator) -> Plant:
    """Three modes of a beam; what may be off is a mode."""
    omega = rng.uniform(8, 12) * np.array([1, 2.8, 5.5])
    zeta = rng.uniform(0.01, 0.02, 3)
    A = block_diag(*[[[0, 1.0], [-(w**2), -2 * z * w]] for w, z in zip(omega, zeta, strict=True)])
    B = np.zeros((6, 1))
    B[1::2, 0] = rng.uniform(0.5, 1.5, 3)
    C = np.zeros((1, 6))
    C[0, ::2] = rng.uniform(0.5, 1.5, 3)
    sites = tuple(
        Site(f"mode {i + 1}", unit(6, (2 * i, 1.0)), unit(6, (2 * i + 1, 1.0)), unit(6, (2 * i + 1, -1.0)),
             ("stiffness", "damping"))
        for i in range(2)
    )  # fmt: skip
    states = tuple(f"{letter}{i + 1}" for i in range(3) for letter in ("eta", "etad"))
    return Plant("modal beam", A, B, C, states, sites, 2 * np.pi / (10 * omega[2]))


def rc_ladder(rng: np.random.Generator) -> Plant:
    """Three capacitors in a row, leaks to the ground."""
    R, C = rng.uniform(0.5, 2, 4), rng.uniform(0.5, 2, 3)
    A, sites = np.zeros((3, 3)), []
    for i in range(4):
        e = unit(3, *((j, s) for j, s in ((i - 1, 1.0), (i, -1.0)) if 0 <= j < 3))
        A -= np.outer(e / C, e) / R[i]
        if i:
            sites.append(Site(f"R{i + 1}", None, e, -e / C, FLOWS))
    B = unit(3, (0, 1 / (R[0] * C[0])))[:, None]
    return Plant("RC ladder", A, B, np.eye(3)[[1, 2]], ("v1", "v2", "v3"), tuple(sites), 0.1)


def lc_ladder(rng: np.random.Generator) -> Plant:
    """Two inductors and two capacitors, a load."""
    L, C, r = rng.uniform(0.5, 2, 2), rng.uniform(0.5, 2, 2), rng.uniform(0.05, 0.15, 2)
    load = rng.uniform(2, 5)
    A = np.array(
        [[-r[0] / L[0], 0, -1 / L[0], 0], [0, -r[1] / L[1], 1 / L[1], -1 / L[1]],
         [1 / C[0], -1 / C[0], 0, 0], [0, 1 / C[1], 0, -1 / (load * C[1])]]
    )  # fmt: skip
    sites = tuple(
        Site(f"L{i + 1}", None, unit(4, (i, 1.0)), unit(4, (i, -1 / L[i])), (*FLOWS, "coulomb_friction"))
        for i in range(2)
    )
    B = unit(4, (0, 1 / L[0]))[:, None]
    return Plant("LC ladder", A, B, np.eye(4)[[3]], ("i1", "i2", "v1", "v2"), sites, 0.25)


def thermal(rng: np.random.Generator) -> Plant:
    """Four rooms in a row, two of them against the surroundings."""
    c, g = rng.uniform(5, 20, 4), rng.uniform(0.5, 2, 3)
    A, sites = np.zeros((4, 4)), []
    links = {f"wall {i + 1}": (unit(4, (i, 1.0), (i + 1, -1.0)), g[i]) for i in range(3)}
    links |= {f"loss {i + 1}": (unit(4, (i, 1.0)), rng.uniform(0.2, 0.6)) for i in (1, 3)}
    for key, (e, gain) in links.items():
        A -= np.outer(e / c, e) * gain
        sites.append(Site(key, None, e, -e / c, FLOWS))
    B = unit(4, (0, 1 / c[0]))[:, None]
    return Plant("thermal", A, B, np.eye(4)[[0, 3]], ("T1", "T2", "T3", "T4"), tuple(sites), 1.0)


def tanks(rng: np.random.Generator) -> Plant:
    """Two tanks, one behind the other."""
    area, out = rng.uniform(1, 3, 2), rng.uniform(0.3, 0.8, 2)
    A = np.array([[-out[0] / area[0], 0], [out[0] / area[1], -out[1] / area[1]]])
    B = np.array([[1 / area[0]], [0.0]])
    site = Site("outlet", None, np.array([0, 1.0]), np.array([0, -1 / area[1]]), FLOWS)
    return Plant("tanks", A, B, np.array([[0, 1.0]]), ("h1", "h2"), (site,), 0.35, 4.0)


def pendulum(rng: np.random.Generator) -> Plant:
    """A pendulum about its lower rest."""
    m, l, b = rng.uniform(0.5, 1.5), rng.uniform(0.3, 1.0), 0.02
    J = m * l**2
    links = {"pivot": (np.array([1.0]), m * 9.81 * l, b)}
    return second_order("pendulum", np.array([[J]]), links, np.array([1.0]), np.array([[1.0]]), 20)


def chain(rng: np.random.Generator) -> Plant:
    """Two to four masses in a row."""
    n = int(rng.integers(2, 5))
    k, m = rng.uniform(120, 350, n), rng.uniform(0.6, 1.6, n)
    links = {
        f"link{i + 1}": (
            unit(n, (i, 1.0), *([(i - 1, -1.0)] if i else [])),
            k[i],
            2 * rng.uniform(0.008, 0.02) * np.sqrt(k[i] * m[i]),
        )
        for i in range(n)
    }
    place = int(rng.integers(n))
    return second_order(
        "chain", np.diag(m), links, unit(n, (int(rng.integers(n)), 1.0)), unit(n, (place, 1.0))[None]
    )


PLANTS: dict[str, Callable[[np.random.Generator], Plant]] = {
    "chain": chain,
    "servo": servo,
    "motor": motor,
    "geared drive": gear,
    "half car": half_car,
    "truss": truss,
    "beam": beam,
    "modal beam": modal_beam,
    "RC ladder": rc_ladder,
    "LC ladder": lc_ladder,
    "thermal": thermal,
    "tanks": tanks,
    "pendulum": pendulum,
}


# ------------------------------------------------------------------ records
def drive(rng: np.random.Generator, kind: str, samples: int) -> Array:
    """Input of unit rms, (N,)."""
    k = np.arange(samples)
    if kind == "steps":
        w = np.repeat(rng.uniform(-1, 1, samples // 40 + 1), 40)[:samples]
    elif kind == "prbs":
        w = np.repeat(rng.choice([-1.0, 1.0], samples // 4 + 1), 4)[:samples]
    elif kind == "hammer":
        w = np.zeros(samples)
        w[5 :: samples // 5] = rng.uniform(0.5, 1.5, w[5 :: samples // 5].size)
        w = lfilter(np.sin(np.pi * np.arange(1, 5) / 5), [1.0], w)
    elif kind == "sweep":
        w = chirp(k, 2e-3, samples, 0.2, method="logarithmic")
    elif kind == "multisine":
        period = samples // 5
        tones = np.arange(1, period // 6)
        phases = rng.uniform(0, 2 * np.pi, tones.size)
        w = np.sin(2 * np.pi * np.outer(k % period, tones) / period + phases).sum(axis=1)
    else:
        w = lfilter([1.0], [1.0, -0.6], rng.standard_normal(samples))
    return w / w.std()


def march_with(plant: Plant, w: Array, site: Site | None, code: str, p: Array) -> tuple[Array, Array]:
    """States (n, N) and the force (N,) of a law under inputs that are held."""
    n, N = plant.A.shape[0], w.shape[1]
    memory = MEMORY.get(code, 0)
    zero = np.zeros(n)
    at = site or Site("", None, zero, zero, ())
    size = np.abs(linear_states(plant, w)).max(axis=1)
    atol = 1e-8 * np.concatenate([np.where(size > 0, size, 1.0), np.full(memory, abs(p[1]) or 1.0)])
    sense = np.zeros(n) if at.d is None else at.d
    steer = np.ascontiguousarray((plant.B @ w).T)
    one = (at.act[None], sense[None], at.v[None], np.array([LAWS[code]]), p[None])
    x = march(plant.A, steer, *one, memory, plant.dt, 1e-8, atol, 3000 * N, True, np.zeros(len(atol))).T
    if not np.isfinite(x).all():
        raise FloatingPointError("the plant with this effect runs away")
    inner = np.zeros(2)
    force = [
        force_of(LAWS[code], p, k * plant.dt, sense @ x[:n, k], at.v @ x[:n, k], x[n:, k], inner)
        for k in range(N)
    ]
    return x[:n], np.array(force)


def detuned(plant: Plant, rng: np.random.Generator, share: float) -> Plant:
    """The plant with the linear law of every site off by a draw."""
    senses = [(s.act, sense) for s in plant.sites for sense in (s.d, s.v) if sense is not None]
    basis = np.array([np.outer(*pair).ravel() for pair in senses]).T
    rows = np.any([act != 0 for act, _ in senses], axis=0)
    sizes = np.linalg.lstsq(basis, (plant.A * rows[:, None]).ravel(), rcond=None)[0]
    change = basis @ (share * rng.standard_normal(sizes.size) * sizes)
    return replace(plant, A=plant.A + change.reshape(plant.A.shape))


def shape(kind: str, d: Array, v: Array, span: float) -> Array:
    """Parameters of a law beside its scale, by the motion that it meets; span in s."""
    at = {
        "coulomb_friction": 2e-3 * v.std(),
        "clearance": 0.6 * d.std(),
        "ramp": span,
        "smooth friction": 0.7 * v.std(),
        "v^1.5": 1.5,
        "sqrt v": 0.5,
        "soft dead zone": 0.7 * d.std(),
        "lugre": 0.05 * d.std(),
        "bouc-wen": 0.4 * d.std(),
        "sine": 0.5 * d.std(),
        "backlash": 0.5 * d.std(),
        "valve": 0.7 * v.std(),
        "soft saturation": 0.7 * d.std(),
        "inverse square": 3.0 * np.abs(d).max(),
        "radiation": 3.0 * np.abs(v).max(),
    }.get(kind, 0.0)
    return np.array([1.0, at, 0.0])


def wider_record(
    seed: int,
    *,
    plant: str = "chain",
    kind: str | None = "any",
    loss: float = 0.05,
    noise: float = 0.03,
    samples: int = 2500,
    drive_kind: str = "steady",
    off: float = 0.0,
    clock: float = 0.0,
    gain: float = 0.0,
    bits: int = 0,
    input_noise: float = 0.0,
    cut: int = 0,
) -> Wider:
    """A record of a plant that may hide a law, or whose numbers, clock or sensors may be off.

    Parameters
    ----------
    seed : int
        Draws everything.
    plant : str
        Key of `PLANTS`.
    kind : str or None
        "any" of those that make sense at the site, a law, or None for nothing.
    loss, noise : float
        Of the nominal model's free run; of the sensors, over the output.
    samples, drive_kind : int, str
        Length; one of `DRIVES`.
    off : float
        Relative sd of the stiffness and the damping of every site; the model keeps its numbers.
    clock, gain : float
        Relative error of the sampling time, of the first sensor.
    bits : int
        Quantization over six standard deviations, 0 for none.
    input_noise : float
        Noise on the recorded input, over its rms.
    cut : int
        Samples that are cut off at the beginning: the record starts in motion.
    """
    rng = np.random.default_rng([seed, sum(map(ord, plant)), 91])
    made = PLANTS[plant](rng)
    true = detuned(made, rng, off) if off else made
    site = made.sites[int(rng.integers(len(made.sites)))]
    if kind == "any":
        kind = str(rng.choice(site.laws))
    whole = samples + cut
    w = (drive(rng, drive_kind, whole) + made.lift)[None]
    test = (drive(rng, drive_kind, whole) + made.lift)[None]
    nothing = np.array([0.0, 1.0, 0.0])
    x0, _ = march_with(true, w, None, "none", nothing)
    y0 = made.C @ x0
    clean, clean_test, reached = y0, made.C @ march_with(true, test, None, "none", nothing)[0], 0.0
    if kind is not None:
        d = x0[0] * 0 if site.d is None else site.d @ x0
        p = shape(kind, d, site.v @ x0, whole * made.dt)
        code = {"smooth friction": "coulomb_friction"}.get(kind, kind)
        p[0] = _scale(true, w, site, code, p, x0, loss)
        clean = made.C @ march_with(true, w, site, code, p)[0]
        clean_test = made.C @ march_with(true, test, site, code, p)[0]
        about = y0 - y0.mean(axis=1, keepdims=True)
        reached = float(np.linalg.norm(clean - y0) / np.linalg.norm(about))
    level = noise * clean.std(axis=1, keepdims=True)

    def shown(truth: Array) -> Array:
        y = truth + level * rng.standard_normal(truth.shape)
        if bits:
            step = 6 * truth.std(axis=1, keepdims=True) / 2**bits
            y = step * np.round(y / step)
        y[0] *= 1 + gain
        return y

    dt = made.dt * (1 + clock)
    data = rco.Measurement(
        (w + input_noise * w.std() * rng.standard_normal(w.shape))[:, cut:],
        shown(clean)[:, cut:],
        dt=dt,
        hold="zoh",
    )
    held = rco.Measurement(test, shown(clean_test), dt=dt, hold="zoh")
    return Wider(made, data, held, None if kind is None else site, kind, reached, noise)


def _scale(plant: Plant, w: Array, site: Site, code: str, p: Array, x0: Array, goal: float) -> float:
    """Scale of a law at which the plant alone loses the goal."""
    y0 = plant.C @ x0
    about = np.linalg.norm(y0 - y0.mean(axis=1, keepdims=True))
    d = np.zeros(x0.shape[1]) if site.d is None else site.d @ x0
    v, inner = site.v @ x0, np.zeros(2)
    memory = np.full(2, 0.3 * p[1])
    alone = [force_of(LAWS[code], p, k * plant.dt, d[k], v[k], memory, inner) for k in range(v.size)]
    own = np.abs(site.v @ site.act) or 1.0
    scale = 0.05 * float(np.std(np.gradient(v, plant.dt))) / own / (float(np.std(alone)) or 1.0)
    for _ in range(12):
        p[0] = scale
        try:
            y = plant.C @ march_with(plant, w, site, code, p)[0]
        except FloatingPointError:
            scale *= 0.3
            continue
        reached = float(np.linalg.norm(y - y0) / about)
        if 0.8 < reached / goal < 1.25:
            break
        scale *= float(np.clip((goal / max(reached, 1e-9)) ** 0.9, 0.05, 20))
    return scale
