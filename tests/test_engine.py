"""The simulation engine against scipy.integrate.solve_ivp, for every kind of effect."""

from __future__ import annotations

import itertools

import control as ct
import numpy as np
import pytest
from inner import Engine, Structure
from scipy.integrate import solve_ivp

import rcorefine as rco

M1, M2, C1, K1, K2 = 1.0, 0.7, 0.3, 40.0, 25.0
DT = 0.05
WIDTH = 0.05


def chain(outputs=("v1", "x1")):
    A = np.array(
        [
            [0, 0, 1, 0],
            [0, 0, 0, 1],
            [-(K1 + K2) / M1, K2 / M1, -2 * C1 / M1, C1 / M1],
            [K2 / M2, -K2 / M2, C1 / M2, -C1 / M2],
        ]
    )
    B = np.array([[0.0], [0.0], [1 / M1], [0.0]])
    C = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0]])
    return ct.ss(A, B, C, 0, inputs="f", outputs=list(outputs), states=["x1", "x2", "v1", "v2"])


def force(n=240, scale=10.0, seed=0):
    return np.random.default_rng(seed).standard_normal(n) * scale


def record(w, hold="foh", ny=2):
    return rco.Measurement(w, np.zeros((ny, w.size)), dt=DT, hold=hold)


def solve(rhs, x0, times):
    """Tight reference solution, restarted at each sample where the input has its kinks."""
    states = [np.asarray(x0, dtype=float)]
    for start, stop in itertools.pairwise(times):
        answer = solve_ivp(rhs, (start, stop), states[-1], rtol=1e-10, atol=1e-12, method="DOP853")
        states.append(answer.y[:, -1])
    return np.array(states).T


def held(w, hold):
    if hold == "zoh":
        return lambda t: w[min(int(np.floor(t / DT + 1e-9)), w.size - 1)]
    times = np.arange(w.size) * DT
    return lambda t: np.interp(t, times, w)


def run(structure, theta, data, substeps, **options):
    return Engine(structure, data, substeps=substeps).run(np.array(theta, dtype=float), **options)


def law_cases():
    s = lambda v: np.tanh(v / WIDTH)  # noqa: E731
    return {
        "cubic_stiffness": ([30.0], lambda d, v: 30 * d**3),
        "quadratic_stiffness": ([20.0], lambda d, v: 20 * d**2),
        "bilinear_stiffness": ([15.0], lambda d, v: 15 * max(d, 0)),
        "clearance": ([50.0, 0.2], lambda d, v: 50 * np.sign(d) * max(abs(d) - 0.2, 0)),
        "soft_clearance": (
            [50.0, 0.2, 0.7],
            lambda d, v: 25 * (2 * d + np.hypot(d - 0.2, 0.14) - np.hypot(d + 0.2, 0.14)),
        ),
        "coulomb_friction": ([1.0], lambda d, v: s(v)),
        "smooth_friction": ([1.0, 0.5], lambda d, v: np.tanh(v / 0.5)),
        "load_friction": ([4.0], lambda d, v: 4 * abs(d) * s(v)),
        "asymmetric_friction": ([1.0, 2.0], lambda d, v: (1.0 if v > 0 else 2.0) * s(v)),
        "asymmetric_damping": ([1.0, 2.0], lambda d, v: (1.0 if v > 0 else 2.0) * v),
        "stribeck_friction": (
            [1.0, 2.0, 0.5],
            lambda d, v: (1 + np.exp(-((v / 0.5) ** 2))) * s(v),
        ),
        "gravity": ([8.0], lambda d, v: 8 * np.sin(d)),
        "cogging": (
            [2.0, 1.0, 0.6],
            lambda d, v: 2 * np.sin(d * np.pi / 0.3) + np.cos(d * np.pi / 0.3) - 1,
        ),
        "quadratic_damping": ([2.0], lambda d, v: 2 * v * abs(v)),
        "cubic_damping": ([0.5], lambda d, v: 0.5 * v**3),
        "power_damping": ([0.8, 1.5], lambda d, v: 0.8 * v * (v * v + WIDTH**2) ** 0.25),
        "stiffness": ([5.0], lambda d, v: 5 * d),
        "damping": ([0.5], lambda d, v: 0.5 * v),
        "constant_force": ([3.0], lambda d, v: 3.0),
    }


