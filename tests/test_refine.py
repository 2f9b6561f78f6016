"""refine reaches what theory allows: true values, Cramer-Rao bounds, error bars that hold.

The truth never comes from the code under test: linear records are made with scipy's matrix
exponential, nonlinear ones with scipy.integrate.solve_ivp.
"""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.stats import binom

import rcorefine as rco
from rcorefine import Effect, Measurement, refine


def held_response(system, w, dt, x0=None):
    """Outputs of a continuous system behind a zero-order hold, by scipy's matrix exponential."""
    A, B, C, D = (np.asarray(m, dtype=float) for m in (system.A, system.B, system.C, system.D))
    n, m = B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A, B
    step = expm(block * dt)
    x = np.zeros(n) if x0 is None else np.asarray(x0, dtype=float)
    w = np.atleast_2d(w)
    y = np.empty((C.shape[0], w.shape[1]))
    for k in range(w.shape[1]):
        y[:, k] = C @ x + D @ w[:, k]
        x = step[:n, :n] @ x + step[:n, n:] @ w[:, k]
    return y


def cramer_rao(response, theta, noise):
    """Standard deviations at the bound, by central differences of the response."""
    columns = []
    for i, value in enumerate(theta):
        h = 1e-5 * max(abs(value), 1e-3)
        up, down = np.array(theta, dtype=float), np.array(theta, dtype=float)
        up[i] += h
        down[i] -= h
        columns.append((response(up) - response(down)).ravel() / (2 * h))
    J = np.array(columns).T
    return noise * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))


