"""Batch fit of effects, linear parameters, offsets and initial states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_whole
from ..data.measurement import Measurement
from ..data.records import as_data
from ..effects.effect import Effect, as_effects
from ..engine.engine import MOST_SUBSTEPS
from ..engine.simulation import check_records
from ..engine.structure import Structure
from ..exceptions import own_arithmetic
from ..inference.assembly import assemble, check_settings, offset_variants, unfold, windows
from ..inference.doubts import doubted
from ..inference.fit import Fit
from ..inference.outcome import output_weights, package
from ..inference.problem import descend
from ..inference.refinement import Refinement
from ..inference.search import starting_states
from ..inference.starts import estimated_motion, law_widths
from ..models.controller import Controller
from ..models.conversion import under_control
from ..models.operating_point import ordered_record, start_above
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array

_Roles = list[tuple[Effect, str]]


def refine(
    model: Any,
    data: Measurement | Sequence[Measurement],
    effects: Sequence[Effect] = (),
    *,
    free: str | Sequence[Any] = (),
    tolerance: float = 0.0,
    offset: bool = True,
    x0: str | Array = "estimate",
    noise: float | Sequence[float] | None = None,
    horizon: float | None = None,
    substeps: int | None = None,
    controller: Controller | ct.StateSpace | None = None,
) -> Refinement:
    """Add effects to a model and estimate them from a record.

    A recursive-type pass (an observer holds the state near the record) finds the
    valley, a free-run least-squares fit on exact sensitivities polishes.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time. Effects that a Refinement holds already are
        estimated again, together with the new ones.
    data : Measurement or list of Measurement
        Record, or segments that share the coefficients but not the initial state. Or a
        `FrequencyResponse` or a list of them at several amplitudes, which have neither `x0`, `horizon`,
        `noise` (they hold their `std`), `substeps` nor offsets.
    effects : sequence of Effect
        What to add.
    free : "linear" or sequence
        "linear" lets every linear parameter of the model float (stiffness, damping,
        input gain, ...) but those that only rescale others; a sequence names some of
        them (parameter names or effects).
    tolerance : float
        Relative prior standard deviation of the linear parameters; with a positive
        one and nothing in `free`, all of them float within it.
    offset : bool
        Estimate a constant sensor offset, or an actuator offset where the model
        integrates: a nuisance that would otherwise spoil the effects.
    x0 : {"estimate", "zero"} or ndarray of shape (n,)
        Initial state of every record.
    noise : float or sequence of float, optional
        Known sensor noise (standard deviation per output); estimated by default.
    horizon : float, optional
        Length in seconds of the free runs: the record is cut into windows with an estimated
        initial state each (so it excludes a given `x0`), in the whole number of equal windows
        that comes nearest. Default: the whole record; one tenth of it where the model
        integrates, because a free run then drifts without bound. The same in `compare`,
        `diagnose` and `improve`.
    substeps : int, optional
        Substeps per sample for nonlinear effects; by default as many as shift no
        coefficient by a third of its standard deviation when they are doubled.
    controller : Controller, StateSpace or TransferFunction, optional
        Controller under which the record was taken: `simulate` and `compare` run the model in its loop,
        and what is fitted needs no windows. Its signals are joined by name, as by
        `control.interconnect`: inputs named as outputs of the model read them, other inputs are
        references that the record holds, outputs drive the inputs of that name. Without names it is the
        negative feedback of ``control.feedback(model, controller)``. Sampled at the time of the record,
        or continuous. Where the record holds the input that it drives, that is what the plant received,
        and no reference is needed; else it is worked out from what the controller read. Its numbers are
        never estimated. `Controller` adds a dead time and limits of the actuator inside the loop.

    Returns
    -------
    Refinement
        Estimates with standard deviations, and the refined model.

    Raises
    ------
    ModelError
        If a place does not exist or an effect is named twice.
    control.ControlDimension
        If the record's channels are not the model's.
    control.ControlArgument
        If an argument is of the wrong kind or out of its range.
    DataError
        If the record is too short for the number of unknowns.

    Warns
    -----
    IdentifiabilityWarning
        Names the combination of parameters that the record cannot see, and what speaks against
        the estimate: an output that does not move or has the wrong sign, a free run that explains
        nothing, modes above half the sampling frequency, error bars that do not hold. Where it
        means nothing for that, `success` is False.

    Notes
    -----
    The covariance is that of the output-error estimate under coloured residuals
    (Ljung, System Identification, sec. 9.3), with an autoregressive residual model.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> chain = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> true = rco.mass_spring_damper([1.0], [0.4], [90.0], sensors="displacement")
    >>> force = np.random.default_rng(0).standard_normal(2000)
    >>> blank = rco.Measurement(force, np.zeros(2000), dt=0.02)
    >>> data = rco.Measurement(force, rco.simulate(true, blank, "zero").outputs, dt=0.02)
    >>> better = rco.refine(chain, data, [rco.Effect("stiffness", "link1")])
    >>> round(better.parameters[0].value, 3)
    90.0
    """
    given = as_data(data, x0=x0, horizon=horizon, noise=noise, controller=controller)
    physical, kept = unfold(under_control(model, controller, data))
    # channels in the order of the model
    records = [ordered_record(physical, record) for record in given]
    # known initial state as a deviation from the operating point
    check_records(physical.linear, given, records, "refine")
    initial = start_above(physical, x0)
    if substeps is not None:
        substeps = as_whole(substeps, "substeps", least=1, most=MOST_SUBSTEPS)
    effects = as_effects(effects, "effects")
    check_settings(
        physical,
        free=free,
        tolerance=tolerance,
        offset=offset,
        noise=noise,
        horizon=horizon,
        known_start=initial is not None,
    )
    with own_arithmetic():
        # windows of the free runs, each with an initial state of its own
        segments, note = windows(physical, records, horizon, known_start=initial is not None)
        bare = Structure(physical)
        # motion at the places, estimated by an observer: for shapes and widths of the laws
        motion, *motion.companions = [estimated_motion(bare, np.zeros(0), record) for record in records]
        best: Fit | None = None
        # one fit for each possible place of the offsets; the lowest cost counts
        for offsets in offset_variants(physical, records[0], offset):
            chosen = assemble(physical, kept, effects, free, tolerance, offsets)
            structure = Structure(physical, [e for e, _ in chosen])
            structure = Structure(physical, structure.effects, constants=law_widths(structure, motion))
            if best is not None and (
                structure.is_linear or structure.n_parameters != best.structure.n_parameters
            ):
                continue  # behind a linear model all offsets are the same
            fit = Fit(structure, [role for _, role in chosen], segments, noise, initial, tolerance)
            fit.run(motion, substeps, near=best)
            if best is None or fit.cost < best.cost:
                best = fit
        assert best is not None
        chosen_fit = best

        # the same fit on other data, to check the result
        def again(pieces: list[Measurement]) -> Fit:
            other = Fit(chosen_fit.structure, chosen_fit.roles, pieces, noise, initial, tolerance)
            other.run(estimated_motion(bare, np.zeros(0), pieces[0]), substeps)
            return other

        # standard deviations, and reasons not to trust the estimate
        found = package(best, physical, note, given)
        return found if found.of_responses else doubted(found, best, again)


def refit(
    model: Refinement,
    data: Measurement | Sequence[Measurement],
    *,
    without: Effect | None = None,
    offsets: Sequence[Effect] | None = None,
    elsewhere: bool = True,
    tolerance: float = 0.0,
    offset: bool = True,
    noise: float | Sequence[float] | None = None,
    horizon: float | None = None,
) -> Refinement:
    """Fit a refinement again, starting from its present values.

    The fit uses these records and makes no search.

    Parameters
    ----------
    model : Refinement
        Where to start.
    data : Measurement or list of Measurement
        Record, or several.
    without : Effect, optional
        An effect of the model to leave out.
    offsets : sequence of Effect, optional
        Constant offsets in place of its own.
    elsewhere : bool
        Whether the offset of a nonlinear model tries its other place too.
    tolerance, offset, noise, horizon
        As in `refine`.

    Returns
    -------
    Refinement
    """
    physical, kept = unfold(model)
    given = as_data(data)
    records = [ordered_record(physical, r) for r in given]
    segments, note = windows(physical, records, horizon)
    # smoothing widths of the laws stay as they are
    widths = {e.key: model.constants[i] for i, (e, _) in enumerate(kept) if i in model.constants}
    if without is not None:
        kept = [(e, role) for e, role in kept if e.key != without.key]
    if offsets is not None:
        kept = _with_offsets(kept, offsets)
    others = _other_offsets(kept, physical, records[0], offset) if elsewhere else []
    best: Fit | None = None
    states = model.initial_states
    for chosen in (kept, *others):
        structure = _with_widths(physical, chosen, widths)
        if best is not None and structure.is_linear:
            break  # behind a linear model all offsets are the same
        # local fit from the present values
        fit = Fit(structure, [role for _, role in chosen], segments, noise, None, tolerance)
        fit.resume(model.substeps, states)
        best = min(filter(None, (best, fit)), key=lambda each: each.cost)
        states = best.problem.unpack(best.result.point)[1]
    assert best is not None
    return package(best, physical, note, given)


def _with_widths(physical: PhysicalModel, chosen: _Roles, widths: dict[str, float]) -> Structure:
    """Return the structure of effects whose laws keep their widths."""
    effects = [e for e, _ in chosen]
    known = {i: widths[e.key] for i, e in enumerate(effects) if e.key in widths}
    return Structure(physical, effects, constants=known)


def _other_offsets(kept: _Roles, physical: PhysicalModel, record: Measurement, offset: bool) -> list[_Roles]:
    """Return the effects with the constant offset at another place."""
    mine = {e.key for e, role in kept if role == "offset"}
    found = []
    for offsets in offset_variants(physical, record, offset):
        # another place with as many offsets
        places = {e.key for e in offsets}
        if mine and places != mine and len(places) == len(mine):
            found.append(_with_offsets(kept, offsets))
    return found


def _with_offsets(kept: _Roles, offsets: Sequence[Effect]) -> _Roles:
    """Return the effects with these constant offsets in place of their own."""
    return [(e, role) for e, role in kept if role != "offset"] + [(e, "offset") for e in offsets]


def base_fit(
    model: Any,
    records: Sequence[Measurement],
    *,
    free: Any,
    tolerance: float,
    offset: bool,
    noise: Any,
    horizon: float | None = None,
) -> Refinement:
    """The model fitted as far as it is declared to be free.

    Where its numbers are trusted, or known to within a prior, the minimum is next to them and no
    search is needed.
    """
    # free parameters without a prior may be far off: the full search
    if len(free) and tolerance == 0 and not all(isinstance(e, Effect) and e.prior for e in free):
        return refine(
            model, records, free=free, tolerance=tolerance, offset=offset, noise=noise, horizon=horizon
        )
    physical, kept = unfold(model)
    ordered = [ordered_record(physical, r) for r in records]
    check_records(physical.linear, records, ordered, "diagnose")
    segments, note = windows(physical, ordered, horizon)
    # otherwise a local fit from the nominal values
    chosen = assemble(physical, kept, (), free, tolerance, offset_variants(physical, ordered[0], offset)[0])
    structure = Structure(physical, [e for e, _ in chosen], constants=getattr(model, "constants", None))
    fit = Fit(structure, [role for _, role in chosen], segments, noise, None, tolerance)
    fit.steps = getattr(model, "substeps", 1)
    if structure.field is not None:  # a nonlinear model needs substeps even without effects
        fit.resume(fit.steps, np.zeros((0, 0)))
        return package(fit, physical, note, records)
    # free run from estimated initial states
    fit.problem = fit.build(segments, fit.steps)
    theta = structure.start()
    point = fit.problem.pack(theta, starting_states(fit.problem, theta))
    fit.result = descend(fit.problem, point, evaluations=30)
    for _ in range(2):  # noise levels from the residual, then the weight of the priors
        fit.weights = output_weights(segments, noise, fit.problem, fit.result.point)
        fit.problem = fit.build(segments, fit.steps)
        fit.result = descend(fit.problem, fit.result.point, evaluations=30, tolerance=0.0, unnoticed=1e-4)
        if noise is not None or (structure.n_outputs == 1 and tolerance == 0):
            break
    return package(fit, physical, note, records)
