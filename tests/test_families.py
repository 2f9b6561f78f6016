"""Nested laws: what contains what, and that the simplest one that does is named."""

import sys
from pathlib import Path
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
from cases import few_or_all, offered
from inner import (
    KINDS,
    Case,
    Engine,
    Hypothesis,
    Progress,
    Search,
    Start,
    Structure,
    answer,
    base_fit,
    levels,
    unit_forces,
)
from scipy.signal import cont2discrete, dlsim
from scipy.stats import chi2
from test_rivals import friction_record

import rcorefine as rco
from rcorefine.diagnosis.verdict import TableRow, special

LIMITS = {
    "displacement": 1e-6,
    "velocity": 1e3,
    "softness": 0.1,
    "static_ratio": 1.0,
    "lower": -0.3,
    "upper": 0.3,
}
NESTED = [(law.name, inside) for law in KINDS.values() if not law.at_channel for inside in law.contains]
# linear laws with a state of their own, and where they are one without: their coefficients, and its own
LINEAR = {
    ("maxwell_element", "stiffness"): ([30.0, 1e4], [30.0]),
    ("maxwell_element", "damping"): ([2e5, 1e-5], [2.0]),
    ("hidden_store", "mass"): ([0.5, 1e5], [0.5]),
    ("hidden_store", "damping"): ([1e5, 0.5], [0.5]),
}


@pytest.mark.parametrize(("general", "special"), LINEAR)
def test_a_linear_law_contains_what_it_says(rng, general, special):
    """At the limit the outputs are the same."""
    one_mass = rco.mass_spring_damper([1.0], [0.8], [100.0])
    store = rco.thermal_network([2.0], {(1, 0): 3.0}, ambient_input=False)
    model, place = (one_mass, "link1") if "mechanical" in KINDS[general].where else (store, "T1")
    data = rco.Measurement(rng.standard_normal((1, 400)), np.zeros((1, 400)), dt=0.02)
    without, one, other = (
        Engine(Structure(model, [rco.Effect(kind, place)] if kind else []), data)
        .run(np.array(values))
        .outputs
        for kind, values in zip(
            ("", special, general), ([], *reversed(LINEAR[general, special])), strict=True
        )
    )
    assert np.linalg.norm(other - one) < 0.01 * np.linalg.norm(one - without) > 0


@pytest.mark.parametrize(("general", "special"), sorted(set(NESTED) - set(LINEAR)))
def test_a_law_contains_what_it_says(general, special):
    """Along any motion the force of the special case is one of the general law's."""
    t = np.linspace(0.0, 20.0, 4000)
    d = 0.3 * np.sin(2.1 * t) + 0.2 * np.sin(3.7 * t)
    v = np.append(0.0, np.diff(d)) / t[1]
    if "mechanical" not in KINDS[general].where & KINDS[special].where:
        v = np.abs(v)  # a level
    law, shape = KINDS[general], dict(KINDS[general].contains[special])
    if special == "stiffness" and "displacement" in law.shaping:
        shape["displacement"] = 1e3  # so far that it never slips
    shape = {name: shape.get(name, LIMITS.get(name, 0.3)) for name in law.shaping}
    own = np.array(unit_forces(rco.Effect(general, "a"), d, v, [shape])).T
    same = {name: shape.get(name, LIMITS.get(name, 0.3)) for name in KINDS[special].shaping}
    wanted = np.sum(unit_forces(rco.Effect(special, "a"), d, v, [same]), axis=0)
    left = wanted - own @ np.linalg.lstsq(own, wanted, rcond=None)[0]
    moving = slice(200, None)  # from rest on
    assert np.linalg.norm(left[moving]) < 0.02 * np.linalg.norm(wanted[moving])


@pytest.fixture(scope="module")
def friction():
    model, data, _ = friction_record(12, 0.005)
    offered = [rco.Effect(f"{kind}_friction", "link1") for kind in ("asymmetric", "coulomb", "stribeck")]
    return rco.diagnose(model, data, candidates=offered)


def test_the_simplest_law_that_does_is_named(friction):
    assert friction.verdict == "effect"
    assert friction.best.effect.kind == "coulomb_friction"
    assert friction.ambiguous == (rco.Effect("coulomb_friction", "link1"),)  # what contains it is no rival
    total = sum(row.probability for row in friction.ranking) + friction.none_of_these
    assert total == pytest.approx(1.0)


