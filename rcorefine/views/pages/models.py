"""The reports of an improvement and of a refinement."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...comparison.compare import compare
from ...data.levels import stretches_by_level
from ...data.measurement import Measurement
from ...data.response_record import in_frequency
from ...diagnosis.improvement import Improvement
from ...inference.refinement import Refinement
from ...words import counted, with_error
from ..check import odd
from ..responses import responses_table
from ..tables import Table, number, root_mean_square
from .answers import improvement_answer, refinement_answer
from .code import model_code, record_code, refinement_code, script
from .comparison import comparison_tables, picture_words
from .page import Page, Paragraphs, Section, reports
from .parts import (
    Parts,
    Wanted,
    code_section,
    estimates,
    origin_section,
    parameter_plot,
    parameter_table,
    pictures,
)

__all__ = ["report_improvement", "report_refinement"]


@reports(Improvement)
def report_improvement(
    improvement: Improvement,
    *,
    data: Any,
    title: str | None,
    code: str | None,
) -> Page:
    """The report of an improvement; see `Improvement.report`."""
    answer, fine = improvement_answer(improvement)
    last = improvement.refinement
    errors = ", ".join(f"{root_mean_square(s.validation_rmse):.3g}" for s in improvement.steps)
    wanted: list[Wanted] = [
        (
            "staircase",
            lambda: improvement.plot(title=" "),
            f"Staircase of the root mean square error after each step; held out: {errors}.",
            "Simulation error after each step on three parts of the record: the fitted part, the part for "
            "selecting the step, and the held-out part. Judge the model by the held-out part.",
        )
    ]
    rows = []
    for i, step in enumerate(improvement.steps):
        values = "; ".join(f"{k} {with_error(v, step.std[k])}" for k, v in step.coefficients.items())
        errors_of = (step.train_rmse, step.choice_rmse, step.validation_rmse)
        rivals = ", ".join(effect.label for effect in step.rivals)
        rows.append([str(i), step.name, values, *(f"{root_mean_square(e):.4g}" for e in errors_of), rivals])
    tables: Parts = [
        *odd(improvement.checks),
        Table(
            ["step", "what", "coefficients", "fitted", "selection", "held out", "not distinguishable"],
            rows,
            title="Root mean square error after each step",
            notes=["The data cannot distinguish the effects in the last column from the one that was added."],
            left=3,
        ),
        parameter_table(last, "Parameters of the last model"),
        Paragraphs(improvement.sentences()),
    ]
    return _report_model(
        title or f"Improvement of {last.physical_model.linear.name}: {improvement.verdict}",
        (answer, fine),
        wanted,
        tables,
        (improvement.steps[0].refinement, last),
        data,
        code,
    )


@reports(Refinement)
def report_refinement(
    refinement: Refinement,
    *,
    data: Any,
    title: str | None,
    code: str | None,
) -> Page:
    """The report of a refinement; see `Refinement.report`."""
    tables: Parts = [
        parameter_table(refinement, "Parameters"),
        Paragraphs([refinement.message, *refinement.warnings]),
    ]
    return _report_model(
        title or f"Refinement of {refinement.physical_model.linear.name}",
        refinement_answer(refinement),
        [],
        tables,
        (None, refinement),
        data,
        code,
    )


def _report_model(
    title: str,
    answer: tuple[list[str], bool],
    wanted: list[Wanted],
    tables: Parts,
    models: tuple[Refinement | None, Refinement],
    data: Any,
    code: str | None,
) -> Page:
    """Build the report of a refined model beside the initial one.

    If there is a record, the report compares both with it.
    """
    first, last = models
    linear = last.physical_model.linear
    about = (
        f"model {linear.name}: {counted(linear.n_states, 'state')}, {counted(linear.n_inputs, 'input')}, "
        f"{counted(linear.n_outputs, 'output')}"
    )
    records = [] if data is None else [data]
    if data is None:
        tables.append(
            Paragraphs(
                [
                    "The result does not contain the record; report(..., data=...) compares the "
                    "models with one."
                ]
            )
        )
    else:
        before: Any = last.physical_model if first is None else first
        beside: Any = replace(compare([before, last], data), names=("initial", "refined"))
        if in_frequency(data):
            said = "Frequency responses of the initial and of the refined model, with the measured points."
            wanted.append(("response", lambda: beside.plot(title=""), said, said))
            tables.append(responses_table(beside))
            about += f"; compared with response {data.name}, {data.omega.size} frequencies"
        else:
            wanted.append(("time", lambda: beside.plot(title=""), *picture_words(beside, "time")))
            tables += comparison_tables(beside)
            about += f"; compared with record {data.name}, {data.n_samples} samples"
    if not in_frequency(data):
        wanted.append(_bode_picture(last, data))
    wanted.append(
        (
            "parameters",
            lambda: parameter_plot(last),
            "Estimates with their 95 % intervals: "
            + ", ".join(f"{r.name} {with_error(r.value, 1.96 * r.std)}" for r in estimates(last)[:12]),
            "Estimates with 95 % intervals, in units of the initial value (or of the estimate, where the "
            "initial model has none); the vertical line is the initial model.",
        )
    )
    if not estimates(last):
        wanted.pop()
    own = script(
        ["# the initial model", *model_code(last.physical_model)],
        record_code(records) if records else ["data = ...  # your record"],
        [*refinement_code(last), "print(better)"],
    )
    sections = [
        Section("Pictures", pictures(wanted)),
        Section("Tables", tables),
        code_section(own, code),
        origin_section(records),
    ]
    sentences, fine = answer
    return Page(title, about, sentences, fine, sections)


def _bode_picture(refinement: Refinement, data: Measurement | None) -> Wanted:
    """Bode diagram, at the levels of the record where the model is not linear."""
    structure, _, _ = refinement.simulation_structure()
    beside = "" if data is None else ", with the measured points"
    if structure.is_linear or data is None:
        return (
            "bode",
            lambda: refinement.bode_plot(data, title=""),
            f"Bode diagram: magnitude and phase of the initial and of the refined model{beside}.",
            "Frequency response of the initial and of the refined model, without "
            "nonlinear effects." + ("" if data is None else " Dots: measured. Bottom row: relative error."),
        )
    rms = [level for level, _ in stretches_by_level(data)]
    # a sine of the same power as the record, and a weaker one where the record has one level only
    levels = [np.sqrt(2.0) * level for level in ([0.3 * rms[0], *rms] if len(rms) == 1 else rms)]
    sines = ", ".join(number(level, 3) for level in levels)
    return (
        "bode at several amplitudes",
        lambda: refinement.bode_plot(data, levels=levels, title=""),
        f"Bode diagram of the refined model for sines of amplitude {sines}{beside}.",
        "Response to sines of several amplitudes, all effects included; a linear system would have one "
        "curve. Dots: measured, by level of the record; thin lines: the model with the same input.",
    )
