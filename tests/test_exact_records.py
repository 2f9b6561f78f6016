"""Records without noise, as a simulation makes them: an exact answer, and no warning of the arithmetic."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from cases import slow

import rcorefine as rco

STEP = np.ones(400)
TURNING = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 40), 10)


def lag(a, b=1.0):
    return ct.ss([[-a]], [[b]], [[1.0]], 0, states="x", inputs="u", outputs="y")


def oscillator(k, c):
    return ct.ss([[0, 1], [-k, -c]], [[0], [1]], [[1, 0]], 0, states=["x", "v"], inputs="u", outputs="y")


def sampled(a, b=0.1):
    return ct.ss([[a]], [[b]], [[1.0]], 0, dt=0.05, states="x", inputs="u", outputs="y")


def record(plant, u, hold):
    y = ct.forced_response(plant, 0.05 * np.arange(u.size), u).outputs
    return rco.Measurement(u, y, dt=0.05, hold=hold)


CASES = {
    "first-order step": (lag(1.2), lag(1.0), STEP),
    "second-order step": (oscillator(4.5, 0.8), oscillator(4.0, 0.8), STEP),
    "discrete lag": (sampled(0.92), sampled(0.9), STEP),
    "forced response": (oscillator(4.0, 1.1), oscillator(4.0, 0.8), TURNING),
}


@pytest.mark.filterwarnings("error::RuntimeWarning", "ignore::rcorefine.ExcitationWarning")
@pytest.mark.parametrize("case", [*list(CASES)[1:3], *slow("first-order step", "forced response")])
def test_an_exact_record_gets_an_exact_answer(case):
    plant, model, u = CASES[case]
    found = rco.diagnose(model, record(plant, u, "foh"))
    # where the motion keeps its sign, a spring on that side only is exact as well: so are all that tie
    assert all(row.refinement.fit.min() > 99.9 for row in found.ranking if row.alike)
    better = found.refine()
    assert better.fit.min() > 99.99  # the priors of parameters pull by 1e-5
    true, estimated = (
        np.sort_complex(s.poles() if s.isctime() else np.log(s.poles().astype(complex)) / s.dt)
        for s in (plant, better.system)
    )
    np.testing.assert_allclose(estimated, true, rtol=1e-3)
    if not plant.isdtime():  # a sampled model has a continuous one with the same samples
        omega = np.array([0.1, 1.0, 3.0, 10.0])
        gains = [ct.frequency_response(one, omega).complex for one in (better.system, plant)]
        np.testing.assert_allclose(*gains, rtol=1e-4)


@pytest.mark.filterwarnings("error::RuntimeWarning", "ignore::rcorefine.ExcitationWarning")
@pytest.mark.parametrize("case", [*list(CASES)[::3], *slow(*list(CASES)[1:3])])
def test_of_an_exact_record_of_the_model_nothing_is_missing(case):
    _, model, u = CASES[case]
    assert rco.diagnose(model, record(model, u, "foh")).verdict == "adequate"
