"""None of these: a force without a law against every winner, and what is known where it wins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from ..effects.along_motion import unit_forces
from ..effects.effect import Effect
from ..effects.tabulated import Table, Tabulated
from ..inference.free_form import FreeForm, fit_free_form
from ..inference.levels import levels
from ..inference.sensitivities import force_responses
from ..systems.linear import Array
from .beside import curve_at, motion_at, stops
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
    beyond : str
        What the force is beside a function of position and velocity, in a sentence; "" for nothing.
    rmse : ndarray, shape (n_y,)
        What is left of each output.
    """

    effect: Effect
    fit_after: float
    nearest: tuple[tuple[Effect, float], ...]
    beyond: str
    rmse: Array


@dataclass(frozen=True, slots=True, eq=False)
class FreeForces:
    """Free forces at the likeliest places.

    Attributes
    ----------
    log_likelihoods : dict
        By place, the freedom paid, in the metric of the candidates.
    law : OpenLaw or None
        At the likeliest place; None where that is no port, or where the free run is worse with it.
    """

    log_likelihoods: dict[str, float]
    law: OpenLaw | None


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
    places = list(dict.fromkeys(rival.effect.place for rival in race.rivals))
    found: dict[str, FreeForm] = {}
    for place in places[:_PLACES]:
        led = race.ratio or 1.0  # an observer of high gain follows the motion of the record
        curve = curve_at(race.fitted, place, led)
        if curve is not None:
            found[place] = fit_free_form(race.fitted, curve, race.whitener, race.ratio, rounds=_FIRST)
    free = {place: form.log_likelihood(race.whitener, race.ratio) for place, form in found.items()}
    named = {rival.effect.place: rival.log_likelihood for rival in reversed(race.rivals)}
    best = max({**named, **free}, key=lambda place: max(named.get(place, -np.inf), free.get(place, -np.inf)))
    if best in found:
        first = found[best]
        found[best] = fit_free_form(race.fitted, first.curve, first.whitener, race.ratio, start=first)
        free[best] = found[best].log_likelihood(race.whitener, race.ratio)
    return FreeForces(free, _tabulated(race, found[best]) if best in found else None)


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
        if free.law is None:  # no force at the best place mends it: as likely it is where the model has none
            logs.append(("", max(value for _, value in logs)))
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
    return OpenLaw(effect, float(np.mean(fit)), _nearest(race, form), _beyond(form, race.ratio), rmse)


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
        if columns:
            F = np.column_stack(columns)
            F = F - F.mean(axis=0)
            left = force - F @ np.linalg.lstsq(F, force, rcond=1e-10)[0]
            rows.append((rival.effect, 100.0 * (1.0 - float(left @ left) / float(force @ force))))
    return tuple(sorted(rows, key=lambda row: -row[1]))


def _beyond(form: FreeForm, ratio: float) -> str:
    """What the table leaves, where memory or time would take up a part of it.

    No certain word: a curve that is finer than the knots leaves the same.
    """
    fitted, place = form.fitted, form.curve.place
    battery = TestedResidual(fitted, ratio)
    said = {"remembers": _remembered, "changes with time": _slow}
    best: tuple[float, str] = (levels().no_function, "")
    for words, make in said.items():
        blocks = []
        for i in range(len(fitted.problem.records)):
            forces = [(place, column) for column in make(*fitted.port(place, ratio, i))]
            blocks.append(force_responses(fitted, i, forces, fitted.gain(ratio)))
        best = min(best, (battery.test(words, blocks).p_value, words))
    acts = fitted.structure.model.port(place).acts_by
    finer = "or like a curve finer than its knots"
    return f"What the table leaves looks like a {acts} that {best[1]}, {finer}." if best[1] else ""


def _remembered(d: Array, v: Array) -> list[Array]:
    """Stops of several radii, and what relaxes within a share of a swing, or some of them."""
    moved = d if np.any(d) else v
    steps = np.diff(moved, prepend=moved[0])
    swing = float(np.std(moved)) / (float(np.std(steps)) or 1.0)  # samples
    relaxed = [lfilter([1.0], [1.0, -np.exp(-1.0 / (k * swing))], steps) for k in (0.3, 1.0, 3.0)]
    return [*stops(moved, float(np.std(moved))).T, *relaxed]


def _slow(d: Array, v: Array) -> list[Array]:
    """Stiffness and damping that change over the record."""
    t = np.linspace(-1.0, 1.0, d.size)
    shapes = [t, t * t, *(f(k * np.pi * t) for k in (1, 2, 3) for f in (np.sin, np.cos))]
    return [x * shape for x in (d, v) if np.any(x) for shape in shapes]