def test_no_law_ends_below_one_that_it_contains(friction):
    """But for 0.5 of the log-likelihood of white noise."""
    left = {row.effect.kind: row.refinement.rmse[0] for row in friction.ranking}
    lost = np.log(left["asymmetric_friction"] / left["coulomb_friction"])
    assert friction.records[0].n_samples * lost < 0.5


@pytest.mark.parametrize(
    ("one", "other", "inside"),
    [
        ("coulomb_friction", "asymmetric_friction", True),
        ("asymmetric_friction", "coulomb_friction", False),
        ("coulomb_friction", "coulomb_friction", False),
        ("coulomb_friction", "cubic_stiffness", False),
        ("coulomb_friction cubic_stiffness", "cubic_stiffness stribeck_friction", True),
        ("coulomb_friction", "cubic_stiffness stribeck_friction", False),
        ("stiffness", "two_stops", True),  # a gap of zero: within a clearance, and that within two stops
        ("coulomb_friction damping", "stribeck_friction cubic_stiffness", False),
    ],
)
def test_a_special_case_is_one_member_by_member(one, other, inside):
    sets = [[rco.Effect(kind, "link1") for kind in kinds.split()] for kinds in (one, other)]
    assert special(*sets) == inside
    elsewhere = [rco.Effect(effect.kind, "link2") for effect in sets[1]]
    assert not special(sets[0], elsewhere)


SIMPLER = {  # forces on an oscillator of stiffness 100, and where a more general law has been fitted
    ("end_stop", "bilinear_stiffness"): (lambda d, v: 30.0 * max(d, 0.0), {"stiffness": 30, "position": 0}),
    ("two_stops", "stiffness"): (
        lambda d, v: -20.0 * d, {"stiffness": -20, "lower": -0.002, "upper": -0.001},
    ),
    ("two_stops", "end_stop"): (
        lambda d, v: 30.0 * max(d - 0.1, 0.0), {"stiffness": 30, "lower": -1e9, "upper": 0.1},
    ),
    ("power_damping", "quadratic_damping"): (lambda d, v: 0.3 * v * abs(v), {"damping": 0.3, "power": 2}),
    ("stribeck_friction", "coulomb_friction"): (
        lambda d, v: 3.0 * np.tanh(v / 0.02), {"coulomb_force": 3, "static_force": 3, "velocity": 1},
    ),
    # of a speed, initial state and constant force are one: 3 is half the sum
    ("asymmetric_friction", "coulomb_friction"): (
        lambda d, v: 3.0 * np.tanh(v / 0.02), {"force_plus": 7.5, "force_minus": -1.5},
    ),
}  # fmt: skip


@pytest.mark.parametrize(("general", "simple"), SIMPLER)
def test_a_special_case_is_fitted_from_the_general_law(rng, general, simple):
    """It ends where the truth is, and as near to the record as the general law."""
    law, start = SIMPLER[general, simple]

    def rate(x, force):
        return np.array([x[1], force - 100.0 * x[0] - 0.8 * x[1] - law(*x)])

    w, x, states = 10.0 * rng.standard_normal(1200), np.zeros(2), []
    for force in w:
        states.append(x)
        for _ in range(20):  # midpoint rule
            middle = x + 0.0005 * rate(x, force)
            x = x + 0.001 * rate(middle, force)
    speed = general == "asymmetric_friction"
    y = np.array(states)[:, int(speed)]
    data = rco.Measurement(w, y + 0.02 * y.std() * rng.standard_normal(1200), dt=0.02)
    sensors = ["velocity" if speed else "displacement"]
    model = rco.mass_spring_damper([1.0], [0.8], [100.0], sensors=sensors)
    effects = [rco.Effect(kind, "link1") for kind in (general, simple)]
    options = {"free": (), "tolerance": 0.0, "offset": False, "noise": None, "horizon": None}
    case = Case(base_fit(model, [data], **options), [data], effects, options, 0.01, Progress())
    search = Search(case)
    search.empty(frozenset())
    fitted = search.fitted.problem
    begin = Start([{n: float(v) for n, v in start.items()}], *fitted.unpack(search.fitted.point))
    whole = search.try_(effects[:1], frozenset(), [begin])
    search._simplify()
    found = next(x for x in search.trials if x.effects == (effects[1],))
    assert found.noise.log_likelihood > whole.noise.log_likelihood - chi2.isf(0.001, 3) / 2
    rows = {row.name: row for row in found.model.refinement.parameters if row.role == "effect"}
    size = next(iter(rows.values()))
    true = 3.0 if speed else next(iter(start.values()))
    assert abs(size.coefficient - true) < 3.3 * size.std + 0.01 * abs(true)


