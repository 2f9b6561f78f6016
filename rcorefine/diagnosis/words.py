"""A diagnosis in words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..inference.levels import levels
from ..words import chance, with_error
from .absorbed import determined, far_numbers, numbers_that_moved, what_was_absorbed
from .improvement import Improvement
from .residual_tests import overall

if TYPE_CHECKING:
    from ..inference.f_tests import FTest
    from .result import Diagnosis

__all__ = ["failed_test", "next_step", "no_test_fires", "sentences"]

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
    alike = ", ".join([row.label for row in found.ranking if row.alike] or [e.label for e in found.ambiguous])
    if len(found.ambiguous) == 1 and found.best is not None:
        force = found.none_of_these > levels().no_law
        alike += f" and {_force(found)} of unknown form" if force else " and changed parameter values"
    n = len(found.effects)
    missing = "One effect is missing" if n < 2 else f"{_NUMBERS[n]} effects are missing"
    place = found.place
    where = "" if place is None else f"; one is missing at {place} (probability {found.places[place]:.2f})"
    lines = [_VERDICTS[found.verdict].format(best=_best(found), alike=alike, where=where, missing=missing)]
    if found.floated is not None and far_numbers(determined(found.floated)):
        lines = ["Parameter values explain the data, but such large changes may hide an effect."]
    if found.verdict == "parameters" and found.left_to_noise:
        lines = ["With re-estimated parameters, the residual cannot be distinguished from colored noise."]
    worst = min(found.tests, key=lambda t: t.p_value) if found.tests else None
    if found.verdict == "adequate":
        head = found.left_to_noise or lines[0]
        lines = [f"{head} {what_was_absorbed(found.base)}".rstrip(), no_test_fires(found)]
        shown = ", ".join(f"{d.effect.label} {d.smallest:.3g} {d.unit}".strip() for d in found.detectable[:4])
        lines += [f"Smallest effects that it would show (95 % probability): {shown}."] if shown else []
    elif worst is not None:  # without motion nothing could be tested
        lines += _open_law(found)
        fails = f"The residual of the model as given is not noise: {failed_test(worst)}."
        if overall(found.tests) < found.significance:
            lines.append(fails)
        elif found.verdict == "unexplained":
            lines.append(f"{no_test_fires(found)} {found.left_to_noise}".rstrip())
        else:
            odds = 1.0 / found.significance
            lines.append(
                f"{no_test_fires(found)} But this is over {odds:.3g} times as probable as no missing effect."
            )
        failed = found.winner_tests and overall(found.winner_tests) < found.significance
        if found.verdict == "unexplained" and failed:
            left = min(found.winner_tests, key=lambda t: t.p_value)
            lines.append(f"With the best candidate it is not noise, either: {failed_test(left)}.")
        if found.floated is not None:
            lines += [found.left_to_noise, numbers_that_moved(determined(found.floated)), _ALIKE]
        lines += _meaning(found)
    is_law = found.best is not None and found.verdict != "unexplained"
    hidden = is_law and found.none_of_these > levels().no_law
    if hidden and not found.force_ratio:
        lines.append(
            f"A{_force(found)[1:]} of another form has probability {found.none_of_these:.2f}; this record "
            "hardly shows its form."
        )
    if found.force_ratio:
        lines.append(
            f"The result allows for an unmeasured force of {100 * found.force_ratio:.2g} % of the input."
        )
    if hidden and found.force_ratio:
        lines.append(
            "If the plant was not disturbed, this force comes from an effect that is not in the library "
            f"(probability {found.none_of_these:.2f})."
        )
    if found.verdict == "ambiguous" and len(found.ambiguous) > 1:
        lines.append(
            "More outputs, a wider band or another amplitude would distinguish them."
            if found.base.of_responses
            else "suggest_experiment() names a record that would distinguish them."
        )
    if found.base.physical_model.operating_point is not None and found.ranking:
        lines.append("At the operating point, each force law is used without its tangent: the model has it.")
    return [*filter(None, lines), *found.notes]


def next_step(found: Diagnosis | Improvement) -> str:
    """Return the next step after a verdict, as a line of Python.

    The line calls the result ``found``.

    Parameters
    ----------
    found : Diagnosis or Improvement
        Result.

    Returns
    -------
    str
    """
    better = "better = found.refine(); print(better)"
    if isinstance(found, Improvement):
        return better.replace("refine()", "refinement") if len(found.steps) > 1 else "found.plot()"
    if found.verdict == "adequate" and found.left_to_noise:  # numbers that are far off leave the same
        return 'print(rco.refine(found.base, found.records, free="linear", tolerance=0.5))'
    if found.verdict == "adequate":
        return "rco.compare(found.base, found.records[0]).plot()  # what is left to noise"
    if found.verdict == "ambiguous" and not found.base.of_responses:
        return "print(found.suggest_experiment())"
    if found.verdict != "unexplained":
        return better
    if found.open_law is not None:
        return "print(rco.refine(found.base, found.records, [found.law()]))"
    return "found.plot()  # the force against the motion, and what is left over"


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
    if effect.spec.of_record:
        shares = " and ".join(f"{100 * v:.3g} % {k}" for k, v in values.items())
        said = effect.explanation
        return [
            f"{said} Here it is {shares}: correct the record, not the model."
            if found.verdict == "effect"
            else f"{said} Here it would be {shares}. A wrong clock and parameters that scale all rates "
            "have the same effect on a record: time the clock itself before you change a parameter."
        ]
    if effect.spec.relative:
        (gain,) = values.values()
        return [f"{effect.place} is then {1 + gain:.5g} times what the model has there."]
    model = found.base.physical_model
    port = next((port for port in model.ports if port.name == effect.place), None)
    if port is None or port.force_unit or any(number.physical for number in model.parameters):
        return []
    return [f"Units of its coefficients: {port.description}. physical(..., parameters=...) declares others."]


def _best(found: Diagnosis) -> str:
    if found.best is None:
        return "nothing"
    row, told = found.best, []
    for effect, own in row.estimates:
        values = ", ".join(with_error(r.coefficient, r.std) for r in own.values())
        told.append(f"{effect.label} ({values})")
    sure = "" if found.verdict == "unexplained" else f", probability {row.probability:.2f}"
    return f"{' and '.join(told)}: fit {row.fit_before:.4g} -> {row.fit_after:.4g} %{sure}"
