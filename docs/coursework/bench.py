"""The benches of the eight labs: what stands on the table, and what its sensors read.

Take measurements here and leave the plants closed: their numbers are what the labs ask for. Each student
number has a plant of its own. The plants share no code with rcorefine.
"""

import math

import numpy as np

import rcorefine as rco


def _march(rates, start, inputs, dt, parts=20):
    """States at the samples, the input held between them (Runge-Kutta, `parts` steps a sample)."""
    x, h, states = list(start), dt / parts, []
    for u in inputs:
        states.append(x)
        for _ in range(parts):
            a = rates(x, u)
            b = rates([s + 0.5 * h * k for s, k in zip(x, a, strict=True)], u)
            c = rates([s + 0.5 * h * k for s, k in zip(x, b, strict=True)], u)
            d = rates([s + h * k for s, k in zip(x, c, strict=True)], u)
            x = [
                s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
                for s, k1, k2, k3, k4 in zip(x, a, b, c, d, strict=True)
            ]
    return np.array(states).T


def _draws(lab, student, *ranges):
    """Numbers of a student's plant, and the generator of the noise."""
    numbers = np.random.default_rng([lab, student])
    return [low + (high - low) * numbers.random() for low, high in ranges], np.random.default_rng(
        [student, lab]
    )


def _sign(v, width):
    return math.tanh(v / width)


def rc_circuit(voltage, student=0):
    """Lab 1. Voltage [V] every 0.1 ms -> voltage of the capacitor [V] and current [A]."""
    (extra,), noise = _draws(1, student, (150.0, 350.0))
    q = _march(lambda x, u: [(u - x[0] / 1e-6) / (1000.0 + extra)], [0.0], voltage, 1e-4)[0]
    before = np.r_[0.0, np.asarray(voltage)[:-1]]  # the converter reads, then the source steps
    current = (before - q / 1e-6) / (1000.0 + extra)
    y = np.array([q / 1e-6, current])
    y += noise.standard_normal(y.shape) * [[0.02], [2e-5]]
    return rco.Measurement(
        voltage, y, dt=1e-4, input_labels="voltage", output_labels=["capacitor_voltage", "current"],
        input_units="V", output_units=["V", "A"],
    )  # fmt: skip


def motor(voltage, student=0):
    """Lab 2. Voltage [V] every 10 ms -> speed [rad/s]."""
    (gain, tau), noise = _draws(2, student, (2.2, 2.8), (0.24, 0.30))
    v = _march(lambda x, u: [(gain * u - x[0]) / tau], [0.0], voltage, 0.01)[0]
    y = v + 0.2 * noise.standard_normal(v.size)
    return rco.Measurement(
        voltage,
        y,
        dt=0.01,
        input_labels="voltage",
        output_labels="speed",
        input_units="V",
        output_units="rad/s",
    )


def servo(voltage, student=0):
    """Lab 3. Voltage [V] every 10 ms -> speed [rad/s] and angle [rad] of a servo."""
    (dry,), noise = _draws(3, student, (0.3, 0.6))
    states = _march(
        lambda x, u: [x[1], (3.0 * (u - dry * _sign(x[1], 1e-3)) - x[1]) / 0.2], [0.0, 0.0], voltage, 0.01, 80
    )
    y = states[::-1] + noise.standard_normal(states.shape) * [[0.1], [0.01]]
    return rco.Measurement(
        voltage, y, dt=0.01, input_labels="voltage", output_labels=["speed", "angle"],
        input_units="V", output_units=["rad/s", "rad"],
    )  # fmt: skip


def thermal(heater, student=0):
    """Lab 4. Heater [%] every 2 s -> temperature of the sensor above the room [K], in steps of 0.32 K."""
    (extra,), noise = _draws(4, student, (0.0006, 0.0009))
    T = _march(
        lambda x, u: [
            (0.04 * u - x[0] / 20 - extra * x[0] * abs(x[0]) - (x[0] - x[1]) / 20) / 5.0,
            (x[0] - x[1]) / 20 / 1.0,
        ],
        [0.0, 0.0], heater, 2.0,
    )[1]  # fmt: skip
    y = 0.32 * np.round((T + 0.1 * noise.standard_normal(T.size)) / 0.32)
    return rco.Measurement(
        heater, y, dt=2.0, input_labels="heater", output_labels="T_sensor", input_units="%", output_units="K"
    )


