"""Effects that multiply: stores, gains and couplings that depend on the state; what plain stores offer."""

import control as ct
import numpy as np
import pytest
from inner import KINDS, Engine, Structure, as_physical, nonlinear_system
from scipy.integrate import solve_ivp

import rcorefine as rco
from rcorefine.diagnosis import case

A, B = np.array([[-0.4, 0.1], [0.3, -0.5]]), np.array([[0.6, 0.0], [0.0, 0.5]])
STORES = ct.ss(A, B, np.eye(2), 0, states=["h1", "h2"], inputs=["q1", "q2"], outputs=["y1", "y2"])
R, L = 2.0, 0.1
COIL = ct.ss([[-R / L]], [[1 / L]], [[1.0]], 0, states=["i"], inputs=["u"], outputs=["y"])
SPEED = ct.ss([[-3.0]], [[4.0]], [[1.0]], 0, states=["speed"], inputs=["u"], outputs=["y"])
ARM = ct.ss([[0, 1], [-25, -3]], [[0], [25]], [[1, 0], [0, 1]], 0, states=["q", "v"], outputs=["y", "r"])
PRODUCTS = ("state_dependent_gain", "product_of_states")


@pytest.mark.parametrize(
    ("effects", "theta", "truth"),
    [
        (
            [rco.Effect("state_dependent_gain", "B[0,0]")],
            [-0.08, 0.02],
            lambda x, w: A @ x + B @ w + [(-0.08 * x[0] + 0.02 * x[0] ** 2) * w[0], 0.0],
        ),
        (  # by labels, and where the model has nothing
            [rco.Effect("state_dependent_gain", "B[h2,q1]")],
            [0.1, 0.0],
            lambda x, w: A @ x + B @ w + [0.0, 0.1 * x[1] * w[0]],
        ),
        (
            [rco.Effect("product_of_states", "A[1,0]")],
            [0.25, -0.1],
            lambda x, w: A @ x + B @ w + [0.0, (0.25 - 0.1 * x[1]) * x[1] * x[0]],
        ),
        (  # beside another loss: the rate is that with it
            [rco.Effect("state_dependent_store", "h1"), rco.Effect("coefficient", "A[0,0]")],
            [-0.2, 0.03, -0.3],
            lambda x, w: (A @ x + B @ w - [0.3 * x[0], 0.0]) / [1 - 0.2 * x[0] + 0.03 * x[0] ** 2, 1.0],
        ),
    ],
)
def test_right_hand_sides(effects, theta, truth, rng):
    system = nonlinear_system(Structure(STORES, effects), np.array(theta))
    for x, w in rng.normal(size=(20, 2, 2)):
        np.testing.assert_allclose(system.dynamics(0.0, x, w), truth(x, w), rtol=1e-12, atol=1e-12)


def test_a_mass_carries_its_displacement_into_the_gain(rng):
    system = nonlinear_system(
        Structure(ARM, [rco.Effect("state_dependent_gain", "B[1,0]")]), np.array([2.0, 5.0])
    )
    for q, v, w in rng.normal(size=(5, 3)):
        rate = [v, -25 * q - 3 * v + (25 + 2 * q + 5 * q * q) * w]
        np.testing.assert_allclose(system.dynamics(0.0, [q, v], [w]), rate, rtol=1e-12)


@pytest.mark.parametrize("place", ["C[0,0]", "A[0,0]", "A[1,0]", "B[0,9]"])
def test_a_gain_sits_at_entries_of_the_input_matrix(place):
    with pytest.raises(rco.ModelError):
        as_physical(STORES).check(rco.Effect("state_dependent_gain", place))


def coil(u, dt, slope, curvature):
    """Current in a coil L (1 + slope i + curvature i^2), the voltage held, by scipy."""
    i, found = 0.0, [0.0]
    for w in u[:-1]:
        run = solve_ivp(
            lambda t, x, w=w: (w - R * x) / (L * (1 + slope * x + curvature * x**2)),
            (0, dt), [i], rtol=1e-9, atol=1e-12,
        )  # fmt: skip
        i = run.y[0, -1]
        found.append(i)
    return np.array(found)


