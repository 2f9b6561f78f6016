"""Exact discretization and the stacked exponential against closed forms and scipy."""

import control as ct
import numpy as np
import pytest
from inner import LinearModel, to_discrete
from scipy import linalg, signal

import rcorefine as rco
from rcorefine import systems
from rcorefine.systems.discretization import exponential


def test_lag_in_closed_form():
    a, b, h = -3.0, 2.0, 0.1
    held = b * np.expm1(a * h) / a
    phi, g0, g1 = systems.discretize([[a]], [[b]], h)
    assert phi[0, 0] == pytest.approx(np.exp(a * h), rel=1e-14)
    assert g0[0, 0] == pytest.approx(held, rel=1e-14)
    assert g1[0, 0] == 0.0
    # x(h) = e^{ah} x + int e^{a(h-s)} b (w0 + (w1 - w0) s / h) ds
    _, g0, g1 = systems.discretize([[a]], [[b]], h, "foh")
    ramp = b * (np.expm1(a * h) - a * h) / (a**2 * h)
    assert g1[0, 0] == pytest.approx(ramp, rel=1e-12)
    assert g0[0, 0] == pytest.approx(held - ramp, rel=1e-12)


def test_chain_of_integrators_is_exact_although_a_is_singular():
    h = 0.25
    phi, g0, g1 = systems.discretize(np.eye(3, k=1), [[0.0], [0.0], [1.0]], h, "foh")
    np.testing.assert_allclose(phi, [[1, h, h**2 / 2], [0, 1, h], [0, 0, 1]], rtol=1e-14)
    # A ramp of slope 1 from 0 integrates to t^2/2, t^3/6, t^4/24.
    np.testing.assert_allclose(g1.ravel() * h, [h**4 / 24, h**3 / 6, h**2 / 2], rtol=1e-13)
    np.testing.assert_allclose((g0 + g1).ravel(), [h**3 / 6, h**2 / 2, h], rtol=1e-13)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_against_scipy_for_random_mimo_models(rng, hold):
    for _ in range(20):
        n = int(rng.integers(1, 7))
        a = rng.standard_normal((n, n)) - 2 * np.eye(n)
        b = rng.standard_normal((n, 2))
        phi, g0, g1 = systems.discretize(a, b, 0.2, hold)
        ad, bd, _, dd, _ = signal.cont2discrete((a, b, np.eye(n), np.zeros((n, 2))), 0.2, hold)
        np.testing.assert_allclose(phi, ad, rtol=1e-10, atol=1e-12)
        # scipy shifts the state: B = G0 + Phi G1, D = C G1.
        np.testing.assert_allclose(g0 + phi @ g1, bd, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(g1, dd, rtol=1e-10, atol=1e-12)


def test_stiff_circuit_agrees_with_its_two_exponentials():
    # The paper's start of the RLC example: poles at -0.004 and -1.25e8 rad/s, T_s = 0.1 ms.
    inductance, capacitance, resistance, h = 2e-6, 1.0, 250.0, 1e-4
    fast = -resistance / inductance
    slow = -1 / (resistance * capacitance)  # to 1e-10 relative
    phi, g0, _ = systems.discretize(
        [[0, 1], [-1 / (inductance * capacitance), fast]], [[0], [1 / inductance]], h
    )
    # The fast mode is gone within the sample; what is left is the slow one.
    np.testing.assert_allclose(phi[0], [np.exp(slow * h), np.exp(slow * h) / -fast], rtol=1e-9)
    np.testing.assert_allclose(phi[1], slow * phi[0], rtol=1e-9)
    # Charge after h under a held volt: C (1 - e^{slow h}), less L / R^2 that the coil takes.
    charge = -capacitance * np.expm1(slow * h) - inductance / resistance**2
    np.testing.assert_allclose(g0[0, 0], charge, rtol=1e-6)
    np.testing.assert_allclose(g0[1, 0], np.exp(slow * h) / resistance, rtol=1e-6)


def test_units_do_not_cost_digits(rng):
    a = rng.standard_normal((5, 5)) - 2 * np.eye(5)
    b = rng.standard_normal((5, 2))
    units = 10.0 ** np.array([-6, 3, 0, 5, -4])
    gain = np.array([1e-5, 1e6])
    phi, g0, g1 = systems.discretize(a, b, 0.1, "foh")
    scaled = systems.discretize(units[:, None] * a / units, units[:, None] * b * gain, 0.1, "foh")
    np.testing.assert_allclose(scaled[0], units[:, None] * phi / units, rtol=1e-12)
    np.testing.assert_allclose(scaled[1], units[:, None] * g0 * gain, rtol=1e-12)
    np.testing.assert_allclose(scaled[2], units[:, None] * g1 * gain, rtol=1e-11)


def test_two_half_steps_make_a_whole_one(rng):
    a, b = rng.standard_normal((4, 4)), rng.standard_normal((4, 1))
    phi, g, _ = systems.discretize(a, b, 0.3)
    half, g_half, _ = systems.discretize(a, b, 0.15)
    np.testing.assert_allclose(half @ half, phi, rtol=1e-11)
    np.testing.assert_allclose(half @ g_half + g_half, g, rtol=1e-11, atol=1e-14)


def test_model_without_states_or_inputs():
    phi, g0, g1 = systems.discretize(np.zeros((0, 0)), np.zeros((0, 2)), 0.1, "foh")
    assert (phi.shape, g0.shape, g1.shape) == ((0, 0), (0, 2), (0, 2))
    phi, g0, _ = systems.discretize([[-1.0]], np.zeros((1, 0)), 0.1)
    assert phi[0, 0] == pytest.approx(np.exp(-0.1))
    assert g0.shape == (1, 0)


@pytest.mark.parametrize(
    "a, b, dt, hold, error, words",
    [
        ([[1.0, 2.0]], [[1.0]], 0.1, "zoh", ct.ControlDimension, "square"),
        ([[1.0]], [[1.0], [2.0]], 0.1, "zoh", ct.ControlDimension, "n_w"),
        ([[np.nan]], [[1.0]], 0.1, "zoh", rco.ModelError, r"A is not finite at \[0, 0\]"),
        ([[1.0]], [[np.inf]], 0.1, "zoh", rco.ModelError, "B is not finite"),
        ([[1.0]], [[1.0]], 0.0, "zoh", rco.ModelError, "positive"),
        ([[1.0]], [[1.0]], True, "zoh", ct.ControlArgument, "True"),
        ([[1.0]], [[1.0]], "fast", "zoh", ct.ControlArgument, "fast"),
        ([[1.0]], [[1.0]], 0.1, "bandlimited", ct.ControlArgument, "bandlimited"),
        ([[1e6]], [[1.0]], 1.0, "zoh", rco.ModelError, "grows beyond"),
    ],
)
def test_bad_input_is_named(a, b, dt, hold, error, words):
    with pytest.raises(error, match=words):
        systems.discretize(a, b, dt, hold)


def test_numpy_numbers_are_sampling_times():
    assert systems.check_sampling_time(np.float32(0.5)) == 0.5
    assert systems.check_sampling_time(np.int64(2)) == 2.0


def labeled(dt=0):
    return LinearModel.from_statespace(
        ct.ss([[-1.0, 1.0], [0.0, -2.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.5]], dt,
              inputs="force", outputs="speed", states=["a", "b"], name="plant")
    )  # fmt: skip


def test_to_discrete_agrees_with_sample_and_keeps_the_labels():
    model = labeled()
    discrete = to_discrete(model, 0.1)
    sampled = model.to_statespace().sample(0.1)
    for key in "ABCD":
        np.testing.assert_allclose(getattr(discrete, key), getattr(sampled, key), rtol=1e-13)
    assert discrete.dt == 0.1
    assert (discrete.name, discrete.input_labels, discrete.output_labels) == ("plant", ("force",), ("speed",))
    assert discrete.state_labels == ("a", "b")


def test_to_discrete_with_first_order_hold_has_the_response_to_a_ramp():
    model = labeled()
    discrete = to_discrete(model, 0.1, hold="foh")
    t = np.arange(200) * 0.1
    x = np.zeros(2)
    y = np.empty(t.size)
    for k, w in enumerate(t):
        y[k] = discrete.C[0] @ x + discrete.D[0, 0] * w
        x = discrete.A @ x + discrete.B[:, 0] * w
    # Particular solution of the ramp w = t: x = p t + q, with A p = -B and A q = p.
    p = np.linalg.solve(model.A, -model.B[:, 0])
    q = np.linalg.solve(model.A, p)
    free = np.array([linalg.expm(model.A * s) @ -q for s in t])
    np.testing.assert_allclose(y, (free + np.outer(t, p) + q) @ model.C[0] + 0.5 * t, atol=1e-12)


@pytest.mark.parametrize(("own", "dt"), [(True, 0.02), (None, 0.02), (0.1, 0.1 * (1 + 1e-9))])
def test_to_discrete_takes_over_the_records_timebase(own, dt):
    model = labeled(own)
    discrete = to_discrete(model, dt)
    assert discrete.dt == dt
    np.testing.assert_array_equal(discrete.A, model.A)


def test_contradicting_sampling_times_are_both_named():
    with pytest.raises(rco.ModelError, match=r"'plant' has dt = 0\.1 s but the record has dt = 0\.2 s"):
        to_discrete(labeled(0.1), 0.2)


@pytest.mark.parametrize("scale", [1e-9, 0.3, 3.0, 40.0])
def test_stacked_exponential_equals_scipy(rng, scale):
    real = rng.standard_normal((5, 7, 7)) * scale
    for stack in (real, real + 1j * rng.standard_normal((5, 7, 7)) * scale):
        oracle = np.array([linalg.expm(each) for each in stack])
        error = np.abs(exponential(stack) - oracle).max(axis=(1, 2)) / np.abs(oracle).max(axis=(1, 2))
        assert error.max() < 1e-11 * max(1.0, scale)


def test_exponential_of_the_stiff_pole_of_the_rlc_start():
    A = np.array([[0.0, 1.0], [-1 / 2e-6, -250 / 2e-6]]) * 1e-4
    slow = np.max(np.roots([1.0, 250 / 2e-6 * 1e-4, 1 / 2e-6 * 1e-8]).real)
    values = np.linalg.eigvals(exponential(A[None])[0])
    assert values.real.max() == pytest.approx(np.exp(slow), rel=1e-9)


def test_overflow_is_not_finite():
    assert not np.isfinite(exponential(np.array([[[1e5]]]))).all()


def test_companion_matrix_of_a_fast_filter_stays_stable():
    poles = -np.array([4.9e3, 6e3 + 2e4j, 6e3 - 2e4j, 9e3 + 3e4j, 9e3 - 3e4j])
    A = np.vstack([-np.poly(poles).real[1:], np.eye(5)[:-1]])  # entries up to 1e21
    steps = np.array([2e-5, 1e-5])
    found = np.linalg.eigvals(exponential(A * steps[:, None, None]))
    for values, step in zip(found, steps, strict=True):
        np.testing.assert_allclose(np.sort_complex(values), np.sort_complex(np.exp(poles * step)), rtol=1e-6)