CORNERS = {"bilinear_stiffness", "clearance", "asymmetric_damping", "quadratic_damping", "power_damping"}
PORTS = {
    "x1": (lambda x: (x[0], x[2]), np.array([0, 0, -1 / M1, 0])),
    "x1-x2": (lambda x: (x[0] - x[1], x[2] - x[3]), np.array([0, 0, -1 / M1, 1 / M2])),
}


@pytest.mark.parametrize("hold", ["foh", "zoh"])
def test_a_users_law_that_feels_an_input_is_of_fourth_order(hold):
    model, w = chain(), force(120)
    sense, act = PORTS["x1-x2"]
    u, times = held(w, hold), np.arange(w.size) * DT

    def rates(t, x):
        d = sense(x)[0]
        return model.A @ x + model.B[:, 0] * u(t) + act * 0.8 * (u(t) * d + 5.0 * d**3)

    truth = model.C @ solve(rates, np.zeros(4), times)
    structure = Structure(model, [rco.Effect("custom", "x1-x2", law=lambda d, v, w: w[0] * d + 5.0 * d**3)])
    errors = [
        np.abs(run(structure, [0.8], record(w, hold), substeps).outputs - truth).max() / np.abs(truth).max()
        for substeps in (2, 4)
    ]
    assert errors[1] < 1e-6
    assert errors[1] < 0.1 * errors[0]  # a sixteenth per halving
    engine = Engine(structure, record(w, hold), substeps=2)
    above, below = (engine.run(np.array([0.8 + h]), sensitivity=False).outputs for h in (1e-6, -1e-6))
    slope = (above - below) / 2e-6
    found = engine.run(np.array([0.8])).sensitivity[:, :, 0]
    np.testing.assert_allclose(found, slope, atol=1e-7 * np.abs(slope).max())


@pytest.mark.parametrize("place", ["x1", "x1-x2"])
@pytest.mark.parametrize("kind", sorted(law_cases()))
def test_mechanical_law_converges_to_solve_ivp(kind, place):
    theta, law = law_cases()[kind]
    model, w = chain(), force(120)
    sense, act = PORTS[place]
    u = held(w, "foh")
    times = np.arange(w.size) * DT
    x = solve(lambda t, x: model.A @ x + model.B[:, 0] * u(t) + act * law(*sense(x)), np.zeros(4), times)
    truth = model.C @ x
    structure = Structure(model, [rco.Effect(kind, place)], constants={0: WIDTH})
    errors = [
        np.abs(run(structure, theta, record(w), substeps).outputs - truth).max() / np.abs(truth).max()
        for substeps in (4, 8, 16)
    ]
    if structure.is_linear:
        assert max(errors) < 1e-8  # exact, whatever the step
    elif structure.jumps:
        # substeps in which the force jumps are cut finer: accurate from the start, without an order
        assert max(errors) < 1e-2
        assert errors[2] < 1e-3
    elif kind in CORNERS:
        # second order, a quarter per halving, but for where in a substep a corner happens to be
        assert errors[2] < 1e-3
        assert errors[2] < 0.25 * errors[0] + 1e-8
    else:
        assert errors[2] < 1e-7
        assert errors[2] < 0.1 * errors[1] + 1e-9  # fourth order: a sixteenth per halving
        assert errors[2] < 0.008 * errors[0] + 1e-9


@pytest.mark.parametrize("kind", sorted(law_cases()))
def test_sensitivities_are_the_derivatives(kind):
    theta = np.array(law_cases()[kind][0])
    data = record(force(150), hold="zoh")
    structure = Structure(chain(), [rco.Effect(kind, "x1-x2")], constants={0: WIDTH})
    engine = Engine(structure, data, substeps=2)
    x0 = np.array([0.01, -0.02, 0.1, 0.0])
    exact = engine.run(theta, x0, initial_state=True).sensitivity
    for i in range(theta.size + 4):
        step = np.zeros(theta.size + 4)
        step[i] = 1e-6
        up = engine.run(theta + step[: theta.size], x0 + step[theta.size :], sensitivity=False).outputs
        down = engine.run(theta - step[: theta.size], x0 - step[theta.size :], sensitivity=False).outputs
        np.testing.assert_allclose(exact[:, :, i], (up - down) / 2e-6, atol=2e-5 * np.abs(exact).max())


