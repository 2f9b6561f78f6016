"""None of these: a force without a law against every winner, and what is known where it wins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..effects.along_motion import unit_forces
from ..effects.effect import Effect
from ..effects.tabulated import Table, Tabulated
from ..inference.basis import Basis, project
from ..inference.free_form import Curve, FreeForm, evidence, fit_free_form
from ..inference.sensitivities import force_responses
from ..systems.linear import Array
from .beside import curve_at, motion_at
from .judging import beyond
from .residual_tests import TestedResidual
from .verdict import probabilities as softmax

if TYPE_CHECKING:
    from .candidate_fits import CandidateFits

__all__ = ["FreeForces", "OpenLaw", "open_law", "probabilities"]

_NAME = "law open, tabulated"
_PLACES = 3  # at which a curve is fitted
_FIRST = 2  # descents at each of them; the best one goes on


@dataclass(frozen=True, slots=True, eq=False)
class OpenLaw:
    """A force at a place that no candidate explains, as a table.

    Attributes
    ----------
    effect : Effect
        The table at its place.
    fit_after : float
        Fit in percent of the model with it, the mean over the outputs.
    nearest : tuple of (Effect, float)
        Laws at the place, and how much of the tabulated force each explains, in percent of its
        mean square.
    rmse : ndarray, shape (n_y,)
        What is left of each output.
    """

    effect: Effect
    fit_after: float
    nearest: tuple[tuple[Effect, float], ...]
    rmse: Array


@dataclass(frozen=True, slots=True, eq=False)
class FreeForces:
    """Free forces at the likeliest places, and curves at the inputs and outputs.

    Attributes
    ----------
    log_likelihoods : dict
        By place, the freedom paid, in the metric of the candidates.
    law : OpenLaw or None
        At the likeliest place; None where that is no port, or where the free run is worse with it.
    left : float
        Share of the error beyond noise that is left at the likeliest place, 0 where it is explained: by the
        free force there, by the best candidate where that is no port, else by the static curve.
    """

    log_likelihoods: dict[str, float]
    law: OpenLaw | None
    left: float


def open_law(race: CandidateFits) -> FreeForces:
    """Fit free forces to a record that no candidate explains.

    Parameters
    ----------
    race : CandidateFits
        Candidates, none of which passes.

    Returns
    -------
    FreeForces
    """
    places = [rival.effect.place for rival in race.rivals]
    found: dict[str, FreeForm] = {}
    for place in list(dict.fromkeys(places))[:_PLACES]:
        # an observer of high gain follows the motion of the record
        curve = curve_at(race.fitted, place, race.ratio or 1.0)
        if curve is not None:
            found[place] = fit_free_form(race.fitted, curve, race.whitener, race.ratio, rounds=_FIRST)
    free = {place: form.log_likelihood(race.whitener, race.ratio) for place, form in found.items()}
    static = _static(race)
    free |= {place: value for place, (value, _) in static.items()}
    best = max([(race.rivals[0].log_likelihood, places[0]), *zip(free.values(), free, strict=True)])[1]
    if best in found:
        first = found[best]
        found[best] = fit_free_form(race.fitted, first.curve, first.whitener, race.ratio, start=first)
        free[best] = found[best].log_likelihood(race.whitener, race.ratio)
        after = found[best].fitted.residuals(race.ratio)
    elif best in places:  # fitted, where the curve is a linear step
        after = race.model(places.index(best)).residuals(race.ratio)
    else:
        after = static[best][1]
    scales = race.fitted.problem.whitener(after).scales
    left = beyond(after, scales) / (beyond(race.fitted.residuals(race.ratio), scales) or 1.0)
    return FreeForces(free, _tabulated(race, found[best]) if best in found else None, min(1.0, left))


def _static(race: CandidateFits) -> dict[str, tuple[float, list[Array]]]:
    """Log-likelihood of a curve at each input and output, and the residual that its least squares leave."""
    fitted, found = race.fitted, dict[str, tuple[float, list[Array]]]()
    if race.ratio:  # the observer follows what a sensor says, whatever curve it has
        return found
    battery, model = TestedResidual(fitted, 0.0, race.whitener), fitted.structure.linear_model
    held, p, weights = fitted.blocks(), fitted.problem.n_theta, fitted.problem.weights
    records = fitted.problem.records
    signals = {label: [r.inputs[j] for r in records] for j, label in enumerate(model.input_labels)}
    outputs = [r / weights[:, None] + one.outputs for (r, _), one in zip(held, records, strict=True)]
    signals |= {label: [y[j] for y in outputs] for j, label in enumerate(model.output_labels)}
    for label, parts in signals.items():
        curve = Curve.along(label, np.concatenate(parts), np.zeros(sum(x.size for x in parts)))
        if not curve.d.size or label in [port.name for port in fitted.structure.model.ports]:
            continue
        blocks = []
        for i, x in enumerate(parts):
            F = curve.columns(x, np.zeros(x.size)) @ curve.root
            if label in model.input_labels:
                blocks.append(force_responses(fitted, i, [(label, f) for f in F.T], fitted.gain(0.0)))
            else:
                blocks.append((weights * (np.array(model.output_labels) == label))[:, None, None] * F)
        seen = evidence(battery.left, project(battery.whiten(blocks), battery.basis))
        J = [(j.reshape(r.size, -1), X.reshape(r.size, -1)) for (r, j), X in zip(held, blocks, strict=True)]
        basis = Basis.of([np.hstack([j[:, :p], X]) for j, X in J], [j[:, p:] for j, _ in J])
        rest = project(np.concatenate([r.ravel() for r, _ in held]), basis)
        ends = np.cumsum([r.size for r, _ in held])[:-1]
        after = [x.reshape(r.shape) for x, (r, _) in zip(np.split(rest, ends), held, strict=True)]
        found[label] = (seen.gain - 0.5 * float(battery.left @ battery.left), after)
    return found


def probabilities(
    race: CandidateFits, beside: float, elsewhere: float, free: FreeForces | None
) -> tuple[Array, float, dict[str, float]]:
    """Probabilities of the candidates, of none of these, and of the places.

    Parameters
    ----------
    race : CandidateFits
        Candidates, the best one first.
    beside : float
        Log of the odds of a force at its place that departs from the best one, over it.
    elsewhere : float
        The same of a force at no known place.
    free : FreeForces or None
        Free forces in place of the candidates, where none passes.

    Returns
    -------
    shares : ndarray, shape (n,)
        Of the candidates.
    none : float
        Of none of these; all sum to one.
    places : dict
        Of each place, the most probable first; to one is missing what is at no known place.
    """
    logs = [(rival.effect.place, rival.log_likelihood) for rival in race.rivals]
    here, top = logs[0]
    for place, odds in ((here, beside), ("", elsewhere)):
        if np.isfinite(odds):
            logs.append((place, top + odds))
    if free is not None:
        logs += free.log_likelihoods.items()
        left = np.clip(free.left, 1e-12, 1.0 - 1e-12)  # what nothing explains is at no known place
        known = np.logaddexp.reduce([value for _, value in logs])
        logs.append(("", float(known + np.log(left) - np.log1p(-left))))
    weights = softmax([value for _, value in logs])
    shares: dict[str, float] = {}
    for (place, _), weight in zip(logs, weights, strict=True):
        shares[place] = shares.get(place, 0.0) + float(weight)
    n = len(race.rivals)
    shares.pop("", None)
    ordered = dict(sorted(shares.items(), key=lambda item: -item[1]))
    return weights[:n], float(weights[n:].sum()), ordered


def _tabulated(race: CandidateFits, form: FreeForm) -> OpenLaw | None:
    """The curve as a law; none if the free run is worse with it."""
    fitted, place = form.fitted, form.curve.place
    table = form.table
    if "offset" in race.fitted.refinement.roles:  # which holds any constant: the force is 0 at rest
        rest = [np.clip(0.0, min(x, default=0.0), max(x, default=0.0)) for x in (table.d, table.v)]
        table = Table(table.d, table.v, np.array(table.force) - table(*rest))
    effect = Effect(Tabulated.name, place, law=table, name=f"{_NAME} at {place}")
    errors = np.concatenate([r / fitted.problem.weights[:, None] for r in fitted.residuals()], axis=1)
    measured = np.concatenate([r.outputs for r in fitted.problem.records], axis=1)
    spread = np.linalg.norm(measured - measured.mean(axis=1, keepdims=True), axis=1)
    fit = 100.0 * (1.0 - np.linalg.norm(errors, axis=1) / np.where(spread > 0, spread, np.inf))
    if fit.mean() <= np.mean(race.fitted.refinement.fit):
        return None
    rmse = np.sqrt(np.mean(errors**2, axis=1))
    return OpenLaw(effect, float(np.mean(fit)), _nearest(race, form), rmse)


def _nearest(race: CandidateFits, form: FreeForm) -> tuple[tuple[Effect, float], ...]:
    """How much of the tabulated force each law at the place explains along the motion, in percent."""
    d, v = motion_at(form.fitted, form.curve.place, race.ratio)
    force = form.table(d, v)
    force = force - force.mean()
    w = np.concatenate([record.inputs for record in form.fitted.problem.records], axis=1)
    rows = []
    for i, rival in enumerate(race.rivals):
        if rival.effect.place != form.curve.place:
            continue
        shape = {
            q.name: q.coefficient for q in race.model(i).refinement.parameters[race.fitted.problem.n_theta :]
        }
        columns = unit_forces(rival.effect, d, v, [shape], w)
        if columns and force.any():
            F = np.column_stack(columns)
            F = F - F.mean(axis=0)
            left = force - F @ np.linalg.lstsq(F, force, rcond=1e-10)[0]
            rows.append((rival.effect, 100.0 * (1.0 - float(left @ left) / float(force @ force))))
    return tuple(sorted(rows, key=lambda row: -row[1]))
