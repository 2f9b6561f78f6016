"""Sensors that smooth their readings or cut them off: against scipy's filters and the exact solution."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import slow
from inner import KINDS, Engine, Structure
from scipy.linalg import expm
from scipy.signal import lfilter

import rcorefine as rco

A = np.array([[0.0, 1.0, 0.0], [-310.0, -0.8, 40.0], [0.0, -3.0, -25.0]])
B = np.array([[0.0], [0.0], [50.0]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
MODEL = ct.ss(A, B, C, 0, states=["x", "v", "i"], inputs="u", outputs=["x", "i"])
DT = 0.012


def solution(u):
    """Outputs under a held input, from rest: exact."""
    M = expm(np.block([[A, B], [np.zeros((1, 4))]]) * DT)
    state, found = np.zeros(3), []
    for value in u:
        found.append(C @ state)
        state = M[:3, :3] @ state + M[:3, 3] * value
    return np.array(found).T


def smoothed(rows, kept):
    return lfilter([1 - kept], [1, -kept], rows, axis=-1)


def drawn(seed, n=900):
    return np.repeat(np.random.default_rng(seed).standard_normal(n // 3), 3)


def measured(u, y, seed, noise=0.02, skip=0):
    y = y + noise * y.std(axis=1, keepdims=True) * np.random.default_rng(seed + 1).standard_normal(y.shape)
    u, y = u[skip:], y[:, skip:]
    return rco.Measurement(u, y, dt=DT, input_labels="u", output_labels=["x", "i"])


CASES = {
    "output_smoothing": ("i", [0.8], lambda u: (y := solution(u), smoothed(y[1], 0.8))),
    "input_smoothing": ("u", [4 * DT], lambda u: (solution(smoothed(u, np.exp(-0.25))), None)),
    "output_range": ("i", [-0.5, 0.9], lambda u: (y := solution(u), np.clip(y[1], -0.5, 0.9))),
}


@pytest.mark.parametrize("kind", CASES)
def test_laws_and_their_derivatives_against_scipy(kind):
    place, values, made = CASES[kind]
    u = drawn(0, 300)
    y, own = made(u)
    if own is not None:
        y[1] = own
    engine = Engine(
        Structure(MODEL, [rco.Effect(kind, place)]), measured(u, y, 0, noise=0.0), initial=np.zeros(3)
    )
    theta = np.array(values)
    run = engine.run(theta)
    np.testing.assert_allclose(run.outputs, y, atol=1e-9 * np.abs(y).max())
    for i, unit in enumerate(np.eye(theta.size)):
        ahead, behind = (engine.run(theta + s * 1e-6 * unit).outputs for s in (1, -1))
        numeric = (ahead - behind) / 2e-6
        np.testing.assert_allclose(run.sensitivity[:, :, i], numeric, atol=1e-5 * np.abs(numeric).max())


@pytest.mark.parametrize(("kind", "seed"), [("output_smoothing", 2), *slow(("input_smoothing", 3))])
def test_smoothing_is_named_in_a_record_that_begins_in_motion(kind, seed):
    place, values, made = CASES[kind]
    u = drawn(seed, 1000)
    y, own = made(u)
    y[1] = y[1] if own is None else own
    offered = list(dict.fromkeys([*rco.effect_library(MODEL), rco.Effect(kind, place)]))
    found = rco.diagnose(MODEL, measured(u, y, seed, skip=200), candidates=offered)
    assert (found.verdict, found.best.effect) == ("effect", rco.Effect(kind, place))
    (name,) = found.best.coefficients
    assert abs(found.best.coefficients[name] - values[0]) < 4 * found.best.std[name]


@pytest.mark.parametrize(
    ("low", "high", "kind"),
    [(-0.5, np.inf, "output_range"), (-0.7, 0.7, "output_saturation"), *slow((-0.5, 0.9, "output_range"))],
)
def test_a_sensor_that_clips_is_named_on_one_side_and_on_both(low, high, kind):
    u = drawn(4)
    data = measured(u, solution(u), 4)
    size = data.outputs[1].std()
    cut = data.outputs.copy()
    cut[1] = np.clip(cut[1], low * size, high * size)
    data = rco.Measurement(u, cut, dt=DT, input_labels="u", output_labels=["x", "i"])
    assert any(row.what == "clipping" for row in rco.check(MODEL, data).looks)
    found = rco.diagnose(MODEL, data)
    assert (found.verdict, found.best.effect) == ("effect", rco.Effect(kind, "i"))
    limit = found.best.coefficients["limit" if kind == "output_saturation" else "low"]
    assert abs(limit) == pytest.approx(abs(low) * size, rel=0.03)


def test_a_range_contains_a_limit():
    y = np.linspace(-2.0, 2.0, 41)
    law, inside = KINDS["output_range"], KINDS["output_saturation"]
    np.testing.assert_array_equal(law.through(y, -0.6, 0.6)[0], inside.through(y, 0.6)[0])
    assert inside.name in law.contains


@pytest.mark.parametrize("kept", [0.3, 0.9])
def test_what_was_smoothed_before_the_record_is_not_judged(kept):
    """After as many samples as the law says a thousandth of a first value is left, by the formula."""
    count = int(np.ceil(KINDS["output_smoothing"].unseen(DT, kept)))
    assert smoothed(np.zeros(count + 1), kept).size == count + 1
    response = lfilter([1 - kept], [1, -kept], np.zeros(count + 1), zi=[kept])[0]
    assert response[-1] <= 1e-3 * 1.001
    time = -DT / np.log(kept)
    assert KINDS["input_smoothing"].unseen(DT, time) == pytest.approx(np.log(1e-3) / np.log(kept))