def test_hysteresis_follows_the_path():
    F, delta = 2.0, 0.1
    model, w = chain(), force(120)
    u = held(w, "foh")
    times = np.arange(w.size) * DT

    def rhs(t, x):
        v = x[2] - x[3]
        f = F * x[4]
        linear = model.A @ x[:4] + model.B[:, 0] * u(t) + PORTS["x1-x2"][1] * f
        return np.append(linear, (v - abs(v) * x[4]) / delta)

    truth = model.C @ solve(rhs, np.zeros(5), times)[:4]
    structure = Structure(model, [rco.Effect("hysteresis", "x1-x2")])
    errors = [
        np.abs(run(structure, [F, delta], record(w), s).outputs - truth).max() / np.abs(truth).max()
        for s in (4, 16)
    ]
    assert errors[1] < 2e-3
    assert errors[1] < 0.15 * errors[0]


@pytest.mark.parametrize("delta", [0.1, 0.004])
def test_lugre_friction_follows_its_equation(delta):
    """Bristles as Canudas de Wit wrote them, without their own damping: soft ones and stiff ones."""
    F, ratio, slow = 2.0, 1.7, 0.4
    model, w = chain(), force(120)
    u = held(w, "foh")
    times = np.arange(w.size) * DT

    def rhs(t, x):
        v = x[2] - x[3]
        level = F * (1 + (ratio - 1) * np.exp(-((v / slow) ** 2)))
        bristles = F / delta  # their stiffness; x[4] is how far they are bent
        linear = model.A @ x[:4] + model.B[:, 0] * u(t) + PORTS["x1-x2"][1] * bristles * x[4]
        return np.append(linear, v - bristles * abs(v) / level * x[4])

    truth = model.C @ solve(rhs, np.zeros(5), times)[:4]
    structure = Structure(model, [rco.Effect("lugre_friction", "x1-x2")])
    theta = [F, ratio, slow, delta]
    errors = [
        np.abs(run(structure, theta, record(w), s).outputs - truth).max() / np.abs(truth).max()
        for s in (4, 64)
    ]
    assert errors[0] < 0.1  # stiff or not, a coarse step stays near
    assert errors[1] < 2e-3
    assert errors[1] < 0.15 * errors[0]


def test_play_is_dragged_along():
    k, gap = 30.0, 0.15
    model, w = chain(), force(120)
    u = held(w, "foh")
    fine = np.linspace(0, DT * (w.size - 1), 200 * (w.size - 1) + 1)
    step = fine[1]

    def dragged(x, z):
        return np.clip(z, x[0] - x[1] - gap, x[0] - x[1] + gap)

    def rate(t, x, z):
        return model.A @ x + model.B[:, 0] * u(t) + PORTS["x1-x2"][1] * k * dragged(x, z)

    x, z, states = np.zeros(4), 0.0, []
    for t in fine[:-1]:  # it may catch at any time: midpoint steps, far finer than the record
        states.append(x)
        half = x + 0.5 * step * rate(t, x, z)
        x = x + step * rate(t + 0.5 * step, half, z)
        z = dragged(x, z)
    truth = model.C @ np.array([*states, x]).T[:, ::200]
    structure = Structure(model, [rco.Effect("play", "x1-x2")])
    answer = run(structure, [k, gap], record(w), 32).outputs
    np.testing.assert_allclose(answer, truth, atol=2e-3 * np.abs(truth).max())


def test_mass_and_hidden_mode_are_exact():
    model, w = chain(), force(120)
    u = held(w, "zoh")
    times = np.arange(w.size) * DT
    extra = 0.3
    A, B = model.A.copy(), model.B.copy()
    A[2] *= M1 / (M1 + extra)
    B[2] *= M1 / (M1 + extra)
    truth = model.C @ solve(lambda t, x: A @ x + B[:, 0] * u(t), np.zeros(4), times)
    heavier = Structure(model, [rco.Effect("mass", "x1")])
    np.testing.assert_allclose(run(heavier, [extra], record(w, "zoh"), 1).outputs, truth, atol=1e-7)

    m, c, k = 0.1, 0.05, 3.0

    def rhs(t, x):
        f = k * (x[0] - x[4]) + c * (x[2] - x[5])
        linear = model.A @ x[:4] + model.B[:, 0] * u(t) + PORTS["x1"][1] * f
        return np.concatenate([linear, [x[5], f / m]])

    truth = model.C @ solve(rhs, np.zeros(6), times)[:4]
    attached = Structure(model, [rco.Effect("hidden_mode", "x1")])
    np.testing.assert_allclose(run(attached, [m, c, k], record(w, "zoh"), 1).outputs, truth, atol=1e-7)


