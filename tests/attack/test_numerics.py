"""Drawn plants, far from what anybody builds: the answer is right, or it is an error of ours or a warning.

Units of 1e-15 to 1e15 on each signal, state and time; stiff over twelve decades; damping of 1e-6; rigid
bodies; poles that repeat; states that are hardly seen; steps far above and below the modes; up to 50 states.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from drawn import Case, draw, sampled

import rcorefine as rco

OURS = (rco.RCOError, ct.ControlArgument, ct.ControlDimension)
SEED = 18


def runs_of(case: Case, discrete: bool):
    """The model of a case, and its record without noise."""
    model = sampled(case) if discrete else case.system
    return model, rco.Measurement(case.w, case.y, dt=case.dt, hold=case.hold)


def attempted(task, case: Case, how, tally, what: str):
    """What a task says of a case, and the warnings beside it, all ours; None where it is refused."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found = task(case, how)
        except OURS as error:
            tally[f"{what}, {type(error).__name__}"] += 1
            return None
    assert all(issubclass(one.category, rco.RCOWarning) for one in said), said[0].message
    return found, said


def simulated(case: Case, discrete: bool) -> float:
    """Distance of the simulation from the closed form, in tolerances."""
    model, data = runs_of(case, discrete)
    found = rco.simulate(model, data, case.x0).outputs
    return float((np.abs(found - case.y).max(axis=1) / np.abs(case.y).max(axis=1)).max() / case.tolerance)


def compared(case: Case, discrete: bool) -> float:
    """Tenths of a point that `compare` misses of a record that the model made; the start is unknown to it."""
    model, data = runs_of(case, discrete)
    return float((100.0 - rco.compare(model, data).fit.min()) / (0.1 + 1e3 * case.tolerance))


@pytest.mark.parametrize("task", [simulated, compared])
@pytest.mark.parametrize("discrete", [False, True], ids=["continuous", "discrete"])
def test_linear_plants(task, discrete, tally):
    wrong = []
    for index in range(tally.cases(40)):
        case = draw(np.random.default_rng([SEED, discrete, index]), samples=1e5 if tally.scale > 1 else 3e3)
        if discrete:
            if case.hold != "zoh" or len(case.x0) > 12:  # a step per sample and the powers of A, in Python
                continue
            case = replace(case, w=case.w[:, :2000], y=case.y[:, :2000])
        done = attempted(task, case, discrete, tally, "linear plants")
        if done is None:
            continue
        tally["linear plants, tried"] += 1
        if not done[0] <= 1.0:
            wrong.append(f"case {index}: {done[0]:.3g} times too far; {', '.join(case.words)}")
    tally["linear plants, wrong"] += len(wrong)
    assert not wrong, "\n".join(wrong)


# ------------------------------------------------------------------ estimates
def noisy(case: Case, gain: np.ndarray, seed: int) -> rco.Measurement:
    """The record with outputs that are too large by shares, and 1 % of noise."""
    y = case.y * (1.0 + gain)[:, None]
    rng = np.random.default_rng([SEED, seed])
    y = y + 0.01 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    return rco.Measurement(case.w, y, dt=case.dt, hold=case.hold)


def refined(case: Case, seed: int) -> str:
    """One gain is 20 % off: found within 6 standard deviations, and no worse with an offset beside it."""
    at = seed % len(case.y)
    gain, place = np.where(np.arange(len(case.y)) == at, 0.2, 0.0), case.system.output_labels[at]
    data, effects = noisy(case, gain, seed), [rco.Effect("output_gain", place)]
    one = rco.refine(case.system, data, effects)
    two = rco.refine(case.system, data, [*effects, rco.Effect("output_offset", place)])
    value, spread = one.theta[0], one.parameters[0].std
    if not (abs(value - 0.2) < 6 * spread + 1e-3 and spread < 0.1):
        return f"{value:.4g} +- {spread:.2g}"
    cost = [np.sum((r.rmse / data.outputs.std(axis=1)) ** 2) for r in (one, two)]
    slack = 1e-6 if len(case.y) == 1 else 0.01  # several outputs are weighed anew, by what is left of each
    return "" if cost[1] <= cost[0] * (1 + slack) else f"an offset more: {cost}"


def checked(case: Case, seed: int) -> str:
    """Nothing is wrong, so nothing stops."""
    rows = rco.check(case.system, noisy(case, np.zeros(len(case.y)), seed), information=False).rows
    return "; ".join(row.sentence for row in rows if row.status == "stop")


def streamed(case: Case, seed: int) -> str:
    """All gains 30 % off: what the stream makes of the model fits no worse."""
    data = noisy(case, np.full(len(case.y), 0.3), seed)
    found = rco.RCORefiner(case.system, dt=case.dt, hold=case.hold).run(data)
    fit = rco.compare([case.system, found.system], data).fit.mean(axis=1)
    return "" if fit[1] > fit[0] - 3.0 else f"fit {fit}"