@pytest.mark.parametrize("stiffness", [-25.0, 30.0])
def test_a_crack_is_named_on_either_side(rng, stiffness):
    """And is no stop at zero: the sign of a displacement is a convention."""
    w, x, y = 10.0 * np.repeat(rng.standard_normal(60), 6), np.zeros(2), []

    def rate(x, force):
        return np.array([x[1], force - 100.0 * x[0] - 0.8 * x[1] - stiffness * min(x[0], 0.0)])

    for force in w:
        y.append(x[0])
        for _ in range(20):  # midpoint rule
            x = x + 0.001 * rate(x + 0.0005 * rate(x, force), force)
    y = np.array(y) + 0.02 * np.std(y) * rng.standard_normal(w.size)
    model = rco.mass_spring_damper([1.0], [0.8], [100.0])
    offered = [rco.Effect(kind, "link1") for kind in ("bilinear_stiffness", "end_stop")]
    there = rco.Effect("bilinear_stiffness", "link1", fixed={"side": -1})
    found = rco.diagnose(model, rco.Measurement(w, y, dt=0.02), candidates=offered)
    assert (found.verdict, found.best.effect) == ("effect", there)
    (value,), (std,) = found.best.coefficients.values(), found.best.std.values()
    assert abs(value - stiffness) < 3.3 * std


def loaded(A, truth, rng, shift=0):
    """A record of the plant x' = truth x + b u, and the model that has A; u is late by `shift` tenths."""
    A, truth = np.atleast_2d(A), np.atleast_2d(truth)
    B, C = np.eye(len(A))[:, -1:], np.eye(len(A))[:1]
    u = np.repeat(rng.choice([-1.0, 1.0], 150), 10)
    late = np.append(np.zeros(shift), np.repeat(u, 10))[: 10 * u.size]
    y = dlsim((*cont2discrete((truth, B, C, np.zeros((1, 1))), 0.005)[:4], 0.005), late)[1][::10, 0]
    data = rco.Measurement(u, y + 0.02 * y.std() * rng.standard_normal(u.size), dt=0.05)
    states = ["T"] if len(A) == 1 else ["x", "v"]
    return ct.ss(A, B, C, 0, states=states, inputs="P", outputs="y"), data


def test_two_names_of_one_change_are_one_hypothesis(rng):
    """The loss of a store is its entry of A, and no overflow at a rim of zero."""
    model, data = loaded(-1.0, -1.25, rng)
    found = rco.diagnose(model, data)
    assert found.verdict == "effect"
    assert found.best.effect == rco.Effect("damping", "T")
    (entry,) = found.best.same
    assert entry.effect == rco.Effect("coefficient", "A[0,0]")
    (value,), (std,) = entry.coefficients.values(), entry.std.values()
    assert abs(value + 0.25) < 3.3 * std
    assert set(found.ambiguous) == {found.best.effect, entry.effect}
    assert found.best.probability > levels().named
    assert [row.effect for row in found.ranking].count(rco.Effect("coefficient", "A[0,0]")) == 0
    assert "coefficient at A[0,0]" in str(found)
    assert "suggest_experiment" not in str(found)


@pytest.mark.parametrize("kinds", few_or_all("damping", "coefficient", "threshold_flow"))
def test_improve_takes_one_of_two_names(rng, kinds):
    model, data = loaded(-1.0, -1.25, rng)
    names = rco.Effect("damping", "T"), rco.Effect("coefficient", "A[0,0]")
    (effect,) = rco.improve(model, data, candidates=offered(model, kinds)).effects
    assert effect in names


def test_a_delay_at_either_end_of_one_path_is_one_hypothesis(rng):
    A = np.array([[0.0, 1.0], [-4.0, -0.8]])
    found = rco.diagnose(*loaded(A, A, rng, shift=7))
    assert found.verdict == "effect"
    names = {rco.Effect("input_delay", "P"), rco.Effect("output_delay", "y")}
    rows = (found.best, *found.best.same)
    assert {row.effect for row in rows} == names
    assert all(abs(row.coefficients["delay"] - 0.035) < 3.3 * row.std["delay"] for row in rows)