def test_what_relaxes_is_exact():
    model, w = chain(), force(120)
    u = held(w, "zoh")
    times = np.arange(w.size) * DT
    k, T = 12.0, 0.3

    def rhs(t, x):
        linear = model.A @ x[:4] + model.B[:, 0] * u(t) + PORTS["x1"][1] * k * x[4]
        return np.append(linear, x[2] - x[4] / T)

    truth = model.C @ solve(rhs, np.zeros(5), times)[:4]
    rubber = Structure(model, [rco.Effect("maxwell_element", "x1")])
    np.testing.assert_allclose(run(rubber, [k, T], record(w, "zoh"), 1).outputs, truth, atol=1e-7)

    tank = ct.ss([[-0.4]], [[1.0]], [[1.0]], 0, inputs="q", outputs="y", states=["T"])
    m, c = 2.5, 0.7
    truth = solve(
        lambda t, x: np.array([-0.4 * x[0] + u(t) - c * (x[0] - x[1]), c * (x[0] - x[1]) / m]),
        np.zeros(2),
        times,
    )[:1]
    wall = Structure(tank, [rco.Effect("hidden_store", "T")])
    np.testing.assert_allclose(run(wall, [m, c], record(w, "zoh"), 1).outputs, truth, atol=1e-7)


def test_a_stop_stands_on_the_side_of_its_sign():
    model, w = chain(), force(150)
    u = held(w, "zoh")
    times = np.arange(w.size) * DT
    for side in (1.0, -1.0):
        k, at = 60.0, 0.04 * side

        def rhs(t, x, k=k, at=at, side=side):
            return model.A @ x + model.B[:, 0] * u(t) + PORTS["x1"][1] * k * side * max(side * (x[0] - at), 0)

        free = model.C @ solve(lambda t, x: model.A @ x + model.B[:, 0] * u(t), np.zeros(4), times)
        truth = model.C @ solve(rhs, np.zeros(4), times)
        answer = run(Structure(model, [rco.Effect("end_stop", "x1")]), [k, at], record(w, "zoh"), 64).outputs
        assert np.abs(truth - free).max() > 0.1 * np.abs(free).max()  # it is hit
        np.testing.assert_allclose(answer, truth, atol=2e-3 * np.abs(truth).max())


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("delay", [0.0, 0.3 * DT, 2.6 * DT])
def test_input_delay_to_a_fraction_of_a_sample(hold, delay):
    model, w = chain(), force(150)
    u = held(w, hold)
    structure = Structure(model, [rco.Effect("input_delay", "f")])
    fine = np.unique(
        np.round(np.concatenate([np.arange(w.size) * DT, np.arange(w.size - 4) * DT + delay]), 12)
    )
    x = solve(lambda t, x: model.A @ x + model.B[:, 0] * u(max(t - delay, 0.0)), np.zeros(4), fine)
    at = np.searchsorted(fine, np.arange(w.size - 5) * DT - 1e-9)
    truth = model.C @ x[:, at]
    answer = run(structure, [delay], record(w, hold), 8)
    scale = np.abs(truth).max()
    np.testing.assert_allclose(answer.outputs[:, : w.size - 5], truth, atol=5e-3 * scale)


def dragged(w, gap):
    """What follows w with play, sample by sample."""
    found, last = np.zeros(w.size), 0.0
    for k, value in enumerate(w):
        found[k] = last = np.clip(last, value - gap, value + gap)
    return found


def test_an_actuator_acts_by_a_power_of_its_command():
    model, w = chain(), force(150)
    u = held(np.sign(w) * 6.0 * np.abs(w / 6.0) ** 1.6, "zoh")
    times = np.arange(w.size) * DT
    truth = model.C @ solve(lambda t, x: model.A @ x + model.B[:, 0] * u(t), np.zeros(4), times)
    answer = run(Structure(model, [rco.Effect("input_power", "f")]), [1.6, 6.0], record(w, "zoh"), 1)
    np.testing.assert_allclose(answer.outputs, truth, atol=1e-6)


