"""Records without noise, as a simulation makes them: an exact answer, and no warning of the arithmetic."""

from __future__ import annotations

import json
from itertools import cycle

import control as ct
import numpy as np
import pytest
from cases import slow

import rcorefine as rco
from rcorefine.comparison.model_error import model_error
from rcorefine.fleet.pooling import pool
from rcorefine.results import with_error

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


PLANTS = {
    "first order": rco.dc_motor(gain=2.0, time_constant=0.5),
    "mass": rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement"),
    "two masses": rco.mass_spring_damper([1.0, 0.8], [0.4, 0.3], [100.0, 60.0], sensors="displacement"),
    "discrete lag": sampled(0.9),
    "integrator": lag(0.0),
    "static gain": ct.ss([], [], [], [[2.0]]),
    "unstable": lag(-0.1),
}
N = 120
NOISE = np.random.default_rng(0).standard_normal((4, N))


def simulated(plant, w, x0="zero"):
    system = getattr(plant, "system", plant)
    start = np.ones(system.nstates) if x0 == "moving" else x0
    blank = rco.Measurement(w, np.zeros((system.noutputs, w.size)), dt=0.05)
    return rco.simulate(plant, blank, start).outputs


def noisy(share):
    def made(plant):
        y = simulated(plant, NOISE[0])
        return NOISE[0], y + share * y.std(axis=1, keepdims=True) * NOISE[1 : 1 + len(y)]

    return made


def flat(level_in, level_out):
    """A constant, or None for the motion of the plant."""

    def made(plant):
        w = NOISE[0] if level_in is None else np.full(N, level_in)
        y = simulated(plant, w)
        return w, y if level_out is None else np.full_like(y, level_out)

    return made


def short(n):
    return lambda plant: (NOISE[0, :n], simulated(plant, NOISE[0])[:, :n])


def scaled(w_size, y_size):
    return lambda plant: (w_size * NOISE[0], y_size * simulated(plant, NOISE[0]))


def last_output(change):
    def made(plant):
        y = simulated(plant, NOISE[0]).copy()
        y[-1] = change(y[-1])
        return NOISE[0], y

    return made


def integers(plant):
    y = simulated(plant, NOISE[0])
    return (3 * NOISE[0]).astype(int), np.round(100 * y / np.abs(y).max()).astype(int)


RECORDS = {
    "exact": noisy(0.0),
    **{f"noise {share:g}": noisy(share) for share in (1e-16, 1e-15, 1e-13, 1e-11, 1e-9)},
    "rounded to 32 bits": lambda plant: (NOISE[0], simulated(plant, NOISE[0]).astype(np.float32)),
    "zeros": flat(0.0, 0.0),
    "output zero": flat(None, 0.0),
    "output 3": flat(None, 3.0),
    "output 0.1": flat(None, 0.1),
    "both constant": flat(1.0, 2.0),
    "input zero": flat(0.0, None),
    "input constant": flat(1.0, None),
    "decay": lambda plant: (np.zeros(N), simulated(plant, np.zeros(N), "moving")),
    "moving start": lambda plant: (NOISE[0], simulated(plant, NOISE[0], "moving")),
    "impulse": lambda plant: (np.eye(N)[3], simulated(plant, np.eye(N)[3])),
    "periodic": lambda plant: (np.tile(NOISE[0, :30], 4), simulated(plant, np.tile(NOISE[0, :30], 4))),
    **{f"{n} samples": short(n) for n in (1, 2, 5, 12, 36, 60)},
    "sizes 1e-300": scaled(1e-300, 1e-300),
    "sizes 1e-69": scaled(1e-69, 1e-69),
    "sizes 1e69": scaled(1e68, 1e68),
    "sizes 1e150": scaled(1e150, 1e150),
    "input 1e-60": scaled(1e-60, 1.0),
    "output 1e-60": scaled(1.0, 1e-60),
    "dead sensor": last_output(np.zeros_like),
    "frozen sensor": last_output(lambda y: np.where(np.arange(N) < 30, y, y[30])),
    "level 1e12": last_output(lambda y: y + 1e12),
    "integers": integers,
}


