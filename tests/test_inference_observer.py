"""The one Riccati equation and the one smoother: against python-control and the Gaussian they stand for."""

from __future__ import annotations

from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
from inner import Structure
from scipy.stats import multivariate_normal

import rcorefine as rco
from rcorefine.engine.observer import steady_filter
from rcorefine.engine.point import linearized
from rcorefine.engine.smoother import smooth


def plant(rng, n=3, ny=2):
    F = rng.standard_normal((n, n))
    F *= 0.95 / np.abs(np.linalg.eigvals(F)).max()
    L = rng.standard_normal((n, n))
    return F, rng.standard_normal((ny, n)), 0.1 * L @ L.T, np.diag(rng.uniform(0.2, 1.0, ny))


@pytest.mark.parametrize("seed", range(5))
def test_gain_is_that_of_dlqe(seed):
    F, H, Q, R = plant(np.random.default_rng([seed, 5]))
    steady = steady_filter(F, H, Q, R)
    L, P, _ = ct.dlqe(F, np.eye(3), H, Q, R)
    assert steady.predicted == pytest.approx(P, rel=1e-8)
    assert F @ steady.gain == pytest.approx(F @ P @ H.T @ np.linalg.inv(H @ P @ H.T + R), rel=1e-8)
    assert np.abs(np.linalg.eigvals(F @ (np.eye(3) - steady.gain @ H))).max() < 1
    assert steady.filtered == pytest.approx(P - steady.gain @ H @ P, rel=1e-8)
    assert L.shape == steady.gain.shape


def test_a_state_that_no_output_sees_leaves_the_others_alone():
    F, H = np.diag([0.9, 1.0]), np.array([[1.0, 0.0]])
    steady = steady_filter(F, H, np.eye(2), np.eye(1))
    alone = steady_filter(F[:1, :1], H[:, :1], np.eye(1), np.eye(1))
    assert steady.gain[0] == pytest.approx(alone.gain[0], rel=1e-6)
    assert steady_filter(np.zeros((0, 0)), np.zeros((2, 0)), np.zeros((0, 0)), np.eye(2)).gain.shape == (0, 2)


def test_where_no_filter_exists_the_gain_is_no_number():
    """A mode that outgrows in 300 steps what a covariance can hold, and outputs that all see it alike."""
    F, H = np.diag([2.0, 3.0, 1.0]), np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    F[0, 1] = 1e200
    assert not np.isfinite(steady_filter(F, H, 1e200 * np.eye(3), 1e-9 * np.eye(2)).gain).all()


def test_a_model_that_no_observer_leads_is_said_to_be_one():
    """A second mass, seen by nothing, that a negative damper drives away."""
    A = [[0.0, 1.0, 0.0, 0.0], [-40.0, -0.5, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -9.0, 300.0]]
    model = ct.ss(
        A, [[0], [1], [0], [1]], [[0, 1, 0, 0]], 0, states=["q1", "q2", "v1", "v2"], inputs="f", outputs="v"
    )
    rng = np.random.default_rng(0)
    data = rco.Measurement(
        rng.standard_normal(500), rng.standard_normal(500), dt=0.1, input_labels="f", output_labels="v"
    )
    with pytest.raises(rco.ModelError, match="no observer leads the model"):
        rco.diagnose(model, data)


def gaussian(F, H, Q, R, P, N):
    """Covariances of all states and outputs of N samples whose first state has covariance P."""
    n = F.shape[0]
    X = np.zeros((N * n, N * n))
    spread = P
    for k in range(N):
        block = spread
        for j in range(k, N):
            X[j * n : (j + 1) * n, k * n : (k + 1) * n] = block
            X[k * n : (k + 1) * n, j * n : (j + 1) * n] = block.T
            block = F @ block
        spread = F @ spread @ F.T + Q
    C = np.kron(np.eye(N), H)
    return X, C, C @ X @ C.T + np.kron(np.eye(N), R)