def test_a_magnet_pulls_by_its_current_over_its_distance():
    A, B = np.array([[0, 1], [-40.0, -0.6]]), np.array([[0, 0], [1.0, 0]])
    model = ct.ss(A, B, [[1.0, 0]], 0, inputs=["f", "i"], outputs=["x"], states=["x", "v"])
    rng = np.random.default_rng(4)
    w = np.stack([force(120, 2.0), 2.0 + 0.3 * rng.standard_normal(120)])
    times = np.arange(120) * DT

    def rhs(t, x):
        push, current = (np.interp(t, times, row) for row in w)
        return A @ x + np.array([0.0, push + 0.2 * current**2 / (0.7 - x[0]) ** 2])

    truth = solve(rhs, np.zeros(2), times)[:1]
    data = rco.Measurement(w, np.zeros((1, 120)), dt=DT, hold="foh")
    pull = rco.Effect("magnetic_force", "x", fixed={"gap": 0.7, "current": 2})
    answer = run(Structure(model, [pull]), [0.2], data, 16)
    np.testing.assert_allclose(answer.outputs, truth, atol=2e-3 * np.abs(truth).max())


def test_input_statics_and_their_derivatives():
    model, w = chain(), force(150)
    times = np.arange(w.size) * DT
    for kind, level, law in (
        ("input_deadzone", 4.0, lambda w: np.sign(w) * np.maximum(np.abs(w) - 4.0, 0)),
        ("input_saturation", 6.0, lambda w: np.clip(w, -6, 6)),
        ("input_play", 2.0, lambda w: dragged(w, 2.0)),
    ):
        u = held(law(w), "zoh")
        truth = model.C @ solve(lambda t, x, u=u: model.A @ x + model.B[:, 0] * u(t), np.zeros(4), times)
        structure = Structure(model, [rco.Effect(kind, "f")])
        engine = Engine(structure, record(w, "zoh"))
        answer = engine.run(np.array([level]))
        np.testing.assert_allclose(answer.outputs, truth, atol=1e-7)
        up, down = (engine.run(np.array([level + s])).outputs for s in (1e-6, -1e-6))
        np.testing.assert_allclose(answer.sensitivity[:, :, 0], (up - down) / 2e-6, atol=1e-6)


def chased(w, rate, hold, fine):
    """An actuator that follows w no faster than a rate: sample by sample, `fine` points in each."""
    points = np.arange((w.size - 1) * fine + 1) / fine
    command = (
        np.append(np.repeat(w[:-1], fine), w[-1]) if hold == "zoh" else np.interp(points, range(w.size), w)
    )
    found, r, reach = np.empty(command.size), w[0], rate * DT / fine
    for k in range(command.size):
        found[k] = r
        target = command[k] if hold == "zoh" else command[min(k + 1, command.size - 1)]
        r += np.clip(target - r, -reach, reach)
    return found


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_an_actuator_cannot_move_faster_than_a_rate(hold):
    model, w = chain(), np.cumsum(force(200)) / 4.0
    rate, fine = 0.6 * np.abs(np.diff(w)).max() / DT, 200
    acts = chased(w, rate, hold, fine)
    times = np.arange(acts.size) * DT / fine
    truth = ct.forced_response(model, times, acts).outputs[:, ::fine]
    structure = Structure(model, [rco.Effect("input_rate_limit", "f")])
    # of a held command the ramps are exact; what is left is how it turns within a substep
    engine = Engine(structure, record(w, hold), substeps=4 if hold == "zoh" else 16)
    answer = engine.run(np.array([rate]), x0=np.zeros(4))
    scale = np.abs(truth).max(axis=1, keepdims=True)
    without = Engine(Structure(model), record(w, hold)).run(np.zeros(0), x0=np.zeros(4)).outputs
    assert np.abs((without - truth) / scale).max() > 0.05
    assert np.abs((answer.outputs - truth) / scale).max() < (1e-5 if hold == "zoh" else 2e-3)
    up, low = (engine.run(np.array([rate + s]), x0=np.zeros(4)).outputs for s in (1e-5, -1e-5))
    slope = (up - low) / 2e-5
    np.testing.assert_allclose(answer.sensitivity[:, :, 0], slope, atol=1e-3 * np.abs(slope).max())


