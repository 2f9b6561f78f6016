"""Log evidence, and the verdict as a function of tests, evidence and levels."""

from __future__ import annotations

from collections.abc import Container
from types import SimpleNamespace
from typing import Any

import control as ct
import numpy as np
import pytest
from inner import (
    Case,
    Hypothesis,
    Progress,
    Search,
    Start,
    Whitener,
    answer,
    base_fit,
    candidate_columns,
    levels,
)
from scipy import stats
from scipy.signal import cont2discrete, dlsim

import rcorefine as rco
from rcorefine.diagnosis import nuisances, residual_tests, screening, verdict
from rcorefine.diagnosis.diagnose import _places
from rcorefine.diagnosis.open_law import FreeForces
from rcorefine.inference.f_tests import FTest
from rcorefine.inference.levels import Levels

NAMES = {"k": "cubic_stiffness", "f": "coulomb_friction", "g": "input_gain", "d": "damping"}
FLOATED, FOH = frozenset([nuisances.Parameters(0.2)]), frozenset([nuisances.Hold("foh")])


def f_tests(*p_values: float, equal: float = 1.0) -> list[FTest]:
    return [FTest("x", 1.0, 1, p, 1.0, equal) for p in p_values]


def test_the_smallest_of_several_tests_counts_as_often_as_there_are_tests() -> None:
    assert residual_tests.overall(f_tests(0.2, 0.01, 0.5)) == pytest.approx(0.03)
    assert residual_tests.overall(f_tests(0.9, 0.8)) == 1.0
    assert residual_tests.overall(
        [*f_tests(0.2), FTest("nothing to test", 0.0, 0, 1e-9, 0.0, 1.0)]
    ) == pytest.approx(0.2)
    assert residual_tests.overall([]) == 0.0  # what was not tested has not passed


def test_chance_fails_as_often_as_the_level_says() -> None:
    rng = np.random.default_rng(1)
    failed = sum(not residual_tests.passes(f_tests(*rng.random(6)), 0.0, 0.05, Levels()) for _ in range(2000))
    assert failed <= stats.binom.ppf(0.999, 2000, 0.05)


def test_a_residual_beyond_the_declared_noise_is_no_noise() -> None:
    assert residual_tests.passes(f_tests(0.5), 1.19, 0.01, Levels())
    assert not residual_tests.passes(f_tests(0.5), 1.21, 0.01, Levels())


def named_by(letters: str) -> tuple[rco.Effect, ...]:
    return tuple(rco.Effect(NAMES[x], "force" if x == "g" else "link1") for x in letters if x in NAMES)


def asked(
    values: dict[str, float],
    passing: Container[str] = (),
    *,
    odds: float = -np.inf,
    unsure: str = "none",
    significance: float = 0.01,
    library: str = "kfgd",
) -> tuple[verdict.Answer, list[Any]]:
    """Answer and table of trials with these log posteriors: effects by letter, + for open parameters."""
    trials = []
    for name, value in values.items():
        effects = named_by(name)
        held = (FLOATED if "+" in name else frozenset()) | (FOH if "h" in name else frozenset())
        own = {"hypothesis": Hypothesis(effects, held), "effects": effects, "name": name, "value": value}
        trials.append(SimpleNamespace(**own, equals=lambda other: False))
    search: Any = SimpleNamespace(
        case=SimpleNamespace(levels=Levels(), significance=significance, library=list(named_by(library))),
        price=np.log(len(library)),
        criticized=lambda trial: SimpleNamespace(odds=odds),
        ranked=lambda: sorted(trials, key=lambda t: -t.value),
        determined=lambda trial: trial.name != unsure,
        posterior=lambda trial: trial.value,
    )
    rows = verdict.table(search)
    return answer(search, rows, lambda trial: trial.name in passing), rows


def said(values: dict[str, float], passing: Container[str] = (), **options: Any) -> tuple[str, str]:
    found = asked(values, passing, **options)[0]
    return found.verdict, found.trial.name  # type: ignore[attr-defined]