def car(force, student=0):
    """Lab 5. Force [N] at the wheels every 0.1 s -> speed [m/s]; it drives 24 m/s when the record begins."""
    (drag,), noise = _draws(5, student, (0.40, 0.60))
    balance = 40.0 * 24.0 + drag * 24.0**2
    v = _march(
        lambda x, u: [(u - 40.0 * x[0] - drag * x[0] * abs(x[0])) / 1200.0], [24.0], force + balance, 0.1, 4
    )[0]
    y = v + 0.05 * noise.standard_normal(v.size)
    return rco.Measurement(
        force + balance, y, dt=0.1, input_labels="force", output_labels="speed", input_units="N",
        output_units="m/s",
    )  # fmt: skip


def pendulum(torque, student=0):
    """Lab 6. Torque [N m] every 20 ms -> angle [rad] of a pendulum that hangs."""
    (length,), noise = _draws(6, student, (0.45, 0.55))
    inertia, weight = length**2, 9.81 * length
    angle = _march(
        lambda x, u: [x[1], (u - 0.1 * x[1] - weight * math.sin(x[0])) / inertia], [0.0, 0.0], torque, 0.02
    )[0]
    y = angle + 0.005 * noise.standard_normal(angle.size)
    data = rco.Measurement(
        torque,
        y,
        dt=0.02,
        input_labels="torque",
        output_labels="angle",
        input_units="N m",
        output_units="rad",
    )
    return data, length


def cart_pendulum(gains, wanted, student=0):
    """Lab 7. State feedback u = -gains (x - wanted) every 10 ms -> force [N], position [m], angle [rad]."""
    (dry,), noise = _draws(7, student, (0.3, 0.7))
    det = 1.2 * 0.05 - 0.1**2

    def rates(x, u):
        push = u - 0.3 * x[2] - dry * _sign(x[2], 1e-3)
        turn = 0.2 * 9.81 * 0.5 * x[1] - 0.01 * x[3]
        return [x[2], x[3], (0.05 * push - 0.1 * turn) / det, (1.2 * turn - 0.1 * push) / det]

    x, seen, rate = [0.0] * 4, np.zeros(2), np.zeros(2)
    force, y = np.zeros(len(wanted)), np.zeros((2, len(wanted)))
    for k, target in enumerate(wanted):
        y[:, k] = np.array(x[:2]) + 0.001 * noise.standard_normal(2)
        rate = 0.7 * rate + 0.3 * (y[:, k] - seen) / 0.01 if k else rate
        seen = y[:, k]
        force[k] = -float(np.asarray(gains) @ (np.r_[seen, rate] - [target, 0.0, 0.0, 0.0]))
        x = _march(rates, x, [force[k], 0.0], 0.01)[:, 1].tolist()
    return rco.Measurement(
        force, y, dt=0.01, input_labels="force", output_labels=["x_m", "angle_m"], input_units="N",
        output_units=["m", "rad"],
    )  # fmt: skip


def frame(force, student=0, damaged=True):
    """Lab 8. Force [N] on the first floor every 10 ms -> velocities [m/s] of the first and the third."""
    (loss, storey), noise = _draws(8, student, (0.08, 0.15), (0, 3))
    k = [900.0, 800.0, 600.0]
    if damaged:
        k[int(storey)] *= 1 - loss
    c, m = [1.5, 1.2, 1.0], [2.0, 2.0, 1.5]

    def rates(x, u):
        f = [
            k[i] * (x[i] - (x[i - 1] if i else 0.0)) + c[i] * (x[3 + i] - (x[2 + i] if i else 0.0))
            for i in range(3)
        ]
        return [*x[3:], (u - f[0] + f[1]) / m[0], (f[1] * -1 + f[2]) / m[1], -f[2] / m[2]]

    v = _march(rates, [0.0] * 6, force, 0.01, 10)[[3, 5]]
    y = v + 0.02 * v.std(axis=1, keepdims=True) * noise.standard_normal(v.shape)
    return rco.Measurement(
        force, y, dt=0.01, input_labels="force", output_labels=["v1", "v3"], input_units="N",
        output_units=["m/s", "m/s"],
    )  # fmt: skip
