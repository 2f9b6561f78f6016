"""Records that led the race astray: a servo with dry friction, chains with strong effects."""

from __future__ import annotations

import control as ct
import numpy as np
from scipy.signal import butter, lfilter

import rcorefine as rco

from .generator import Hidden, linear_states
from .integrator import LAWS, MEMORY, force_of, march
from .plants import Array, Place, Plant, chain_of

STRONG = (
    "stiffness", "bilinear_stiffness", "quadratic_stiffness", "cubic_stiffness", "clearance",
    "coulomb_friction", "quadratic_damping", "cubic_damping", "dahl",
)  # fmt: skip
_NAMES = {"dahl": "hysteresis"}


class WholeLibrary(Hidden):
    """A record whose estimator is offered everything."""

    @property
    def candidates(self) -> None:
        """The default."""
        return


def servo_record(seed: int, *, samples: int = 3500, noise: float = 0.02) -> Hidden:
    """A servo as a plain state-space model, its angle measured, dry friction hidden.

    Parameters
    ----------
    seed : int
        Draws input and noise.
    samples, noise : int, float
        Length at 100 Hz; noise over the rms of the angle.
    """
    rng = np.random.default_rng([seed, 81])
    J, b, gain, dt = 0.01, 0.06, 0.1, 0.01
    A, B, C = np.array([[0.0, 1], [0, -b / J]]), np.array([[0.0], [gain / J]]), np.array([[1.0, 0]])
    model = ct.ss(A, B, C, 0, inputs=["voltage"], outputs=["angle"], states=["angle", "speed"])
    place = Place("angle", np.array([1.0, 0]), np.array([0, 1.0]), np.array([0, -gain / J]))
    plant = Plant("servo", model, A, B, C, np.zeros((1, 1)), 0 * C, [place], dt, np.array([8.0]), False)
    w = np.repeat(rng.uniform(-8, 8, -(-samples // 20)), 20)[None, :samples]
    w = w + 0.5 * rng.standard_normal(w.shape)
    return _record(plant, place, "coulomb_friction", np.array([0.08 / gain, 0.005, 0.0]), w, noise, rng, True)


def strong_record(seed: int, *, samples: int = 6000, kind: str | None = None) -> Hidden:
    """A chain of four masses with a law of 12 to 35 % of the link's elastic force, one sensor.

    Parameters
    ----------
    seed : int
        Draws masses, links, sensor, place, law, strength, input and noise.
    samples : int
        Length at 200 Hz.
    kind : str, optional
        One of `STRONG`; drawn where None.
    """
    rng = np.random.default_rng([seed, 82])
    n, links, dt = 4, int(rng.integers(4, 6)), 0.005
    m, k, c = rng.uniform(0.6, 1.6, n), rng.uniform(400, 1600, links), rng.uniform(0.3, 1.2, links)
    sensor = str(rng.choice(["displacement", "velocity", "acceleration"]))
    plant = chain_of(m, c, k, 0, [(sensor, int(rng.integers(n)))], dt)
    place = plant.places[int(rng.integers(links))]
    kind = kind or str(rng.choice(STRONG))
    low = butter(4, 25 * 2 * dt)
    w = lfilter(*low, rng.standard_normal((1, samples)))
    w *= 10 / w.std()
    share, noise = rng.uniform(0.12, 0.35), rng.uniform(0.01, 0.05)
    x = linear_states(plant, w)
    d, v = place.d @ x, place.v @ x
    second = {"clearance": rng.uniform(0.5, 1.2), "dahl": rng.uniform(0.2, 0.6)}.get(kind, 0.0) * d.std()
    law = np.array([1.0, 1e-3 if kind == "coulomb_friction" else second, 0.0])
    inner = np.zeros(2)
    if kind == "dahl":
        size = 1.0
    else:
        unit = [force_of(LAWS[kind], law, 0.0, *at, np.zeros(2), inner) for at in zip(d, v, strict=True)]
        size = float(np.std(unit))
    sign = {"stiffness": -1.0}.get(kind, 1.0)
    if kind in ("quadratic_stiffness", "bilinear_stiffness"):
        sign = float(rng.choice([-1.0, 1.0]))
    law[0] = sign * share * k[int(place.name[4:]) - 1] * d.std() / size
    return _record(plant, place, kind, law, w, noise, rng, False)


def _record(
    plant: Plant,
    place: Place,
    kind: str,
    law: Array,
    w: Array,
    noise: float,
    rng: np.random.Generator,
    held: bool,
) -> Hidden:
    n, memory, N = plant.A.shape[0], MEMORY.get(kind, 0), w.shape[1]
    x0 = linear_states(plant, w)
    atol = 1e-8 * np.concatenate([x0.std(axis=1), np.full(memory, law[1])])
    x = march(
        plant.A, np.ascontiguousarray((plant.B @ w).T), place.act[None], place.d[None], place.v[None],
        np.array([LAWS[kind]]), law[None], memory, plant.dt, 1e-8, atol, 2000 * N, held,
        np.zeros(len(atol)),
    ).T  # fmt: skip
    if not np.isfinite(x).all():
        raise FloatingPointError("the plant with this effect runs away")
    inner = np.zeros(2)
    force = np.array(
        [
            force_of(LAWS[kind], law, i * plant.dt, place.d @ x[:n, i], place.v @ x[:n, i], x[n:, i], inner)
            for i in range(N)
        ]
    )
    y = (
        plant.C @ x[:n]
        + plant.D @ w
        + plant.rates @ (plant.A @ x[:n] + plant.B @ w + np.outer(place.act, force))
    )
    alone = plant.C @ x0 + plant.D @ w + plant.rates @ (plant.A @ x0 + plant.B @ w)
    loss = float(np.linalg.norm(y - alone) / np.linalg.norm(alone - alone.mean()))
    y = y + noise * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    data = rco.Measurement(w, y, dt=plant.dt, hold="zoh" if held else "foh")
    return WholeLibrary(
        plant, data, _NAMES.get(kind, kind), place.name, float(law[0]), loss, noise, float(law[0])
    )