def test_what_one_record_alone_cannot_distinguish_stays_two_hypotheses(rng):
    """Stiffness and mass are the same at one frequency, not at others."""
    w = np.sin(7.0 * 0.02 * np.arange(1500))
    plant = ct.ss([[0, 1], [-102, -0.8]], [[0], [1]], [[1, 0]], 0)
    y = np.imag(plant(7.0j) * np.exp(7.0j * 0.02 * np.arange(1500)))
    y = y + 0.02 * y.std() * rng.standard_normal(w.size)
    laws = [rco.Effect(kind, "link1") for kind in ("stiffness", "mass")]
    model = rco.mass_spring_damper([1.0], [0.8], [100.0])
    found = rco.diagnose(model, rco.Measurement(w, y, dt=0.02, hold="bandlimited"), candidates=laws)
    assert found.verdict == "ambiguous"
    assert set(found.ambiguous) >= set(laws)
    assert "suggest_experiment" in str(found)
    assert all(one.effect.kind == row.effect.kind for row in found.ranking for one in row.same)


def named(values, passing, estimates=()):
    """Verdict, kind and probability from the log posterior of each kind, and those that pass."""
    sets = [((), "", -60.0), *(((rco.Effect(k, "link1"),), k, value) for k, value in values.items())]
    model = SimpleNamespace(refinement=SimpleNamespace(parameters=estimates))
    trials = [
        SimpleNamespace(hypothesis=Hypothesis(e), effects=e, kind=k, value=v, model=model) for e, k, v in sets
    ]
    rows = [TableRow(trial.effects, False, trial.value, [trial]) for trial in trials]
    library = [effect for trial in trials for effect in trial.effects]
    search = SimpleNamespace(
        case=SimpleNamespace(levels=levels(), significance=0.01, library=library),
        price=np.log(len(library)),
        criticized=lambda trial: SimpleNamespace(odds=-np.inf),
        ranked=lambda: sorted(trials, key=lambda trial: -trial.value),
        determined=lambda trial: True,
        posterior=lambda trial: trial.value,
    )
    rows.sort(key=lambda row: -row.value)
    found = answer(search, rows, lambda trial: trial.kind in passing)
    return found.verdict, found.trial.kind, found.probability


@pytest.mark.parametrize(("lead", "kind"), [(-2.0, "coulomb"), (2.2, "coulomb"), (2.4, "asymmetric")])
def test_of_a_family_the_simplest_within_odds_of_10_is_named_and_the_others_count_for_it(lead, kind):
    values = {"coulomb_friction": 0.0, "asymmetric_friction": lead, "cubic_stiffness": -4.0}
    word, found, probability = named(values, values)
    weights = np.exp(list(values.values()))
    assert (word, found) == ("effect", f"{kind}_friction")
    assert probability == pytest.approx(weights[:2].sum() / weights.sum())


@pytest.mark.parametrize(
    ("values", "passing", "word", "kind"),
    [
        ((0.0, 1.0, -4.0), "ab", "effect", "a"),
        ((0.0, 1.0, -4.0), "b", "effect", "b"),
        ((0.0, 1.0, -4.0), "", "unexplained", "b"),
        ((0.0, -1.0, -4.0), "ab", "effect", "a"),
        ((0.0, -1.0, -4.0), "b", "effect", "b"),  # a is a case of it
        ((0.0, -1.0, -4.0), "c", "unexplained", "a"),
        ((0.0, -0.1, -0.2), "b", "ambiguous", "b"),  # 0.37
        ((0.0, -0.2, -0.1), "c", "ambiguous", "c"),
        ((0.0, -0.1, -0.2), "c", "unexplained", "a"),  # 0.37 and 0.33
    ],
)
def test_what_contains_a_law_that_fails_is_named_where_it_passes(values, passing, word, kind):
    """Unless what fails is likelier than all else. a is a friction, b contains it, c does not."""
    kinds = {"a": "coulomb_friction", "b": "asymmetric_friction", "c": "cubic_stiffness"}
    found = named(dict(zip(kinds.values(), values, strict=True)), [kinds[x] for x in passing])
    assert found[:2] == (word, kinds[kind])


@pytest.mark.parametrize(("position", "kind"), [(1.6e-4, "bilinear_stiffness"), (1.8e-4, "end_stop")])
@pytest.mark.parametrize("passing", [("end_stop",), ("end_stop", "bilinear_stiffness")])
def test_a_limit_within_two_errors_of_zero_is_said_as_the_simpler_law(position, kind, passing):
    """By its value, here with an error of 8.5e-5, whatever the odds and the tests: 30:1 for the stop."""
    row = {"role": "effect", "place": "link1", "kind": "end_stop"}
    rows = [SimpleNamespace(coefficient=x, std=s, **row) for x, s in ((30.0, 0.1), (position, 8.5e-5))]
    found = named({"bilinear_stiffness": 0.0, "end_stop": np.log(30.0)}, passing, rows)
    assert found[:2] == ("effect", kind)