def test_motion_and_derivatives_of_a_coil(rng):
    u, dt = np.repeat(rng.uniform(-10, 10, 8), 15), 2e-3
    truth = coil(u, dt, -0.08, 0.004)
    data = rco.Measurement(dt=dt, inputs=u, outputs=truth, input_labels=["u"], output_labels=["y"])
    wrong = ct.ss([[-1.5 * R / L]], COIL.B, COIL.C, 0, states=["i"], inputs=["u"], outputs=["y"])
    effects = [rco.Effect("state_dependent_store", "i"), rco.Effect("damping", "i")]
    engine = Engine(Structure(wrong, effects), data, substeps=8, initial=np.zeros(1))
    theta = np.array([-0.08, 0.004, -0.5 * R])  # forces are in units of the voltage
    run = engine.run(theta)
    assert np.abs(run.outputs - truth).max() < 2e-4 * truth.std()
    for c, step in enumerate(1e-6 * np.eye(3)):
        slope = (engine.run(theta + step).outputs - engine.run(theta - step).outputs) / 2e-6
        np.testing.assert_allclose(
            run.sensitivity[:, :, c], slope.reshape(run.sensitivity.shape[:2]), atol=1e-5
        )


def kinds(model, **options):
    return {(effect.kind, effect.place) for effect in rco.effect_library(model, **options)}


def test_what_plain_stores_and_speeds_offer():
    friction = {"stribeck_friction", "asymmetric_friction", "asymmetric_damping", "maxwell_element"}
    stores, speed, arm = kinds(STORES), kinds(SPEED), kinds(ARM)
    at = {kind: {place for k, place in stores if k == kind} for kind, _ in stores}
    assert at["state_dependent_gain"] == {"B[0,0]", "B[1,1]"}
    assert at["product_of_states"] == {"A[0,1]", "A[1,0]"}
    assert at["state_dependent_store"] == {"h1", "h2"}
    assert {"h1", "h2"} <= at["curved_loss"]
    assert not friction & at.keys()
    assert {(kind, "speed") for kind in friction} <= speed
    assert ("state_dependent_store", "speed") not in speed
    assert ("output_play", "y") in arm
    assert ("output_play", "r") not in arm  # a speed
    assert not {kind for kind, _ in arm} & {*PRODUCTS}
    assert ("state_dependent_gain", "B[1,0]") in kinds(ARM, kinds="state_dependent_gain")


def test_a_network_does_not_flood(rng):
    A = rng.normal(size=(6, 6)) - 8 * np.eye(6)
    assert not {kind for kind, _ in kinds(ct.ss(A, np.ones((6, 2)), np.eye(6), 0))} & {*PRODUCTS}


@pytest.mark.parametrize("model", [STORES, SPEED, ARM], ids=["stores", "speed", "arm"])
def test_what_is_not_tried_is_said(model, rng):
    inputs, outputs = rng.normal(size=(model.ninputs, 9)), rng.normal(size=(model.noutputs, 9))
    physical, data = as_physical(model), rco.Measurement(dt=0.1, inputs=inputs, outputs=outputs)
    tried = case.candidates_of(physical)
    said = case.not_tried(physical, tried, [data]).removeprefix("Not tried: ").partition(". ")[0].split(", ")
    every = [kind for kind, law in KINDS.items() if not (law.needs_law or law.is_parameter)]
    fitting = {kind for kind, _ in kinds(model, kinds=every)} - {effect.kind for effect in tried}
    # a power is no effect of an input that changes its sign; a differenced speed is asked for beside these
    assert set(said) == fitting - {"input_power", "output_average"} | {*said} & {"output_average"}


def test_a_coil_that_saturates_is_named(rng):
    """One percent of noise; L falls by 8 % per ampere."""
    u, dt = np.repeat(rng.uniform(-10, 10, 24), 25), 2e-3
    y = coil(u, dt, -0.08, 0.0)
    y = y + 0.01 * y.std() * rng.normal(size=y.size)
    data = rco.Measurement(dt=dt, inputs=u, outputs=y, input_labels=["u"], output_labels=["y"])
    found = rco.diagnose(COIL, data)
    assert found.best.effect == rco.Effect("state_dependent_store", "i")
    row = found.best
    assert abs(row.coefficients["slope"] + 0.08) < 4 * row.std["slope"]
