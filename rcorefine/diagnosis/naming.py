"""The candidates in the order of their probability, and what is said of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..data.measurement import Measurement
from ..inference.f_tests import FTest
from ..inference.sensitivities import Candidate
from .case import Case
from .colored_noise import left_to_noise
from .families import hosts, said_of_families
from .judging import Judged, outweighed
from .open_law import open_law, probabilities
from .ranking import in_free_run, ranking
from .remarks import amplitude_test, fit_remarks, not_known, remarks
from .residual_tests import TestedResidual
from .result import Diagnosis
from .verdict import tied, verdict
from .without_a_law import about_hold

__all__ = ["named"]


def named(
    case: Case,
    judged: Judged,
    scored: Sequence[Candidate],
    scores: Sequence[FTest],
    batteries: Sequence[TestedResidual],
    validation: Measurement | None,
    tests: Sequence[FTest],
) -> Diagnosis:
    """The ranking, who is tied, and what the tests of the winner make of it.

    Parameters
    ----------
    case : Case
        What is asked.
    judged : Judged
        The winner before the tests.
    scored, scores : sequence
        Candidates, and the score test of each.
    batteries : sequence of TestedResidual
        Residuals of the model, free and led by its observers.
    validation : Measurement or None
        Record on which the rows of the ranking are judged.
    tests : sequence of FTest
        Tests of the model as it is.

    Returns
    -------
    Diagnosis
        "effect", "ambiguous" or "unexplained".
    """
    race = judged.race
    likelihoods = [rival.log_likelihood for rival in race.rivals]
    p_of = {c.effect: test.p_value for c, test in zip(scored, scores, strict=True)}
    lacks = [0.0 if rival.settled else rival.lack for rival in race.rivals]
    ties = tied(likelihoods, lacks, case.levels)
    held = hosts(race.rivals, ties, case.levels)
    alike = tuple(race.rivals[i].effect for i in ties if i not in held)
    several = judged.passed and len(case.records) > 1
    agreement, sentence = amplitude_test(race, case.levels) if several else (1.0, "")
    unknown = not_known(race, case.levels) if judged.passed else ""
    passed = judged.passed and not unknown
    word = verdict(passed, agreement, len(alike), case.levels, judged.against)
    with case.progress.step("free forces"):
        law = open_law(race) if word == "unexplained" and case.thorough and case.in_time else None
    odds = (judged.beside, judged.elsewhere) if judged.passed else (-np.inf, -np.inf)
    shares, none, places = probabilities(race, *odds, law)
    if word == "unexplained":  # none is printed for what fails its own tests
        shares, none = np.full(len(shares), np.nan), 1.0
    shown = in_free_run(race) if word == "unexplained" and case.thorough and not unknown else race
    p_values = [p_of[rival.effect] for rival in shown.rivals]
    if word == "unexplained" and not case.in_time:  # laws that fail do not tell where
        places = {}
    rows = ranking(shown, p_values, shares, case.base, validation, case.settings["horizon"])
    notes = [*about_hold(case), *fit_remarks(race), *remarks(race)]
    notes += said_of_families(race.rivals, held)
    notes += [said for said in (sentence, unknown, outweighed(judged, case.levels)) if said]
    own = {"force_ratio": race.ratio, "notes": tuple(notes), **case.about}
    own["left_to_noise"] = "" if judged.tests else left_to_noise(batteries[0], case.levels)
    found = Diagnosis(word, rows, alike, tuple(tests), tuple(judged.tests), (), **own)
    return replace(found, none_of_these=none, places=places, open_law=None if law is None else law.law)