def test_a_set_counts_with_all_its_nuisances_and_what_is_not_determined_does_not() -> None:
    found, rows = asked({"": 0.0, "+": 1.0, "k": 2.0, "k+": 2.5, "kf": 4.0}, ["k+"], unsure="kf")
    assert [(len(row.effects), row.floated) for row in rows] == [(1, False), (0, True), (0, False)]
    assert rows[0].value == pytest.approx(np.logaddexp(2.0, 2.5))
    weights = np.exp([0.0, 1.0, 2.0, 2.5])
    assert found.probability == pytest.approx(weights[2:].sum() / weights.sum())


def test_odds_of_a_hundred_to_one_end_a_tie() -> None:
    for odds, word in ((99.0, ("k",)), (101.0, ())):
        found, rows = asked({"": -50.0, "f": 0.0, "k": -np.log(odds)}, ["f"])
        assert found.ties == tuple(row for row in rows if row.trials[0].name in word)
    assert found.probability == pytest.approx(101 / 102)


@pytest.mark.parametrize(
    ("values", "passing", "word"),
    [
        ({"": 0.0, "k": 4.5}, ["", "k"], ("adequate", "")),  # odds of 90 to 1
        ({"": 0.0, "k": 4.7}, ["", "k"], ("effect", "k")),  # 110 to 1
        ({"": 0.0, "k": 2.9}, ["k"], ("ambiguous", "k")),
        ({"": 0.0, "k": 9.0}, [], ("unexplained", "k")),
        ({"": 0.0, "k": 9.0, "f": 6.2}, ["k", "f"], ("ambiguous", "k")),  # 0.94
        ({"": 0.0, "k": 9.0, "f": 6.0}, ["k", "f"], ("effect", "k")),  # 0.952
        ({"": 0.0, "k": 9.0, "f": 8.9}, ["f"], ("unexplained", "k")),  # 0.52 fail
        ({"": 0.0, "k": 9.0, "f": 8.9, "kf": 6.5}, ["f", "kf"], ("unexplained", "k")),  # 0.503
        ({"": 0.0, "k": 9.0, "f": 8.9, "kf": 6.8}, ["f", "kf"], ("ambiguous", "f")),  # 0.496
        ({"": 0.0, "k": 9.0, "f": 8.9, "kf": 8.8}, ["f", "kf"], ("ambiguous", "f")),  # 0.37
        ({"": 0.0, "k": 9.0, "f": 8.9, "kf": 8.8}, ["kf"], ("unexplained", "k")),  # 0.37 and 0.33
        ({"": 0.0, "k": 9.0, "f": 4.3}, ["f"], ("unexplained", "k")),  # what fails excludes it all the same
        ({"": 0.0, "+": 9.0, "k": 6.0}, ["+", "k"], ("parameters", "+")),
        ({"": 0.0, "+": 9.0, "k": 5.0}, ["k"], ("unexplained", "+")),  # parameters that fail count, too
        ({"": 0.0, "+": 9.0, "k": 8.9, "f": 8.8}, ["k"], ("ambiguous", "k")),
        ({"": 0.0, "g+": 9.0}, ["g+"], ("parameters", "g+")),  # a gain is one of them
        ({"": 0.0, "gk+": 9.0}, ["gk+"], ("effect", "gk+")),
        ({"": 0.0, "h": 9.0}, ["h"], ("adequate", "h")),
        ({"": 0.0, "kh": 9.0, "k": 8.0}, ["k"], ("effect", "k")),
    ],
)
def test_what_follows(values: dict[str, float], passing: list[str], word: tuple[str, str]) -> None:
    assert said(values, passing) == word


@pytest.mark.parametrize("significance", [0.05, 0.01, 0.001])
def test_nothing_is_kept_within_odds_of_one_over_the_significance(significance: float) -> None:
    for share, word in ((0.9, ("adequate", "")), (1.1, ("effect", "k"))):
        values = {"": 0.0, "k": np.log(share / significance)}
        assert said(values, ["", "k"], significance=significance) == word


