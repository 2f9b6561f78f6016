"""Plants of a control course by their parameters, and some whose model lacks a part of the plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import control as ct
import numpy as np

__all__ = ["PLANTS", "WRONG", "Plant"]


@dataclass(frozen=True)
class Plant:
    """A plant: its model by parameters, true values, sampling time.

    With `reality` the true plant is built by another function of the same parameters and more.
    """

    name: str
    build: Callable[..., ct.StateSpace]
    values: dict[str, float]
    dt: float
    controlled: bool = False
    reality: Callable[..., ct.StateSpace] | None = None
    force_noise: float = 0.0
    known: tuple[str, ...] = field(default=())

    @property
    def wrong(self) -> bool:
        """Whether the model lacks something that the plant has."""
        return self.reality is not None or self.force_noise > 0

    def systems(self, rng: np.random.Generator) -> tuple[ct.StateSpace, ct.StateSpace]:
        """True plant, and the model with each parameter 10 to 50 % off."""
        off = {
            name: value * (1 + rng.choice([-1, 1]) * rng.uniform(0.1, 0.5))
            for name, value in self.values.items()
            if name not in self.known
        }
        return (self.reality or self.build)(**self.values), self.build(**(self.values | off))


def system(A, B, C, D=None) -> ct.StateSpace:
    A, B, C = np.atleast_2d(A), np.asarray(B, float), np.atleast_2d(C)
    B = B.reshape(len(A), -1)
    return ct.ss(A, B, C, np.zeros((len(C), B.shape[1])) if D is None else np.atleast_2d(D))


# -- electrical ----------------------------------------------------------------------------------------


def motor(J, b, K, R, L, sensors="speed"):
    C = {"speed": [[1, 0]], "current": [[0, 1]], "both": np.eye(2)}[sensors]
    return system([[-b / J, K / J], [-K / L, -R / L]], [0, 1 / L], C)


def motor_angle(J, b, K, R, L):
    return system([[0, 1, 0], [0, -b / J, K / J], [0, -K / L, -R / L]], [0, 0, 1 / L], [1, 0, 0])


def servo(J, b, gain):
    return system([[0, 1], [0, -b / J]], [0, gain / J], [1, 0])


def rc(R, C):
    return system([[-1 / (R * C)]], [1 / (R * C)], [1])


def rl(R, L):
    return system([[-R / L]], [1 / L], [1])


def rc_ladder(R1, C1, R2, C2):
    A = [[-(1 / R1 + 1 / R2) / C1, 1 / (R2 * C1)], [1 / (R2 * C2), -1 / (R2 * C2)]]
    return system(A, [1 / (R1 * C1), 0], [0, 1])


def rlc(R, L, C, sensor="voltage"):
    return system([[-R / L, -1 / L], [1 / C, 0]], [1 / L, 0], [0, 1] if sensor == "voltage" else [1, 0])


def buck(L, C, R, V):
    return system([[0, -1 / L], [1 / C, -1 / (R * C)]], [V / L, 0], [0, 1])


def boost(L, C, R, V, duty):
    off = 1 - duty
    out = V / off
    A = [[0, -off / L], [off / C, -1 / (R * C)]]
    return system(A, [out / L, -out / (off * R) / C], [0, 1])


def filtered_buck(L, C, R, V, Lf, Rf, Cf, duty=0.5):
    A = [
        [-Rf / Lf, -1 / Lf, 0, 0],
        [1 / Cf, 0, -duty / Cf, 0],
        [0, duty / L, 0, -1 / L],
        [0, 0, 1 / C, -1 / (R * C)],
    ]
    return system(A, [0, -0.5 / Cf, V / L, 0], [0, 0, 0, 1])


# -- thermal and hydraulic ----------------------------------------------------------------------------


def thermal(C1, C2, R1, R2):
    return system(
        [[-1 / (R1 * C1), 1 / (R1 * C1)], [1 / (R1 * C2), -(1 / R1 + 1 / R2) / C2]], [1 / C1, 0], [0, 1]
    )


def thermal3(C1, C2, C3, G1, G2, G3):
    A = [[-G1 / C1, G1 / C1, 0], [G1 / C2, -(G1 + G2) / C2, G2 / C2], [0, G2 / C3, -(G2 + G3) / C3]]
    return system(A, [1 / C1, 0, 0], [0, 0, 1])


def exchanger(Ch, Cc, U, Wh, Wc):
    A = [[-(U + Wh) / Ch, U / Ch], [U / Cc, -(U + Wc) / Cc]]
    return system(A, [[Wh / Ch, 0], [0, Wc / Cc]], np.eye(2))


def tanks(A1, A2, a1, a2):
    return system([[-a1 / A1, 0], [a1 / A2, -a2 / A2]], [1 / A1, 0], [0, 1])


def coupled_tanks(A1, A2, a12, a2):
    return system([[-a12 / A1, a12 / A1], [a12 / A2, -(a12 + a2) / A2]], [1 / A1, 0], [0, 1])


def three_tanks(A1, A2, A3, a1, a2, a3):
    A = [[-a1 / A1, 0, 0], [a1 / A2, -a2 / A2, 0], [0, a2 / A3, -a3 / A3]]
    return system(A, [1 / A1, 0, 0], [0, 0, 1])


def quadruple_tank(T1, T2, T3, T4, g1, g2):
    A = [[-1 / T1, 0, 1 / T3, 0], [0, -1 / T2, 0, 1 / T4], [0, 0, -1 / T3, 0], [0, 0, 0, -1 / T4]]
    return system(A, [[g1, 0], [0, g2], [0, 0.3 * g2], [0.3 * g1, 0]], [[1, 0, 0, 0], [0, 1, 0, 0]])


def lags_2x2(T11, T12, T21, T22, k11, k12, k21, k22):
    A = -np.diag([1 / T11, 1 / T12, 1 / T21, 1 / T22])
    B = [[k11 / T11, 0], [0, k12 / T12], [k21 / T21, 0], [0, k22 / T22]]
    return system(A, B, [[1, 1, 0, 0], [0, 0, 1, 1]])


# -- mechanical ----------------------------------------------------------------------------------------


def mass(m, c, k, sensor="position"):
    rate = [-k / m, -c / m]
    if sensor == "acceleration":
        return system([[0, 1], rate], [0, 1 / m], rate, [[1 / m]])
    return system([[0, 1], rate], [0, 1 / m], [1, 0] if sensor == "position" else [0, 1])


def base_motion(m, c, k):
    """Absolute position on a base whose displacement is the input."""
    return system([[0, 1], [-k / m, -c / m]], [c / m, k / m - (c / m) ** 2], [1, 0])


def base_acceleration(m, c, k, sensor="acceleration"):
    """Base acceleration in; absolute acceleration, or relative displacement out."""
    rate = [-k / m, -c / m]
    return system([[0, 1], rate], [0, -1], rate if sensor == "acceleration" else [1, 0])


def pendulum(m, length, d):
    return system([[0, 1], [-9.81 / length, -d / (m * length**2)]], [0, 1 / (m * length**2)], [1, 0])


def cruise(m, b):
    return system([[-b / m]], [1 / m], [1])


def chain(m, c, k, sensor=(1,), force=1, kind="position"):
    """Masses in a row, the first and (if there is a link more) the last tied to the ground."""
    m, n = np.asarray(m, float), len(m)
    K, D = np.zeros((n, n)), np.zeros((n, n))
    for matrix, values in ((K, k), (D, c)):
        for i, value in enumerate(values):
            ends = [j for j in (i - 1, i) if 0 <= j < n]
            for a in ends:
                for b in ends:
                    matrix[a, b] += value if a == b else -value
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-K / m[:, None], -D / m[:, None]]])
    B = np.zeros(2 * n)
    B[n + force - 1] = 1 / m[force - 1]
    rows = {"position": np.eye(2 * n)[:n], "velocity": np.eye(2 * n)[n:], "acceleration": A[n:]}[kind]
    C = rows[[s - 1 for s in sensor]]
    D = None if kind != "acceleration" else [[B[n + s - 1]] for s in sensor]
    return system(A, B, C, D)


def two_masses(m1, m2, c1, c2, k1, k2, **where):
    return chain((m1, m2), (c1, c2), (k1, k2), **where)


def three_masses(m1, m2, m3, c1, c2, c3, k1, k2, k3, **where):
    return chain((m1, m2, m3), (c1, c2, c3), (k1, k2, k3), **where)


def drive(J1, J2, b1, b2, k, c, sensor="motor speed"):
    """Two inertias on a soft shaft: twist, motor speed, load speed."""
    A = [[0, 1, -1], [-k / J1, -(b1 + c) / J1, c / J1], [k / J2, c / J2, -(b2 + c) / J2]]
    return system(A, [0, 1 / J1, 0], [0, 1, 0] if sensor == "motor speed" else [0, 0, 1])


def quarter_car(ms, mu, k, c, kt, sensor="position"):
    A = [
        [0, 1, 0, 0], [-k / ms, -c / ms, k / ms, c / ms],
        [0, 0, 0, 1], [k / mu, c / mu, -(k + kt) / mu, -c / mu],
    ]  # fmt: skip
    return system(A, [0, 0, 0, kt / mu], [1, 0, 0, 0] if sensor == "position" else A[1])


def heave_pitch(m, J, kf, kr, cf, cr, a, b):
    A = [
        [0, 1, 0, 0],
        [-(kf + kr) / m, -(cf + cr) / m, (a * kf - b * kr) / m, (a * cf - b * cr) / m],
        [0, 0, 0, 1],
        [
            (a * kf - b * kr) / J,
            (a * cf - b * cr) / J,
            -(a * a * kf + b * b * kr) / J,
            -(a * a * cf + b * b * cr) / J,
        ],
    ]
    return system(
        A, [[0, 0], [kf / m, kr / m], [0, 0], [-a * kf / J, b * kr / J]], [[1, 0, 0, 0], [0, 0, 1, 0]]
    )


def crane(M, m, length, d):
    """Trolley speed under a force, and the angle of the load."""
    A = [[-d / M, m * 9.81 / M, 0], [0, 0, 1], [d / (M * length), -(M + m) * 9.81 / (M * length), -0.05]]
    return system(A, [1 / M, 0, -1 / (M * length)], [[1, 0, 0], [0, 1, 0]])


# -- flight, process, unstable --------------------------------------------------------------------------


def short_period(Za, Ma, Mq, Zd, Md):
    return system([[-Za, 1], [-Ma, -Mq]], [-Zd, -Md], [0, 1])


def pitch(Za, Ma, Mq, Zd, Md):
    return system([[-Za, 1, 0], [-Ma, -Mq, 0], [0, 1, 0]], [Zd, Md, 0], [0, 0, 1])


def water_turbine(Tw, Tg):
    """Gate servo and water column: the power first moves the wrong way."""
    return system([[-2 / Tw, 6 / Tw], [0, -1 / Tg]], [0, 1 / Tg], [1, -2])


def right_zero(w, zeta, zero, gain):
    return system([[0, 1], [-(w**2), -2 * zeta * w]], [0, gain * w**2], [1, -1 / zero])


def lag_and_delay(T, gain, delay):
    """First order behind a dead time (Pade, second order)."""
    a = 6.0 / delay
    A = [[-1 / T, -12 * gain / (delay * T), 0], [0, -a, -12 / delay**2], [0, 1, 0]]
    return system(A, [gain / T, 1, 0], [1, 0, 0])


def levitation(m, kx, ki):
    return system([[0, 1], [kx / m, 0]], [0, ki / m], [1, 0])


def inverted_pendulum(m, length, d):
    return system([[0, 1], [9.81 / length, -d / (m * length**2)]], [0, 1 / (m * length**2)], [1, 0])


def cart_pendulum(M, m, length, d):
    A = [
        [0, 1, 0, 0], [0, -d / M, -m * 9.81 / M, 0],
        [0, 0, 0, 1], [0, d / (M * length), (M + m) * 9.81 / (M * length), 0],
    ]  # fmt: skip
    return system(A, [0, 1 / M, 0, -1 / (M * length)], [[1, 0, 0, 0], [0, 0, 1, 0]])


def ball_and_beam(g, T):
    return system([[0, 1, 0], [0, 0, g], [0, 0, -1 / T]], [0, 0, 1 / T], [1, 0, 0])


def sensor_lag(build, T):
    """The same plant behind a sensor with a lag."""

    def built(**values):
        s = build(**values)
        n = s.nstates
        A = np.block([[s.A, np.zeros((n, 1))], [s.C / T, -np.eye(1) / T]])
        return system(A, np.vstack([s.B, s.D / T]), np.eye(n + 1)[n])

    return built


def delayed(build, dt, samples):
    """The same plant, its input some samples late, in discrete time."""

    def built(**values):
        s = build(**values).sample(dt)
        line = ct.ss(np.eye(samples, k=1), np.eye(samples)[:, -1:], np.eye(samples)[:1], [[0.0]], dt)
        return s * line

    return built


_M = {"m": 1.0, "c": 0.8, "k": 30.0}
_MOTOR = {"J": 0.01, "b": 0.1, "K": 0.1, "R": 1.0, "L": 0.5}
_TWO = {"m1": 1.0, "m2": 1.2, "c1": 0.1, "c2": 0.12, "k1": 20.0, "k2": 30.0}
_THREE = {
    "m1": 1.0,
    "m2": 1.0,
    "m3": 1.0,
    "c1": 0.2,
    "c2": 0.16,
    "c3": 0.12,
    "k1": 10.0,
    "k2": 8.0,
    "k3": 6.0,
}
_DRIVE = {"J1": 0.02, "J2": 0.05, "b1": 0.02, "b2": 0.03, "k": 5.0, "c": 0.02}
_CAR = {"ms": 300.0, "mu": 40.0, "k": 16000.0, "c": 1000.0, "kt": 190000.0}
_HEAT = {"C1": 100.0, "C2": 200.0, "R1": 1.0, "R2": 2.0}

PLANTS = (
    Plant("motor, speed", motor, _MOTOR, 0.02),
    Plant("motor, R and L off", motor, _MOTOR, 0.02, known=("J", "b", "K")),
    Plant("motor, current", lambda **v: motor(**v, sensors="current"), _MOTOR, 0.02),
    Plant("motor, speed and current", lambda **v: motor(**v, sensors="both"), _MOTOR, 0.02),
    Plant("motor, angle", motor_angle, _MOTOR, 0.02),
    Plant("servo, angle", servo, {"J": 0.01, "b": 0.06, "gain": 0.1}, 0.01),
    Plant("RC", rc, {"R": 1e3, "C": 1e-4}, 0.005),
    Plant("RL", rl, {"R": 2.0, "L": 0.1}, 0.005),
    Plant("RC ladder", rc_ladder, {"R1": 1e3, "C1": 1e-4, "R2": 2e3, "C2": 0.5e-4}, 0.01),
    Plant("RLC, voltage", rlc, {"R": 1.0, "L": 0.1, "C": 0.01}, 0.01),
    Plant("RLC, current", lambda **v: rlc(**v, sensor="current"), {"R": 1.0, "L": 0.1, "C": 0.01}, 0.01),
    Plant("buck converter", buck, {"L": 1e-4, "C": 1e-4, "R": 5.0, "V": 24.0}, 2e-5),
    Plant("boost converter", boost, {"L": 1e-4, "C": 2e-4, "R": 8.0, "V": 12.0, "duty": 0.4}, 5e-5),
    Plant("buck with input filter", filtered_buck,
          {"L": 2e-4, "C": 1e-4, "R": 5.0, "V": 24.0, "Lf": 1e-4, "Rf": 0.3, "Cf": 3e-4}, 3e-5),
    Plant("thermal, 2 nodes", thermal, _HEAT, 5.0),
    Plant("thermal, 3 nodes", thermal3,
          {"C1": 100.0, "C2": 150.0, "C3": 200.0, "G1": 1.0, "G2": 0.8, "G3": 0.6}, 10.0),
    Plant("heat exchanger 2x2", exchanger, {"Ch": 50.0, "Cc": 60.0, "U": 2.0, "Wh": 3.0, "Wc": 4.0}, 1.0),
    Plant("mass, position", mass, _M, 0.03),
    Plant("mass, velocity", lambda **v: mass(**v, sensor="velocity"), _M, 0.03),
    Plant("mass, acceleration", lambda **v: mass(**v, sensor="acceleration"), _M, 0.03),
    Plant("base motion", base_motion, _M, 0.03),
    Plant("base acceleration", base_acceleration, _M, 0.03),
    Plant("base acceleration, relative", lambda **v: base_acceleration(**v, sensor="relative"), _M, 0.03),
    Plant("pendulum, down", pendulum, {"m": 0.5, "length": 0.6, "d": 0.05}, 0.04),
    Plant("cruise", cruise, {"m": 1000.0, "b": 50.0}, 1.0),
    Plant("two tanks", tanks, {"A1": 1.0, "A2": 1.4, "a1": 0.1, "a2": 0.08}, 1.0),
    Plant("coupled tanks", coupled_tanks, {"A1": 1.0, "A2": 1.2, "a12": 0.1, "a2": 0.08}, 1.0),
    Plant("three tanks", three_tanks,
          {"A1": 1.0, "A2": 1.4, "A3": 0.8, "a1": 0.1, "a2": 0.08, "a3": 0.1}, 1.0),
    Plant("quadruple tank 2x2", quadruple_tank,
          {"T1": 62.0, "T2": 90.0, "T3": 23.0, "T4": 30.0, "g1": 0.08, "g2": 0.06}, 4.0),
    Plant("four lags 2x2", lags_2x2, {"T11": 17.0, "T12": 21.0, "T21": 11.0, "T22": 14.0, "k11": 1.3,
          "k12": -1.9, "k21": 0.7, "k22": -2.0}, 1.5),
    Plant("two masses, one sensor", lambda **v: two_masses(**v, sensor=(2,)), _TWO, 0.05),
    Plant("two masses, two sensors", lambda **v: two_masses(**v, sensor=(1, 2)), _TWO, 0.05),
    Plant("three masses, one sensor", lambda **v: three_masses(**v, force=3), _THREE, 0.1),
    Plant("three masses, acceleration",
          lambda **v: three_masses(**v, sensor=(2,), force=3, kind="acceleration"), _THREE, 0.1),
    Plant("two-inertia drive, motor", drive, _DRIVE, 0.01),
    Plant("two-inertia drive, load", lambda **v: drive(**v, sensor="load"), _DRIVE, 0.01),
    Plant("quarter car", quarter_car, _CAR, 0.005),
    Plant("quarter car, acceleration", lambda **v: quarter_car(**v, sensor="acceleration"), _CAR, 0.005),
    Plant("heave and pitch 2x2", heave_pitch, {"m": 1200.0, "J": 1500.0, "kf": 35e3, "kr": 38e3, "cf": 1500.0,
          "cr": 1700.0, "a": 1.1, "b": 1.4}, 0.03),
    Plant("crane", crane, {"M": 10.0, "m": 4.0, "length": 1.5, "d": 6.0}, 0.05),
    Plant("short period", short_period, {"Za": 0.8, "Ma": 4.0, "Mq": 1.2, "Zd": 0.1, "Md": 5.0}, 0.05),
    Plant("aircraft pitch", pitch, {"Za": 0.31, "Ma": 1.4, "Mq": 0.43, "Zd": 0.23, "Md": 2.0}, 0.1),
    Plant("water turbine", water_turbine, {"Tw": 1.0, "Tg": 0.4}, 0.1),
    Plant("zero in the right half plane", right_zero, {"w": 2.0, "zeta": 0.3, "zero": 3.0, "gain": 1.5}, 0.1),
    Plant("lag and dead time", lag_and_delay, {"T": 5.0, "gain": 2.0, "delay": 1.0}, 0.2),
    Plant("levitation", levitation, {"m": 0.1, "kx": 20.0, "ki": 5.0}, 0.01, controlled=True),
    Plant("inverted pendulum", inverted_pendulum, {"m": 0.4, "length": 0.5, "d": 0.1}, 0.02, controlled=True),
    Plant("pendulum on a cart", cart_pendulum, {"M": 1.0, "m": 0.2, "length": 0.5, "d": 0.3}, 0.02,
          controlled=True),
    Plant("ball and beam", ball_and_beam, {"g": 7.0, "T": 0.1}, 0.02, controlled=True),
)  # fmt: skip

WRONG = (
    Plant("wrong: mass, lag", mass, _M, 0.03, reality=sensor_lag(mass, 0.15)),
    Plant("wrong: mass, delay", mass, _M, 0.03, reality=delayed(mass, 0.03, 2)),
    Plant("wrong: missing mode", mass, _M, 0.03,
          reality=lambda m, c, k: two_masses(m, 0.3 * m, c, 0.3 * c, k, 1.5 * k, sensor=(1,))),
    Plant("wrong: force noise", mass, _M, 0.03, force_noise=0.2),
    Plant("wrong: motor, lag", motor, _MOTOR, 0.02, reality=sensor_lag(motor, 0.1)),
    Plant("wrong: servo, delay", servo, {"J": 0.01, "b": 0.06, "gain": 0.1}, 0.01,
          reality=delayed(servo, 0.01, 3)),
    Plant("wrong: heat, missing node", thermal, _HEAT, 5.0,
          reality=lambda C1, C2, R1, R2: thermal3(C1, 0.5 * C1, C2, 1 / R1, 1 / R1, 1 / R2)),
    Plant("wrong: tanks, force noise", tanks, {"A1": 1.0, "A2": 1.4, "a1": 0.1, "a2": 0.08}, 1.0,
          force_noise=0.1),
)  # fmt: skip