@pytest.mark.parametrize("seed", range(3))
def test_states_are_the_mean_given_all_outputs(seed):
    rng = np.random.default_rng([seed, 9])
    F, H, Q, R = plant(rng)
    N, drive = 12, rng.standard_normal((12, 3))
    known = np.zeros((N, 3))
    for k in range(N - 1):
        known[k + 1] = F @ known[k] + drive[k]
    X, C, Y = gaussian(F, H, Q, R, steady_filter(F, H, Q, R).predicted, N)
    noise = rng.multivariate_normal(np.zeros(Y.shape[0]), Y)
    found = smooth(F, H, Q, R, noise.reshape(N, 2) + known @ H.T, drive=drive)
    expected = (X @ C.T @ np.linalg.solve(Y, noise)).reshape(N, 3)
    assert found.states - known == pytest.approx(expected, abs=1e-8)
    assert found.filtered[-1] == pytest.approx(found.states[-1])
    constant = -0.5 * Y.shape[0] * np.log(2 * np.pi)
    assert found.log_likelihood + constant == pytest.approx(
        multivariate_normal(np.zeros(Y.shape[0]), Y).logpdf(noise), rel=1e-9
    )


def test_a_reset_begins_anew(rng):
    F, H, Q, R = plant(rng)
    y = rng.standard_normal((30, 2))
    reset = np.zeros(30, np.uint8)
    reset[[0, 18]] = 1
    both = smooth(F, H, Q, R, y, reset=reset)
    assert both.states[:18] == pytest.approx(smooth(F, H, Q, R, y[:18]).states)
    assert both.states[18:] == pytest.approx(smooth(F, H, Q, R, y[18:]).states)


# ---------------------------------------------------------------- along the motion
def test_a_cubic_spring_is_as_stiff_as_its_describing_function(rng):
    """At amplitude a the best linear fit of k d^3 is 3/4 k a^2 d; where nothing moves, the model stays."""
    model = rco.mass_spring_damper(m=1.0, c=0.1, k=10.0, sensors=("acceleration", 1))
    structure = Structure(model, [rco.Effect("cubic_stiffness", "link1")])
    theta, amplitude, phase = np.array([7.0]), 0.3, 2 * np.pi * np.arange(1000) / 50
    d, v = amplitude * np.sin(phase), amplitude * np.cos(phase)
    states = np.zeros((structure.n_states, 1000))
    port = model.port("link1")
    states[np.argmax(np.abs(port.position))], states[np.argmax(np.abs(port.velocity))] = d, v
    run = SimpleNamespace(states=states, forces=7.0 * (port.position @ states)[None] ** 3)
    A, C = linearized(structure, theta, run, np.zeros((structure.n_inputs, 1000)))
    plain = structure.matrices(theta)
    stiffer = rco.mass_spring_damper(
        m=1.0, c=0.1, k=10.0 + 0.75 * 7.0 * amplitude**2, sensors=("acceleration", 1)
    )
    assert A == pytest.approx(stiffer.system.A, rel=1e-9)
    assert C == pytest.approx(stiffer.system.C, rel=1e-9)
    still = SimpleNamespace(states=0 * states, forces=0 * run.forces)
    assert linearized(structure, theta, still, np.zeros((structure.n_inputs, 1000)))[0] == pytest.approx(
        plain.A
    )


@pytest.mark.parametrize("driven", [1.0, 0.0])
def test_smoothed_covariance_is_the_recursion_backwards(driven: float) -> None:
    """Also of a constant without process noise, which the record shows ever better."""
    F, H = np.array([[0.9, 0.1], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    Q = np.diag([0.1, 1e-3 * driven + 1e-14])
    found = smooth(F, H, Q, np.array([[0.2]]), np.random.default_rng(5).standard_normal((500, 1)))
    P, Pp = found.steady.filtered, found.steady.predicted
    back = P @ F.T @ np.linalg.pinv(Pp, rcond=1e-12)
    expected = P.copy()
    for _ in range(512):
        expected = P + back @ (expected - Pp) @ back.T
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6, atol=1e-9)