@pytest.mark.parametrize(("significance", "library"), [(0.01, "kfgd"), (0.05, "kfgd"), (0.01, "kf")])
def test_what_is_not_determined_and_far_ahead_leaves_all_else_unexplained(
    significance: float, library: str
) -> None:
    """Ahead by more than what keeps nothing and the price of an effect."""
    limit = np.log(len(library) / significance)
    options: dict[str, Any] = {"unsure": "kf", "significance": significance, "library": library}
    for lead, words in ((limit - 0.1, ("effect", "adequate")), (limit + 0.1, ("unexplained", "unexplained"))):
        assert said({"": 0.0, "k": 9.0, "kf": 9.0 + lead}, ["k", "kf"], **options) == (words[0], "k")
        assert said({"": 0.0, "kf": lead}, ["", "kf"], **options) == (words[1], "")
    found, rows = asked({"": 0.0, "k": 9.0, "kf": 9.1 + limit}, ["k"], **options)
    assert (found.row, found.effects) == (rows[0], named_by("k"))
    assert np.isnan(found.probability)
    assert found.none == 1.0
    nothing_unsure = {**options, "unsure": "none"}
    assert said({"": 0.0, "k": 9.0, "kf": 9.1 + limit}, ["kf"], **nothing_unsure) == ("effect", "kf")


@pytest.mark.parametrize(("name", "counts"), [("d", True), ("dg", True), ("k", False), ("dk", False)])
def test_open_parameters_count_for_what_is_nothing_but_parameters(name: str, counts: bool) -> None:
    found, rows = asked({"": 0.0, "+": 8.0, name: 9.0}, [name])
    assert (found.verdict, found.effects) == ("effect" if counts else "ambiguous", named_by(name))
    opened = (rows[1],)
    assert rows[1].floated
    assert (found.inside, found.ties) == ((opened, ()) if counts else ((), opened))
    weights = np.exp([9.0, 8.0, 0.0])
    assert found.probability == pytest.approx(weights[: 1 + counts].sum() / weights.sum())


@pytest.mark.parametrize(
    ("name", "library", "word", "effects"),
    [
        ("d", "kfgd", "effect", "d"),
        ("d", "kfg", "parameters", ""),
        ("dk", "kfgd", "effect", "dk"),
        ("dk", "kfg", "effect", "k"),
        ("dg", "kf", "parameters", ""),
    ],
)
def test_what_was_not_asked_for_is_not_named(name: str, library: str, word: str, effects: str) -> None:
    found, rows = asked({"": 0.0, name: 9.0}, [name], library=library)
    assert (found.verdict, found.effects) == (word, named_by(effects))
    assert found.row is rows[0]
    assert found.probability == pytest.approx(1.0 / (1.0 + np.exp(-9.0)))


def test_a_law_that_passes_stands_beside_a_force_of_no_law_that_is_likelier() -> None:
    for odds, word in ((-np.inf, "effect"), (np.log(0.9), "effect"), (np.log(1.1), "ambiguous")):
        found, _ = asked({"": 0.0, "k": 20.0}, ["k"], odds=odds)
        assert found.verdict == word  # less than even: no name
        assert found.none == pytest.approx(np.exp(odds) / (1.0 + np.exp(odds)))
        assert found.probability == pytest.approx(1.0 - found.none, abs=1e-6)


@pytest.mark.parametrize("left", [0.0, 0.3, 0.6, 1.0])
def test_what_the_likeliest_force_leaves_is_at_no_known_place(left: float) -> None:
    found, rows = asked({"": 0.0, "k": 5.0})
    places = _places(rows, found, FreeForces({"a": 40.0, "u": 0.0}, None, left), True)
    assert sum(places.values()) == pytest.approx(1.0 - left, abs=1e-9)
    assert next(iter(places)) == "a"


def static(rng: np.random.Generator) -> tuple[Search, rco.Measurement, dict[str, np.ndarray]]:
    """An oscillator with an entry of D and a gain that are off, and what a unit of each does by scipy."""
    A, B, C, D = np.array([[0, 1], [-40, -0.8]]), np.array([[0], [1.0]]), np.eye(2)[:1], np.zeros((1, 1))
    force = 10 * rng.standard_normal(1200)
    y = dlsim((*cont2discrete((A, B, C, D), 0.05)[:4], 0.05), force)[1][:, 0]
    noise = 0.03 * y.std() * rng.standard_normal(1200)
    seen = 1.006 * y + 0.2 * noise.std() * force / force.std() + noise
    data = rco.Measurement(force, seen, dt=0.05, input_labels="u")
    model = ct.ss(A, B, C, D, states=["x", "v"], inputs="u", outputs="y")
    laws = [rco.Effect("coefficient", "D[0,0]"), rco.Effect("input_gain", "u")]
    options = {"free": (), "tolerance": 0.0, "offset": False, "noise": None, "horizon": None}
    case = Case(base_fit(model, [data], **options), [data], laws, options, 0.01, Progress())
    free = [ct.initial_response(ct.ss(model), 0.05 * np.arange(1200), x0).outputs for x0 in np.eye(2)]
    return Search(case), data, {"nothing": y, "D": force, "gain": y, "free": np.array(free).T}