def watched(case: Case, seed: int) -> str:
    """Nothing changes, so there is no alarm."""
    laws = [rco.Effect("output_gain", place) for place in case.system.output_labels]
    monitor = rco.Monitor(case.system, laws, dt=case.dt, hold=case.hold, learn=max(200, case.y.shape[1] // 2))
    monitor.run(noisy(case, np.zeros(len(case.y)), seed))
    good = monitor.alarm is None and np.isfinite(monitor.statistic).all()
    return "" if good else f"{monitor.alarm}, {monitor.statistic}"


@pytest.mark.parametrize("task", [refined, checked, streamed, watched])
def test_estimates(task, tally):
    wrong = []
    for index in range(tally.cases(12)):
        rng = np.random.default_rng([SEED, 2, index])
        case = draw(rng, states=6, signals=3, samples=2000, least=300, stable=True)
        done = attempted(task, case, index, tally, "estimates")
        if done is None:
            continue
        fault, said = done
        tally[f"estimates, {task.__name__}"] += 1
        if fault and said:
            tally["estimates, wrong and warned"] += 1
        elif fault:
            wrong.append(f"case {index}: {fault}; {', '.join(case.words)}")
    tally["estimates, wrong without a word"] += len(wrong)
    assert not wrong, "\n".join(wrong)


# ------------------------------------------------------------------ what was found
def test_initial_states_in_units_far_apart():
    """A decay of two lags, one of them in units of 1e-15: its initial state was dropped, and the fit 0."""
    t = 0.1 * np.arange(200)
    y = np.exp(-t) + np.exp(-0.2 * t)
    data = rco.Measurement(np.random.default_rng(1).standard_normal(200), y, dt=0.1)
    for unit in (1.0, 1e-15, 1e15):
        C = [[1.0 / unit, 1.0]]
        for model in (
            ct.ss(np.diag([-1.0, -0.2]), [[0.0], [0.0]], C, 0),
            ct.ss(np.diag(np.exp([-0.1, -0.02])), [[0.0], [0.0]], C, 0, 0.1),
        ):
            found = rco.simulate(model, data)
            np.testing.assert_allclose(found.outputs[0], y, atol=1e-9)
            np.testing.assert_allclose(found.x0 / [unit, 1.0], 1.0, rtol=1e-7)


def test_no_unit_of_a_state_is_out_of_bounds():
    """A state of 1e15 in its unit was a divergence; a run that leaves the record by twelve decades is one."""
    w, t = np.ones(100), 0.1 * np.arange(100)
    model = ct.ss([[-1.0]], [[1e30]], [[1e-30]], 0)
    for y in (1 - np.exp(-t), 0 * t):
        found = rco.simulate(model, rco.Measurement(w, y, dt=0.1), "zero")
        np.testing.assert_allclose(found.outputs[0], 1 - np.exp(-t), rtol=1e-9)
    away = ct.ss([[4.0]], [[1.0]], [[1.0]], 0)
    with pytest.raises(rco.DivergenceError):
        rco.simulate(away, rco.Measurement(w, 1 - np.exp(-t), dt=0.1), "zero")


def test_estimates_of_a_model_whose_states_have_units_far_apart():
    """The observer of such a model ended in LinAlgError."""
    rng = np.random.default_rng(5)
    units = np.array([1e-15, 1e15, 1.0, 1e9])
    A = np.diag([-1.0, -2.0, -30.0, -0.1]) + np.diag([1.0, 1.0, 1.0], 1)
    B, C = rng.standard_normal((4, 2)), rng.standard_normal((2, 4))
    plain = ct.ss(A, B, C, 0)
    model = ct.ss(A * units[:, None] / units, units[:, None] * B, C / units, 0)
    w = rng.standard_normal((2, 400))
    blank = rco.Measurement(w, np.zeros((2, 400)), dt=2.0)
    y = 1.2 * rco.simulate(plain, blank, "zero").outputs
    data = rco.Measurement(w, y + 0.01 * rng.standard_normal(y.shape) * y.std(axis=1, keepdims=True), dt=2.0)
    effects = [rco.Effect("output_gain", place) for place in model.output_labels]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rco.IdentifiabilityWarning)  # two offsets of inputs are one
        one, other = (rco.refine(each, data, effects) for each in (plain, model))
    np.testing.assert_allclose(one.theta[:2], 0.2, atol=0.01)
    np.testing.assert_allclose(other.theta[:2], one.theta[:2], rtol=1e-6)
    np.testing.assert_allclose(np.diag(other.covariance)[:2], np.diag(one.covariance)[:2], rtol=1e-5)
