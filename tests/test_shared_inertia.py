"""Coordinates that share inertia: the mass matrix of a plain model, against the one it was built from."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from hidden.generator import Law, held_motion

import rcorefine as rco


def model(M: np.ndarray, K: np.ndarray, C: np.ndarray, B: np.ndarray, digits: int = 17) -> ct.StateSpace:
    """State space of M q'' + C q' + K q = B w, its entries rounded."""
    n, W = len(M), np.linalg.inv(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-W @ K, -W @ C]])
    rounded = np.vectorize(lambda x: float(f"{x:.{digits}g}"))
    names = [f"q{i}" for i in range(n)] + [f"v{i}" for i in range(n)]
    return ct.ss(
        rounded(A), rounded(np.vstack([0 * B, W @ B])), np.eye(2 * n)[:n], 0, states=names, inputs=B.shape[1]
    )


def acts(system: ct.StateSpace) -> np.ndarray:
    """What a unit force at each coordinate does to the velocities, a column per coordinate."""
    n = system.nstates // 2
    found = {port.name: port for port in rco.ports(system)}
    return -np.array([found[f"q{i}"].act[n:] for i in range(n)]).T


def cantilever(elements: int) -> tuple[np.ndarray, np.ndarray]:
    """Mass and stiffness of Euler-Bernoulli finite elements with consistent mass, clamped at one end."""
    L = 1.0 / elements
    stiff = np.array(
        [
            [12, 6 * L, -12, 6 * L],
            [6 * L, 4 * L * L, -6 * L, 2 * L * L],
            [-12, -6 * L, 12, -6 * L],
            [6 * L, 2 * L * L, -6 * L, 4 * L * L],
        ]
    )
    mass = np.array(
        [
            [156, 22 * L, 54, -13 * L],
            [22 * L, 4 * L * L, 13 * L, -3 * L * L],
            [54, 13 * L, 156, -22 * L],
            [-13 * L, -3 * L * L, -22 * L, 4 * L * L],
        ]
    )
    M = np.zeros((2 * elements + 2,) * 2)
    K = M.copy()
    for e in range(elements):
        part = slice(2 * e, 2 * e + 4)
        K[part, part] += stiff / L**3
        M[part, part] += mass * L / 420
    return M[2:, 2:], K[2:, 2:]


CART, POLE, LENGTH, INERTIA = 0.5, 0.2, 0.3, 0.006
PENDULUM = np.array([[CART + POLE, POLE * LENGTH], [POLE * LENGTH, INERTIA + POLE * LENGTH**2]])
HEAVY = np.diag([0.0, -POLE * 9.8 * LENGTH])


@pytest.mark.parametrize("digits", [17, 6, 4])
@pytest.mark.parametrize("damping", [(0.1, 0.0), (0.1, 0.002), (0.0, 0.0)])
def test_a_cart_and_its_pendulum(damping: tuple[float, float], digits: int) -> None:
    system = model(PENDULUM, HEAVY, np.diag(damping), np.array([[1.0], [0.0]]), digits)
    W = np.linalg.inv(PENDULUM)
    np.testing.assert_allclose(acts(system), W, rtol=3 * 10.0**-digits + 1e-9)
    values = {q.name: q.value for q in rco.physical(system).parameters}
    expected = {"k[q1]": HEAVY[1, 1], "gain[u[0]]": 1.0}
    expected |= {f"c[q{i}]": c for i, c in enumerate(damping)}
    assert set(values) == set(expected)
    for name, value in expected.items():
        assert values[name] == pytest.approx(value, rel=20 * 10.0**-digits + 1e-9)


def test_an_angle_that_is_measured_from_another() -> None:
    hub, link = 0.002, 0.004
    M = np.array([[hub + link, link], [link, link]])  # the second is the deflection of the link
    system = model(M, np.diag([0.0, 1.3]), np.diag([0.09, 0.0]), np.array([[0.12], [0.0]]))
    np.testing.assert_allclose(acts(system), 0.12 * np.linalg.inv(M), rtol=1e-9)  # in units of the input


@pytest.mark.parametrize("elements", [2, 3, 5])
@pytest.mark.parametrize("damped", [False, True])
def test_finite_elements(elements: int, damped: bool) -> None:
    M, K = cantilever(elements)
    tip = np.eye(len(M))[:, -2:-1]
    C = 0.1 * M + 1e-4 * K if damped else 0.0 * K
    W = np.linalg.inv(M)
    np.testing.assert_allclose(acts(model(M, K, C, tip)), W, atol=1e-8 * np.abs(W).max())


def test_random_masses_are_those_that_the_model_was_built_from(rng: np.random.Generator) -> None:
    for _ in range(30):
        n = int(rng.integers(2, 5))
        X, Y, z = rng.standard_normal((n, 2 * n)), rng.standard_normal((n, 2 * n)), rng.standard_normal(n)
        M = X @ X.T
        system = model(M, Y @ Y.T, 0.1 * np.outer(z, z), np.eye(n)[:, rng.integers(n)][:, None])
        W = np.linalg.inv(M)
        np.testing.assert_allclose(acts(system), W, atol=1e-6 * np.abs(W).max())


def test_what_no_mass_matrix_makes_symmetric_has_none(rng: np.random.Generator) -> None:
    for damped in (False, True):
        for _ in range(30):
            n = int(rng.integers(2, 4))
            C = rng.standard_normal((n, n)) if damped else np.zeros((n, n))
            system = model(np.eye(n), rng.standard_normal((n, n)), C, rng.standard_normal((n, 1)))
            found = acts(system)
            assert np.count_nonzero(found) == n  # a force acts on its own velocity alone


def test_friction_at_the_cart_of_a_plain_pendulum_is_named() -> None:
    system = model(PENDULUM, HEAVY, np.diag([0.1, 0.0]), np.array([[1.0], [0.0]]))
    gain = ct.lqr(system, np.diag([10.0, 1.0, 1.0, 1.0]), 0.1)[0][0]
    rng, dt, x = np.random.default_rng(3), 0.02, np.zeros(4)
    command = np.repeat(2.0 * rng.standard_normal(400), 3)[:1000]
    push, at = system.B[:, 0], np.eye(4)
    friction = [(Law("coulomb_friction", np.array([1.0, 2e-3, 0.0])), -push, at[0], at[2])]
    inputs, outputs = np.zeros(1000), np.zeros((2, 1000))
    for k in range(1000):
        outputs[:, k], inputs[k] = x[:2], command[k] - gain @ x
        x = held_motion(system.A, np.outer([1.0, 0.0], inputs[k] * push), dt, friction, start=x)[1]
    outputs += 0.02 * outputs.std(axis=1, keepdims=True) * rng.standard_normal(outputs.shape)
    found = rco.diagnose(system, rco.Measurement(inputs, outputs, dt=dt))
    assert found.place == "q0"
    assert found.best is not None
    assert "friction" in found.best.effect.kind
    row = next(r for r in found.ranking if r.effect.kind == "coulomb_friction")
    assert abs(row.coefficients["force"] - 1.0) < 4 * row.std["force"]