def test_lags_gains_and_offsets_are_exact():
    model, w = chain(), force(150)
    u = held(w, "zoh")
    times = np.arange(w.size) * DT
    lag = 0.13

    def rhs(t, x):
        return np.append(model.A @ x[:4] + model.B[:, 0] * x[4], (1.2 * u(t) + 0.7 - x[4]) / lag)

    truth = model.C @ solve(rhs, np.zeros(5), times)[:4]
    effects = [rco.Effect("input_lag", "f"), rco.Effect("input_gain", "f"), rco.Effect("input_offset", "f")]
    answer = run(Structure(model, effects), [lag, 0.2, 0.7], record(w, "zoh"), 1)
    np.testing.assert_allclose(answer.outputs, truth, atol=1e-7)

    def sensor(t, x):
        y = x[2]
        return np.append(model.A @ x[:4] + model.B[:, 0] * u(t), (y - x[4]) / lag)

    x = solve(sensor, np.zeros(5), times)
    effects = [
        rco.Effect("output_lag", "v1"),
        rco.Effect("output_gain", "v1"),
        rco.Effect("output_offset", "x1"),
    ]
    answer = run(Structure(model, effects), [lag, -0.1, 2.0], record(w, "zoh"), 1)
    np.testing.assert_allclose(answer.outputs[0], 0.9 * x[4], atol=1e-7)
    np.testing.assert_allclose(answer.outputs[1], x[0] + 2.0, atol=1e-7)


def test_sensor_statics_and_delay():
    model, w = chain(), force(150)
    u = held(w, "foh")
    times = np.arange(w.size) * DT
    x = solve(lambda t, x: model.A @ x + model.B[:, 0] * u(t), np.zeros(4), times)
    y = model.C @ x
    clip = run(Structure(model, [rco.Effect("output_saturation", "v1")]), [0.8], record(w), 1)
    np.testing.assert_allclose(clip.outputs[0], np.clip(y[0], -0.8, 0.8), atol=1e-7)
    bridge = run(Structure(model, [rco.Effect("output_rectification", "x1")]), [0.9], record(w), 1)
    np.testing.assert_allclose(bridge.outputs[1], 0.1 * y[1] + 0.9 * np.abs(y[1]), atol=1e-7)
    late = 1.4 * DT
    shifted = solve(
        lambda t, x: model.A @ x + model.B[:, 0] * u(t),
        np.zeros(4),
        np.unique(np.round(np.concatenate([times, times[2:] - late]), 12)),
    )
    fine = np.unique(np.round(np.concatenate([times, times[2:] - late]), 12))
    truth = model.C @ shifted[:, np.searchsorted(fine, times[2:] - late - 1e-9)]
    answer = run(Structure(model, [rco.Effect("output_delay", "x1")]), [late], record(w), 1)
    np.testing.assert_allclose(answer.outputs[1, 2:], truth[1], atol=2e-3 * np.abs(truth[1]).max())


def test_moving_average_against_finer_integration():
    """The mean over the last 3.4 samples, and its derivative by the window."""
    model = chain()
    rng = np.random.default_rng(3)
    w = np.repeat(rng.uniform(-1, 1, 30), 10)
    structure, window = Structure(model, [rco.Effect("output_average", "x1")]), 3.4 * DT
    fine = rco.Measurement(np.repeat(w, 50), np.zeros((2, 50 * w.size)), dt=DT / 50)
    y = run(Structure(model, []), [], fine, 1).outputs[1]
    area = np.concatenate([[0.0], np.cumsum((y[1:] + y[:-1]) / 2)])
    k = np.arange(w.size) * 50
    count = round(50 * window / DT)
    truth = (area[k] - area[np.maximum(k - count, 0)]) / count  # at rest before the record
    held_record = record(w, "zoh")
    answer = run(structure, [window], held_record, 4)
    np.testing.assert_allclose(answer.outputs[1], truth, atol=5e-4 * np.abs(y).max())  # spline over kinks
    up, low = (run(structure, [window + s], held_record, 4).outputs[1] for s in (1e-6, -1e-6))
    tolerance = 1e-4 * np.abs(y).max() / window
    np.testing.assert_allclose(answer.sensitivity[1, :, 0], (up - low) / 2e-6, atol=tolerance)