def test_a_rim_below_every_level_is_no_rival_of_a_loss():
    """A converter's current never turns: what its choke loses could as well spill over a rim at zero."""
    choke, store, load, lost, volts, dt = 47e-6, 100e-6, 5.0, 0.15, 24.0, 5e-6

    def converter(resistance):
        A = np.array([[-resistance / choke, -1 / choke], [1 / store, -1 / (load * store)]])
        return [A, np.array([[volts / choke], [0.0]]), np.array([[0.0, 1.0]]), np.zeros((1, 1))]

    rng = np.random.default_rng(2)
    duty = 0.5 + 0.06 * np.repeat(rng.standard_normal(40), 25)
    A, B, C, *_ = cont2discrete(converter(lost), dt)
    at_rest = np.linalg.solve(np.eye(2) - A, B[:, 0] * duty[0])
    _, volt, _ = dlsim((A, B, C, np.zeros((1, 1)), dt), duty, x0=at_rest)
    seen = volt[:, 0] + 0.02 * volt.std() * rng.standard_normal(1000)
    model = ct.ss(*converter(0.0), states=["iL", "vC"], inputs="d", outputs="v")
    kinds = ("damping", "threshold_flow", "sqrt_flow")
    data = rco.Measurement(duty, seen, dt=dt, input_labels="d", output_labels="v")
    found = rco.diagnose(model, data, candidates=[rco.Effect(kind, "iL") for kind in kinds])
    assert (found.verdict, found.best.effect) == ("effect", rco.Effect("damping", "iL"))
    # volts per ampere over what one unit of duty puts across the choke; and the text says so
    assert found.best.coefficients["damping"] == pytest.approx(lost / volts, rel=0.02)
    assert f"storage {choke / volts:.4g} from the input d" in str(found).replace("\n", " ")


def test_every_estimate_that_carries_an_answer_is_printed(rng):
    """A speed whose zero is 13.2 m/s off, and a friction: the offset stands beside the friction."""
    model, dt = ct.ss([[-0.5]], [[1.0]], [[1.0]], 0, states=["v"], inputs="F", outputs="speed"), 0.05
    w, x, speed = 3.0 * np.repeat(rng.standard_normal(120), 10) + 2.0, 0.0, []
    for force in w:
        speed.append(x)
        for _ in range(20):
            x += dt / 20 * (force - 0.5 * x - 0.8 * np.tanh(x / 0.01))
    y = np.array(speed) - 13.2 + 0.01 * np.std(speed) * rng.standard_normal(w.size)
    data, laws = rco.Measurement(w, y, dt=dt), [rco.Effect("coulomb_friction", "v")]
    ladder = rco.improve(model, data, candidates=laws)
    for found in (ladder.diagnosis, ladder):
        said = " ".join(str(found).split())
        assert "offset of -13.2 at speed" in said or "offset at speed 0 -> -13." in said


def test_only_the_shapes_of_a_new_effect_are_open():
    """Beside a clearance, whose gap has several starts, a sensor's gain has one, and one column."""
    from inner import candidate_columns, estimated_motion, fitted_from

    model = rco.mass_spring_damper([1.0, 0.8], [0.3, 0.2], [100.0, 80.0], sensors=["displacement", 1])
    rng = np.random.default_rng(3)
    w = 30.0 * rng.standard_normal(600)
    held, blank = rco.Effect("clearance", "link1"), rco.Measurement(w, np.zeros(600), dt=0.02)
    engine = Engine(Structure(model, [held]), blank, substeps=8)
    y = engine.run(np.array([60.0, 0.3]), sensitivity=False).outputs
    data = rco.Measurement(w, y + 0.01 * y.std() * rng.standard_normal(y.shape), dt=0.02)
    refined = rco.refine(model, data, [held])
    fitted = fitted_from(refined, [data], tolerance=0.0)
    motion = estimated_motion(fitted.structure, fitted.theta, fitted.problem.records[0])
    beside = [rco.Effect("output_gain", "q1"), rco.Effect("clearance", "link2")]
    gain, clearance = candidate_columns(fitted, beside, motion, (0.0,))
    assert len(gain.starts) == gain.columns[0.0][0].shape[2] == 1
    assert len(clearance.starts) > 1


@pytest.mark.parametrize("seed", [7022, 7024])
def test_a_maxwell_element_keeps_its_state(seed):
    """A linear model of the order without it fits as well, but not with the kinematics of the masses."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    import calibration

    row = calibration.run(seed)
    assert row["missing"] == "maxwell"
    assert (row["verdict"], row["named"], row["outcome"]) == ("effect", "maxwell_element", "right")
