"""A diagnosis in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..effects.effect import Effect
from ..inference.levels import levels
from ..inference.parameters import EstimatedParameter
from ..inference.refinement import Refinement
from ..results import chance, with_error
from .noise import in_percent
from .residual_tests import overall

if TYPE_CHECKING:
    from ..inference.f_tests import FTest
    from .result import Diagnosis, RankedEffect


_VERDICTS = {
    "adequate": "This record shows no missing effect.",
    "parameters": "Changed parameter values explain the data. No additional effect is needed.",
    "effect": "{missing}: {best}.",
    "ambiguous": "The data cannot distinguish {alike}. Most probable: {best}.",
    "unexplained": "No candidate effect explains the data{where}. Closest: {best}.",
}
#: Meaning of each residual test that is significant.
_FAILED = {
    "library": "{most} would reduce it",
    "other laws": "it depends on the motion",
    "changes with time": "it changes with time",
    "parameters": "other parameter values would reduce it",
    "input": "it depends on the input",
    "powers of the input": "it depends on powers of the input",
    "neighbors": "neighboring points have similar errors",
}
_NUMBERS = ("No", "One", "Two", "Three", "Four", "Five", "Six")
_ALIKE = (
    "A weak effect that acts like changed parameter values would be missed. A record at another amplitude "
    "or in another band would show it."
)


def sentences(found: Diagnosis) -> list[str]:
    """Return the findings, one sentence each.

    Parameters
    ----------
    found : Diagnosis
        Result.

    Returns
    -------
    list of str
    """
    # headline first; the rest depends on the verdict
    lines = [_headline(found)]
    worst = min(found.tests, key=lambda t: t.p_value) if found.tests else None
    if found.verdict == "adequate":
        head = found.left_to_noise or lines[0]
        lines = [f"{head} {what_was_absorbed(found.base)}".rstrip(), *_left(found)]
        if worst is not None and np.isfinite(found.adequate_to):
            lines.append(f"The residual is not noise: {failed_test(worst)}.")
        else:
            lines.append(no_test_fires(found))
            shown = (f"{d.effect.label} {d.smallest:.3g} {d.unit}".strip() for d in found.detectable[:4])
            if said := ", ".join(shown):
                lines.append(f"Smallest effects that it would show (95 % probability): {said}.")
    # other verdicts: the residual tests, then what the model leaves
    elif worst is not None:  # without motion nothing could be tested
        lines += [*_open_law(found), *_tests(found, worst), *_left(found), *_meaning(found)]
    lines += [*_other_names(found), *_offsets(found), *_other_forces(found)]
    if found.verdict == "ambiguous" and sum(row.alike for row in found.ranking) != 1:
        lines.append(distinguishing(found))
    if found.base.physical_model.operating_point is not None and found.ranking:
        lines.append("At the operating point, each force law is used without its tangent: the model has it.")
    return [*filter(None, lines), *found.notes]


def distinguishing(found: Diagnosis) -> str:
    """Return what would distinguish the candidates that tie."""
    if found.base.of_responses:
        return "More outputs, a wider band or another amplitude would distinguish them."
    return "suggest_experiment() names a record that would distinguish them."


def _left(found: Diagnosis) -> list[str]:
    """Describe what the model of the verdict leaves of the motion."""
    if not found.error_shares:
        return []
    # the output with the largest model error
    worst = max(found.error_shares, key=lambda one: one.model)
    said = f"The free run leaves {in_percent(worst.share)} of the motion of {worst.output}: the error of the "
    said += f"model is at most {in_percent(worst.model)}"
    least, close = found.settings["matters"], bool(np.isfinite(found.adequate_to))
    said += f", less than what matters ({in_percent(least)})" if close and worst.model <= least else ""
    said += f"; the step of the sensor is {in_percent(worst.step)}" if worst.step > 0 else ""
    enough = " It may serve in a simulation, although its effects may only imitate what is missing."
    return [f"{said}.{enough if close and found.verdict == 'unexplained' else ''}"]


def _other_names(found: Diagnosis) -> list[str]:
    """Return the other names of the named change."""
    same = found.best.same if found.best and found.effects else ()
    names = ", ".join(map(_estimated, same))
    return [f"For these inputs and outputs it is the same change as {names}."] if names else []


def _offsets(found: Diagnosis) -> list[str]:
    """Return the offsets that the named model includes."""
    if found.verdict == "adequate":  # they are told with what else was absorbed
        return []
    # offsets that differ clearly from zero
    named = found.best.refinement if found.best and found.effects else found.base
    rows = [r for r in (found.floated or named).parameters if r.role == "offset" and _moved(r)]
    return [f"The fit includes {', '.join(map(_one, rows))}."] if rows else []


def _other_forces(found: Diagnosis) -> list[str]:
    """Describe an unmeasured force, and a force of another form."""
    hidden = (
        found.best is not None and found.verdict != "unexplained" and found.none_of_these > levels().no_law
    )
    if not found.force_ratio:
        form = f"of another form has probability {found.none_of_these:.2f}"
        return [f"A{_force(found)[1:]} {form}; this record hardly shows its form."] if hidden else []
    lines = [f"The result allows for an unmeasured force of {100 * found.force_ratio:.2g} % of the input."]
    if hidden:
        lines.append(
            "If the plant was not disturbed, this force comes from an effect that is not in the library "
            f"(probability {found.none_of_these:.2f})."
        )
    return lines


def _headline(found: Diagnosis) -> str:
    """Return the verdict in a sentence."""
    # adequate in spite of significant tests
    close = np.isfinite(found.adequate_to) and f"adequate to {in_percent(found.adequate_to)}."
    if close and not found.ranking:
        return f"This record shows no missing effect that matters: the model is {close}"
    if close and found.verdict == "unexplained":
        return f"No candidate explains all, but {_best(found)} is {close}"
    if found.verdict == "parameters" and found.left_to_noise:
        return "With re-estimated parameters, the residual cannot be distinguished from colored noise."
    if found.floated is not None and far_numbers(determined(found.floated)):
        return "Parameter values explain the data, but such large changes may hide an effect."
    n, place = len(found.effects), found.place
    missing = "One effect is missing" if n < 2 else f"{_NUMBERS[n]} effects are missing"
    where = "" if place is None else f"; one is missing at {place} (probability {found.places[place]:.2f})"
    return _VERDICTS[found.verdict].format(
        best=_best(found), alike=_alike(found), where=where, missing=missing
    )


def _alike(found: Diagnosis) -> str:
    """List the hypotheses that the data cannot distinguish."""
    # several rows tie, or one row and a force that has no name
    tied = [row.label for row in found.ranking if row.alike]
    named = [effect.label for effect in found.ambiguous]
    if len(tied) != 1:
        return ", ".join(tied or named)
    if np.isfinite(found.adequate_to):  # a part of the set is tied, or the tests contradict all of it
        return ", ".join((named[1:] and named) or [tied[0], f"{_force(found)} of another form"])
    force = found.none_of_these > levels().no_law
    return tied[0] + (f" and {_force(found)} of unknown form" if force else " and changed parameter values")


def _tests(found: Diagnosis, worst: FTest) -> list[str]:
    """Return the results of the residual tests, if not adequate."""
    # tests of the model as given, then of the best candidate
    if overall(found.tests) < found.significance:
        lines = [f"The residual of the model as given is not noise: {failed_test(worst)}."]
    elif found.verdict == "unexplained":
        lines = [f"{no_test_fires(found)} {found.left_to_noise}".rstrip()]
    else:
        odds = f"over {1.0 / found.significance:.3g} times as probable as no missing effect"
        lines = [f"{no_test_fires(found)} But this is {odds}."]
    failed = found.winner_tests and overall(found.winner_tests) < found.significance
    if failed and (found.verdict == "unexplained" or np.isfinite(found.adequate_to)):
        left = min(found.winner_tests, key=lambda t: t.p_value)
        lines.append(f"With the best candidate it is not noise, either: {failed_test(left)}.")
    if found.verdict != "unexplained":
        lines.append(found.left_to_noise)
    if found.floated is not None:
        lines += [numbers_that_moved(determined(found.floated)), _ALIKE]
    return lines


def failed_test(test: FTest) -> str:
    """Describe a failed test under its name in `Diagnosis.tests`.

    Parameters
    ----------
    test : FTest
        Test.

    Returns
    -------
    str
    """
    name, _, most = test.name.partition(" (most: ")
    meaning = _FAILED.get(name, "").format(most=most.rstrip(")"))
    said = f"the test {name!r} is significant ({chance(test.p_value, 'p')})"
    return f"{said}, {meaning}" if meaning else said


def no_test_fires(found: Diagnosis) -> str:
    """State the significance level and the smallest p-value.

    The level holds for all tests together.
    """
    said = f"No residual test is significant at the level {found.significance:g}"
    if not found.tests:
        return f"{said}."
    worst = min(found.tests, key=lambda t: t.p_value)
    return (
        f"{said}: the smallest p-value is {chance(worst.p_value)} ({worst.name!r}), or "
        f"{chance(overall(found.tests))} corrected for the number of tests."
    )


def _open_law(found: Diagnosis) -> list[str]:
    """Describe the tabulated force that no candidate explains."""
    # table at a port or curve of a channel, with its fit
    law = found.open_law
    if law is None:
        return []
    fits = f"fit {found.ranking[0].fit_before:.4g} -> {law.fit_after:.4g} %"
    table: Any = law.effect.law
    if law.effect.spec.at_channel:
        ends = f"{table.d[0]:.3g} to {table.d[-1]:.3g}"
        return [f"law() tabulates the unknown curve of {law.effect.place} from {ends}: {fits}."]
    port = found.base.physical_model.port(law.effect.place)
    knots = zip(port.senses, (table.d, table.v), strict=True)
    shown = " and a ".join(f"{name} of {x[0]:.3g} to {x[-1]:.3g}" for name, x in knots if x)
    lines = [f"law() tabulates the unknown {port.acts_by} for a {shown}: {fits}."]
    near = ", ".join(f"{effect.label} {max(share, 0):.0f} %" for effect, share in law.nearest[:3])
    return [*lines, f"Effects that explain most of that {port.acts_by}: {near}."] if near else lines


def _force(found: Diagnosis) -> str:
    """Name the force at the place of the best candidate.

    The words are those of its domain.
    """
    place = found.best.effect.place if found.best is not None else ""
    ports = {port.name: port.acts_by for port in found.base.physical_model.ports}
    return f"a {ports.get(place, 'force')} at {place}"


def _meaning(found: Diagnosis) -> list[str]:
    """Explain the coefficients of the best candidate if needed."""
    if found.best is None or (found.verdict == "unexplained" and not found.best.effect.spec.of_record):
        return []
    effect, values = found.best.effect, found.best.coefficients
    # faults of the record, differenced encoders, gains and units need a word
    if effect.spec.of_record:
        return [_of_record(effect, values, sure=found.verdict == "effect")]
    if effect.spec.of_differences and effect.prior:
        return [f"{effect.place} is the mean over a sample: a differenced encoder."]
    if effect.spec.relative:
        (gain,), (std,) = values.values(), found.best.std.values()
        said = f"{effect.place} is then {1 + gain:.5g} times what the model has there"
        turned = 1 + gain + levels().moved * std < 0
        return [f"{said}{': it is reversed (swapped wires, or another sign convention)' * turned}."]
    model = found.base.physical_model
    port = next((port for port in model.ports if port.name == effect.place), None)
    if port is None or port.force_unit or any(number.physical for number in model.parameters):
        return []
    return [f"Units of its coefficients: {port.description}. physical(..., parameters=...) declares others."]


def _of_record(effect: Effect, values: Mapping[str, float], *, sure: bool) -> str:
    """Explain a fault of the record as a whole."""
    shares = " and ".join(f"{100 * v:.3g} % {k}" for k, v in values.items())
    if sure:
        return f"{effect.explanation} Here it is {shares}: correct the record, not the model."
    return (
        f"{effect.explanation} Here it would be {shares}. A wrong clock and parameters that scale all "
        "rates have the same effect on a record: time the clock itself before you change a parameter."
    )


def _best(found: Diagnosis) -> str:
    if found.best is None:
        return "nothing"
    row = found.best
    sure = "" if np.isnan(row.probability) else f", probability {row.probability:.2f}"
    return f"{_estimated(row)}: fit {row.fit_before:.4g} -> {row.fit_after:.4g} %{sure}"


def _estimated(row: RankedEffect) -> str:
    """Name the effects of a row with their coefficients."""
    told = []
    for effect, own in row.estimates:
        values = ", ".join(with_error(r.coefficient, r.std) for r in own.values())
        told.append(f"{effect.label} ({values})")
    return " and ".join(told)


_LISTED = 6  # numbers that are listed
_TOLD = 0.1  # of the standard deviation of its prior, below which a parameter is determined alone
_ALONE = 0.1  # of its variance that is left where others are known, below which only products are determined
_POWER = 0.05  # of a parameter in a product, below which it takes no part


def what_was_absorbed(base: Refinement) -> str:
    """Describe the changes of offsets and parameters in the base fit.

    With these changes, no effect is missing from the model.

    Parameters
    ----------
    base : Refinement
        The model with its nuisances and free parameters fitted.

    Returns
    -------
    str
        One sentence, empty where no number moved by more than chance.
    """
    # changes by their significance
    moved = [row for row in base.parameters if row.role != "effect" and _moved(row)]
    if not moved:
        return ""
    moved.sort(key=lambda row: -abs(row.value - row.initial) / max(row.std, 1e-300))
    said = [_one(row) for row in moved[:_LISTED]]
    if len(moved) > _LISTED:
        said.append(f"{len(moved) - _LISTED} more parameters")
    return (
        f"The fit includes {', '.join(said)}: that increases the fit of the simulation from "
        f"{percent(base.initial_fit)} to {percent(base.fit)}."
    )


def numbers_that_moved(rows: Sequence[EstimatedParameter]) -> str:
    """The numbers of a model that are off, as multiples of what it says.

    Parameters
    ----------
    rows : sequence of EstimatedParameter
        Numbers that were fitted.

    Returns
    -------
    str
        One sentence.
    """
    # changes by their significance, then a caution for large ones
    sure = sorted((r for r in rows if _moved(r)), key=lambda r: -abs(r.coefficient) / max(r.std, 1e-300))
    said = [
        f"{row.name} {with_error(row.value / row.initial, row.std / abs(row.initial))} times nominal"
        if row.initial
        else f"{row.name} {with_error(row.value, row.std, row.unit)}, 0 in the model"
        for row in sure[:_LISTED]
    ]
    if not said:
        return "No single parameter changed significantly; together they explain the residual."
    more = f" and {len(sure) - _LISTED} more" if len(sure) > _LISTED else ""
    far = far_numbers(sure)
    doubt = (
        f" The change of {', '.join(far[:_LISTED])} is so large that an effect may be missing at a place "
        "that the model does not show: declare its links with physical(...)."
    )
    return f"Significant changes, if the sensors are right: {', '.join(said)}{more}.{doubt if far else ''}"


def determined(model: Refinement) -> list[EstimatedParameter]:
    """Return the parameters, or their products, that the data determine.

    Parameters
    ----------
    model : Refinement
        Its linear parameters were estimated, each with a prior.

    Returns
    -------
    list of EstimatedParameter
        A parameter that the data determine only in relation to others is replaced by its product with
        powers of as few of them as possible, as a multiple of nominal. One that is zero in the model is no
        part of a product.
    """
    prior = {(e.kind, e.place): sd for e in model.effects for sd in e.prior.values()}
    linear = [i for i, r in enumerate(model.parameters) if r.role == "linear" and (r.kind, r.place) in prior]
    at = [i for i in linear if model.parameters[i].initial]
    rows = [model.parameters[i] for i in at]
    size = np.abs([row.value for row in rows])  # of logarithms: products of parameters are sums
    widths = np.array([prior[row.kind, row.place] for row in rows]) / size
    C = model.covariance[np.ix_(at, at)] / np.outer(size, size)
    return [*(row for i in linear if not (row := model.parameters[i]).initial), *_products(rows, C, widths)]


def _products(
    rows: Sequence[EstimatedParameter], C: np.ndarray, widths: np.ndarray
) -> Iterator[EstimatedParameter]:
    """Yield parameters determined alone, and products of the others."""
    held, left = _held(C, widths)
    # regress the held ones on each: exponents of the product
    powers = -np.linalg.lstsq(C[np.ix_(held, held)], C[held], rcond=None)[0]
    for i, row in enumerate(rows):
        if left[i, i] > _ALONE * C[i, i] or C[i, i] < (_TOLD * widths[i]) ** 2:
            yield row
        elif i not in held:
            name, ratio = row.name, row.value / row.initial
            for k, power in zip(held, powers[:, i], strict=True):
                if abs(power) > _POWER:
                    written = "" if abs(abs(power) - 1.0) < _POWER else f"^{abs(power):.2g}"
                    name += f" {'*' if power > 0 else '/'} {rows[k].name}{written}"
                    ratio *= abs(rows[k].value / rows[k].initial) ** power
            std = abs(ratio) * float(np.sqrt(max(left[i, i], 0.0)))
            yield replace(row, name=name, initial=1.0, value=ratio, coefficient=ratio - 1.0, std=std)


def _held(C: np.ndarray, widths: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Hold the parameters that determine most others, one after the other.

    Parameters
    ----------
    C : ndarray, shape (p, p)
        Covariance of the logarithms of the parameters.
    widths : ndarray, shape (p,)
        Prior standard deviations of the logarithms.

    Returns
    -------
    held : list of int
        Positions of the held parameters.
    left : ndarray, shape (p, p)
        Covariance of the others beside them.
    """
    left, held = C, list[int]()
    while True:
        sds = np.sqrt(np.maximum(np.diag(left), 1e-300))
        alike = np.sum(np.abs(left / np.outer(sds, sds)) > np.sqrt(1.0 - _ALONE), axis=0)
        alike = alike * (sds > _TOLD * widths)
        if np.max(alike, initial=0) < 2:  # itself
            return held, left
        held.append(int(np.argmax(alike)))  # known, it would determine the most others
        taken = left[:, held[-1]]
        left = left - np.outer(taken, taken) / taken[held[-1]]
        left[held[-1]] = left[:, held[-1]] = 0.0


def far_numbers(rows: Sequence[EstimatedParameter]) -> list[str]:
    """Return the names of parameters that changed implausibly much.

    Such a change is certain, and larger than the error of somebody who knows the plant. A parameter that is
    zero in the model has no size to compare its change with.
    """
    sure, far = levels().moved, levels().moved_far
    known = [row for row in rows if row.initial]
    return [row.name for row in known if abs(row.coefficient) - sure * row.std > far * abs(row.initial)]


def _moved(row: EstimatedParameter) -> bool:
    return abs(row.coefficient) > levels().moved * row.std


def _one(row: EstimatedParameter) -> str:
    unit = f" {row.unit}" if row.unit else ""
    if row.role == "offset":
        return f"an offset of {row.value:.3g}{unit} at {row.place}"
    change = f" ({100 * (row.value / row.initial - 1):+.3g} %)" if row.initial else ""
    return f"{row.name} from {row.initial:.4g} to {row.value:.4g}{unit}{change}"


def percent(fit: np.ndarray) -> str:
    """The fit of each output [%]."""
    return " / ".join(f"{value:.4g} %" for value in np.atleast_1d(fit))
