"""Free forces, tabulated, for records that no candidate effect explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Unpack

import control as ct
import numpy as np

from ..data.measurement import Measurement
from ..data.signals import over_time
from ..effects.effect import Effect, unit_forces
from ..effects.given import InputCurve, OutputCurve, Table, Tabulated
from ..inference.f_tests import Basis, project
from ..inference.fitted import FittedModel
from ..inference.free_form import FreeForm, estimated_force, evidence, fit_free_form
from ..inference.refinement import Refinement
from ..inference.whitening import Whitener
from ..models.ports import Port
from ..results import Look, Result, picture, show
from ..systems.linear import Array
from .beside import channel_curve, curve_at, curve_columns, motion_at
from .hypothesis import Trial
from .nuisances import Nuisance
from .residual_tests import TestedResidual, likely_places
from .search import Search

_NAMES = {
    Tabulated.name: "unknown force",
    InputCurve.name: "unknown curve",
    OutputCurve.name: "unknown curve",
}
_PLACES = 3  # places at which a curve is fitted
_FIRST = 2  # first descents at each place; only the best one is continued


@dataclass(frozen=True, slots=True, eq=False)
class OpenLaw:
    """Unknown force at a place, or unknown curve of a channel, tabulated.

    Attributes
    ----------
    effect : Effect
        The table at its place.
    fit_after : float
        Fit in percent of the model with the table, mean over the outputs.
    nearest : tuple of (Effect, float)
        Candidate effects at the place, the best one first. The number is the share of the tabulated force
        that each explains, in percent of its mean square.
    rmse : ndarray, shape (n_y,)
        Root mean square error of each output with the table.
    """

    effect: Effect
    fit_after: float
    nearest: tuple[tuple[Effect, float], ...]
    rmse: Array


class SingleFits(NamedTuple):
    """Fits of single effects at one base, none of which passes the tests.

    Attributes
    ----------
    fitted : FittedModel
        The base.
    trials : list of Trial
        The effects, the best one first.
    whitener : Whitener
        Metric of the comparison with free forces: the noise filter of the best effect's residual.
    """

    fitted: FittedModel
    trials: list[Trial]
    whitener: Whitener

    def log_likelihood(self, i: int) -> float:
        """Return the log-likelihood of an effect, in the common metric.

        The priors count. Each coefficient beyond the first costs half the log of the number of samples.
        """
        trial, problem = self.trials[i], self.trials[i].problem
        # Gaussian log-likelihood with the priors and Schwarz's penalty, one whitening for all
        white = self.whitener.apply([r for r, _ in trial.blocks])
        theta, held = problem.unpack(trial.point)[0], np.isfinite(problem.prior_sd)
        moved = ((theta - problem.prior_mean)[held] / problem.prior_sd[held]) ** 2
        more = max(problem.n_theta - self.fitted.problem.n_theta - 1, 0)
        return -0.5 * (float(white @ white) + float(moved.sum()) + more * float(np.log(white.size)))


class FreeForces(NamedTuple):
    """Free forces at the likeliest places, and free curves of channels.

    Attributes
    ----------
    log_likelihoods : dict
        Log-likelihood by place, penalized for the free coefficients, in the metric of the candidates.
    law : OpenLaw or None
        Tabulated force, or curve of a channel, at the likeliest place. None if the table does not improve
        the fit in free run.
    left : float
        Share of the error beyond noise that remains at the likeliest place; 0 if nothing remains. At a port
        the free force counts. Elsewhere the best candidate at the place counts, or without one the static
        curve.
    """

    log_likelihoods: dict[str, float]
    law: OpenLaw | None
    left: float

    @property
    def fit_after(self) -> float:
        """Fit in percent of the model with the table, 0 without one."""
        return 0.0 if self.law is None else self.law.fit_after


def open_law(fits: SingleFits) -> FreeForces:
    """Fit free forces to a record that no candidate explains.

    Parameters
    ----------
    fits : SingleFits
        Effects, none of which passes the tests.

    Returns
    -------
    FreeForces
    """
    # free curves at the likeliest ports, and linear estimates of curves at the channels
    places = [trial.effects[0].place for trial in fits.trials]
    found = _forms(fits, places)
    free = {place: form.log_likelihood(fits.whitener, 0.0) for place, form in found.items()}
    static = _static(fits)
    free |= {place: value for place, (value, _) in static.items()}
    # the best of all goes on: as a full fit, a candidate, or a linear step
    best = max([(fits.log_likelihood(0), places[0]), *zip(free.values(), free, strict=True)])[1]
    if best in found:
        first = found[best]
        found[best] = fit_free_form(fits.fitted, first.curve, first.whitener, start=first)
        free[best] = found[best].log_likelihood(fits.whitener, 0.0)
        after = found[best].fitted.residuals()
    elif best in places:  # the candidate was fitted; the curve is a linear step only
        after = [r for r, _ in fits.trials[places.index(best)].blocks]
    else:
        after = static[best][1]
    # share of the model error that remains with the best free force
    scales = fits.fitted.problem.whitener(after).scales
    left = _beyond(after, scales) / (_beyond(fits.fitted.residuals(), scales) or 1.0)
    left = min(1.0, left)
    # a free curve of a channel can imitate effects elsewhere: its place needs more than half the probability
    odds = free.get(best, -np.inf) - float(np.logaddexp.reduce(list(free.values())))
    if best in static and np.exp(odds) * (1.0 - left) > 0.5:
        curve = channel_curve(fits.fitted, best)
        assert curve is not None
        found[best] = fit_free_form(fits.fitted, curve, fits.whitener)
    return FreeForces(free, _tabulated(fits, found[best]) if best in found else None, left)


def _forms(fits: SingleFits, places: Sequence[str]) -> dict[str, FreeForm]:
    """Fit curves at the ports of the effects, at most `_PLACES`.

    If no effect is at a port, the ports are those at which a free force explains most.
    """
    # ports of the candidates; without any, ports where a generic force explains most
    ports = {port.name for port in fits.fitted.structure.model.ports}
    likely = [place for place in places if place in ports]
    likely = likely or likely_places(TestedResidual(fits.fitted, 1.0), ports)
    found = {}
    for place in list(dict.fromkeys(likely))[:_PLACES]:
        # a predictor of high gain follows the motion of the record
        curve = curve_at(fits.fitted, place, 1.0)
        if curve is not None:
            found[place] = fit_free_form(fits.fitted, curve, fits.whitener, rounds=_FIRST)
    return found


def _static(fits: SingleFits) -> dict[str, tuple[float, list[Array]]]:
    """Return log-likelihood and residual of a curve at each input and output.

    Channels that are ports are left out.
    """
    fitted, found = fits.fitted, dict[str, tuple[float, list[Array]]]()
    tested, model = TestedResidual(fitted, 0.0, fits.whitener), fitted.structure.linear_model
    held, p = fitted.blocks(), fitted.problem.n_theta
    ports = [port.name for port in fitted.structure.model.ports]
    # linear least squares: columns of the curve beside those of the fit
    for label in (*model.input_labels, *model.output_labels):
        blocks = None if label in ports else curve_columns(fitted, label)
        if blocks is None:
            continue
        seen = evidence(tested.left, project(tested.whiten(blocks), tested.basis))
        gaps = [np.isnan(r) for r, _ in held]
        blocks = [np.where(gone[:, :, None], 0.0, X) for gone, X in zip(gaps, blocks, strict=True)]
        J = [
            (np.nan_to_num(j).reshape(r.size, -1), X.reshape(r.size, -1))
            for (r, j), X in zip(held, blocks, strict=True)
        ]
        basis = Basis.of([np.hstack([j[:, :p], X]) for j, X in J], [j[:, p:] for j, _ in J])
        rest = project(np.concatenate([np.nan_to_num(r).ravel() for r, _ in held]), basis)
        ends = np.cumsum([r.size for r, _ in held])[:-1]
        after = [x.reshape(gone.shape) for x, gone in zip(np.split(rest, ends), gaps, strict=True)]
        after = [np.where(gone, np.nan, x) for gone, x in zip(gaps, after, strict=True)]
        found[label] = (seen.gain - 0.5 * float(tested.left @ tested.left), after)
    return found


def _beyond(residuals: Sequence[Array], scales: Array) -> float:
    """Return the excess power of residuals over their innovations.

    It is relative to the power of the innovations, and summed over the outputs.
    """
    # mean square over the innovations, minus one
    left = np.hstack(residuals) / scales[:, None]
    return float(np.sum(np.maximum(over_time(np.mean, left**2) - 1.0, 0.0)))


def _tabulated(fits: SingleFits, form: FreeForm) -> OpenLaw | None:
    """Return the curve as a table, None if it does not improve the fit."""
    fitted, place = form.fitted, form.curve.place
    table, kind = form.table, form.curve.kind
    # limit the knots to the motion of the final fit
    if kind == Tabulated.name:
        table = reached(table, *motion_at(form.fitted, place, 0.0))
    if "offset" in fits.fitted.refinement.roles:  # the offset covers any constant: the force is 0 at rest
        rest = [np.clip(0.0, min(x, default=0.0), max(x, default=0.0)) for x in (table.d, table.v)]
        table = Table(table.d, table.v, np.array(table.force) - table(*rest))
    effect = Effect(kind, place, law=table, name=f"{_NAMES[kind]}, tabulated at {place}")
    # fit of the simulation with the table
    errors = np.hstack([r / fitted.problem.weights[:, None] for r in fitted.residuals()])
    measured = np.hstack([r.outputs for r in fitted.problem.records])
    spread = over_time(np.linalg.norm, measured - over_time(np.mean, measured)[:, None])
    fit = 100.0 * (1.0 - over_time(np.linalg.norm, errors) / np.where(spread > 0, spread, np.inf))
    if fit.mean() <= np.mean(fits.fitted.refinement.fit):
        return None
    rmse = np.sqrt(over_time(np.mean, errors**2))
    near = _nearest(fits, form) if kind == Tabulated.name else ()
    return OpenLaw(effect, float(np.mean(fit)), near, rmse)


def reached(table: Table, d: Array, v: Array) -> Table:
    """Return the same table with knots in the range of a motion only.

    An observer makes larger motions at the start of a record, until it follows.
    """
    kept = []
    # end knots at the ends of the motion, inner knots as they are
    for knots, x in ((table.d, d), (table.v, v)):
        low, high = (float(np.clip(end, knots[0], knots[-1])) if knots else 0.0 for end in (x.min(), x.max()))
        if len(knots) > 1 and not low < high:
            return table
        slack = 1e-6 * (high - low)
        inner = [knot for knot in knots if low + slack < knot < high - slack]
        kept.append([low, *inner, high] if len(knots) > 1 else list(knots))
    at = np.meshgrid(*(each or [0.0] for each in kept), indexing="ij")
    return Table(kept[0], kept[1], table(*at))


def _nearest(fits: SingleFits, form: FreeForm) -> tuple[tuple[Effect, float], ...]:
    """Return the share of the tabulated force that each effect explains [%].

    Only effects at the place of the table count; the motion is that of the fit.
    """
    # regress the tabulated force on each candidate's force at its fitted shape
    d, v = motion_at(form.fitted, form.curve.place, 0.0)
    force = form.table(d, v)
    force = force - force.mean()
    w = np.hstack([record.inputs for record in form.fitted.problem.records])
    rows = []
    for trial in fits.trials:
        effect, shape = trial.effects[0], trial.start.values[0]
        if effect.place != form.curve.place:
            continue
        columns = unit_forces(effect, d, v, [shape], w)
        if columns and force.any():
            F = np.column_stack(columns)
            F = F - F.mean(axis=0)
            left = force - F @ np.linalg.lstsq(F, force, rcond=1e-10)[0]
            rows.append((effect, 100.0 * (1.0 - float(left @ left) / float(force @ force))))
    return tuple(sorted(rows, key=lambda row: -row[1]))


@dataclass(frozen=True, slots=True, eq=False)
class HiddenForce(Result):
    """Unknown force at a place, estimated without a force law.

    The estimate comes from the record and the model.

    Attributes
    ----------
    place : str
        Port.
    timepts : ndarray, shape (N,)
        Time in s.
    d, v : ndarray, shape (N,)
        Displacement and velocity there, 0 where the port senses none.
    force, std : ndarray, shape (N,)
        Resisting force and its standard deviation. Its mean is no part of the estimate: it
        passes for the offset.
    position_unit, velocity_unit, force_unit : str
        Units, "" where unknown.
    """

    place: str
    timepts: Array
    d: Array
    v: Array
    force: Array
    std: Array
    position_unit: str = ""
    velocity_unit: str = ""
    force_unit: str = ""

    @picture
    def plot(self, **options: Unpack[Look]) -> ct.ControlPlot:
        """Plot the force over time, and over displacement and velocity.

        The plot over time shows two standard deviations.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)