# ------------------------------------------------------------------ the paper's structure
def structure(k2, k3):
    m1, m2, c1, c2, c3, k1 = 0.8, 0.5, 100.0, 200.0, 120.0, 1000.0
    M = np.diag([m1, m2])
    K = np.array([[k1 + k2, -k2], [-k2, k2 + k3]])
    C = np.array([[c1 + c2, -c2], [-c2, c2 + c3]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    return ct.ss(
        A, [[0], [0], [1 / m1], [0]], [[0, 0, 1, 0]], 0,
        inputs="force", outputs="v1", states=["x1", "x2", "v1", "v2"],
    )  # fmt: skip


SPRINGS = [Effect("stiffness", "x1-x2"), Effect("stiffness", "x2")]
DT = 1e-3


def test_two_springs_noise_free():
    w = np.random.default_rng(1).standard_normal(3000)
    y = held_response(structure(1500.0, 2000.0), w, DT)
    result = refine(structure(25000.0, 25000.0), Measurement(w, y, dt=DT), SPRINGS)
    values = [row.value for row in result.parameters[:2]]
    np.testing.assert_allclose(values, [1500.0, 2000.0], rtol=1e-7)
    assert result.success
    assert result.fit[0] > 99.9999
    np.testing.assert_allclose(result.system.A, structure(1500.0, 2000.0).A, rtol=1e-7, atol=1e-6)


@pytest.mark.slow
def test_two_springs_reach_the_cramer_rao_bound():
    """40 seeds: standard deviation within 1.15 of the bound, 95 % intervals cover 88-99 %."""
    truth, n, seeds = np.array([1500.0, 2000.0]), 5000, 40
    estimates, spreads, bounds, narrow = [], [], [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        w = rng.standard_normal(n)
        y = held_response(structure(*truth), w, DT)
        noise = 0.01 * y.std()
        data = Measurement(w, y + noise * rng.standard_normal(y.shape), dt=DT)
        result = refine(structure(25000.0, 25000.0), data, SPRINGS)
        estimates.append([row.value for row in result.parameters[:2]])
        spreads.append([row.std for row in result.parameters[:2]])
        if seed < 4:  # the bound varies little with the input

            def response(p, w=w):  # springs, offset, initial state: everything that is estimated
                return held_response(structure(*p[:2]), w, DT, p[3:]) + p[2]

            bounds.append(cramer_rao(response, [*truth, 0, 0, 0, 0, 0], noise)[:2])
            narrow.append(cramer_rao(lambda p, w=w: held_response(structure(*p), w, DT), truth, noise))
    estimates, spreads, bound = np.array(estimates), np.array(spreads), np.mean(bounds, axis=0)
    # the figures of the literature: 0.9 % and 0.36 %
    np.testing.assert_allclose(100 * np.mean(narrow, axis=0) / truth, [0.9, 0.36], rtol=0.06)
    assert np.all(estimates.std(axis=0, ddof=1) <= 1.15 * bound)
    np.testing.assert_allclose(spreads.mean(axis=0), bound, rtol=0.05)
    bias = (estimates.mean(axis=0) - truth) / (bound / np.sqrt(seeds))
    assert np.all(np.abs(bias) < 3.5)
    covered = np.mean(np.abs(estimates - truth) < 1.96 * spreads, axis=0)
    assert np.all((covered >= 0.88) & (covered <= 1.0))
    assert 0.88 <= covered.mean() <= 0.99


# ------------------------------------------------------------------------- RLC
def circuit(L, C, R=250.0):
    return ct.ss(
        [[0, 1], [-1 / (L * C), -R / L]], [[0], [1 / L]], [[0, R]], 0,
        inputs="u", outputs="vR", states=["q", "i"],
    )  # fmt: skip


def inductance_and_capacitance(result):
    """The model's L = 2 uH and 1/C = 1 /F plus what the effects add."""
    return 2e-6 + result.theta[0], 1.0 / (1.0 + result.theta[1])


RLC_EFFECTS = [Effect("mass", "q"), Effect("stiffness", "q")]


def test_circuit_is_exact_without_noise():
    w = np.random.default_rng(0).standard_normal(6000)
    y = held_response(circuit(55e-3, 23.5e-6), w, 1e-4)
    result = refine(circuit(2e-6, 1.0), Measurement(w, y, dt=1e-4), RLC_EFFECTS)
    np.testing.assert_allclose(inductance_and_capacitance(result), (55e-3, 23.5e-6), rtol=1e-6)


@pytest.mark.slow
def test_circuit_reaches_the_cramer_rao_bound():
    truth, n, seeds = np.array([55e-3, 23.5e-6]), 3000, 40
    estimates, bounds = [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        w = rng.standard_normal(n)
        y = held_response(circuit(*truth), w, 1e-4)
        noise = 0.02 * y.std()
        data = Measurement(w, y + noise * rng.standard_normal(y.shape), dt=1e-4)
        estimates.append(inductance_and_capacitance(refine(circuit(2e-6, 1.0), data, RLC_EFFECTS)))
        if seed < 4:

            def response(p, w=w):  # relative values, offset, initial charge and current
                return held_response(circuit(*(truth * p[:2])), w, 1e-4, p[3:] * [1e-6, 1e-3]) + p[2]

            bounds.append(cramer_rao(response, [1, 1, 0, 0, 0], noise)[:2])
    relative = np.array(estimates) / truth - 1.0
    bound = np.mean(bounds, axis=0)
    assert np.all(relative.std(axis=0, ddof=1) <= 1.15 * bound)
    assert np.all(np.abs(relative.mean(axis=0)) < 3.5 * bound / np.sqrt(seeds))


# ------------------------------------------------------------ 1-DOF transmissibility
def test_transmissibility_gives_mass_and_damping():
    """Base excitation, accelerometer, stiffness known: M = 803 kg, C_d = 7000 N s/m."""
    M, Cd, K, dt = 803.0, 7000.0, 63500.0, 0.01
    start = rco.mass_spring_damper([200.0], [15000.0], [K], excitation="base", sensors="acceleration")
    linear = start.linear
    rng = np.random.default_rng(0)
    w = rng.standard_normal((linear.n_inputs, 5000))
    # the builder says what its input is; the truth is the same structure with the true numbers
    true = rco.mass_spring_damper([M], [Cd], [K], excitation="base", sensors="acceleration")
    y = held_response(true.system, w, dt)
    # by hand: s^p (C s + K) / (M s^2 + C s + K), p = 2 from base displacement to acceleration
    s = 1j * np.array([3.0, 9.0, 40.0])
    ratio = (Cd * s + K) / (M * s**2 + Cd * s + K)
    by_hand = np.array([true.system(point).ravel()[0] for point in s])
    assert min(np.abs(by_hand / (ratio * s**p) - 1).max() for p in (0, 1, 2)) < 1e-9
    places = {q.kind: q.place for q in start.parameters}
    result = refine(
        start,
        Measurement(w, y, dt=dt),
        [Effect("mass", places["mass"]), Effect("damping", places["damping"])],
    )
    np.testing.assert_allclose(result.parameter("mass").value, M, rtol=1e-3)
    np.testing.assert_allclose(result.parameter("damping").value, Cd, rtol=1e-3)


# ------------------------------------------------------- one hidden effect, solve_ivp
M1, M2, C1, K1, K2 = 1.0, 0.7, 0.3, 40.0, 25.0
STEP = 0.05


def chain(output="v1"):
    A = [
        [0, 0, 1, 0],
        [0, 0, 0, 1],
        [-(K1 + K2) / M1, K2 / M1, -2 * C1 / M1, C1 / M1],
        [K2 / M2, -K2 / M2, C1 / M2, -C1 / M2],
    ]
    C = [[0, 0, 1, 0]] if output == "v1" else [[1, 0, 0, 0]]
    return ct.ss(
        A, [[0], [0], [1 / M1], [0]], C, 0, inputs="f", outputs=output, states=["x1", "x2", "v1", "v2"]
    )


SENSE = {
    "x1": (lambda x: (x[0], x[2]), np.array([0, 0, -1 / M1, 0])),
    "x2": (lambda x: (x[1], x[3]), np.array([0, 0, 0, -1 / M2])),
    "x1-x2": (lambda x: (x[0] - x[1], x[2] - x[3]), np.array([0, 0, -1 / M1, 1 / M2])),
}
WIDTH = 0.004
LAWS = {
    ("cubic_stiffness", "x2"): ([20.0], lambda d, v: 20 * d**3),
    ("cubic_stiffness", "x1-x2"): ([40.0], lambda d, v: 40 * d**3),
    ("quadratic_stiffness", "x1"): ([10.0], lambda d, v: 10 * d**2),
    ("bilinear_stiffness", "x1-x2"): ([8.0], lambda d, v: 8 * max(d, 0.0)),
    ("clearance", "x1"): ([30.0, 0.2], lambda d, v: 30 * np.sign(d) * max(abs(d) - 0.2, 0.0)),
    ("coulomb_friction", "x1-x2"): ([1.0], lambda d, v: np.tanh(v / WIDTH)),
    ("coulomb_friction", "x2"): ([0.8], lambda d, v: 0.8 * np.tanh(v / WIDTH)),
    ("asymmetric_damping", "x1"): ([0.3, 0.6], lambda d, v: (0.3 if v > 0 else 0.6) * v),
    ("quadratic_damping", "x2"): ([0.3], lambda d, v: 0.3 * v * abs(v)),
    ("cubic_damping", "x1"): ([0.1], lambda d, v: 0.1 * v**3),
    ("damping", "x1-x2"): ([0.4], lambda d, v: 0.4 * v),
    ("stiffness", "x2"): ([6.0], lambda d, v: 6.0 * d),
}


def solved(place, law, w, memory=None):
    """The chain with a force at a port, input linear between samples, by DOP853."""
    model, times = chain(), np.arange(w.size) * STEP
    A, B = np.asarray(model.A), np.asarray(model.B)[:, 0]
    sense, act = SENSE[place]

    def rhs(t, x):
        d, v = sense(x)
        return A @ x + B * np.interp(t, times, w) + act * law(d, v)

    answer = solve_ivp(
        rhs, (0, times[-1]), np.zeros(4), t_eval=times, rtol=1e-8, atol=1e-10, max_step=STEP, method="LSODA"
    )
    return np.asarray(model.C) @ answer.y


@pytest.mark.parametrize(("kind", "place"), sorted(LAWS))
def test_hidden_effect_is_found_within_its_error_bar(kind, place):
    truth, law = LAWS[kind, place]
    rng = np.random.default_rng(7)
    w = 10 * rng.standard_normal(1200)
    y = solved(place, law, w)
    data = Measurement(w, y + 0.01 * y.std() * rng.standard_normal(y.shape), dt=STEP, hold="foh")
    result = refine(chain(), data, [Effect(kind, place)])
    n = len(truth)
    spread = np.sqrt(np.diag(result.covariance))[:n]
    assert np.all(np.abs(result.theta[:n] - truth) < 3 * spread), (result.theta, spread)
    assert np.all(spread < 0.2 * np.abs(truth))
    assert 98.5 < result.fit[0] < 99.3  # 1 % noise leaves 99 %


def test_hysteresis_with_its_own_state():
    """Dahl: f = F z, dz/dt = (v - |v| z) / displacement."""
    force, length = 1.5, 0.1
    rng = np.random.default_rng(3)
    w = 10 * rng.standard_normal(1200)
    model, times = chain(), np.arange(1200) * STEP
    A, B = np.asarray(model.A), np.asarray(model.B)[:, 0]
    sense, act = SENSE["x1"]

    def rhs(t, x):
        _, v = sense(x)
        rate = A @ x[:4] + B * np.interp(t, times, w) + act * force * x[4]
        return np.append(rate, (v - abs(v) * x[4]) / length)

    answer = solve_ivp(
        rhs, (0, times[-1]), np.zeros(5), t_eval=times, rtol=1e-8, atol=1e-10, max_step=STEP, method="LSODA"
    )
    y = answer.y[2:3]
    data = Measurement(w, y + 0.01 * y.std() * rng.standard_normal(y.shape), dt=STEP, hold="foh")
    result = refine(chain(), data, [Effect("hysteresis", "x1")])
    spread = np.sqrt(np.diag(result.covariance))[:2]
    assert np.all(np.abs(result.theta[:2] - [force, length]) < 3 * spread)


def test_sensor_and_actuator_effects():
    """Static laws and a delay of a fraction of a sample, applied by hand to the samples."""
    rng = np.random.default_rng(11)
    w = 10 * rng.standard_normal(1500)
    # held input: a dead zone acts on the samples
    y = held_response(chain(), np.sign(w) * np.maximum(np.abs(w) - 2.0, 0.0), STEP)
    noisy = y + 0.01 * y.std() * rng.standard_normal(y.shape)
    row = refine(chain(), Measurement(w, noisy, dt=STEP), [Effect("input_deadzone", "f")]).parameters[0]
    assert abs(row.value - 2.0) < 3 * row.std < 0.1
    y = held_response(chain(), np.clip(w, -9.0, 9.0), STEP)
    noisy = y + 0.01 * y.std() * rng.standard_normal(y.shape)
    row = refine(chain(), Measurement(w, noisy, dt=STEP), [Effect("input_saturation", "f")]).parameters[0]
    assert abs(row.value - 9.0) < 3 * row.std < 0.3
    y = held_response(chain(), w, STEP)
    rectified = 0.3 * y + 0.7 * np.abs(y)
    noisy = rectified + 0.01 * y.std() * rng.standard_normal(y.shape)
    row = refine(chain(), Measurement(w, noisy, dt=STEP), [Effect("output_rectification", "v1")]).parameters[
        0
    ]
    assert abs(row.value - 0.7) < 3 * row.std < 0.05
    # 0.4 of a sample: the fine grid of a fifth of the sampling time sees two steps of delay
    fine = held_response(chain(), np.repeat(w, 5), STEP / 5)
    delayed = np.concatenate([np.zeros((1, 2)), fine], axis=1)[:, : fine.shape[1]][:, ::5]
    noisy = delayed + 0.01 * y.std() * rng.standard_normal(y.shape)
    row = refine(chain(), Measurement(w, noisy, dt=STEP), [Effect("input_delay", "f")]).parameters[0]
    assert abs(row.value - 0.4 * STEP) < 3 * row.std < 0.1 * STEP


@pytest.mark.slow
def test_error_bars_hold_over_many_records():
    """40 records with a cubic spring: share within 2 standard deviations as the normal law has it."""
    truth, law = LAWS["cubic_stiffness", "x1-x2"]
    z = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        w = 10 * rng.standard_normal(800)
        y = solved("x1-x2", law, w)
        data = Measurement(w, y + 0.01 * y.std() * rng.standard_normal(y.shape), dt=STEP, hold="foh")
        row = refine(chain(), data, [Effect("cubic_stiffness", "x1-x2")]).parameters[0]
        z.append((row.value - truth[0]) / row.std)
    z = np.array(z)
    inside = int(np.sum(np.abs(z) < 2))
    assert binom.cdf(inside, z.size, 0.9545) > 1e-3
    assert np.all(np.abs(z) < 4)
    assert 1 / 1.25 < np.sqrt(np.mean(z**2)) < 1.25


@pytest.mark.slow
def test_strong_cubic_spring_far_from_the_sensor():
    """Free runs have many valleys there; the windows must lead to the right one."""
    for seed in (0, 1, 2):
        rng = np.random.default_rng(seed)
        w = 10 * rng.standard_normal(2000)
        y = solved("x2", lambda d, v: 40 * d**3, w)
        data = Measurement(w, y + 0.01 * y.std() * rng.standard_normal(y.shape), dt=STEP, hold="foh")
        row = refine(chain(), data, [Effect("cubic_stiffness", "x2")]).parameters[0]
        assert abs(row.value - 40) < 3.5 * row.std
        assert row.std < 0.2


def test_coloured_residual_widens_the_error_bars():
    """With AR noise the plain bound would be wrong by the colour; 24 seeds, normal bound on rms z."""
    from scipy.signal import lfilter

    z = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        w = rng.standard_normal(1500)
        y = held_response(chain("x1"), w, STEP)
        colour = lfilter([1.0], [1.0, -0.95], rng.standard_normal(y.size + 200))[200:]
        data = Measurement(w, y + 0.03 * y.std() * colour, dt=STEP)
        row = refine(chain("x1"), data, [Effect("stiffness", "x1")]).parameters[0]
        z.append(row.value / row.std if row.initial == 0 else (row.value - row.initial) / row.std)
    rms = np.sqrt(np.mean(np.square(z)))
    assert 0.6 < rms < 1.45  # chi-square with 24 degrees: 0.62 to 1.41 at 99.9 %