def test_first_order_laws():
    model = ct.ss([[-0.1]], [[1.0]], [[1.0]], 0, inputs="q", outputs="y", states=["level"])
    rng = np.random.default_rng(3)
    w = np.repeat(rng.uniform(0, 3, 30), 10)
    u = held(w, "zoh")
    times = np.arange(w.size) * DT
    for kind, theta, law in (
        ("sqrt_flow", [0.5], lambda x: 0.5 * np.sqrt(max(x, 0))),
        ("threshold_flow", [0.6, 1.2], lambda x: 0.6 * max(x - 1.2, 0)),
        ("coulomb_friction", [0.3], lambda x: 0.3 * np.tanh(x / WIDTH)),
        ("quadratic_damping", [0.2], lambda x: 0.2 * x * abs(x)),
        ("radiation", [1e-8], lambda x: 1e-8 * ((x + 293.15) ** 4 - 293.15**4)),
        ("smooth_friction", [0.3, 0.8], lambda x: 0.3 * np.tanh(x / 0.8)),
        ("power_damping", [0.2, 1.4], lambda x: 0.2 * x * (x * x + WIDTH**2) ** 0.2),
        ("cubic_damping", [0.1], lambda x: 0.1 * x**3),
        ("damping", [0.2], lambda x: 0.2 * x),
    ):
        truth = solve(lambda t, x, law=law: -0.1 * x + u(t) - law(x[0]), [2.0], times)
        constants = {0: 1e-5 if kind == "sqrt_flow" else WIDTH}
        structure = Structure(model, [rco.Effect(kind, "level")], constants=constants)
        answer = run(structure, theta, record(w, "zoh", 1), 8, x0=np.array([2.0]))
        np.testing.assert_allclose(answer.outputs, truth, atol=2e-4 * np.abs(truth).max(), err_msg=kind)


def test_coefficient_of_A_and_custom_law():
    model, w = chain(), force(80)
    u = held(w, "foh")
    times = np.arange(w.size) * DT
    A = model.A.copy()
    A[3, 0] += 4.0
    truth = model.C @ solve(lambda t, x: A @ x + model.B[:, 0] * u(t), np.zeros(4), times)
    answer = run(Structure(model, [rco.Effect("coefficient", "A[v2,x1]")]), [4.0], record(w), 1)
    np.testing.assert_allclose(answer.outputs, truth, atol=1e-7)

    def law(d, v, a, b):
        return a * np.sin(d) + b * v * v * v

    own = Structure(model, [rco.Effect("custom", "x1", law=law, start={"a": 5.0, "b": 0.1})])
    x = solve(
        lambda t, x: model.A @ x + model.B[:, 0] * u(t) + PORTS["x1"][1] * law(x[0], x[2], 5.0, 0.1),
        np.zeros(4),
        times,
    )
    engine = Engine(own, record(w), substeps=8)
    theta = np.array([5.0, 0.1])
    answer = engine.run(theta)
    np.testing.assert_allclose(answer.outputs, model.C @ x, atol=2e-3 * np.abs(model.C @ x).max())
    up, down = (engine.run(theta + np.array([s, 0.0])).outputs for s in (1e-4, -1e-4))
    np.testing.assert_allclose(answer.sensitivity[:, :, 0], (up - down) / 2e-4, atol=1e-6)


def test_accelerometer_feels_the_force():
    A, B = chain().A, chain().B
    model = ct.ss(A, B, A[2:3], B[2:3], inputs="f", outputs="a1", states=["x1", "x2", "v1", "v2"])
    w = force(100)
    u = held(w, "foh")
    times = np.arange(w.size) * DT
    law = lambda d, v: 30 * d**3  # noqa: E731
    x = solve(lambda t, x: A @ x + B[:, 0] * u(t) + PORTS["x1"][1] * law(x[0], x[2]), np.zeros(4), times)
    truth = A[2] @ x + w / M1 - law(x[0], x[2]) / M1
    answer = run(Structure(model, [rco.Effect("cubic_stiffness", "x1")]), [30.0], record(w, ny=1), 16)
    np.testing.assert_allclose(answer.outputs[0], truth, atol=2e-3 * np.abs(truth).max())


