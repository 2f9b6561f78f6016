"""Contents of results that write a report, with their answers and pages."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import control as ct
import numpy as np

from ..comparison.compare import compare
from ..comparison.responses import FrequencyComparison
from ..comparison.result import Comparison, failures_of
from ..comparison.signals import root_mean_square
from ..data.measurement import Measurement
from ..data.records import stretches_by_level
from ..diagnosis.check_rows import warned
from ..diagnosis.diagnose import diagnose
from ..diagnosis.result import Diagnosis, Improvement, next_step
from ..diagnosis.verdict import estimates as estimates_of
from ..diagnosis.words import distinguishing, no_test_fires, numbers_that_moved
from ..engine.simulation import simulated
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
from .comparison import comparison_table, plot_comparison
from .content import Content, content, fields
from .diagnosis import caption_of, plot_diagnosis, ranking_table
from .failure_map import failure_table
from .figures import Frame
from .measurement import odd
from .models import (
    estimates,
    estimates_table,
    parameter_plot,
    plot_bode,
    plot_response,
    plot_staircase,
    system_dict,
)
from .page import Page, Picture
from .responses import plot_responses, responses_table
from .tables import TextTable, cells, number

#: Pictures of a comparison, and what each shows; the one that answers comes first.
_WORDS = {
    "map": "Where the model fails: significant failures over time, frequency, amplitude, state and place.",
    "time": "The record (broad, pale) and the simulation of each model, with the fit in the legend; below, "
    "the residuals.",
    "bode": "Frequency responses, sampled like the record; dots and band: measured, with two standard "
    "deviations. Bottom row: relative error, and the error that noise alone would cause.",
    "residual": "Correlation of the residuals with themselves and with the inputs, and the bounds for no "
    "correlation.",
    "horizon": "Error against the prediction horizon, from one step to the simulation over the whole record.",
}


# ------------------------------------------------------------------ comparisons
@content.register
def comparison_content(result: Comparison) -> Content:
    """Return the content of a comparison: fits, and where the models fail."""
    return Content(
        tables=[comparison_table(result)],
        answer=partial(_comparison_answer, result),
        data=lambda: {"models": _models(result)},
        columns=lambda: (_fits(result),),
        pictures={"plot": plot_comparison},
        page=_comparison_page,
    )


_FIGURES = ("name", "unit", "fit", "rmse", "bias")


def _models(result: Comparison) -> list[dict[str, Any]]:
    """Return each model with its outputs and failures."""
    bias = np.nanmean(result.data.outputs - result.runs, axis=2)
    figures = zip(np.atleast_2d(result.fit), np.atleast_2d(result.rmse), bias, strict=True)
    labels, units = result.data.output_labels, result.data.output_units
    models = []
    for index, (name, one) in enumerate(zip(result.names, figures, strict=True)):
        rows = [dict(zip(_FIGURES, row, strict=True)) for row in zip(labels, units, *one, strict=True)]
        models.append({"name": name, "outputs": rows, "failures": tuple(failures_of(result, index))})
    return models


def _fits(result: Comparison) -> list[dict[str, Any]]:
    """Return the figures of each model and output."""
    return [
        {"model": model["name"], "output": row.pop("name"), **row}
        for model in _models(result)
        for row in model["outputs"]
    ]


def _comparison_page(result: Comparison) -> Page:
    data = result.data
    return Page(
        f"{' and '.join(result.names[:3])}: comparison with {data.name}",
        f"{len(result.names)} model(s), {data.n_samples} samples, {number(data.duration)} s",
        *_comparison_answer(result),
        pictures=[(kind, partial(result.plot, kind, title=""), words) for kind, words in _WORDS.items()],
        tables=_comparison_tables(result),
        code=_comparison_code(result),
        records=[data],
    )


def _comparison_tables(result: Comparison) -> list[TextTable | Sequence[str]]:
    """Failures of each model, or a sentence, and the table of fits."""
    maps = [failure_table(failures_of(result, index), full=True) for index in range(len(result.names))]
    nowhere = [found if found.rows else (str(found.title), *found.notes) for found in maps]
    return [*nowhere, comparison_table(result)]


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


@content.register
def responses_content(result: FrequencyComparison) -> Content:
    """Return the content of a comparison with a measured response."""
    return Content(
        tables=[responses_table(result)],
        answer=partial(_response_answer, result),
        pictures={"plot": plot_responses},
        records=[result.measured],
        code=partial(_response_code, result),
    )


def _response_code(result: FrequencyComparison) -> str:
    blocks, models = _models_code(result.models, result.several)
    call = [f"result = rco.compare({models}, measured)", "print(result)", "result.plot()"]
    return script(*blocks, response_code(result.measured), call)


# ------------------------------------------------------------------ diagnosis
@content.register
def diagnosis_content(found: Diagnosis) -> Content:
    """Return the content of a diagnosis: the verdict, and the ranking."""
    explained = found.verdict in ("adequate", "parameters", "effect")
    places = () if found.best is None else tuple(e.place for e in found.best.effects)
    answer, *more = found.sentences()
    told = "verdict ranking none_of_these places ambiguous parameters tests winner_tests detectable "
    return Content(
        title="Diagnosis",
        verdict=found.verdict,
        above=[answer, *warned(found.checks, explained, places), *more],
        tables=[ranking_table(found) if found.floated is None else estimates_table(found.parameters)],
        following=next_step(found),
        answer=partial(_diagnosis_answer, found),
        data=lambda: {**fields(found, told + "significance notes checks"), "next_step": next_step(found)},
        pictures={"plot": plot_diagnosis},
        page=_diagnosis_page,
    )


def _diagnosis_page(found: Diagnosis) -> Page:
    name = found.base.physical_model.linear.name
    every: list[Any] = list(found.records)
    samples = sum(r.n_points for r in every)
    responses = found.base.of_responses
    given = counted(len(every), "response" if responses else "record")
    return Page(
        f"Diagnosis of {name}: {found.verdict}",
        f"model {name}, {given}, {samples} {'frequencies' if responses else 'samples'}",
        *_diagnosis_answer(found),
        pictures=[("diagnosis", partial(found.plot, title=""), caption_of(found))],
        tables=_diagnosis_tables(found),
        code=_diagnosis_code(found),
        records=found.records,
    )


def _diagnosis_tables(found: Diagnosis) -> list[TextTable | Sequence[str]]:
    tests = (("model as given", found.tests), ("with the best effect", found.winner_tests))
    ranking = replace(
        ranking_table(found, full=True), title="Candidates that were refitted", notes=[found.legend], left=2
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
    estimated = {"The model as given, with its free parameters fitted": found.base}
    if found.floated is not None:
        estimated["All parameters re-estimated"] = found.floated
    tables = [estimates_table(model.parameters, name, full=True) for name, model in estimated.items()]
    shown = ranking if found.ranking else detectable
    return [*odd(found.checks), shown, tested, *tables, found.notes]


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


# ------------------------------------------------------------------ refined models
@content.register
def improvement_content(found: Improvement) -> Content:
    """Return the content of an improvement: the steps, and their meaning."""
    odd = warned(found.checks, found.verdict in ("adequate", "parameters"), [e.place for e in found.effects])
    told = "verdict message steps checks"
    return Content(
        title=f"Improvement in {counted(len(found.steps) - 1, 'step')}",
        verdict=found.verdict,
        above=odd,
        tables=[_steps_table(found)],
        below=found.sentences(),
        following=next_step(found),
        answer=partial(_improvement_answer, found),
        data=lambda: {**fields(found, told), "next_step": next_step(found), **_model(found.refinement)},
        pictures={"plot": plot_staircase},
        page=_improvement_page,
    )


def _model(found: Refinement) -> dict[str, Any]:
    system = system_dict(LinearModel.from_statespace(found.system))
    return {**fields(found, "parameters hold"), "system": system}


def _steps_table(found: Improvement) -> TextTable:
    rows = []
    for i, step in enumerate(found.steps):
        values = {name: with_error(v, step.std[name]) for name, v in step.coefficients.items()}
        told = [f"{name} {value}" if len(values) > 1 else value for name, value in values.items()]
        errors = (step.train_rmse, step.choice_rmse, step.validation_rmse)
        rows.append([f"{i} {step.name}", "; ".join(told), *(f"{root_mean_square(e):.4g}" for e in errors)])
    return TextTable(["step", "coefficient", "fitted", "selection", "held out"], rows)


def _improvement_page(found: Improvement, data: Any = None) -> Page:
    last = found.refinement
    said = (
        "Simulation error after each step on three parts of the record: the fitted part, the part for "
        "selecting the step, and the held-out part. Judge the model by the held-out part."
    )
    page = Page(
        f"Improvement of {last.physical_model.linear.name}: {found.verdict}",
        "",
        *_improvement_answer(found),
        pictures=[("staircase", partial(found.plot, title=""), said)],
        tables=[
            *odd(found.checks),
            replace(_steps_table(found), title="Root mean square error after each step", left=2),
            estimates_table(last.parameters, "Parameters of the last model", full=True),
            found.sentences(),
        ],
    )
    return _beside_record(page, (found.steps[0].refinement, last), data)


@content.register
def refinement_content(found: Refinement) -> Content:
    """Return the content of a refinement: the parameters, and their meaning."""
    return Content(
        title=f"Refinement of {found.physical_model.linear.name!r}",
        tables=[estimates_table(found.parameters)],
        below=found.sentences(),
        answer=partial(_refinement_answer, found),
        data=lambda: {**_model(found), **fields(found, "fit rmse initial_fit success message warnings")},
        pictures={"plot": plot_refinement, "bode_plot": plot_bode, "response_plot": plot_response},
        page=_refinement_page,
    )


def plot_refinement(found: Refinement, frame: Frame, data: Any = None) -> ct.ControlPlot:
    """Draw a record beside both models; see `Refinement.plot`."""
    beside = _compared((found.physical_model, found), found.records[0] if data is None else data)
    return content(beside).pictures["plot"](beside, frame)


def _compared(models: tuple[Any, Refinement], data: Any) -> Any:
    """Compare a record with the initial and with the refined model."""
    return replace(compare(list(models), data), names=("initial", "refined"))


def _refinement_page(found: Refinement, data: Any = None) -> Page:
    page = Page(
        f"Refinement of {found.physical_model.linear.name}",
        "",
        *_refinement_answer(found),
        tables=[estimates_table(found.parameters, "Parameters", full=True), [found.message, *found.warnings]],
    )
    return _beside_record(page, (found.physical_model, found), data)


def _beside_record(page: Page, models: tuple[Any, Refinement], data: Any) -> Page:
    """Add the initial and the refined model, and a record if there is one."""
    last = models[1]
    data = last.records[0] if data is None else data
    linear = last.physical_model.linear
    about = (
        f"model {linear.name}: {counted(linear.n_states, 'state')}, {counted(linear.n_inputs, 'input')}, "
        f"{counted(linear.n_outputs, 'output')}"
    )
    drawn, tables, beside = [*page.pictures], [*page.tables], _compared(models, data)
    if not data.in_time:
        said = "Frequency responses of the initial and of the refined model, with the measured points."
        drawn.append(("response", partial(beside.plot, title=""), said))
        tables.append(responses_table(beside))
        about += f"; compared with response {data.name}, {data.omega.size} frequencies"
    else:
        drawn += [("time", partial(beside.plot, title=""), _WORDS["time"]), _bode_picture(last, data)]
        tables += _comparison_tables(beside)
        about += f"; compared with record {data.name}, {data.n_samples} samples"
    if estimates(last):
        said = (
            "Estimates with 95 % intervals, in units of the initial value (or of the estimate, where the "
            "initial model has none); the vertical line is the initial model."
        )
        drawn.append(("parameters", partial(parameter_plot, last), said))
    code = refinement_script(last, data)
    return replace(page, about=about, pictures=drawn, tables=tables, code=code, records=[data])


def refinement_script(refinement: Refinement, data: Any, horizon: float | None = None) -> str:
    """Return a program that repeats a refinement; see `Refinement.script`."""
    return script(
        ["# the initial model", *model_code(refinement.physical_model)],
        ["data = ...  # your record"] if data is None else record_code([data]),
        [*refinement_code(refinement, horizon), "print(better)"],
    )


def _bode_picture(refinement: Refinement, data: Measurement) -> Picture:
    """Bode diagram, at the levels of the record where the model is not linear."""
    structure, _, _ = refinement.simulation_structure()
    if structure.is_linear:
        said = "Frequency response of the initial and of the refined model. Dots: measured. Bottom row: "
        said += "relative error."
        return "bode", partial(refinement.bode_plot, data, title=""), said
    rms = [level for level, _ in stretches_by_level(data)]
    # a sine of the same power as the record, and a weaker one where the record has one level only
    levels = [np.sqrt(2.0) * level for level in ([0.3 * rms[0], *rms] if len(rms) == 1 else rms)]
    return (
        "bode at several amplitudes",
        partial(refinement.bode_plot, data, levels=levels, title=""),
        f"Response to sines of amplitude {', '.join(number(level, 3) for level in levels)}, all effects "
        "included; a linear system would have one curve. Dots: measured, by level of the record; thin lines: "
        "the model with the same input.",
    )


# ------------------------------------------------------------------ answers
def _comparison_answer(result: Comparison) -> tuple[list[str], bool]:
    """Answer how well the models fit, where they fail, and what to do."""
    fits, data, best = np.atleast_2d(result.fit), result.data, result.best
    name, ahead = result.names[best], "One sample ahead, " if result.led else ""
    if np.isnan(fits).all():
        first = f"The measured output of {data.name} is constant, so there is nothing to explain."
    else:
        means = [f"{fit:.4g} %" for fit in np.nanmean(fits, axis=1)]
        others = ", ".join(f"{n} {means[i]}" for i, n in enumerate(result.names) if i != best)
        verb = f"{'predicts' if result.led else 'explains'} {means[best]} of the record {data.name}"
        first = f"{ahead or 'The simulation of '}{name} {verb}."
        if others:
            first = f"{name} comes closest: {ahead.lower()}it {verb} ({others})."
    found = failures_of(result, best)
    rmse = np.atleast_2d(result.rmse)[best]
    sizes = ", ".join(
        f"{number(size, 3)}{' ' * bool(unit)}{unit} in {label}"
        for size, unit, label in zip(rmse, data.output_units, data.output_labels, strict=True)
    )
    if result.led:
        return [
            first,
            f"The typical one-step prediction error is {sizes}.",
            "This does not show that an unstable model is adequate; use diagnose to test it.",
        ], True
    if data.there is not None:
        return [first, f"The typical error is {sizes}.", f"{found.notes[0]}."], False
    if not found:
        return [
            first,
            f"The residual (typically {sizes}) cannot be distinguished from noise.",
            "The model is adequate for this record; a record at another amplitude could still show more.",
        ], True
    besides = sum(row.role == "besides" for row in found)
    more = f" (and {counted(besides, 'more failure')})" if besides else ""
    return [
        first,
        f"Where it fails{more}: {found[0].sentence.rstrip('.')}.",
        f"The typical error is {sizes}; use diagnose to find the missing physical effect.",
    ], False


def _response_answer(result: FrequencyComparison) -> tuple[list[str], bool]:
    """Answer how well the models meet a measured response, and where not."""
    measured, figures = result.measured, (result.fit, result.relative_error, result.worst)
    fits, error, worst = (one if result.several else one[None] for one in figures)
    means = np.nan_to_num(fits, nan=-np.inf).reshape(len(result.names), -1).mean(axis=1)
    best = int(np.argmax(means))
    i, j = np.unravel_index(int(np.argmin(np.nan_to_num(fits[best], nan=np.inf))), fits[best].shape)
    others = ", ".join(f"{n} {means[k]:.4g} %" for k, n in enumerate(result.names) if k != best)
    path = f"from {measured.input_labels[j]} to {measured.output_labels[i]}"
    return [
        f"{result.names[best]} explains {means[best]:.4g} % of the measured response {measured.name}"
        + (f" ({others})." if others else "."),
        f"It deviates most near {worst[best, i, j]:.4g} rad/s, {path}.",
        f"The typical relative error is {100 * np.nanmedian(error[best]):.3g} %; a record over time would "
        "show whether that is noise.",
    ], False


def _diagnosis_answer(found: Diagnosis) -> tuple[list[str], bool]:
    """Answer which effect is missing, how sure that is, and what to do."""
    first = found.sentences()[0]
    worst = min(found.tests, key=lambda t: t.p_value) if found.tests else None
    if found.verdict == "adequate":
        seen = [f"{d.effect.label} {number(d.smallest, 3)} {d.unit}".strip() for d in found.detectable[:3]]
        third = "Adding an effect would only fit the noise."
        if seen:
            third = f"Smallest effects that it would show (95 % probability): {', '.join(seen)}."
        return [first, "No test was possible." if worst is None else no_test_fires(found), third], True
    second = "No test was possible."
    if worst is not None:
        second = "The model as given fails the residual tests, most significantly this one: "
        second += f"{worst.name}, {chance(worst.p_value, 'p')}."
    table = " law() returns the force as a table." * (found.open_law is not None)
    third = {
        "parameters": numbers_that_moved(found.parameters),
        "effect": "Add it with refine, and validate the result on held-out data.",
        "ambiguous": distinguishing(found),
        "unexplained": "Do not trust the closest candidate: the missing effect is not in the library."
        + table,
    }[found.verdict]
    return [first, second, third], False


def _improvement_answer(found: Improvement) -> tuple[list[str], bool]:
    """Answer how far the error fell, by which effects, and why it stopped."""
    first, last = found.steps[0], found.steps[-1]
    before, after = (root_mean_square(s.validation_rmse) for s in (first, last))
    unit = f" {found.output_units[0]}" if len(found.output_units) == 1 and found.output_units[0] else ""
    change = f" ({100 * (after / before - 1):+.0f} %)" if before > 0 else ""
    names = []
    for effect in found.effects:
        rows = estimates_of(last.refinement, effect).values()
        sizes = ", ".join(with_error(row.coefficient, row.std, row.unit) for row in rows)
        names.append(f"{effect.label} ({sizes})")
    added = f"Added: {'; '.join(names)}." if names else "No effect was added."
    return [
        f"The error on held-out data changes from {before:.4g} to {after:.4g}{unit}{change}.",
        added,
        found.message,
    ], found.verdict == "adequate" and not names


def _refinement_answer(refinement: Refinement) -> tuple[list[str], bool]:
    """Answer how far the fit rose and which parameter changed most."""
    first = refinement.sentences()[0]
    moved = [r for r in refinement.parameters if r.role != "offset" and r.std > 0]
    if moved:
        row = max(moved, key=lambda r: abs(r.coefficient) / r.std)
        sure = abs(row.coefficient) / row.std
        size = with_error(row.value, row.std, row.unit)
        second = (
            f"The most significant change is {row.name} at {row.place}: {row.initial:.4g} to {size}, "
            f"{sure:.3g} standard deviations from the initial model."
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
