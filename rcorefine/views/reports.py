"""Reports of results, and the three sentences that each opens with."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ..comparison.compare import compare
from ..comparison.responses import FrequencyComparison
from ..comparison.result import Comparison, best_of, failures_of
from ..data.measurement import Measurement
from ..data.records import stretches_by_level
from ..diagnosis.diagnose import diagnose
from ..diagnosis.result import Diagnosis, Improvement
from ..diagnosis.words import no_test_fires, numbers_that_moved
from ..engine.simulation import simulated
from ..inference.parameters import EstimatedParameter
from ..inference.refinement import Refinement
from ..results import chance, counted, with_error
from ..systems.linear import LinearModel
from .code import (
    call_options,
    effects_code,
    model_code,
    names_of,
    record_code,
    refinement_code,
    response_code,
    script,
)
from .comparison import comparison_table
from .failure_map import ROLES
from .measurement import odd
from .page import (
    Page,
    Wanted,
    boxed,
    estimates,
    paragraphs,
    parameter_plot,
    parameter_table,
    report_page,
    reports,
)
from .responses import responses_table
from .tables import TextTable, cells, number, root_mean_square

#: What each picture of a comparison shows, and what it means; the one that answers first.
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


@reports(Comparison)
def report_comparison(result: Comparison, *, title: str | None, code: str | None) -> Page:
    """The report of a comparison; see `Comparison.report`."""
    data = result.data
    return report_page(
        title or f"{' and '.join(result.names[:3])}: comparison with {data.name}",
        f"{len(result.names)} model(s), {data.n_samples} samples, {number(data.duration)} s",
        comparison_answer(result),
        drawn=[_comparison_picture(result, kind) for kind in _WORDS],
        tables=_comparison_tables(result),
        code=(_comparison_code(result), code),
        records=[data],
    )


def _comparison_picture(result: Comparison, kind: str) -> Wanted:
    rows = zip(result.names, np.atleast_2d(result.fit), strict=True)
    fits = "; ".join(f"{name} fits {' / '.join(f'{v:.4g} %' for v in row)}" for name, row in rows)
    shown, meant = _WORDS[kind]
    shown = shown.format(record=f"record {result.data.name}", fits=fits)
    return kind, partial(result.plot, kind, title=""), shown, meant


def _comparison_tables(result: Comparison) -> list[str]:
    """Failures, where there are any, and the table of fits."""
    headers = ["", "dimension", "where", "in words", "statistic", "p-value", "share of the error"]
    legend = (
        "1: best single explanation; +: adds to the rows above; =: alternative to row 1.",
        "statistic: twice the increase of the log-likelihood. p-value: probability of such a row by chance "
        "if the model were right. share: part of the error energy that the row explains (rows overlap).",
    )
    parts: list[str] = []
    for index in range(len(result.names)):
        found = failures_of(result, index)
        notes = [f"{note}." for note in found.notes]
        rows = [
            [
                ROLES[r.role],
                *cells(r, "dimension where sentence statistic:.3g"),
                chance(r.p_value),
                f"{100 * r.share:.3g} %",
            ]
            for r in found
        ]
        if rows:
            parts += boxed(TextTable(headers, rows, f"Where {found.name} fails", [*legend, *notes], left=4))
        else:
            nowhere = f"Where {found.name} fails: no significant failure in this record."
            parts.append(paragraphs([nowhere, *notes]))
    return [*parts, *boxed(comparison_table(result))]


def _comparison_code(result: Comparison) -> str:
    """Return the models and the record of a comparison as code.

    A comparison holds no nonlinear effects; a comment says so.
    """
    blocks, models = _models_code(result.models, result.several)
    for index, model in enumerate(result.models) if len(result.starts) == 1 else ():
        if not _reproduces(model, result, index):
            name = names_of("model", result.models)[index]
            has = f"# {name} has nonlinear effects; below is its linear part only. Put the Refinement here."
            blocks[index] = [has, *blocks[index]]
    horizon = "" if result.horizon is None else f", horizon={result.horizon!r}"
    x0 = {"estimate": "", "zero": ', x0="zero"'}.get(result.x0, ", x0=...  # as given\n")
    call = f"result = rco.compare({models}, data{horizon}{x0})"
    return script(*blocks, record_code([result.data]), [call, "print(result)", "result.plot()"])


def _models_code(models: Sequence[LinearModel], several: bool) -> tuple[list[list[str]], str]:
    """Return the code of each model, and how a call names them."""
    names = names_of("model", models)
    blocks = [model_code(model, name) for model, name in zip(models, names, strict=True)]
    return blocks, f"[{', '.join(names)}]" if several or len(names) > 1 else names[0]


def _reproduces(model: LinearModel, result: Comparison, index: int) -> bool:
    """Return whether the linear model alone gives the compared run."""
    start = result.initial_states[index][0][: model.n_states]
    run = simulated(model.to_statespace(), result.data, start, led=True).outputs
    scale = float(np.abs(result.runs[index]).max()) or 1.0
    return bool(np.abs(run - result.runs[index]).max() < 1e-6 * scale)


@reports(FrequencyComparison)
def report_responses(result: FrequencyComparison, *, title: str | None, code: str | None) -> Page:
    """Build the report of a comparison with a measured response.

    See `FrequencyComparison.report`.
    """
    measured = result.measured
    blocks, models = _models_code(result.models, result.several)
    call = [f"result = rco.compare({models}, measured)", "print(result)", "result.plot()"]
    drawn = (
        "bode",
        partial(result.plot, title=""),
        f"Bode diagram of {', '.join(result.names)} and the measured response {measured.name}.",
        "Dots: measured response. Lines: the models. Bottom row: relative error.",
    )
    return report_page(
        title or f"{' and '.join(result.names[:3])}: comparison with {measured.name}",
        f"{len(result.names)} model(s), {measured.omega.size} frequencies",
        response_answer(result),
        drawn=[drawn],
        tables=boxed(responses_table(result)),
        code=(script(*blocks, response_code(measured), call), code),
        records=[measured],
    )


@reports(Diagnosis)
def report_diagnosis(found: Diagnosis, *, title: str | None, code: str | None) -> Page:
    """The report of a diagnosis; see `Diagnosis.report`."""
    named = found.verdict != "unexplained"
    shown = ", ".join(
        f"{row.label} {row.probability:.2f}" if named else row.label for row in found.ranking[:4]
    )
    drawn = (
        "diagnosis",
        partial(found.plot, title=""),
        f"Ranking of the candidates ({shown or 'nothing'}), the hidden force against the motion, "
        "and the residual before and after.",
        "The candidates, the most probable first; the force that was estimated at the place of the "
        "best one, with its formula; and the residual with and without it.",
    )
    name = found.base.physical_model.linear.name
    every: list[Any] = list(found.records)
    samples = sum(r.n_points for r in every)
    responses = found.base.of_responses
    given = counted(len(every), "response" if responses else "record")
    return report_page(
        title or f"Diagnosis of {name}: {found.verdict}",
        f"model {name}, {given}, {samples} {'frequencies' if responses else 'samples'}",
        diagnosis_answer(found),
        drawn=[drawn],
        tables=_diagnosis_tables(found),
        code=(_diagnosis_code(found), code),
        records=found.records,
    )


def _diagnosis_tables(found: Diagnosis) -> list[str]:
    tests = (("model as given", found.tests), ("with the best effect", found.winner_tests))
    headers = ["effect", "coefficient", "value", "std", "fit before [%]", "fit after [%]", "p-value"]
    ranking = TextTable(
        [*headers, "probability"],
        _ranking_rows(found),
        title="Candidates that were refitted",
        notes=[
            "p-value: probability of such a score if nothing were missing. probability: of each "
            "candidate among all and none of them; not given if no candidate passes its own tests. "
            "std: one standard deviation of the coefficient.",
        ],
        left=2,
    )
    detectable = TextTable(
        ["effect", "smallest coefficient", "unit"],
        [cells(d, "effect.label smallest:.3g unit") for d in found.detectable],
        title="Smallest effects that the record would show",
        notes=["The smallest coefficient that would have been detected with 95 % probability."],
    )
    tested = TextTable(
        ["model", "test", "F", "degrees of freedom", "p-value"],
        [
            [model, *cells(t, "name statistic:.4g dof"), chance(t.p_value)]
            for model, these in tests
            for t in these
        ],
        title="Residual tests",
        notes=[
            f"The significance level is {found.significance:g}, divided by the number of tests. A small "
            "p-value shows that the residual still depends on what this test examines."
        ],
        left=2,
    )
    free = [] if found.floated is None else [parameter_table(found.floated, "All parameters re-estimated")]
    return [
        *boxed(*odd(found.checks), ranking if found.ranking else detectable, tested),
        *boxed(parameter_table(found.base, "The model as given, with its free parameters fitted"), *free),
        paragraphs(found.notes),
    ]


def _ranking_rows(found: Diagnosis) -> list[list[str]]:
    rows = []
    for row in found.ranking:
        tail = [number(row.fit_before), number(row.fit_after), chance(row.p_value)]
        tail.append(number(row.probability, 3))
        for k, (effect, own) in enumerate(row.estimates):
            for i, (name, one) in enumerate(own.items()):
                head = "" if i else "+ " * (k > 0) + effect.label
                rest = [""] * 4 if k or i else tail
                rows.append([head, name, *cells(one, "coefficient:.5g std:.2g"), *rest])
    if found.verdict != "unexplained":
        rows.append(["none of these", *[""] * 6, number(found.none_of_these, 3)])
    if found.open_law is not None:
        before, after = found.ranking[0].fit_before, found.open_law.fit_after
        rows.append([found.open_law.effect.label, *[""] * 3, number(before), number(after), "", ""])
    return rows


def _diagnosis_code(found: Diagnosis) -> str:
    """Return code that makes the diagnosis again.

    If effects were in the initial model, it is a refinement.
    """
    known = inspect.signature(diagnose).parameters
    settings = {key: value for key, value in found.settings.items() if key in known}
    candidates = settings.pop("candidates", None)
    settings["significance"] = found.significance
    start, model = model_code(found.base.physical_model), "model"
    if "effect" in found.base.roles:
        held = "# diagnose started from this model with the effects that it held:"
        start, model = [*start, held, *refinement_code(found.base)], "better"
    listed = "" if candidates is None else f"candidates = {effects_code(candidates)}\n"
    chosen = ", candidates=candidates" if listed else ""
    call = f"{listed}found = rco.diagnose({model}, data{chosen}{call_options(settings)})"
    return script(start, record_code(found.records), [call, "print(found)", "found.plot()"])


@reports(Improvement)
def report_improvement(improvement: Improvement, *, data: Any, title: str | None, code: str | None) -> Page:
    """The report of an improvement; see `Improvement.report`."""
    last = improvement.refinement
    errors = ", ".join(f"{root_mean_square(s.validation_rmse):.3g}" for s in improvement.steps)
    staircase = (
        "staircase",
        partial(improvement.plot, title=" "),
        f"Staircase of the root mean square error after each step; held out: {errors}.",
        "Simulation error after each step on three parts of the record: the fitted part, the part for "
        "selecting the step, and the held-out part. Judge the model by the held-out part.",
    )
    rows = []
    for i, step in enumerate(improvement.steps):
        values = "; ".join(f"{k} {with_error(v, step.std[k])}" for k, v in step.coefficients.items())
        errors_of = (step.train_rmse, step.choice_rmse, step.validation_rmse)
        rivals = ", ".join(effect.label for effect in step.rivals)
        rows.append([str(i), step.name, values, *(f"{root_mean_square(e):.4g}" for e in errors_of), rivals])
    steps = TextTable(
        ["step", "what", "coefficients", "fitted", "selection", "held out", "not distinguishable"],
        rows,
        title="Root mean square error after each step",
        notes=["The data cannot distinguish the effects in the last column from the one that was added."],
        left=3,
    )
    parameters = parameter_table(last, "Parameters of the last model")
    return _report_model(
        (improvement.steps[0].refinement, last),
        title or f"Improvement of {last.physical_model.linear.name}: {improvement.verdict}",
        improvement_answer(improvement),
        [staircase],
        [*boxed(*odd(improvement.checks), steps, parameters), paragraphs(improvement.sentences())],
        data,
        code,
    )


@reports(Refinement)
def report_refinement(refinement: Refinement, *, data: Any, title: str | None, code: str | None) -> Page:
    """The report of a refinement; see `Refinement.report`."""
    said = paragraphs([refinement.message, *refinement.warnings])
    return _report_model(
        (refinement.physical_model, refinement),
        title or f"Refinement of {refinement.physical_model.linear.name}",
        refinement_answer(refinement),
        [],
        [*boxed(parameter_table(refinement, "Parameters")), said],
        data,
        code,
    )


def _report_model(
    models: tuple[Any, Refinement],
    title: str,
    answer: tuple[list[str], bool],
    drawn: list[Wanted],
    tables: list[str],
    data: Any,
    code: str | None,
) -> Page:
    """Build the report of a refined model beside the initial one.

    If there is a record, the report compares both with it.
    """
    last = models[1]
    linear = last.physical_model.linear
    about = (
        f"model {linear.name}: {counted(linear.n_states, 'state')}, {counted(linear.n_inputs, 'input')}, "
        f"{counted(linear.n_outputs, 'output')}"
    )
    if data is None:
        missing = (
            "The result does not contain the record; report(..., data=...) compares the models with one."
        )
        tables.append(paragraphs([missing]))
        drawn.append(_bode_picture(last, data))
    else:
        beside: Any = replace(compare(list(models), data), names=("initial", "refined"))
        if not data.in_time:
            said = "Frequency responses of the initial and of the refined model, with the measured points."
            drawn.append(("response", partial(beside.plot, title=""), said, said))
            tables += boxed(responses_table(beside))
            about += f"; compared with response {data.name}, {data.omega.size} frequencies"
        else:
            drawn += [_comparison_picture(beside, "time"), _bode_picture(last, data)]
            tables += _comparison_tables(beside)
            about += f"; compared with record {data.name}, {data.n_samples} samples"
    if rows := estimates(last):
        intervals = ", ".join(f"{r.name} {with_error(r.value, 1.96 * r.std)}" for r in rows[:12])
        shown = f"Estimates with their 95 % intervals: {intervals}"
        meant = (
            "Estimates with 95 % intervals, in units of the initial value (or of the estimate, where the "
            "initial model has none); the vertical line is the initial model."
        )
        drawn.append(("parameters", partial(parameter_plot, last), shown, meant))
    records = [] if data is None else [data]
    own = script(
        ["# the initial model", *model_code(last.physical_model)],
        record_code(records) if records else ["data = ...  # your record"],
        [*refinement_code(last), "print(better)"],
    )
    return report_page(title, about, answer, drawn=drawn, tables=tables, code=(own, code), records=records)


def _bode_picture(refinement: Refinement, data: Measurement | None) -> Wanted:
    """Bode diagram, at the levels of the record where the model is not linear."""
    structure, _, _ = refinement.simulation_structure()
    beside = "" if data is None else ", with the measured points"
    if structure.is_linear or data is None:
        return (
            "bode",
            partial(refinement.bode_plot, data, title=""),
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
        partial(refinement.bode_plot, data, levels=levels, title=""),
        f"Bode diagram of the refined model for sines of amplitude {sines}{beside}.",
        "Response to sines of several amplitudes, all effects included; a linear system would have one "
        "curve. Dots: measured, by level of the record; thin lines: the model with the same input.",
    )


def comparison_answer(result: Comparison) -> tuple[list[str], bool]:
    """Answer how well the models fit, where they fail, and what to do.

    Returns
    -------
    sentences : list of str
        Three of them.
    fine : bool
        Whether nothing stands out.
    """
    fits = np.nanmean(np.atleast_2d(result.fit), axis=1) if not np.isnan(result.fit).all() else None
    data = result.data
    best = best_of(result)
    if fits is None:
        first = f"The measured output of {data.name} is constant, so there is nothing to explain."
    elif len(result.names) == 1:
        first = f"The simulation of {result.names[0]} explains {fits[0]:.4g} % of the record {data.name}."
    else:
        others = ", ".join(f"{n} {fits[i]:.4g} %" for i, n in enumerate(result.names) if i != best)
        first = (
            f"{result.names[best]} comes closest: it explains {fits[best]:.4g} % of the record "
            f"{data.name} ({others})."
        )
    found = failures_of(result, best)
    rmse = np.atleast_2d(result.rmse)[best]
    sizes = ", ".join(
        f"{number(rmse[i], 3)}{' ' + data.output_units[i] if data.output_units[i] else ''} in {label}"
        for i, label in enumerate(data.output_labels)
    )
    if result.led:
        return [
            first.replace("The simulation of", "One sample ahead,").replace(" explains", " predicts"),
            f"The typical one-step prediction error is {sizes}.",
            "This does not show that an unstable model is adequate; use diagnose to test it.",
        ], True
    if not found:
        return [
            first,
            f"The residual (typically {sizes}) cannot be distinguished from noise.",
            "The model is adequate for this record; a record at another amplitude could still show more.",
        ], True
    besides = sum(row.role == "besides" for row in found)
    more = f" (and {besides} more failure{'s' * (besides > 1)})" if besides else ""
    return [
        first,
        f"Where it fails{more}: {found[0].sentence.rstrip('.')}.",
        f"The typical error is {sizes}; use diagnose to find the missing physical effect.",
    ], False


def response_answer(result: FrequencyComparison) -> tuple[list[str], bool]:
    """Answer how well the models meet a measured response, and where not.

    The return values are those of `comparison_answer`.
    """
    measured = result.measured
    fits = result.fit if result.several else result.fit[None]
    means = np.nan_to_num(fits, nan=-np.inf).reshape(len(result.names), -1).mean(axis=1)
    best = int(np.argmax(means))
    error = result.relative_error if result.several else result.relative_error[None]
    worst = result.worst if result.several else result.worst[None]
    i, j = np.unravel_index(int(np.argmin(np.nan_to_num(fits[best], nan=np.inf))), fits[best].shape)
    others = ", ".join(f"{n} {means[k]:.4g} %" for k, n in enumerate(result.names) if k != best)
    path = f"from {measured.input_labels[j]} to {measured.output_labels[i]}"
    typical = float(np.nanmedian(error[best]))
    return [
        f"{result.names[best]} explains {means[best]:.4g} % of the measured response {measured.name}"
        + (f" ({others})." if others else "."),
        f"It deviates most near {worst[best, i, j]:.4g} rad/s, {path}.",
        f"The typical relative error is {100 * typical:.3g} %; a record over time would show whether that "
        "is noise.",
    ], False


def diagnosis_answer(found: Diagnosis) -> tuple[list[str], bool]:
    """Answer which effect is missing, how sure that is, and what to do.

    The return values are those of `comparison_answer`.
    """
    first = found.sentences()[0]
    worst = min(found.tests, key=lambda t: t.p_value) if found.tests else None
    if worst is None:
        second = "No test was possible."
    elif found.verdict == "adequate":
        second = no_test_fires(found)
    else:
        p = chance(worst.p_value, "p")
        second = (
            f"The model as given fails the residual tests, most significantly this one: {worst.name}, {p}."
        )
    if found.verdict == "adequate":
        seen = ", ".join(
            f"{d.effect.label} {number(d.smallest, 3)} {d.unit}".strip() for d in found.detectable[:3]
        )
        third = (
            f"Smallest effects that it would show (95 % probability): {seen}."
            if seen
            else "Adding an effect would only fit the noise."
        )
        return [first, second, third], True
    third = {
        "parameters": numbers_that_moved(found.parameters),
        "effect": "Add it with refine, and validate the result on held-out data.",
        "ambiguous": found.sentences()[-1 - len(found.notes)],
        "unexplained": "Do not trust the closest candidate: the missing effect is not in the library. law() "
        "returns the force as a table."
        if found.open_law is not None
        else "Do not trust the closest candidate: the missing effect is not in the library.",
    }[found.verdict]
    return [first, second, third], False


def improvement_answer(found: Improvement) -> tuple[list[str], bool]:
    """Answer how far the error fell, by which effects, and why it stopped.

    The return values are those of `comparison_answer`.
    """
    first, last = found.steps[0], found.steps[-1]
    before, after = (root_mean_square(s.validation_rmse) for s in (first, last))
    unit = f" {found.output_units[0]}" if len(found.output_units) == 1 and found.output_units[0] else ""
    change = f" ({100 * (after / before - 1):+.0f} %)" if before > 0 else ""
    names = [f"{e.label} ({_estimate(last.refinement, e.kind, e.place)})" for e in found.effects]
    added = f"Added: {'; '.join(names)}." if names else "No effect was added."
    return [
        f"The error on held-out data changes from {before:.4g} to {after:.4g}{unit}{change}.",
        added,
        found.message,
    ], found.verdict == "adequate" and not names


def refinement_answer(refinement: Refinement) -> tuple[list[str], bool]:
    """Answer how far the fit rose and which parameter changed most.

    It also states how well that parameter is known. The return values are those of `comparison_answer`.
    """
    before, after = float(np.mean(refinement.initial_fit)), float(np.mean(refinement.fit))
    first = f"The refined model explains {after:.4g} % of the record, the initial one {before:.4g} %."
    moved = [r for r in refinement.parameters if r.role != "offset" and r.std > 0]
    if moved:
        row = max(moved, key=lambda r: abs(r.coefficient) / r.std)
        sure = abs(row.coefficient) / row.std
        second = (
            f"The most significant change is {_row(row)}, {sure:.3g} standard deviations from the initial "
            "model."
        )
    else:
        second = "No parameter was estimated."
    labels = refinement.physical_model.linear.output_labels
    left = ", ".join(
        f"{number(size, 3)} in {label}" for size, label in zip(refinement.rmse, labels, strict=True)
    )
    third = f"{refinement.message.rstrip('.')}; the typical residual is {left}."
    if refinement.warnings:
        third = refinement.warnings[0]
    return [first, second, third], refinement.success


def _row(row: EstimatedParameter) -> str:
    return f"{row.name} at {row.place}: {row.initial:.4g} to {with_error(row.value, row.std, row.unit)}"


def _estimate(refinement: Refinement, kind: str, place: str) -> str:
    rows = [r for r in refinement.parameters if r.kind == kind and r.place == place]
    return ", ".join(with_error(r.coefficient, r.std, r.unit) for r in rows)
