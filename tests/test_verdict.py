"""The verdict as a function of tests, likelihoods and levels."""

from __future__ import annotations

from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
from scipy import stats

from rcorefine.diagnosis.open_law import FreeForces
from rcorefine.diagnosis.open_law import probabilities as by_place
from rcorefine.diagnosis.verdict import keeps_name, overall, passes, probabilities, tied, verdict
from rcorefine.inference.f_tests import FTest
from rcorefine.inference.levels import Levels, levels


def f_tests(*p_values: float, equal: float = 1.0) -> list[FTest]:
    return [FTest("x", 1.0, 1, p, 1.0, equal) for p in p_values]


def test_the_smallest_of_several_tests_counts_as_often_as_there_are_tests() -> None:
    assert overall(f_tests(0.2, 0.01, 0.5)) == pytest.approx(0.03)
    assert overall(f_tests(0.9, 0.8)) == 1.0
    assert overall([*f_tests(0.2), FTest("nothing to test", 0.0, 0, 1e-9, 0.0, 1.0)]) == pytest.approx(0.2)
    assert overall([]) == 0.0  # what was not tested has not passed
    assert overall(f_tests(0.9, 0.8, equal=1e-4), equal=True) == pytest.approx(2e-4)


def test_chance_fails_as_often_as_the_level_says() -> None:
    rng = np.random.default_rng(1)
    failed = sum(not passes(f_tests(*rng.random(6)), 0.0, 0.05, Levels()) for _ in range(2000))
    assert failed <= stats.binom.ppf(0.999, 2000, 0.05)


def test_a_residual_beyond_the_declared_noise_is_no_noise() -> None:
    assert passes(f_tests(0.5), 1.19, 0.01, Levels())
    assert not passes(f_tests(0.5), 1.21, 0.01, Levels())


def test_odds_of_a_hundred_to_one_end_a_tie() -> None:
    values = [0.0, -np.log(99.0), -np.log(101.0), -np.log(101.0)]
    assert tied(values, [0.0, 0.0, 0.0, 0.1], Levels()) == [0, 1, 3]  # the last is not at its minimum
    assert probabilities(values[:2]) == pytest.approx([0.99, 0.01])


@pytest.mark.parametrize(
    ("passed", "agreement", "ties", "word"),
    [
        (True, 1.0, 1, "effect"),
        (True, 1.0, 2, "ambiguous"),
        (False, 1.0, 1, "unexplained"),
        (True, 0.004, 1, "unexplained"),
        (True, 0.006, 1, "effect"),
    ],
)
def test_what_follows(passed: bool, agreement: float, ties: int, word: str) -> None:
    assert verdict(passed, agreement, ties, Levels()) == word


def test_one_effect_keeps_its_name_where_all_numbers_together_are_not_a_hundred_times_likelier() -> None:
    assert keeps_name(0.0, np.log(99.0), Levels())
    assert not keeps_name(0.0, np.log(101.0), Levels())
    assert keeps_name(0.0, -50.0, Levels())


def test_a_law_that_passes_stands_beside_a_force_of_no_law_that_is_likelier() -> None:
    assert verdict(True, 1.0, 1, Levels()) == "effect"
    assert verdict(True, 1.0, 1, Levels(), beside=np.log(0.9)) == "effect"
    assert verdict(True, 1.0, 1, Levels(), beside=np.log(1.1)) == "ambiguous"  # less than even: no name
    assert verdict(True, 1.0, 1, Levels(), beside=np.log(99.0)) == "ambiguous"
    assert verdict(True, 1.0, 1, Levels(), beside=np.log(101.0)) == "unexplained"  # as a rival is excluded
    assert verdict(False, 1.0, 1, Levels(), beside=np.log(3.1)) == "unexplained"


def test_a_force_at_no_known_place_is_at_no_place() -> None:
    """Odds of 1 : 3 : 12 of the laws at a, a free force there, and a force whose place nobody knows."""
    rivals = [("a", 2.0), ("b", 1.0)]
    race = SimpleNamespace(
        rivals=[SimpleNamespace(effect=SimpleNamespace(place=p), log_likelihood=value) for p, value in rivals]
    )
    odds = np.array([1.0, np.exp(-1.0), 3.0, 12.0])
    shares, none, places = by_place(race, np.log(3.0), np.log(12.0), None)
    np.testing.assert_allclose([*shares, none], [*odds[:2] / odds.sum(), odds[2:].sum() / odds.sum()])
    assert places == pytest.approx({"a": 4.0 / odds.sum(), "b": odds[1] / odds.sum()})


@pytest.mark.parametrize("left", [0.0, 0.3, 0.6, 1.0])
def test_what_the_likeliest_force_leaves_is_at_no_known_place(left: float) -> None:
    rival = SimpleNamespace(effect=SimpleNamespace(place="a"), log_likelihood=0.0)
    free = FreeForces({"a": 40.0, "u": 0.0}, None, left)
    places = by_place(SimpleNamespace(rivals=[rival]), -np.inf, -np.inf, free)[2]
    assert sum(places.values()) == pytest.approx(1.0 - left, abs=1e-9)


def test_levels_of_a_session() -> None:
    ct.config.defaults["rcorefine.rival"] = 6.0
    try:
        ct.config.defaults["rcorefine.departs"] = Levels().departs  # its own default, which is 0
        assert (levels().rival, levels().departs) == (6.0, 0.0)
        ct.config.defaults["rcorefine.rivals"] = 6.0
        with pytest.raises(ct.ControlArgument, match="rcorefine.rivals; there is noise_excess"):
            levels()
        ct.config.defaults.pop("rcorefine.rivals")
        ct.config.defaults["rcorefine.rival"] = "much"
        with pytest.raises(ct.ControlArgument, match="positive number"):
            levels()
    finally:
        for name in ("rcorefine.rival", "rcorefine.rivals", "rcorefine.departs"):
            ct.config.defaults.pop(name, None)