def hidden_force(model: Refinement, noise: Array, port: Port, record: Measurement) -> HiddenForce:
    """Estimate the force at a port over a record; see `estimated_force`."""
    force, states, std = estimated_force(model, noise, port, record)
    # motion at the port from the estimated states
    d = port.position @ states + port.position_input @ record.inputs
    v = port.velocity @ states + port.velocity_input @ record.inputs
    spread = 0.0 * force + std
    units = (port.position_unit, port.velocity_unit, port.force_unit)
    return HiddenForce(port.name, record.timepts, d, v, force, spread, *units)


def open_force(search: Search) -> tuple[FreeForces | None, FittedModel]:
    """Return free forces for an unexplained record, and their base model.

    The base is the model as given, unless its re-estimated parameters alone fit better than any free force or
    single effect. The forces are None if no single candidate effect was fitted at the chosen base.
    """
    empty = {trial.hypothesis.key: trial for trial in search.trials if not trial.effects}
    library = set(search.case.library)
    # the model as given first, then with re-estimated parameters
    for nuisances in dict.fromkeys((frozenset[Nuisance](), search.opened)):
        base = search.base(nuisances)
        offered = [x for x in search.ranked() if len(x.effects) == 1 and library.issuperset(x.effects)]
        alone = [x for x in offered if x.base is base]
        if not alone:
            continue
        whitener = base.problem.whitener([r for r, _ in alone[0].blocks])
        free = open_law(SingleFits(base, alone, whitener))
        opened = empty.get((frozenset(), search.opened))
        # the best fit with a force or effect against that of the parameters alone
        after = max(free.fit_after, *(float(np.mean(x.model.refinement.fit)) for x in alone))
        if opened is None or nuisances or after >= float(np.mean(opened.model.refinement.fit)):
            return free, base
    return None, search.base(search.opened)
