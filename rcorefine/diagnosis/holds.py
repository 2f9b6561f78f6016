"""Which hold of the input suits a record: it outweighs most effects, so it is tested before them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..data.measurement import HOLDS, Measurement
from ..effects.effect import Effect
from ..effects.input_path import InputDelay, InputLag
from ..engine.structure import Structure
from ..exceptions import DivergenceError
from ..inference.assembly import assemble, unfold
from ..inference.fit import Fit
from ..inference.levels import levels
from ..inference.outcome import output_weights
from ..inference.refinement import Refinement
from ..inference.search import starting_states
from ..inference.windows import windows
from ..refinement.refine import refit

__all__ = ["best_hold", "hold_errors"]

_ROUNDS = 3
_DELAY, _LAG = 0.2, 0.1  # of a sample, where the search for a late or slow channel begins
_NAMES = {"zoh": "zero-order hold", "foh": "first-order hold", "bandlimited": "band-limited input"}


def hold_errors(
    model: Refinement, records: Sequence[Measurement], settings: dict[str, Any]
) -> dict[str, float]:
    """Mean log error of the free run under each hold, the model fitted again under it.

    Parameters
    ----------
    model : Refinement
        Where each fit starts.
    records : sequence of Measurement
        Records.
    settings : dict
        tolerance, offset and noise as in `refine`.

    Returns
    -------
    dict
        ``{hold: log error}``, holds under which the model runs away left out.
    """
    found = {}
    for hold in HOLDS:
        try:
            fitted = refit(model.with_hold(hold), records, **settings)
        except DivergenceError:
            continue
        found[hold] = float(np.mean(np.log(fitted.rmse + 1e-300)))
    return found


def floating_error(
    model: Refinement,
    records: Sequence[Measurement],
    settings: dict[str, Any],
    hold: str,
    *,
    late: bool = False,
) -> float:
    """Mean log error of the free run under a hold, all parameters floating.

    Parameters
    ----------
    model, records, settings
        As in `hold_errors`.
    hold : str
        Hold.
    late : bool
        Whether each input may be late and slow too: what one hold has over another is half a
        sample of delay, and a filter behind the sensor gives as much.

    Returns
    -------
    float
    """
    physical, kept = unfold(model)
    dt, tolerance = records[0].dt, settings.get("tolerance", 0.0) or levels().off
    slow = [
        Effect(law.name, place, start={law.coefficients[0].name: share * dt})
        for place in physical.linear.input_labels
        for law, share in ((InputDelay, _DELAY), (InputLag, _LAG))
        if late and not any((e.kind, e.place) == (law.name, place) for e, _ in kept)
    ]
    chosen = assemble(physical, kept, slow, "linear", tolerance, [])
    structure = Structure(replace(physical, hold=hold), [e for e, _ in chosen], constants=model.constants)
    segments, _ = windows(physical, list(records), settings.get("horizon"))
    fit = Fit(structure, [role for _, role in chosen], segments, settings.get("noise"), None, tolerance)
    fit.steps = max(model.substeps, 1 if structure.is_linear else 2)
    fit.problem = fit.build(segments, fit.steps)
    theta = structure.start()
    point = fit.problem.pack(theta, starting_states(fit.problem, theta))
    for _ in range(_ROUNDS):  # the error sets the weight of the priors
        fit.weights = output_weights(segments, fit.noise, fit.problem, point)
        fit.problem = fit.build(segments, fit.steps)
        fit.result = fit.problem.minimize(point, max_nfev=12, tol=1e-5)
        point = fit.result.x
    return 0.5 * fit.cost / structure.n_outputs


def best_hold(model: Refinement, records: Sequence[Measurement], settings: dict[str, Any]) -> tuple[str, str]:
    """The hold to use, and a sentence where it is not the declared one.

    Parameters
    ----------
    model, records, settings
        As in `hold_errors`.

    Returns
    -------
    hold : str
        The declared one (the model's own where it has one) unless another lowers the error by
        more than 5 %, the parameters floating, and a delay or lag does not explain it as well; records
        that declare different holds are taken at their word.
    sentence : str
        What was found, empty where the declared hold is right.
    """
    declared = model.hold or records[0].hold
    if model.hold is None and any(record.hold != declared for record in records):
        return declared, ""  # several holds were declared on purpose
    errors = hold_errors(model, records, settings)
    best = min(errors, key=lambda hold: errors[hold], default=declared)
    if declared in errors and errors[declared] - errors[best] < levels().hold:
        return declared, ""
    if declared in errors:
        found, given = (floating_error(model, records, settings, hold) for hold in (best, declared))
        if given - found < levels().hold:
            return declared, ""
        if floating_error(model, records, settings, declared, late=True) < errors[best] - levels().hold_alike:
            return declared, ""
    figures = ", ".join(f"{hold} {np.exp(value):.4g}" for hold, value in errors.items())
    said = "the record declares" if model.hold is None else "the model was fitted with"
    return best, (
        f"The hold matters more than most effects: {said} hold={declared!r}, a {_NAMES[best]} "
        f"(hold={best!r}) fits better (error {figures})."
    )
