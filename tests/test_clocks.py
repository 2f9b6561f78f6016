"""Inputs and outputs by two clocks: against the exact solution at the times of either clock."""

from __future__ import annotations

import pickle
import warnings

import control as ct
import numpy as np
import pytest
from cases import slow
from inner import Engine, Structure
from scipy.linalg import expm

import rcorefine as rco
from rcorefine.inference import starts

A, B = np.array([[0.0, 1.0], [-380.0, -0.4]]), np.array([0.0, 1.0])
MODEL = ct.ss(A, B[:, None], [[1.0, 0.0]], 0, states=["x", "v"], inputs="force", outputs="x")
DT = 0.02


def solution(force, *, inputs=0.0, outputs=0.0):
    """Displacement at k dt (1 + outputs) under a force that is held from k dt (1 + inputs) on: exact."""
    step = DT * (1 + inputs)
    whole = np.block([[A, B[:, None]], [np.zeros((1, 3))]])
    states = [np.zeros(2)]
    for u in force:
        M = expm(whole * step)
        states.append(M[:2, :2] @ states[-1] + M[:2, 2] * u)
    y = np.empty(force.size)
    for k, t in enumerate(DT * (1 + outputs) * np.arange(force.size)):
        at = min(int(t / step + 1e-9), force.size - 1)
        M = expm(whole * (t - at * step))
        y[k] = M[0, :2] @ states[at] + M[0, 2] * force[at]
    return y


