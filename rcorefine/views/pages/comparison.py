"""The report of a comparison."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...comparison.adequacy import failures_of
from ...comparison.failure_map.search import Failure
from ...comparison.responses import FrequencyComparison
from ...comparison.result import KINDS, Comparison
from ...engine.simulation import simulated
from ...systems.linear import LinearModel
from ...words import chance
from ..comparison import comparison_table
from ..failure_map import ROLES
from ..responses import responses_table
from ..tables import Table, number
from .answers import comparison_answer, response_answer
from .code import model_code, record_code, response_code, script
from .origin import response_facts, version_facts
from .page import Facts, Page, Paragraphs, Section, reports
from .parts import Parts, Wanted, code_section, origin_section, pictures

__all__ = ["comparison_tables", "fits_in_words", "picture_words", "report_comparison", "report_responses"]


@reports(Comparison)
def report_comparison(result: Comparison, *, title: str | None, code: str | None) -> Page:
    """The report of a comparison; see `Comparison.report`."""
    answer, fine = comparison_answer(result)
    sections = [
        Section(
            "Pictures",
            pictures([_comparison_picture(result, kind) for kind in _kinds_of(result)]),
        ),
        Section("Tables", comparison_tables(result)),
        code_section(_comparison_code(result), code),
        origin_section([result.data]),
    ]
    heading = title or f"{' and '.join(result.names[:3])}: comparison with {result.data.name}"
    about = f"{len(result.names)} model(s), {result.data.n_samples} samples, {number(result.data.duration)} s"
    return Page(heading, about, answer, fine, sections)


@reports(FrequencyComparison)
def report_responses(result: FrequencyComparison, *, title: str | None, code: str | None) -> Page:
    """Build the report of a comparison with a measured response.

    See `FrequencyComparison.report`.
    """
    measured = result.measured
    answer, fine = response_answer(result)
    magnitudes = ", ".join(result.names)
    drawn = (
        "bode",
        lambda: result.plot(title=""),
        f"Bode diagram of {magnitudes} and the measured response {measured.name}.",
        "Dots: measured response. Lines: the models. Bottom row: relative error.",
    )
    models = [model_code(m, f"model{i + 1}") for i, m in enumerate(result.models)]
    listed = ", ".join(f"model{i + 1}" for i in range(len(models)))
    call = f"result = rco.compare({f'[{listed}]' if result.several else listed}, measured)"
    own = script(*models, response_code(measured), [call, "print(result)", "result.plot()"])
    sections = [
        Section("Pictures", pictures([drawn])),
        Section("Tables", [responses_table(result)]),
        code_section(own, code),
        Section("Response and versions", [Facts(response_facts(measured)), Facts(version_facts())]),
    ]
    heading = title or f"{' and '.join(result.names[:3])}: comparison with {measured.name}"
    about = f"{len(result.names)} model(s), {measured.omega.size} frequencies"
    return Page(heading, about, answer, fine, sections)


def _comparison_picture(result: Comparison, kind: str) -> Wanted:
    return kind, lambda: result.plot(kind, title=""), *picture_words(result, kind)


def _kinds_of(result: Comparison) -> list[str]:
    """Pictures that a comparison offers, the one that answers first."""
    return [kind for kind in _WORDS if kind in KINDS]


def fits_in_words(result: Comparison) -> str:
    """Fit of every model and output."""
    fits = np.atleast_2d(result.fit)
    return "; ".join(
        f"{name} fits {' / '.join(f'{v:.4g} %' for v in row)}"
        for name, row in zip(result.names, fits, strict=True)
    )


#: What each picture of a comparison shows, and what it means.
_WORDS = {
    "map": (
        "Failure map of {record}: where over time, frequency, amplitude, state and place the model fails.",
        "Where the model fails: significant failures over time, frequency, amplitude, state and place.",
    ),
    "time": (
        "Measured and simulated outputs of {record} over time; {fits}. Residuals in the lower row.",
        "The record (broad, pale) and the simulation of each model, with the fit in the legend; below, the "
        "residuals.",
    ),
    "bode": (
        "Bode diagram of the models and the measured frequency response of {record}.",
        "Frequency responses, sampled like the record; dots and band: measured, with two standard "
        "deviations. Bottom row: relative error, and the error that noise alone would cause.",
    ),
    "residual": (
        "Residuals of {record}: correlation with themselves and with the inputs.",
        "Correlation of the residuals with themselves and with the inputs, and the bounds for no "
        "correlation.",
    ),
    "horizon": (
        "Error against the length of the prediction for {record}.",
        "Error against the prediction horizon, from one step to the simulation over the whole record.",
    ),
}


def picture_words(result: Comparison, kind: str) -> tuple[str, str]:
    """Return what a picture shows and what it means."""
    shown, meant = _WORDS[kind]
    return shown.format(record=f"record {result.data.name}", fits=fits_in_words(result)), meant


def comparison_tables(result: Comparison) -> Parts:
    """Failures, where there are any, and the table of fits."""
    parts: Parts = [comparison_table(result)]
    maps = [failures_of(result, index) for index in range(len(result.names))]
    first: Parts = []
    for found in maps:
        notes = [f"{note}." for note in found.notes]
        if found:
            explained = [*_FAILURE_NOTES, *notes]
            title = f"Where {found.name} fails"
            first.append(
                Table(
                    _FAILURE_HEADERS, [_failure_row(r) for r in found], title=title, notes=explained, left=4
                )
            )
        else:
            nowhere = f"Where {found.name} fails: no significant failure in this record."
            first.append(Paragraphs([nowhere, *notes]))
    return [*first, *parts]


_FAILURE_HEADERS = ("", "dimension", "where", "in words", "statistic", "p-value", "share of the error")
_FAILURE_NOTES = (
    "1: best single explanation; +: adds to the rows above; =: alternative to row 1.",
    "statistic: twice the increase of the log-likelihood. p-value: probability of such a row by chance if "
    "the model were right. share: part of the error energy that the row explains (rows overlap).",
)


def _failure_row(row: Failure) -> list[str]:
    words = [ROLES[row.role], row.dimension, row.where, row.sentence]
    return [*words, number(row.statistic, 3), chance(row.p_value), f"{100 * row.share:.3g} %"]


def _comparison_code(result: Comparison) -> str:
    """Return the models and the record of a comparison as code.

    A comparison holds no nonlinear effects; a comment says so.
    """
    blocks: list[Sequence[str]] = []
    for index, model in enumerate(result.models):
        name = "model" if len(result.models) == 1 else f"model{index + 1}"
        lines = model_code(model, name)
        if len(result.starts) == 1 and not _reproduces(model, result, index):
            lines = [
                f"# {name} has nonlinear effects; below is its linear part only. Put the Refinement here.",
                *lines,
            ]
        blocks.append(lines)
    names = ", ".join(f"model{i + 1}" for i in range(len(result.models)))
    models = (
        "model"
        if len(result.models) == 1 and not result.several
        else f"[{names if len(result.models) > 1 else 'model'}]"
    )
    options = (
        ""
        if result.x0 == "estimate"
        else f', x0="{result.x0}"'
        if result.x0 == "zero"
        else ", x0=...  # as given"
    )
    if result.horizon is not None:
        options = f", horizon={result.horizon!r}" + options
    close = ")" if "#" not in options else "\n)"
    call = [f"result = rco.compare({models}, data{options}{close}", "print(result)", "result.plot()"]
    return script(*blocks, record_code([result.data]), call)


def _reproduces(model: LinearModel, result: Comparison, index: int) -> bool:
    """Return whether the linear model alone gives the compared run."""
    start = result.initial_states[index][0][: model.n_states]
    run = simulated(model.to_statespace(), result.data, start, led=True).outputs
    scale = float(np.abs(result.runs[index]).max()) or 1.0
    return bool(np.abs(run - result.runs[index]).max() < 1e-6 * scale)
