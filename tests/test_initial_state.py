"""How a record starts: estimated where it shows, as it moves later where it does not."""

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import rcorefine as rco

DT = 0.01
MODES = ((3.0, 0.02), (40.0, 0.05), (900.0, 0.8))  # rad/s, damping ratio: the last dies within a sample


def plant(mix: np.ndarray) -> ct.StateSpace:
    """Three modes seen by two displacements, in coordinates that mix them."""
    A = np.zeros((6, 6))
    for i, (omega, zeta) in enumerate(MODES):
        A[i, 3 + i], A[3 + i, i], A[3 + i, 3 + i] = 1.0, -(omega**2), -2 * zeta * omega
    B, C = np.array([[0, 0, 0, 1.0, 1.0, 1.0]]).T, np.array([[1, 1, 1, 0, 0, 0], [1, -1, 0.5, 0, 0, 0.0]])
    T = np.kron(np.eye(2), mix)
    return ct.ss(T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), 0)


def record(system: ct.StateSpace, x0: np.ndarray, noise: float, rng: np.random.Generator) -> rco.Measurement:
    """By the matrix exponential of scipy, sample for sample."""
    n, w = 6, rng.normal(size=600)
    held = expm(np.block([[system.A, system.B], [np.zeros((1, n + 1))]]) * DT)
    x, y = x0, np.empty((2, 600))
    for k in range(600):
        y[:, k] = system.C @ x
        x = held[:n, :n] @ x + held[:n, n] * w[k]
    return rco.Measurement(w, y + noise * y.std(axis=1, keepdims=True) * rng.normal(size=y.shape), dt=DT)


@pytest.fixture
def mixed(rng):
    return plant(np.linalg.qr(rng.normal(size=(3, 3)))[0])


def test_a_mode_that_dies_within_a_sample_starts_no_farther_off_than_it_moves(mixed, rng):
    for _ in range(5):
        data = record(mixed, np.zeros(6), 0.02, rng)
        found = rco.simulate(mixed, data)
        truth = rco.simulate(mixed, data, "zero").states
        assert np.all(np.abs(found.x0) < 3000.0 * np.abs(truth).max(axis=1))
        refined = rco.refine(mixed, data)
        assert np.all(np.abs(refined.initial_states[0]) < 3000.0 * np.abs(truth).max(axis=1))


def test_an_exact_record_keeps_its_exact_start(mixed, rng):
    x0 = 0.1 * rng.normal(size=6)
    start = rco.simulate(mixed, record(mixed, x0, 0.0, rng)).x0
    # through the outputs alone: the velocity of the brief mode is not seen behind the first sample
    seen = np.vstack([mixed.C @ expm(mixed.A * DT * k) for k in range(200)])
    assert np.abs(seen @ (start - x0)).max() < 1e-9 * np.abs(seen @ x0).max()


def test_slow_modes_start_without_bias(mixed, rng):
    """Estimates over their standard deviations, by scipy's least squares on the two slow modes: normal."""
    x0 = plant_start(mixed)
    z = []
    for _ in range(60):
        data = record(mixed, x0, 0.02, rng)
        start = rco.refine(mixed, data, offset=False).initial_states[0]
        noise = 0.02 * data.outputs.std(axis=1)
        seen = np.concatenate([mixed.C @ expm(mixed.A * DT * k) / noise[:, None] for k in range(600)])
        slow = np.linalg.svd(seen)[2][:4]  # the four directions that the record sees best
        spread = np.sqrt(np.diag(slow @ np.linalg.pinv(seen.T @ seen) @ slow.T))
        z.append(slow @ (start - x0) / spread)
    mean = np.mean(z, axis=0) * np.sqrt(60)
    assert np.abs(mean).max() < 4.0  # normal: 4 in 60 000 beyond, 4 directions
    assert 0.75 < np.std(z) < 1.25  # 240 values: 0.954 to 1.046 in one of three


def plant_start(system: ct.StateSpace) -> np.ndarray:
    """Released from where a constant force of 300 holds it: hundreds of times what the input does."""
    return -np.linalg.solve(system.A, system.B[:, 0]) * 300.0


def test_a_nonlinear_record_cut_in_motion_starts_where_it_was():
    """A car on a hardening spring: the linear part alone explains nothing, and would start anywhere."""
    ms, mu, k, kt, c, hard, dt, n = 300.0, 40.0, 16e3, 190e3, 1e3, 1.5e6, 0.01, 2800
    rng = np.random.default_rng(3)
    road = np.convolve(rng.normal(size=n), np.exp(-((np.arange(-40, 41) / 8) ** 2)), "same")
    road *= 0.06 / road.std()

    def slope(x, r):
        d = x[0] - x[1]
        pull = k * d + hard * d**3 + c * (x[2] - x[3])
        return np.array([x[2], x[3], -pull / ms, (pull - kt * (x[1] - r)) / mu])

    x, body, h = np.zeros(4), np.empty(n), dt / 4  # Runge-Kutta, 4 steps a sample
    for i in range(n):
        body[i] = x[0]
        for _ in range(4):
            a = slope(x, road[i])
            b = slope(x + h / 2 * a, road[i])
            e = slope(x + h / 2 * b, road[i])
            x = x + h / 6 * (a + 2 * b + 2 * e + slope(x + h * e, road[i]))
    noise = 0.02 * body.std()
    data = rco.Measurement(road, body + noise * rng.normal(size=n), dt=dt)
    model = rco.quarter_car(
        ms, mu, k, c, kt, road="displacement", sensors="body_position", inputs="u[0]", outputs="y[0]"
    )
    held = rco.Effect("cubic_stiffness", "suspension", fixed={"cubic_stiffness": hard})
    whole = rco.refine(model, data, [held], offset=False)
    parts = [data.segment(float(first), float(first + 8)) for first in range(1, 20)]
    left = np.array([rco.compare(whole, part).rmse[0] for part in parts]) / noise
    # noise alone leaves 1 +- 0.025; a start in a wrong valley, up to 10
    assert np.sum(left > 1.15) <= 1
