"""Coordinates, units and the order of channels are the user's choice: the answer may not depend on them."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from test_refine import STEP, held_response

import rcorefine as rco
from rcorefine import Effect, Measurement, refine

N = 800
M = np.diag([1.0, 0.7, 1.3])
K = np.array([[65.0, -25.0, 0.0], [-25.0, 55.0, -30.0], [0.0, -30.0, 30.0]])
C = 0.008 * K + 0.1 * M


def structure(stiffness=K, order=(0, 1, 2)):
    """Three masses; `order` renumbers the coordinates."""
    p = np.array(order)
    pick = np.ix_(p, p)
    A = np.block(
        [
            [np.zeros((3, 3)), np.eye(3)],
            [-np.linalg.solve(M, stiffness)[pick], -np.linalg.solve(M, C)[pick]],
        ]
    )
    force, sensor = list(order).index(0), list(order).index(2)
    B = np.zeros((6, 1))
    B[3 + force] = 1.0
    output = np.zeros((2, 6))
    output[0, 3 + force], output[1, sensor] = 1.0, 1.0
    names = [f"x{i + 1}" for i in order]
    return ct.ss(A, B, output, 0, inputs="f", outputs=["v1", "x3"], states=names + ["d" + q for q in names])


def softer():
    k = K.copy()
    k[1:, 1:] -= 8.0 * np.array([[1, -1], [-1, 1]])
    return structure(k)


def record(seed=0, noise=0.01):
    rng = np.random.default_rng(seed)
    w = 10 * rng.standard_normal(N)
    y = held_response(softer(), w, STEP)
    return w, y + noise * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)


def same_outputs(one, other, tolerance=1e-8):
    assert np.abs(one - other).max() <= tolerance * np.abs(one).max()


def test_permuted_coordinates():
    w, y = record()
    data = Measurement(w, y, dt=STEP)
    plain = refine(structure(), data, [Effect("stiffness", "x2-x3"), Effect("damping", "x1")])
    turned = structure(order=(2, 0, 1))
    place = next(port.name for port in rco.ports(turned) if set(port.name.split("-")) == {"x2", "x3"})
    other = refine(turned, data, [Effect("stiffness", place), Effect("damping", "x1")])
    same_outputs(rco.simulate(plain, data).outputs, rco.simulate(other, data).outputs)
    np.testing.assert_allclose(other.theta, plain.theta, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(np.diag(other.covariance), np.diag(plain.covariance), rtol=1e-6)


def test_similar_coordinates():
    """In mixed coordinates there are no ports; effects at channels exist there as well."""
    w, y = record()
    data = Measurement(w, 1.1 * y + 0.2, dt=STEP)
    model = softer()
    T = np.random.default_rng(3).standard_normal((6, 6)) + 2 * np.eye(6)
    mixed = ct.ss(
        T @ model.A @ np.linalg.inv(T), T @ model.B, model.C @ np.linalg.inv(T), 0,
        inputs="f", outputs=["v1", "x3"],
    )  # fmt: skip
    effects = [Effect("output_gain", "v1"), Effect("output_gain", "x3"), Effect("input_lag", "f")]
    plain, other = refine(model, data, effects), refine(mixed, data, effects)
    same_outputs(rco.simulate(plain, data).outputs, rco.simulate(other, data).outputs)
    np.testing.assert_allclose(other.theta[:2], plain.theta[:2], rtol=1e-6)
    np.testing.assert_allclose(plain.theta[:2], 0.1, atol=0.01)


def test_coefficient_of_a_first_order_model_in_other_units():
    """x in other units leaves a diagonal coefficient as it is."""
    rng = np.random.default_rng(0)
    w = np.repeat(rng.standard_normal(80), 10)
    y = held_response(ct.ss([[-0.5]], [[2.0]], [[1.0]], 0), w, STEP)
    data = Measurement(w, y + 0.01 * y.std() * rng.standard_normal(y.shape), dt=STEP)
    runs, thetas = [], []
    for unit in (1.0, 1e6, 0.0371):
        model = ct.ss([[-0.8]], [[2.0 * unit]], [[1.0 / unit]], 0, inputs="u", outputs="y", states=["level"])
        result = refine(model, data, [Effect("coefficient", "A[0,0]")])
        thetas.append(result.theta[0])
        runs.append(rco.simulate(result, data).outputs)
    np.testing.assert_allclose(thetas, thetas[0], rtol=1e-7)
    same_outputs(runs[0], runs[1])
    same_outputs(runs[0], runs[2])


@pytest.mark.parametrize("units", [(1e3, 1e-3, 1e6), (7.3, 0.0254, 11.0)])
def test_units_of_inputs_and_outputs(units):
    per_input, per_v, per_x = units
    w, y = record()
    data = Measurement(w, y, dt=STEP)
    scale = np.array([[per_v], [per_x]])
    model = structure()
    scaled = ct.ss(
        model.A, np.asarray(model.B) / per_input, scale * np.asarray(model.C), 0,
        inputs="f", outputs=["v1", "x3"], states=model.state_labels,
    )  # fmt: skip
    other_data = Measurement(w * per_input, y * scale, dt=STEP)
    # forces are then per unit of the input, so an effect is named by its law on the states
    plain = refine(model, data, [Effect("stiffness", "x2-x3")])
    other = refine(scaled, other_data, [Effect("stiffness", "x2-x3")])
    same_outputs(rco.simulate(plain, data).outputs, rco.simulate(other, other_data).outputs / scale)
    np.testing.assert_allclose(
        other.parameters[0].std / abs(other.theta[0]),
        plain.parameters[0].std / abs(plain.theta[0]),
        rtol=1e-6,
    )


def test_units_of_states():
    """Positions in mm, velocities in mm/s; a nonlinear force follows with the cube of the unit."""
    w, y = record()
    data = Measurement(w, y, dt=STEP)
    model = structure()
    unit = 1e3
    scaled = ct.ss(
        model.A, unit * np.asarray(model.B), np.asarray(model.C) / unit, 0,
        inputs="f", outputs=["v1", "x3"], states=model.state_labels,
    )  # fmt: skip
    effects = [Effect("stiffness", "x2-x3"), Effect("cubic_stiffness", "x2-x3")]
    plain, other = refine(model, data, effects), refine(scaled, data, effects)
    same_outputs(rco.simulate(plain, data).outputs, rco.simulate(other, data).outputs)


def test_reordered_outputs():
    w, y = record()
    labels = dict(input_labels=["f"], dt=STEP)
    data = Measurement(w, y, output_labels=["v1", "x3"], **labels)
    swapped = Measurement(w, y[::-1], output_labels=["x3", "v1"], **labels)
    plain = refine(structure(), data, [Effect("stiffness", "x2-x3"), Effect("output_gain", "x3")])
    other = refine(structure(), swapped, [Effect("stiffness", "x2-x3"), Effect("output_gain", "x3")])
    np.testing.assert_allclose(other.theta, plain.theta, rtol=1e-8, atol=1e-12)
    turned = ct.ss(
        structure().A, structure().B, np.asarray(structure().C)[::-1], 0,
        inputs="f", outputs=["x3", "v1"], states=structure().state_labels,
    )  # fmt: skip
    third = refine(turned, data, [Effect("stiffness", "x2-x3"), Effect("output_gain", "x3")])
    value = lambda result, kind: result.parameter(kind).coefficient  # noqa: E731
    for kind in ("stiffness", "output_gain"):
        np.testing.assert_allclose(value(third, kind), value(plain, kind), rtol=1e-7)
    np.testing.assert_allclose(
        rco.compare(third, swapped).fit.ravel(), rco.compare(plain, swapped).fit.ravel(), atol=1e-6
    )
