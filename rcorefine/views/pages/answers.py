"""The answer that a report opens with, in three sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...comparison.adequacy import best_of, failures_of
from ...diagnosis.absorbed import numbers_that_moved
from ...diagnosis.words import no_test_fires
from ...words import chance, with_error
from ..tables import number, root_mean_square

if TYPE_CHECKING:
    from ...comparison.responses import FrequencyComparison
    from ...comparison.result import Comparison
    from ...diagnosis.improvement import Improvement
    from ...diagnosis.result import Diagnosis
    from ...inference.refinement import EstimatedParameter, Refinement

__all__ = [
    "comparison_answer",
    "diagnosis_answer",
    "improvement_answer",
    "refinement_answer",
    "response_answer",
]


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
