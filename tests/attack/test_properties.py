"""What no answer may depend on, and what must follow: drawn by hypothesis, 1000 cases in the long form."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import rcorefine as rco

MOST = 1000  # examples of the long form
DT = 0.05
SEEDS = st.integers(0, 2**32 - 1)
SCALES = st.sampled_from([1e-9, 1e-3, 1.0, 1e4, 1e9])


def every(tally: Any, name: str, quick: int, **drawn: st.SearchStrategy[Any]) -> Callable[..., Any]:
    """Run a check on drawn cases, always the same ones, and count them."""

    def run(check: Callable[..., Any]) -> None:
        def counted(**values: Any) -> None:
            tally[f"properties, {name}"] += 1
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", rco.RCOWarning)
                check(**values)

        settings(
            max_examples=min(MOST, tally.cases(quick)),
            derandomize=True,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        )(given(**drawn)(counted))()

    return run


@dataclass
class Drawn:
    """A chain of masses, and a record of one whose stiffness and gain are others."""

    model: rco.PhysicalModel
    w: np.ndarray
    y: np.ndarray
    rng: np.random.Generator

    @property
    def data(self) -> rco.Measurement:
        return self.record(self.w, self.y)

    def record(self, w: np.ndarray, y: np.ndarray) -> rco.Measurement:
        linear = self.model.linear
        labels = {"input_labels": linear.input_labels, "output_labels": linear.output_labels}
        return rco.Measurement(w, y, dt=DT, **labels)


def drawn(seed: int, samples: int = 400, **signals: Any) -> Drawn:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    m, c, k = rng.uniform(0.5, 2, n), rng.uniform(0.2, 2, n), rng.uniform(5, 80, n)
    other = k.copy()
    other[rng.integers(n)] *= rng.uniform(0.7, 1.4)
    both = {"excitation": "force", "sensors": ("displacement", tuple(range(1, n + 1))), **signals}
    model, true = rco.mass_spring_damper(m, c, k, **both), rco.mass_spring_damper(m, c, other, **both)
    w = rng.standard_normal((model.linear.n_inputs, samples)).cumsum(axis=1)
    w -= 0.9 * np.roll(w, 1, axis=1)
    found = Drawn(model, w, np.zeros((n, samples)), rng)
    y = rng.uniform(0.8, 1.2) * rco.simulate(true, found.data, "zero").outputs
    found.y = y + 0.02 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    return found


def gains(model: rco.PhysicalModel) -> list[rco.Effect]:
    return [rco.Effect("input_gain", label) for label in model.linear.input_labels]


def labeled(model: rco.PhysicalModel, A: Any, B: Any, C: Any, order: Any = slice(None)) -> ct.StateSpace:
    linear = model.linear
    names = np.array(linear.output_labels)[order]
    return ct.ss(A, B, C, 0, inputs=list(linear.input_labels), outputs=list(names), name="other")


def answers(model: Any, data: rco.Measurement, effects: list[rco.Effect]) -> tuple[np.ndarray, ...]:
    """Fit of the model, fit of the refined one, coefficients, their standard deviations."""
    fit = rco.compare(model, data).fit
    found = rco.refine(model, data, effects)
    n = len(effects)
    return fit.ravel(), found.fit, found.theta[:n], np.sqrt(np.diag(found.covariance))[:n]


def agree(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> None:
    """Fits to 1e-5 points, estimates to 1e-4 of their standard deviations."""
    np.testing.assert_allclose(other[0], one[0], atol=1e-5)
    np.testing.assert_allclose(other[1], one[1], atol=1e-5)
    assert np.all(np.abs(other[2] - one[2]) <= 1e-4 * one[3])
    np.testing.assert_allclose(other[3], one[3], rtol=1e-4)


def test_coordinates_of_the_state_change_nothing(tally):
    @every(tally, "similarity", 10, seed=SEEDS, turned=st.booleans(), decades=st.integers(0, 6))
    def check(seed, turned, decades):
        case = drawn(seed)
        linear, rng = case.model.linear, case.rng
        n = linear.n_states
        T = np.diag(10.0 ** rng.uniform(-decades, decades, n))
        if turned:
            T = T @ np.linalg.qr(rng.standard_normal((n, n)))[0]
        back = np.linalg.inv(T)
        plain = labeled(case.model, linear.A, linear.B, linear.C)
        other = labeled(case.model, T @ linear.A @ back, T @ linear.B, linear.C @ back)
        effects = gains(case.model)
        agree(answers(plain, case.data, effects), answers(other, case.data, effects))


def test_units_of_signals_change_nothing(tally):
    @every(tally, "units", 10, seed=SEEDS, of_input=SCALES, of_output=SCALES)
    def check(seed, of_input, of_output):
        case = drawn(seed)
        linear = case.model.linear
        plain = labeled(case.model, linear.A, linear.B, linear.C)
        other = labeled(case.model, linear.A, linear.B / of_input, linear.C * of_output)
        effects = gains(case.model)
        scaled = case.record(case.w * of_input, case.y * of_output)
        agree(answers(plain, case.data, effects), answers(other, scaled, effects))


def test_order_of_signals_changes_nothing(tally):
    """Neither that of the record, which is matched by name, nor that of the model."""

    @every(tally, "order of signals", 10, seed=SEEDS)
    def check(seed):
        case = drawn(seed)
        linear, order = case.model.linear, case.rng.permutation(len(case.y))
        plain = labeled(case.model, linear.A, linear.B, linear.C)
        mixed = rco.Measurement(
            case.w,
            case.y[order],
            dt=DT,
            input_labels=linear.input_labels,
            output_labels=[linear.output_labels[i] for i in order],
        )
        first, effects = answers(plain, case.data, gains(case.model)), gains(case.model)
        found = answers(plain, mixed, effects)  # `compare` has the order of the record, `refine` of the model
        agree(first, (found[0][np.argsort(order)], *found[1:]))
        turned = labeled(case.model, linear.A, linear.B, linear.C[order], order)
        found = answers(turned, case.data, effects)
        agree(first, (found[0], found[1][np.argsort(order)], *found[2:]))


def cuts(rng: np.random.Generator, samples: int) -> list[slice]:
    at = np.unique([0, samples, *rng.integers(0, samples, int(rng.integers(1, 20)))])
    return [slice(a, b) for a, b in itertools.pairwise(at)]


@pytest.mark.numba
def test_blocks_of_a_stream_change_nothing(tally):
    """One block or many: the same model, and the same alarm, to the last bit."""

    @every(tally, "batch = stream", 10, seed=SEEDS, kind=st.sampled_from(["refiner", "effects", "monitor"]))
    def check(seed, kind):
        case = drawn(seed, 900)
        effects = [rco.Effect("stiffness", "link1")]
        made = {
            "refiner": lambda: rco.RCORefiner(case.model, dt=DT),
            "effects": lambda: rco.RCORefiner(case.model, dt=DT, effects=effects),
            "monitor": lambda: rco.Monitor(case.model, effects, dt=DT, learn=300),
        }[kind]
        whole, parts = made(), made()
        whole.update(case.w, case.y)
        for part in cuts(case.rng, 900):
            parts.update(case.w[:, part], case.y[:, part])
        if kind == "monitor":
            np.testing.assert_array_equal(parts.probability, whole.probability)
            assert str(parts) == str(whole)
        else:
            np.testing.assert_array_equal(parts.system.A, whole.system.A)
            np.testing.assert_array_equal(parts.predict(case.w[:, 0]), whole.predict(case.w[:, 0]))


#: Coefficients whose value 0 is a law that does nothing, by what the laws are.
NOTHING = {
    "stiffness": "stiffness",
    "damping": "damping",
    "mass": "mass",
    "cubic_stiffness": "cubic_stiffness",
    "quadratic_damping": "quadratic_damping",
    "coulomb_friction": "force",
    "input_gain": "gain",
    "output_gain": "gain",
}


def test_an_effect_of_size_zero_changes_nothing(tally):
    @every(tally, "zero effect", 10, seed=SEEDS, kind=st.sampled_from(sorted(NOTHING)))
    def check(seed, kind):
        case = drawn(seed)
        linear = case.model.linear
        gained = {"input_gain": linear.input_labels[0], "output_gain": linear.output_labels[0]}
        effect = rco.Effect(kind, {"mass": "mass1", **gained}.get(kind, "link1"))
        held = effect.replace(fixed={**dict.fromkeys(effect.coefficients, 0.1), NOTHING[kind]: 0.0})
        found = rco.refine(case.model, case.data, [held], offset=False)
        for start in ("zero", "estimate"):
            plain = rco.simulate(case.model, case.data, start).outputs
            with_it = rco.simulate(found, case.data, start).outputs
            np.testing.assert_allclose(with_it, plain, atol=1e-8 * np.abs(plain).max())
        fits = rco.compare([case.model, found], case.data).fit
        np.testing.assert_allclose(fits[0], fits[1], atol=1e-5)


def test_the_ladder_never_climbs(tally):
    """What is added lowers the error on the record that it is fitted to."""

    @every(tally, "ladder", 1, seed=SEEDS, kind=st.sampled_from(["cubic_stiffness", "coulomb_friction"]))
    def check(seed, kind):
        case = drawn(seed, 900)
        law = rco.Effect(kind, "link1")
        found = rco.improve(
            case.model,
            case.data,
            candidates=[rco.Effect("stiffness", "link1"), *gains(case.model), law],
            max_effects=3,
        )
        sizes = case.y.std(axis=1)
        errors = [float(np.linalg.norm(step.train_rmse / sizes)) for step in found.steps]
        for before, after, step in zip(errors, errors[1:], found.steps[1:], strict=False):
            if step.action in ("add", "pair", "parameters"):
                assert after <= before * (1 + 1e-6), (step.name, before, after)


def test_more_data_is_never_less_certain(tally):
    """The first part of a record and all of it; the second part may be all but silent.

    Information only adds up, so a standard deviation grows by the estimate of the noise alone: of its level,
    with a relative deviation of 1 / sqrt(2 N), and of its color, 1 - sum a, with sqrt(p / N) where p
    coefficients were taken for one. 5 deviations of both.
    """

    @every(tally, "more data", 10, seed=SEEDS, rest=st.sampled_from([0.0, 0.1, 1.0]))
    def check(seed, rest):
        case = drawn(seed, 1200)
        linear = case.model.linear
        w = case.w * np.where(np.arange(1200) < 600, 1.0, rest)
        y = rco.simulate(case.model, case.record(w, case.y), "zero").outputs * 1.1
        noise = 0.02 * y.std(axis=1, keepdims=True)
        y = y + noise * case.rng.standard_normal(y.shape)
        plain, effects = labeled(case.model, linear.A, linear.B, linear.C), gains(case.model)
        fits = [rco.refine(plain, case.record(w[:, :n], y[:, :n]), effects) for n in (1200, 600)]
        whole, part = (np.sqrt(found.covariance[0, 0]) for found in fits)
        colors = max(max(found.residual_orders) for found in fits)
        assert whole <= part * (1 + 5 * np.sqrt((0.5 / len(y) + colors) / 600))