def record(seed, n=900, noise=0.03, **clocks):
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.standard_normal(n // 3), 3)
    y = solution(force, **clocks)
    y = y + noise * y.std() * rng.standard_normal(n)
    return rco.Measurement(force, y, dt=DT, input_labels="force", output_labels="x")


@pytest.mark.parametrize("slow", [0.003, -0.004])
@pytest.mark.parametrize("whose", ["inputs", "outputs"])
def test_two_clocks_against_the_exact_solution(whose, slow):
    data = record(0, noise=0.0, **{whose: slow})
    theta = np.array([slow, slow] if whose == "outputs" else [1 / (1 + slow) - 1, 0.0])
    structure = Structure(MODEL, [rco.Effect("clocks_apart", "force")])
    errors = []
    for substeps in (8, 32):
        engine = Engine(structure, data, substeps=substeps, initial=np.zeros(2))
        judged = engine.judged(theta)[0]
        assert (~judged).sum() <= np.ceil(abs(slow) * judged.size)
        errors.append(np.std((engine.run(theta).outputs - data.outputs)[:, judged]) / data.outputs.std())
    assert errors[0] < 3e-3
    assert errors[1] < errors[0] / 8  # the edges between the samples are of second order


def test_a_part_of_the_record_keeps_its_lag():
    data = record(1, noise=0.0, outputs=0.004)
    structure = Structure(MODEL, [rco.Effect("clocks_apart", "force")])
    theta = np.array([0.004, 0.004])
    whole = Engine(structure, data, substeps=8)
    run = whole.run(theta, histories=True)
    later = Engine(structure, data.split(500 / 900)[1], substeps=8)
    again = later.run(theta, run.states[:, 500])
    judged = later.judged(theta)[0]
    np.testing.assert_allclose(
        again.outputs[:, judged], run.outputs[:, 500:][:, judged], atol=1e-3 * data.outputs.std()
    )


@pytest.mark.parametrize("since", [1.7e9, -3.0e4])
def test_it_does_not_matter_what_the_times_count_from(since):
    data, effect = record(5, outputs=0.002), rco.Effect("clocks_apart", "force")
    shifted = rco.Measurement(
        data.inputs, data.outputs, timepts=since + data.timepts, input_labels="force", output_labels="x"
    )
    assert shifted.dt == data.dt
    ours, theirs = (rco.refine(MODEL, one.split(0.6)[0], [effect]) for one in (data, shifted))
    assert ours.fit > 95
    for one, other in zip(ours.parameters, theirs.parameters, strict=True):
        assert other.value == pytest.approx(one.value, rel=1e-9, abs=1e-12)
    for part in (slice(0, 1), slice(1, 2)):  # the rest of the record, too, knows the lag it had
        one, other = data.split(0.6)[part][0], shifted.split(0.6)[part][0]
        runs = [rco.simulate(found, d).outputs for found, d in ((ours, one), (theirs, other))]
        np.testing.assert_allclose(*runs, rtol=1e-9, atol=1e-12)
        assert rco.compare(theirs, other).fit == pytest.approx(rco.compare(ours, one).fit, rel=1e-9)
    assert rco.compare(ours, data.split(0.6)[1]).fit > 95


def test_a_record_cut_by_hand_says_how_long_it_had_run():
    data = record(6, outputs=0.004)
    later = data.split(0.5)[1]
    own = rco.Measurement(later.inputs, later.outputs, dt=DT, input_labels="force", output_labels="x")
    told = rco.Measurement(
        later.inputs, later.outputs, dt=DT, input_labels="force", output_labels="x", elapsed=450 * DT
    )
    fits = [rco.refine(MODEL, one, [rco.Effect("clocks_apart", "force")]).fit for one in (later, told, own)]
    assert fits[0] == pytest.approx(fits[1], rel=1e-9)
    assert fits[1] > fits[2] + 1  # a lag of two samples, which own denies
    assert (later.elapsed, own.elapsed) == (pytest.approx(450 * DT), 0.0)
    assert pickle.loads(pickle.dumps(later)).elapsed == later.elapsed
    slow = later.with_hold("foh").decimate(2)
    assert slow.elapsed == pytest.approx(later.elapsed + slow.timepts[0] - later.timepts[0])


@pytest.mark.parametrize("hold", ["zoh", "foh", "bandlimited"])
def test_derivatives_are_those_of_the_simulation(hold):
    data = record(2, n=300, noise=0.0)
    data = rco.Measurement(data.inputs, data.outputs, dt=DT, hold=hold)
    engine = Engine(Structure(MODEL, [rco.Effect("clocks_apart", "force")]), data, substeps=8)
    theta, step = np.array([0.0031, 0.0013]), 2e-6
    slopes = engine.run(theta).sensitivity
    for i, unit in enumerate(np.eye(2)):
        ahead, behind = (engine.run(theta + s * step * unit).outputs for s in (1, -1))
        numeric = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(slopes[:, :, i], numeric, atol=0.02 * np.abs(numeric).max())


@pytest.mark.parametrize(("whose", "slow"), [("outputs", 0.0012), *slow(("inputs", -0.002))])
def test_clocks_that_run_apart_are_named(whose, slow):
    data = record(3, n=3000, **{whose: slow})
    assert starts.growing_lags(Structure(MODEL), [data])[0] == pytest.approx(
        slow if whose == "outputs" else -slow, abs=5e-4
    )
    found = rco.diagnose(MODEL, data)
    assert (found.verdict, found.best.effect.kind) == ("effect", "clocks_apart")
    expected = (slow, slow) if whose == "outputs" else (1 / (1 + slow) - 1, 0.0)
    for name, value in zip(("apart", "slow"), expected, strict=True):
        assert abs(found.best.coefficients[name] - value) < 4 * found.best.std[name]
    assert "correct the record" in " ".join(str(found).split())


def test_no_stream_no_response_and_no_equations_of_two_clocks():
    data, effect = record(4, n=600), rco.Effect("clocks_apart", "force")
    with pytest.raises(rco.ModelError, match="stream"):
        rco.RCORefiner(MODEL, effects=[effect], dt=DT)
    with pytest.raises(rco.ModelError, match="in time"):
        rco.refine(MODEL, ct.frequency_response(MODEL, [1.0, 10.0, 30.0]), [effect])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rco.IdentifiabilityWarning)
        found = rco.refine(MODEL, data, [effect])
    with pytest.raises(rco.ModelError, match="state equation"):
        _ = found.nonlinear


@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_the_common_lag_is_that_of_the_highest_correlation_coefficient(unit):
    data, rng = record(3), np.random.default_rng(4)
    free = rco.simulate(MODEL, data, "zero").outputs[0]
    late = np.concatenate([np.cumsum(rng.standard_normal(41)), free[:-41]]) + 0.3 * free.std()
    shown = rco.Measurement(data.inputs, unit * late, dt=DT)
    count = late.size // 3
    alike = [abs(np.corrcoef(late[k:], free[: late.size - k])[0, 1]) for k in range(count)]
    assert starts.common_lag(Structure(MODEL), shown) == pytest.approx(DT * int(np.argmax(alike)))


def test_a_motion_at_the_end_alone_has_no_drift_that_is_no_number():
    """A clock that runs slower leaves out the only samples that move: there is no correlation then."""
    force = np.zeros(600)
    force[-2] = 1.0
    data = rco.Measurement(force, np.random.default_rng(5).standard_normal(600), dt=DT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isfinite(starts.growing_lags(Structure(MODEL), [data])).all()