def few_effects(plant, data):
    channels = {*data.input_labels, *getattr(plant, "system", plant).input_labels}
    rests = not np.ptp(data.inputs, axis=1).any()
    library = [e for e in rco.effect_library(plant) if not (rests and e.place in channels)]
    return library[:: max(1, len(library) // 3)][:3]


def confirmed(plant, data):
    first, second = data.split(0.5)
    better = rco.refine(plant, first, few_effects(plant, data)[:1])
    return rco.confirm(better, [first, second], candidates=few_effects(plant, data))


VERBS = {
    "simulate": rco.simulate,
    "check": rco.check,
    "compare": rco.compare,
    "refine": lambda plant, data: rco.refine(plant, data, few_effects(plant, data)[:1]),
    "localize_damage": rco.localize_damage,
    "confirm": confirmed,
    "diagnose": lambda plant, data: rco.diagnose(plant, data, candidates=few_effects(plant, data)),
    "improve": lambda plant, data: rco.improve(
        plant, data, candidates=few_effects(plant, data), max_effects=1
    ),
}


def shown(found, path):
    """Text, page, data and pictures of a result: no figure in a text is NaN."""
    pages = [str(found), repr(found)]
    if isinstance(found, rco.Simulation):
        return
    pages.append(found._repr_html_())
    json.dumps(found.to_dict(), allow_nan=False)
    found.to_dataframe()
    if hasattr(found, "report"):
        pages.append(found.report(path).read_text())
    elif hasattr(found, "plot"):
        found.plot()
    assert not any(f"nan{after}" in page for page in pages for after in (" ", "%", "<", ")"))


def answered(verb, plant, name, path):
    """An answer, or an error of the package: neither warnings nor errors of the arithmetic."""
    try:
        w, y = RECORDS[name](plant)
        found = VERBS[verb](plant, rco.Measurement(w, y, dt=0.05))
    except (rco.RCOError, ct.ControlArgument, ct.ControlDimension):
        return
    shown(found, path / "report.html")


WITHOUT_WARNINGS = pytest.mark.filterwarnings("error", "ignore::rcorefine.RCOWarning")


@WITHOUT_WARNINGS
@pytest.mark.parametrize(("verb", "plant", "name"), [
    ("check", "mass", "exact"), ("check", "static gain", "integers"), ("simulate", "discrete lag", "zeros"),
    ("simulate", "two masses", "output 0.1"), ("simulate", "mass", "zeros"),
    ("refine", "integrator", "1 samples"),
    ("check", "unstable", "sizes 1e69"), ("compare", "two masses", "sizes 1e150"),
    ("refine", "first order", "sizes 1e-300"), ("diagnose", "two masses", "both constant"),
])  # fmt: skip
def test_exact_and_resting_records_are_answered_or_refused(verb, plant, name, tmp_path):
    answered(verb, PLANTS[plant], name, tmp_path)


@pytest.mark.slow
@WITHOUT_WARNINGS
@pytest.mark.parametrize(("plant", "name"), list(zip(cycle(PLANTS), RECORDS, strict=False)))
def test_every_verb_answers_or_refuses_every_such_record(plant, name, tmp_path):
    for verb in VERBS:
        answered(verb, PLANTS[plant], name, tmp_path)


@WITHOUT_WARNINGS
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_an_exact_simulation_has_no_failures(offset):
    """Nothing is left to explain, so the sums of squares that rows divide by are zero."""
    plant = PLANTS["mass"]
    found = rco.compare(plant, rco.Measurement(NOISE[0], simulated(plant, NOISE[0]) + offset, dt=0.05))
    assert len(found.failures) == 0
    assert "rounding" in str(found.failures)
    assert not model_error(found).differs.any()
    assert found.plot("horizon") is not None


@WITHOUT_WARNINGS
def test_the_map_of_a_motion_at_rest_is_drawn():
    found = rco.compare(PLANTS["mass"], rco.Measurement(np.zeros(N), np.zeros(N), dt=0.05))
    assert found.plot("map") is not None
    assert "nan" not in repr(found)


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
def test_a_constant_output_weighs_by_its_level(size):
    """Its standard deviation is the rounding of its mean: beside a live output it took the whole fit."""
    model = PLANTS["two masses"]
    y = simulated(
        rco.mass_spring_damper([1.0, 0.8], [0.4, 0.3], [90.0, 60.0], sensors="displacement"), NOISE[0]
    )
    y = np.vstack([y[0], np.full(N, 0.1)])
    found = rco.refine(
        model, rco.Measurement(size * NOISE[0], size * y, dt=0.05), [rco.Effect("stiffness", "link1")]
    )
    alike = rco.refine(model, rco.Measurement(NOISE[0], y, dt=0.05), [rco.Effect("stiffness", "link1")])
    assert found.parameters[0].value == pytest.approx(alike.parameters[0].value, rel=1e-6)


@WITHOUT_WARNINGS
def test_an_output_that_stops_has_failures():
    """Most of its samples are left out of what is looked at, and the mean of no sample was taken."""
    plant = PLANTS["static gain"]
    w = np.random.default_rng(0).standard_normal(240)
    y = np.where(np.arange(240) < 60, 2.0 * w, 2.0 * w[60])
    assert rco.compare(plant, rco.Measurement(w, y, dt=0.1)).failures[0].dimension == "time"


@pytest.mark.filterwarnings("ignore::rcorefine.RCOWarning")
def test_a_record_at_rest_confirms_nothing():
    plant, effect = PLANTS["mass"], rco.Effect("stiffness", "link1")
    moving = rco.Measurement(NOISE[0], simulated(plant, NOISE[0]), dt=0.05)
    better = rco.refine(plant, moving, [effect])
    still = rco.Measurement(np.ones(N), np.ones(N), dt=0.05)
    with pytest.raises(rco.DataError, match=r"no output ever changes \(record 2\)"):
        rco.confirm(better, [moving, still], candidates=[effect])


@WITHOUT_WARNINGS
def test_a_static_gain_is_diagnosed():
    """It has no place where a force could act, so no columns of other laws."""
    data = rco.Measurement(NOISE[0], 2.0 * NOISE[0] + 0.01 * NOISE[1], dt=0.05)
    gain = PLANTS["static gain"]
    assert rco.diagnose(gain, data, candidates=few_effects(gain, data)).verdict == "adequate"


@pytest.mark.slow
@WITHOUT_WARNINGS
def test_an_exact_decay_has_nothing_missing():
    """Its residual is zero, and so were the units of its noise: the normal equations were singular."""
    plant = PLANTS["first order"]
    w, y = RECORDS["decay"](plant)
    for data in (rco.Measurement(w, y, dt=0.05), rco.Measurement.free_decay(y, dt=0.05)):
        assert rco.diagnose(plant, data, candidates=few_effects(plant, data)).verdict == "adequate"


@pytest.mark.parametrize(("value", "std", "text"), [
    (10.0, 7.1e-18, "10.0000 (exact to rounding) kg"), (-1e-12, 1e-28, "-1.00000e-12 (exact to rounding) kg"),
    (1.0, 1e-13, "1.00000 +/- 1.0e-13 kg"), (10.0, 0.0, "10 +/- 0 kg"),
    (0.0, 1e-18, "0.000000 +/- 1.0e-18 kg"),
])  # fmt: skip
def test_a_deviation_below_the_rounding_of_its_value_is_no_figure(value, std, text):
    assert with_error(value, std, "kg") == text


def test_an_exact_estimate_beside_others_is_pooled():
    """DerSimonian and Laird: the spread does not depend on how much more certain the best one is."""
    values = np.array([1.0, 3.0, 2.0])
    found = [pool(values, np.array([small, 0.5, 0.5])) for small in (1e-10, 1e-14, 1e-40)]
    assert [one.spread for one in found] == pytest.approx([found[0].spread] * 3, rel=1e-6)


@WITHOUT_WARNINGS
def test_a_response_of_zero_is_refined_or_refused():
    plant, blank = PLANTS["mass"], rco.Measurement(NOISE.ravel(), np.zeros(4 * N), dt=0.05)
    found = rco.refine(plant, blank.frequency_response(segment_length=60), free="linear")
    assert not found.success
    assert "nan" not in str(found)
