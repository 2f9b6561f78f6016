"""The report of a diagnosis."""

from __future__ import annotations

import inspect
from typing import Any

from ...data.response_record import in_frequency
from ...diagnosis.diagnose import diagnose
from ...diagnosis.result import Diagnosis
from ...inference.refinement import Refinement
from ...words import chance, counted
from ..check import odd
from ..tables import Table, number
from .answers import diagnosis_answer
from .code import call_options, effects_code, model_code, record_code, refinement_code, script
from .page import Page, Paragraphs, Section, reports
from .parts import Parts, code_section, origin_section, parameter_table, pictures

__all__ = ["report_diagnosis"]


@reports(Diagnosis)
def report_diagnosis(found: Diagnosis, *, title: str | None, code: str | None) -> Page:
    """The report of a diagnosis; see `Diagnosis.report`."""
    answer, fine = diagnosis_answer(found)
    named = found.verdict != "unexplained"
    shown = ", ".join(
        f"{row.label} {row.probability:.2f}" if named else row.label for row in found.ranking[:4]
    )
    drawn = pictures(
        [
            (
                "diagnosis",
                lambda: found.plot(title=""),
                f"Ranking of the candidates ({shown or 'nothing'}), the hidden force against the motion, "
                "and the residual before and after.",
                "The candidates, the most probable first; the force that was estimated at the place of the "
                "best one, with its formula; and the residual with and without it.",
            )
        ]
    )
    linear = found.base.physical_model.linear
    sections = [
        Section("Pictures", drawn),
        Section("Tables", [part for part in _tables(found) if not isinstance(part, Table) or part.rows]),
        code_section(_own_code(found), code),
        origin_section(found.records),
    ]
    every: list[Any] = list(found.records)
    samples = sum(r.omega.size if in_frequency(r) else r.n_samples for r in every)
    responses, many = found.base.of_responses, len(found.records)
    given = counted(many, "response") if responses else counted(many, "record")
    about = f"model {linear.name}, {given}, {samples} {'frequencies' if responses else 'samples'}"
    return Page(title or f"Diagnosis of {linear.name}: {found.verdict}", about, answer, fine, sections)


def _tables(found: Diagnosis) -> Parts:
    tested = [
        ["model as given", t.name, number(t.statistic), str(t.dof), chance(t.p_value)] for t in found.tests
    ] + [
        ["with the best effect", t.name, number(t.statistic), str(t.dof), chance(t.p_value)]
        for t in found.winner_tests
    ]
    return [
        *odd(found.checks),
        Table(
            [
                "effect",
                "coefficient",
                "value",
                "std",
                "fit before [%]",
                "fit after [%]",
                "p-value",
                "probability",
            ],
            _ranking_rows(found),
            title="Candidates that were refitted",
            notes=[
                "p-value: probability of such a score if nothing were missing. probability: of each "
                "candidate among all and none of them; not given if no candidate passes its own tests. "
                "std: one standard deviation of the coefficient.",
            ],
            left=2,
        )
        if found.ranking
        else Table(
            ["effect", "smallest coefficient", "unit"],
            [[d.effect.label, number(d.smallest, 3), d.unit] for d in found.detectable],
            title="Smallest effects that the record would show",
            notes=["The smallest coefficient that would have been detected with 95 % probability."],
        ),
        Table(
            ["model", "test", "F", "degrees of freedom", "p-value"],
            tested,
            title="Residual tests",
            notes=[
                f"The significance level is {found.significance:g}, divided by the number of tests. A small "
                "p-value shows that the residual still depends on what this test examines."
            ],
            left=2,
        ),
        parameter_table(found.base, "The model as given, with its free parameters fitted"),
        *([] if found.floated is None else [parameter_table(found.floated, "All parameters re-estimated")]),
        Paragraphs(found.notes),
    ]


def _own_code(found: Diagnosis) -> str:
    """Code that makes the diagnosis again."""
    known = inspect.signature(diagnose).parameters
    settings = {key: value for key, value in found.settings.items() if key in known}
    candidates = settings.pop("candidates", None)
    settings["significance"] = found.significance
    call = f"found = rco.diagnose(model, data{call_options(settings)})"
    if candidates is not None:
        call = f"candidates = {effects_code(candidates)}\n" + call.replace(
            "data", "data, candidates=candidates", 1
        )
    start, name = _start_code(found.base)
    return script(
        start,
        record_code(found.records),
        [call.replace("(model,", f"({name},", 1), "print(found)", "found.plot()"],
    )


def _ranking_rows(found: Diagnosis) -> list[list[str]]:
    rows = []
    for row in found.ranking:
        fits = [number(row.fit_before), number(row.fit_after)]
        tail = [*fits, chance(row.p_value), number(row.probability, 3)]
        for k, (effect, own) in enumerate(row.estimates):
            for i, (name, one) in enumerate(own.items()):
                head = "" if i else "+ " * (k > 0) + effect.label
                rest = [""] * 4 if k or i else tail
                rows.append([head, name, f"{one.coefficient:.5g}", f"{one.std:.2g}", *rest])
    if found.verdict != "unexplained":
        rows.append(["none of these", *[""] * 6, number(found.none_of_these, 3)])
    if found.open_law is not None:
        before, after = found.ranking[0].fit_before, found.open_law.fit_after
        rows.append([found.open_law.effect.label, *[""] * 3, number(before), number(after), "", ""])
    return rows


def _start_code(base: Refinement) -> tuple[list[str], str]:
    """Return code for the initial model of a diagnosis, and its name.

    If effects were in that model, it is a refinement.
    """
    lines = model_code(base.physical_model)
    if "effect" not in base.roles:
        return lines, "model"
    return [
        *lines,
        "# diagnose started from this model with the effects that it held:",
        *refinement_code(base),
    ], "better"