def test_the_evidence_is_the_marginal_likelihood_of_a_linear_model(rng: np.random.Generator) -> None:
    """States flat, each coefficient as wide as the set as a whole; the rest is a normal density."""
    search, data, does = static(rng)
    search.empty(frozenset())
    zero, laws = search.fitted, search.case.library
    wanted, found = [], []
    outside = np.linalg.qr(does["free"], mode="complete")[0][:, 2:].T  # flat directions projected out
    r = outside @ (data.outputs[0] - does["nothing"])
    for effects, names in (((), ()), (laws[:1], ["D"]), (laws[1:], ["gain"]), (laws, ["D", "gain"])):
        X = outside @ np.array([does[name] for name in names]).T if names else np.zeros((r.size, 0))
        left = r - X @ np.linalg.lstsq(X, r, rcond=None)[0] if names else r
        variance, size = left @ left / data.n_samples, r @ r - left @ left
        prior = X / np.linalg.norm(X, axis=0) if names else X
        C = variance * np.eye(r.size) + size * prior @ prior.T
        flat = -0.5 * 2 * np.log(2 * np.pi * variance)  # two states, in units of the noise
        wanted.append(stats.multivariate_normal.logpdf(r, cov=C) + flat)
        start = Start(
            [{e.coefficients[0]: 0.0} for e in effects], zero.theta, zero.problem.unpack(zero.point)[1]
        )
        trial = search.try_(effects, frozenset(), [start]) if effects else search.trials[0]
        assert trial is not None
        assert trial.noise.names == ("autoregressive 0",)
        found.append(trial.total)
    np.testing.assert_allclose(np.diff(found), np.diff(wanted), atol=0.1)
    assert np.ptp(wanted) > 10.0


def test_a_screen_gives_the_least_squares_of_a_set(rng: np.random.Generator) -> None:
    search, data, does = static(rng)
    fitted, laws = search.fitted, search.case.library
    scored = candidate_columns(fitted, laws, search.motion, (0.0,))
    metric = screening.Metric(Whitener.fit(fitted.residuals(), order=0))
    screen = screening.Screen(fitted, scored, {}, metric, search.motion)
    groups = [next(g for g in screen.groups if g.effect == e) for e in laws]
    start = screen.start(groups, False, fitted)
    X = np.column_stack([does["D"], does["gain"], does["free"]])
    wanted = np.linalg.lstsq(X, data.outputs[0] - does["nothing"], rcond=None)[0]
    own = [v for values in start.values for v in values.values()]
    np.testing.assert_allclose([*own, *start.states[0]], wanted, rtol=0.01, atol=1e-4)


def test_levels_of_a_session() -> None:
    ct.config.defaults["rcorefine.rival"] = 6.0
    try:
        ct.config.defaults["rcorefine.spoiled"] = Levels().spoiled  # its own default
        assert (levels().rival, levels().spoiled) == (6.0, 0.02)
        ct.config.defaults["rcorefine.rivals"] = 6.0
        with pytest.raises(ct.ControlArgument, match="rcorefine.rivals; there is noise_excess"):
            levels()
        ct.config.defaults.pop("rcorefine.rivals")
        for gone in ("color", "departs"):
            ct.config.defaults[f"rcorefine.{gone}"] = 1.0
            with pytest.raises(ct.ControlArgument, match=f"rcorefine.{gone} .*decides nothing any more"):
                levels()
            ct.config.defaults.pop(f"rcorefine.{gone}")
        ct.config.defaults["rcorefine.rival"] = "much"
        with pytest.raises(ct.ControlArgument, match="positive number"):
            levels()
    finally:
        for name in ("rival", "rivals", "spoiled", "color", "departs"):
            ct.config.defaults.pop(f"rcorefine.{name}", None)