def test_two_ports_at_once():
    model, w = chain(), force(120)
    u = held(w, "foh")
    times = np.arange(w.size) * DT

    def rhs(t, x):
        f1 = 1.0 * np.tanh(x[2] / WIDTH)
        f2 = 30 * (x[0] - x[1]) ** 3
        return model.A @ x + model.B[:, 0] * u(t) + PORTS["x1"][1] * f1 + PORTS["x1-x2"][1] * f2

    truth = model.C @ solve(rhs, np.zeros(4), times)
    effects = [rco.Effect("coulomb_friction", "x1"), rco.Effect("cubic_stiffness", "x1-x2")]
    structure = Structure(model, effects, constants={0: WIDTH})
    answer = run(structure, [1.0, 30.0], record(w), 16)
    np.testing.assert_allclose(answer.outputs, truth, atol=2e-3 * np.abs(truth).max())


def test_stiff_pole_and_singular_matrix_are_exact():
    R, L, C = 250.0, 2e-6, 1.0
    stiff = ct.ss([[0, 1], [-1 / (L * C), -R / L]], [[0], [1 / L]], [[0, R]], 0, states=["q", "i"])
    w = np.random.default_rng(1).standard_normal(50)
    data = rco.Measurement(w, np.zeros(50), dt=1e-4)
    s1, s2 = np.roots([L, R, 1 / C])  # q = a / (s - s1) - a / (s - s2), each exact under a hold
    s2 = 1 / (L * C * s1)  # the slow root, without cancellation
    a, modes, exact = 1 / (L * (s1 - s2)), np.zeros(2), []
    for value in w:
        exact.append(a * (modes[0] - modes[1]))
        for i, pole in enumerate((s1, s2)):
            modes[i] = np.exp(pole * 1e-4) * modes[i] + np.expm1(pole * 1e-4) / pole * value
    answer = rco.simulate(stiff, data, "zero")
    np.testing.assert_allclose(answer.states[0], exact, rtol=1e-7, atol=1e-9 * np.abs(exact).max())
    double = ct.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0)
    answer = rco.simulate(double, rco.Measurement(np.ones(20), np.zeros(20), dt=0.5), "zero")
    np.testing.assert_allclose(answer.outputs[0], 0.5 * (0.5 * np.arange(20)) ** 2, rtol=1e-12)


def test_band_limited_hold_follows_a_sine():
    model = chain()
    n = 600
    omega = 2 * np.pi * 0.35 / DT  # 70 % of Nyquist
    ramp = np.minimum(np.arange(n) / 200, 1.0)
    w = np.sin(omega * np.arange(n) * DT) * ramp**2
    steady = abs(model(1j * omega)[1, 0])
    answer = rco.simulate(model, record(w, "bandlimited"), "zero").outputs[1, 400:560]
    free = np.column_stack(
        [np.sin(omega * np.arange(400, 560) * DT), np.cos(omega * np.arange(400, 560) * DT)]
    )
    slow = np.vander(np.linspace(-1, 1, 160), 12)
    amplitude = np.linalg.lstsq(np.hstack([free, slow]), answer, rcond=None)[0][:2]
    assert np.hypot(*amplitude) == pytest.approx(steady, rel=0.05)  # foh would lose 35 %


def test_observer_pulls_towards_the_record_and_windows_let_go():
    model, w = chain(), force(300)
    truth = rco.simulate(model, record(w), "zero")
    wrong = Structure(model, [rco.Effect("stiffness", "x1")])
    data = rco.Measurement(w, truth.outputs, dt=DT, hold="foh")
    engine = Engine(wrong, data)
    theta = np.array([8.0])
    from rcorefine.engine.observer import observer_gain

    gain = observer_gain(wrong, theta, data, 1.0)
    free = engine.run(theta).outputs - truth.outputs
    led = engine.run(theta, gain=gain).outputs - truth.outputs
    assert np.sqrt(np.mean(led**2)) < 0.5 * np.sqrt(np.mean(free**2))
    off = np.zeros((300, 2), dtype=bool)
    np.testing.assert_allclose(engine.run(theta, gain=gain, use=off).outputs, engine.run(theta).outputs)


def test_divergence_says_when():
    unstable = ct.ss([[5.0]], [[1.0]], [[1.0]], 0)
    data = rco.Measurement(np.ones(400), np.zeros(400), dt=1.0)
    with pytest.raises(rco.DivergenceError, match="sample"):
        rco.simulate(unstable, data, "zero")
