"""Plants written out by hand: equations of motion, sensors, and places where an effect can hide."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import control as ct
import numpy as np

import rcorefine as rco

Array = np.ndarray


@dataclass
class Place:
    """Where an effect can act: motion there, and what a resisting force does to the rates."""

    name: str
    d: Array | None  # displacement = d @ x, None for a first-order place
    v: Array
    act: Array
    laws: tuple[str, ...] = ()  # that make sense here, all where empty


@dataclass
class Plant:
    """Linear equations dx/dt = A x + B w, y = C x + D w + (what `rates` reads of dx/dt), and its places."""

    name: str
    model: object  # what the estimator is given
    A: Array
    B: Array
    C: Array
    D: Array
    rates: Array  # y += rates @ dx/dt, for accelerometers
    places: list[Place]
    dt: float
    amplitude: Array
    chain: bool = True
    lift: float = 0.0  # mean of the input over its amplitude

    def alike(self, one: str, two: str) -> bool:
        """Whether two places are the same one: same motion, same force."""
        known = {p.name: p for p in self.places}
        if one == two or one not in known or two not in known:
            return one == two
        a, b = known[one], known[two]
        pairs = [(a.d, b.d), (a.v, b.v), (a.act, b.act)]
        return all(p is q or (p is not None and q is not None and np.array_equal(p, q)) for p, q in pairs)


def _sensor(n: int, what: str, mass: int) -> tuple[Array, Array]:
    state, rate = np.zeros(2 * n), np.zeros(2 * n)
    if what == "displacement":
        state[mass] = 1
    elif what == "velocity":
        state[n + mass] = 1
    else:
        rate[n + mass] = 1
    return state, rate


def chain(rng: np.random.Generator, sensors: int = 1, masses: int | None = None) -> Plant:
    """1 to 6 masses between two walls or on one, a force at one, one or two sensors."""
    n = masses or int(rng.integers(1, 7))
    m = rng.uniform(0.6, 1.6, n)
    links = n + int(rng.integers(0, 2))
    k = rng.uniform(120, 350, links)
    c = 2 * rng.uniform(0.008, 0.02) * np.sqrt(k * m.mean())
    force = int(rng.integers(n))
    spots = rng.permutation(n)[: min(sensors, n)]
    kinds = [str(rng.choice(["velocity", "displacement", "acceleration"])) for _ in spots]
    return chain_of(m, c, k, force, [(kind, int(i)) for kind, i in zip(kinds, spots, strict=True)])


def chain_of(
    m: Array, c: Array, k: Array, force: int, sensors: list[tuple[str, int]], dt: float | None = None
) -> Plant:
    """Masses in a row, the first link at a wall, one more link than masses for a wall at the end too."""
    n = m.size
    K, Cd = np.zeros((n, n)), np.zeros((n, n))
    places = []
    for i in range(k.size):
        e = np.zeros(n)
        if i < n:
            e[i] = 1
            if i > 0:
                e[i - 1] = -1
        else:
            e[n - 1] = 1  # mass n to ground, in the sense of motion of mass n
        K += k[i] * np.outer(e, e)
        Cd += c[i] * np.outer(e, e)
        zero = np.zeros(n)
        places.append(
            Place(
                f"link{i + 1}",
                np.concatenate([e, zero]),
                np.concatenate([zero, e]),
                np.concatenate([zero, -e / m]),
            )
        )
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-K / m[:, None], -Cd / m[:, None]]])
    B = np.zeros((2 * n, 1))
    B[n + force, 0] = 1 / m[force]
    rows = [_sensor(n, kind, i) for kind, i in sensors]
    model = rco.mass_spring_damper(m, c, k, force=force + 1, sensors=[(kind, i + 1) for kind, i in sensors])
    fast = np.abs(np.linalg.eigvals(A)).max() / (2 * np.pi)
    C = np.array([r[0] for r in rows])
    R = np.array([r[1] for r in rows])
    return Plant(
        f"chain{n}",
        model,
        A,
        B,
        C,
        np.zeros((len(rows), 1)),
        R,
        places,
        dt or 1 / (12 * fast),
        np.array([10.0]),
    )


def motor(rng: np.random.Generator, sensors: int = 1) -> Plant:
    """DC motor with inductance, speed measured (and current)."""
    R, L, Kt, J, b = rng.uniform([1, 2e-3, 0.04, 1e-4, 5e-5], [3, 8e-3, 0.08, 3e-4, 2e-4])
    what = ["speed", "current"][:sensors]
    model = rco.dc_motor(R=R, L=L, Kt=Kt, J=J, b=b, sensors=what)
    A = np.array([[-b / J, Kt / J], [-Kt / L, -R / L]])
    B = np.array([[0.0], [1 / L]])
    places = [Place("shaft", None, np.array([1.0, 0]), np.array([-1 / J, 0]))]
    C = np.eye(2)[:sensors]
    return Plant(
        "motor", model, A, B, C, np.zeros((sensors, 1)), 0 * C, places, 1.5e-3, np.array([6.0]), False
    )


def quarter_car(rng: np.random.Generator, sensors: int = 1) -> Plant:
    """Quarter car on a road given by its velocity."""
    mb, mw, ks, cs, kt = rng.uniform([220, 28, 12e3, 700, 130e3], [350, 45, 22e3, 1500, 200e3])
    what = ["body_acceleration", "suspension_deflection"][:sensors]
    model = rco.quarter_car(mb, mw, ks, cs, kt, sensors=what)
    # states: suspension deflection zb - zw, tire deflection zw - road, velocities
    A = np.array(
        [
            [0, 0, 1, -1],
            [0, 0, 0, 1],
            [-ks / mb, 0, -cs / mb, cs / mb],
            [ks / mw, -kt / mw, cs / mw, -cs / mw],
        ]
    )
    B = np.array([[0.0], [-1], [0], [0]])
    places = [
        Place(
            "suspension",
            np.array([1.0, 0, 0, 0]),
            np.array([0, 0, 1.0, -1]),
            np.array([0, 0, -1 / mb, 1 / mw]),
        )
    ]
    C = np.array([[0.0, 0, 0, 0], [1, 0, 0, 0]])[:sensors]
    rates = np.array([[0.0, 0, 1, 0], [0, 0, 0, 0]])[:sensors]
    return Plant(
        "quarter car", model, A, B, C, np.zeros((sensors, 1)), rates, places, 0.006, np.array([0.3]), False
    )


def rlc(rng: np.random.Generator, sensors: int = 1) -> Plant:
    """Series circuit, charge and current as position and velocity."""
    R, L, C = rng.uniform([3, 0.03, 1.5e-5], [8, 0.08, 4e-5])
    model = rco.series_rlc(R, L, C, sensors=["current", "capacitor_voltage"][:sensors])
    A = np.array([[0, 1.0], [-1 / (L * C), -R / L]])
    B = np.array([[0.0], [1 / L]])
    charge, current, act = np.array([1.0, 0]), np.array([0, 1.0]), np.array([0, -1 / L])
    places = [
        Place(
            "capacitor",
            charge,
            current,
            act,
            ("stiffness", "cubic_stiffness", "quadratic_stiffness", "bilinear_stiffness"),
        ),
        Place(
            "resistor",
            charge,
            current,
            act,
            ("damping", "coulomb_friction", "quadratic_damping", "cubic_damping"),
        ),
    ]
    out = np.array([[0, 1.0], [1 / C, 0]])[:sensors]
    return Plant(
        "RLC",
        model,
        A,
        B,
        out,
        np.zeros((sensors, 1)),
        0 * out,
        places,
        8e-5 * np.sqrt(L * C / 1e-6),
        np.array([10.0]),
        False,
    )


def tanks(rng: np.random.Generator, sensors: int = 1) -> Plant:
    """Two tanks in a row; the upper level is measured too where two sensors are asked for."""
    area, out = rng.uniform(1, 3, 2), rng.uniform(0.3, 0.8, 2)
    model = rco.two_tanks(area, out, sensors=[2, 1][:sensors])
    A = np.array([[-out[0] / area[0], 0], [out[0] / area[1], -out[1] / area[1]]])
    B = np.array([[1 / area[0]], [0.0]])
    places = [
        Place("tank1", None, np.array([1.0, 0]), np.array([-1 / area[0], 0])),
        Place("tank2", None, np.array([0, 1.0]), np.array([0, -1 / area[1]])),
    ]
    C = np.array([[0, 1.0], [1.0, 0]])[:sensors]
    return Plant(
        "tanks", model, A, B, C, np.zeros((sensors, 1)), 0 * C, places, 0.35, np.array([1.0]), False, 4.0
    )


def thermal(rng: np.random.Generator, sensors: int = 1) -> Plant:
    """Two bodies, heat into the first, the second against the surroundings."""
    c1, c2, r12, r20 = rng.uniform([8, 15, 0.4, 1.5], [15, 30, 0.8, 3])
    model = rco.thermal_network(
        [c1, c2], {(1, 2): r12, (2, 0): r20}, ambient_input=False, sensors=[2, 1][:sensors]
    )
    A = np.array([[-1 / (r12 * c1), 1 / (r12 * c1)], [1 / (r12 * c2), -1 / (r12 * c2) - 1 / (r20 * c2)]])
    B = np.array([[1 / c1], [0.0]])
    places = [
        Place("T1", None, np.array([1.0, 0]), np.array([-1 / c1, 0])),
        Place("T2", None, np.array([0, 1.0]), np.array([0, -1 / c2])),
        Place("T1-T2", None, np.array([1.0, -1.0]), np.array([-1 / c1, 1 / c2])),
    ]
    C = np.array([[0, 1.0], [1.0, 0]])[:sensors]
    return Plant(
        "thermal", model, A, B, C, np.zeros((sensors, 1)), 0 * C, places, 0.8, np.array([50.0]), False
    )


def ring(rng: np.random.Generator, sensors: int = 1) -> Plant:
    """Three masses, each tied to the ground and to both others, given as a plain StateSpace."""
    n, m = 3, rng.uniform(0.5, 2.0, 3)
    pairs = [(i, None) for i in range(n)] + [(0, 1), (0, 2), (1, 2)]
    k = rng.uniform(80, 400, len(pairs))
    c = 2 * rng.uniform(0.01, 0.03) * np.sqrt(k * m.mean())
    K, damping, places = np.zeros((n, n)), np.zeros((n, n)), []
    zero = np.zeros(n)
    for (i, j), stiff, viscous in zip(pairs, k, c, strict=True):
        e = np.zeros(n)
        e[i] = 1
        if j is not None:
            e[j] = -1
        K += stiff * np.outer(e, e)
        damping += viscous * np.outer(e, e)
        name = f"p{i + 1}" if j is None else f"p{i + 1}-p{j + 1}"
        places.append(
            Place(
                name,
                np.concatenate([e, zero]),
                np.concatenate([zero, e]),
                np.concatenate([zero, -e / m]),
            )
        )
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-K / m[:, None], -damping / m[:, None]]])
    force = int(rng.integers(n))
    B = np.zeros((2 * n, 1))
    B[n + force, 0] = 1 / m[force]
    spots = rng.permutation(n)[:sensors]
    C = np.array([_sensor(n, str(rng.choice(["velocity", "displacement"])), int(i))[0] for i in spots])
    D = np.zeros((len(spots), 1))
    model = ct.ss(
        A, B, C, D, inputs=["force"], outputs=[f"y{i + 1}" for i in range(len(spots))],
        states=["p1", "p2", "p3", "s1", "s2", "s3"],
    )  # fmt: skip
    fast = np.abs(np.linalg.eigvals(A)).max() / (2 * np.pi)
    return Plant("ring", model, A, B, C, D, 0 * C, places, 1 / (12 * fast), np.array([10.0]))


PLANTS: dict[str, Callable[..., Plant]] = {
    "chain": chain, "motor": motor, "quarter car": quarter_car,
    "RLC": rlc, "tanks": tanks, "thermal": thermal, "ring": ring,
}  # fmt: skip
