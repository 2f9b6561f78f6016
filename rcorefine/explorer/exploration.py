"""State of an exploration: model, record, added effects, undo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.linalg import expm

from rcorefine import (
    Check,
    Comparison,
    Diagnosis,
    Effect,
    Measurement,
    PhysicalModel,
    Refinement,
    check,
    compare,
    diagnose,
    refine,
)

from ..arguments import as_choice, as_instance, as_number
from ..comparison.failure_map.search import Failure
from ..comparison.failure_map.state import ResidualForce, residual_force
from ..data.records import as_record
from ..diagnosis.case import candidates_of, not_held
from ..effects.effect import unit_forces
from ..engine.amplitude_response import engine_on
from ..engine.controlled import checked_horizon
from ..engine.structure import Structure
from ..exceptions import DivergenceError, ModelError, own_arithmetic
from ..inference.assembly import windows
from ..inference.outcome import fit_of, output_weights
from ..inference.problem import Problem, descend, natural_sizes
from ..inference.starts import Motion, estimated_motion, law_widths, shape_starts
from ..models.conversion import as_model, as_physical
from ..models.operating_point import ordered_record
from ..refinement.refine import base_fit
from ..systems.linear import Array, LinearModel
from ..views.code import call_options, comment, effects_code, model_code, record_code, script

_SUBSTEPS = 4  # of a sample, where a law is not linear
_MOST = 10  # evaluations to settle offset and initial state


def key(effect: Effect) -> tuple[str, str]:
    """Return the kind and place that identify an effect in a model."""
    return effect.kind, effect.place


def values_of(model: Refinement, index: int) -> dict[str, float]:
    """Coefficients of an effect of a model, held or estimated."""
    structure, theta, _ = model.simulation_structure()
    return {name: float(structure.value(theta, index, name)) for name in model.effects[index].coefficients}


def with_held(model: Refinement, motion: Motion, effect: Effect, values: Mapping[str, float]) -> Refinement:
    """Return a model with one effect changed or added, the others held.

    Parameters
    ----------
    model : Refinement
        Present model.
    motion : Motion
        Estimated motion, for the widths of laws.
    effect : Effect
        What is moved or added.
    values : dict
        All its coefficients.

    Returns
    -------
    Refinement
        Offsets are all that is estimated in it; they, the initial states, fit and rmse are those of `model`.
    """
    before, theta, substeps = model.simulation_structure()
    effects = [
        each if role == "offset" else _held(each, values_of(model, i))
        for i, (each, role) in enumerate(zip(model.effects, model.roles, strict=True))
    ]
    keys = [key(each) for each in effects]
    at = keys.index(key(effect)) if key(effect) in keys else len(effects)
    effects[at : at + 1] = [_held(effect, values)]
    widths = law_widths(Structure(model.physical_model, effects), motion) | model.constants
    structure = Structure(model.physical_model, effects, constants=widths)
    kept = [before.position(q.effect, q.name) for q in structure.parameters]
    starts = np.zeros((model.initial_states.shape[0], structure.n_states))
    starts[:, : model.initial_states.shape[1]] = model.initial_states
    roles = (*model.roles, "effect")[: len(effects)]
    held = [each.label for each, role in zip(effects, roles, strict=True) if role != "offset"]
    return replace(
        model,
        effects=tuple(effects),
        roles=roles,
        constants=widths,
        theta=theta[kept],
        parameters=tuple(model.parameters[i] for i in kept),
        covariance=model.covariance[np.ix_(kept, kept)],
        initial_states=starts,
        substeps=max(substeps, 1 if structure.is_linear else _SUBSTEPS),
        message=f"Set by hand and not fitted: {', '.join(held)}.",
        warnings=(),
    )


def _held(effect: Effect, values: Mapping[str, float]) -> Effect:
    return effect.replace(start={}, prior={}, fixed={**effect.fixed, **values})


def free_run(model: Refinement, pieces: Sequence[Measurement]) -> Array:
    """Outputs (n_y, N) over the windows of a record, one after the other.

    Raises
    ------
    DivergenceError
        If the model leaves all bounds.
    """
    structure, theta, substeps = model.simulation_structure()
    found = [
        engine_on(structure, piece, substeps=substeps).run(theta, start, sensitivity=False, check=False)
        for piece, start in zip(pieces, model.initial_states, strict=True)
    ]
    runs = np.concatenate([run.outputs for run in found], axis=1)
    if any(run.blew_up >= 0 for run in found) or not np.isfinite(runs).all():
        raise DivergenceError("with these coefficients the model leaves all bounds; move them back")
    return runs


def settled(model: Refinement, pieces: Sequence[Measurement]) -> Refinement:
    """Estimate offsets and initial states with all coefficients held."""
    free_run(model, pieces)  # a divergence is said before anything is estimated
    structure, theta, substeps = model.simulation_structure()
    weights = output_weights(pieces, None)
    problem = Problem(structure, pieces, weights, substeps=substeps, hold_brief=False)
    point = descend(problem, problem.pack(theta, model.initial_states), evaluations=_MOST).point
    theta, starts = problem.unpack(point)
    rows = [
        replace(row, value=row.initial + value, coefficient=value)
        for row, value in zip(model.parameters, theta.tolist(), strict=True)
    ]
    model = replace(model, theta=theta, initial_states=starts, parameters=tuple(rows))
    fit, rmse = fit_of(pieces, [free_run(model, pieces) - np.hstack([p.outputs for p in pieces])])
    return replace(model, fit=fit, rmse=rmse)


def quickly_settled(model: Refinement, pieces: Sequence[Measurement]) -> Array:
    """Simulate with offsets and initial states fitted to the linear part.

    The free run has shape (n_y, N).
    A constant input adds a constant to each output, and a free motion.
    """
    runs = free_run(model, pieces)
    if model.led:
        return runs
    linear = LinearModel.from_statespace(model.system)
    motion, step = linear.C[None], expm(linear.A * pieces[0].dt)
    while motion.shape[0] < max(piece.n_samples for piece in pieces):
        motion, step = np.concatenate([motion, motion @ step]), step @ step
    n, ny = linear.n_states, linear.n_outputs
    width = n * len(pieces) + (ny if "offset" in model.roles else 0)
    blocks = []
    for i, piece in enumerate(pieces):
        block = np.zeros((piece.n_samples, ny, width))
        block[:, :, n * len(pieces) :] = np.eye(ny)[:, : width - n * len(pieces)]
        block[:, :, n * i : n * (i + 1)] = motion[: piece.n_samples]
        blocks.append(block)
    columns, weights = np.concatenate(blocks), output_weights(pieces, None)[:, None]
    rows = (weights * columns).reshape(-1, width)
    error = (weights * (np.hstack([piece.outputs for piece in pieces]) - runs)).T.ravel()
    return np.asarray(runs + (columns @ np.linalg.lstsq(rows.T @ rows, rows.T @ error, rcond=1e-10)[0]).T)


T = TypeVar("T")

_REACH = 3.0  # of its present size that a coefficient is moved to
_STEPS = 20  # of the best share, in which candidates are ordered


def _given(value: T | None, kind: type[T], name: str) -> T | None:
    return None if value is None else as_instance(value, kind, name)


def _at_channel(row: Failure | None) -> bool:
    """Return whether a failure lies at an input or an output.

    No force acts there.
    """
    return row is not None and (row.dimension == "time" or "input" in row.values)


@dataclass(frozen=True, slots=True, eq=False)
class ExplorationStep:
    """One step of an exploration.

    Attributes
    ----------
    action : str
        "start", "add", "move" (a coefficient was set by hand) or "fit".
    name : str
        The same in words.
    effects : tuple of Effect
        Those added so far; what was set by hand is in `Effect.fixed`.
    refinement : Refinement
        The model with them.
    runs : ndarray, shape (n_y, N)
        Its free run.
    fit : ndarray, shape (n_y,)
        In percent, as in `Refinement.fit`.
    """

    action: str
    name: str
    effects: tuple[Effect, ...]
    refinement: Refinement
    runs: Array
    fit: Array

    @property
    def error(self) -> float:
        """Mean of 100 minus the fit over the outputs, in percent.

        It is the part of the outputs that the model does not explain.
        """
        return 100.0 - float(np.nanmean(self.fit))


class Exploration:
    """A model beside a record, to which effects are added by hand.

    Each change is a step, and `undo` takes the last one back. The constant offset of the record and the
    initial state are estimated from the start, as `refine` does.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement
        Record.
    horizon : float, optional
        Length in s of the free runs, as in `refine`.

    Raises
    ------
    control.ControlArgument
        If the data are no record in time.
    DivergenceError
        If the free run of the model leaves all bounds.

    Examples
    --------
    >>> from rcorefine.explorer import Exploration
    >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> true = rco.mass_spring_damper([1.0], [0.4], [90.0], sensors="displacement")
    >>> force = np.random.default_rng(0).standard_normal(600)
    >>> y = rco.simulate(true, rco.Measurement(force, np.zeros(600), dt=0.02), "zero").outputs
    >>> tried = Exploration(model, rco.Measurement(force, y, dt=0.02))
    >>> tried.add(rco.Effect("stiffness", "link1"), stiffness=-5.0).error < tried.steps[0].error
    True
    >>> round(tried.fit().refinement.parameter("stiffness").value, 3)
    90.0
    """

    def __init__(self, model: Any, data: Measurement, *, horizon: float | None = None) -> None:
        self.model, self.data, self.horizon = as_model(model), as_record(data), checked_horizon(horizon)
        self.physical = as_physical(self.model)
        #: the record in the order of the model's channels, above its operating point
        self.record: Measurement = ordered_record(self.physical, data)
        self._pieces, self.note = windows(self.physical, [self.record], horizon)
        with own_arithmetic():
            base = base_fit(
                self.model, [data], free=(), tolerance=0.0, offset=True, noise=None, horizon=horizon
            )
        self._steps = [self._step("start", "initial model", (), base)]
        self._compared: tuple[ExplorationStep, Comparison] | None = None

    # ------------------------------------------------------------------ where it stands
    @property
    def steps(self) -> tuple[ExplorationStep, ...]:
        """All steps that count, the initial model first."""
        return tuple(self._steps)

    @property
    def refinement(self) -> Refinement:
        """The present model, which `compare`, `refine` and the others take."""
        return self._steps[-1].refinement

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects added so far."""
        return self._steps[-1].effects

    @property
    def error(self) -> float:
        """Part of the record that the present model misses, in percent."""
        return self._steps[-1].error

    @property
    def comparison(self) -> Comparison:
        """Comparison of the present model with the record, as by `compare`.

        Its `failures` list where the model fails.
        """
        now = self._steps[-1]
        if self._compared is None or self._compared[0] is not now:
            self._compared = now, compare(now.refinement, self.data, horizon=self.horizon)
        return self._compared[1]

    def coefficients(self, effect: Effect) -> dict[str, float]:
        """Present values of an added effect, in the model's units."""
        return values_of(self.refinement, self._index(effect))

    def units(self, effect: Effect) -> dict[str, str]:
        """Unit of each coefficient of an effect, "" where unknown."""
        structure = self._alone(effect)
        return {q.name: structure.unit(q) for q in structure.parameters}

    def reach(self, effect: Effect, name: str) -> tuple[float, float]:
        """Return the range in which it is useful to vary a coefficient.

        The range depends on the present value and stays inside the bounds.
        """
        structure = self._alone(effect)
        names = [q.name for q in structure.parameters]
        at = names.index(as_choice(name, "name", names))
        bound = structure.parameters[at]
        size = abs(self.coefficients(effect)[name]) or float(natural_sizes(structure, [self.record])[at])
        return max(bound.lower, -_REACH * size), min(bound.upper, _REACH * size)

    # ------------------------------------------------------------------ what could be missing
    @cached_property
    def motion(self) -> Motion:
        """Motion at the ports as the record and the initial model show it."""
        return estimated_motion(Structure(self.physical), np.zeros(0), self.record)

    def force(self, row: Failure | None = None) -> ResidualForce | None:
        """Return the force that the present model lacks at a failure.

        The failure is a row of its failure map. By default, and where the row has no place, the force is that
        at the place that explains most of the record. It is None for a row at an input or an output, and for
        a model without places.
        """
        row = _given(row, Failure, "row")
        place = None if row is None else row.values.get("place")
        return None if _at_channel(row) else residual_force(self.comparison, 0, place)

    def candidates(self, row: Failure | None = None, force: ResidualForce | None = None) -> list[Addition]:
        """Return the effects that could explain a row of the failure map.

        Effects that the model already holds are left out. By default, all others are returned. With `force`,
        their force laws are fitted to it, and those that explain most come first.
        """
        row, force = _given(row, Failure, "row"), _given(force, ResidualForce, "force")
        library = not_held(candidates_of(self.physical), self.refinement.effects)
        if _at_channel(row):
            library = [effect for effect in library if effect.spec.at_channel]
        elif force is not None:
            library = [effect for effect in library if effect.place == force.place]
        found = [laid_over(one, self.physical, self.motion, self.record.inputs, force) for one in library]
        best = max((one.share for one in found if one.share > 0), default=1.0)

        def rank(one: Addition) -> tuple[int, int]:  # of those that explain about the same, the simplest
            share = -1 if one.curve is None else round(_STEPS * max(one.share, 0.0) / best)
            return -share, len(one.coefficients)

        return sorted(found, key=rank)

    # ------------------------------------------------------------------ what can be done
    def add(self, effect: Effect, **values: float) -> ExplorationStep:
        """Add an effect with coefficients set by hand.

        Coefficients that are left out get the value at which the effect is absent, or a small one.

        Raises
        ------
        ModelError
            If the model holds it already, or it does not fit.
        DivergenceError
            If the model leaves all bounds with it; nothing has changed then.
        """
        if key(as_instance(effect, Effect, "effect")) in map(key, self.refinement.effects):
            raise ModelError(f"the model holds {effect.label} already; move its coefficient")
        with own_arithmetic():
            model = settled(self._changed(effect, values), self._pieces)
            return self._enter(self._step("add", f"add {effect.label}", (*self.effects, effect), model))

    def move(self, effect: Effect, **values: float) -> ExplorationStep:
        """Set coefficients of an added effect by hand.

        The offset and the initial state are estimated again.
        Moves of one effect after the other are one step. Raises as `add`.
        """
        self._index(effect)
        with own_arithmetic():
            model = settled(self._changed(effect, values), self._pieces)
            step = self._enter(self._step("move", f"move {effect.label}", self.effects, model))
        if self._steps[-2].name == step.name:
            del self._steps[-2]
        return step

    def preview(self, effect: Effect, **values: float) -> tuple[Array, float]:
        """Return the free run and its error with coefficients changed.

        The run has shape (n_y, N), the error is in percent. The call is fast enough to follow a slider.
        Nothing is changed. Offset and initial state are estimated as for the linear part of the model; `move`
        does it for the whole. Raises as `add`.
        """
        self._index(effect)
        with own_arithmetic():
            runs = quickly_settled(self._changed(effect, values), self._pieces)
        return runs, 100.0 - float(np.nanmean(fit_of([self.record], [runs - self.record.outputs])[0]))

    def fit(self) -> ExplorationStep:
        """Estimate all added effects together.

        The result is that of ``refine(model, data, effects)``.
        """
        found = refine(self.model, self.data, self.effects, horizon=self.horizon)
        return self._enter(self._step("fit", "fit", self.effects, found))

    def undo(self) -> ExplorationStep:
        """Undo the last step and return the one before.

        The initial model always remains.
        """
        if len(self._steps) > 1:
            del self._steps[-1]
        return self._steps[-1]

    # ------------------------------------------------------------------ what is asked of it
    def diagnose(self) -> Diagnosis:
        """Verdict on the present model: whether anything is still missing."""
        return diagnose(self.refinement, self.data, horizon=self.horizon)

    def check(self) -> Check:
        """Check the record, and the initial model beside it."""
        return check(self.model, self.data)

    def script(self) -> str:
        """Return a Python program that reproduces the present model.

        Coefficients set by hand are held; the others are fitted.
        """
        start = self._steps[0].refinement
        held = [e for e, role in zip(start.effects, start.roles, strict=True) if role != "offset"]
        added = [self.refinement.effects[self._index(effect)] for effect in self.effects]
        lines = [
            f"effects = {effects_code([*held, *added])}",
            f"better = rco.refine(model, data, effects{call_options({'horizon': self.horizon})})",
            "print(better)",
            f"print(rco.compare([model, better], data{call_options({'horizon': self.horizon})}))",
        ]
        return script(["# the initial model", *model_code(self.physical)], record_code([self.data]), lines)

    def report(self, path: str | PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the report of the present model beside the record.

        It contains the steps and the script.
        Raises as `Refinement.report`.
        """
        steps = [comment(f"{step.name}: error {step.error:.3g} %") for step in self._steps]
        code = "\n".join(["# the steps by hand", *steps, "", self.script()])
        title = f"Exploration of {self.physical.name}"
        return self.refinement.report(path, data=self.data, title=title, code=code, overwrite=overwrite)

    # ------------------------------------------------------------------ how it is done
    def _index(self, effect: Effect) -> int:
        as_instance(effect, Effect, "effect")
        keys = [key(each) for each in self.refinement.effects]
        if not self._added(effect):
            known = ", ".join(each.label for each in self.effects) or "none"
            raise ModelError(f"{effect.label} was not added; there are {known}")
        return keys.index(key(effect))

    def _alone(self, effect: Effect) -> Structure:
        """The model with one effect whose coefficients are all free."""
        free = as_instance(effect, Effect, "effect").replace(fixed={}, start={}, prior={})
        return Structure(self.physical, [free])

    def _added(self, effect: Effect) -> bool:
        return key(effect) in map(key, self.effects)

    def _changed(self, effect: Effect, values: Mapping[str, float]) -> Refinement:
        """Return the present model with an effect changed or added."""
        unknown = [name for name in values if name not in effect.coefficients]
        if unknown:
            raise ModelError(f"{effect.label} has no {unknown[0]}, only {', '.join(effect.coefficients)}")
        given = {name: as_number(value, name) for name, value in values.items()}
        if self._added(effect):
            first = self.coefficients(effect)
        else:
            first = laid_over(effect, self.physical, self.motion, self.record.inputs, None).coefficients
        return with_held(self.refinement, self.motion, effect, first | given)

    def _step(
        self, action: str, name: str, effects: tuple[Effect, ...], model: Refinement
    ) -> ExplorationStep:
        return ExplorationStep(action, name, effects, model, free_run(model, self._pieces), model.fit)

    def _enter(self, step: ExplorationStep) -> ExplorationStep:
        self._steps.append(step)
        return step


_EDGE = 50  # part of a record at each end where a force is only half known


@dataclass(frozen=True, slots=True, eq=False)
class Addition:
    """An effect that could be added.

    Attributes
    ----------
    effect : Effect
        Kind and place.
    coefficients : dict
        Where to begin: from the force, where the law lies over one, else where it is absent or small.
    share : float
        Part of the lacking force that it explains, 0 to 1; NaN where it is no force along the motion.
    curve : ndarray, shape (N,), or None
        Its force along the motion.
    """

    effect: Effect
    coefficients: dict[str, float]
    share: float = np.nan
    curve: Array | None = None


def laid_over(
    effect: Effect, physical: PhysicalModel, motion: Motion, inputs: Array, force: ResidualForce | None
) -> Addition:
    """Fit the shape and the coefficients of an effect to a force.

    Parameters
    ----------
    effect : Effect
        Law at a place.
    physical : PhysicalModel
        Model.
    motion : Motion
        Estimated motion, which proposes shapes.
    inputs : ndarray, shape (n_w, N)
        Of the record.
    force : ResidualForce or None
        What is to be explained.

    Returns
    -------
    Candidate
    """
    structure = Structure(physical, [effect])
    starts = [
        {q.name: float(value) for q, value in zip(structure.parameters, theta, strict=True)}
        for theta in shape_starts(structure, structure.start(), motion)
    ]
    best = Addition(effect, _ordered(effect, dict(starts[0])))
    if force is None or force.place != effect.place:
        return best
    levels = [q for q in structure.parameters if q.name not in effect.spec.shaping]
    edge = force.force.size // _EDGE
    inner = slice(edge, force.force.size - edge)
    wanted = force.force[inner] - force.force[inner].mean()
    for start in starts:
        shape = {name: value for name, value in start.items() if name in effect.spec.shaping}
        columns = unit_forces(effect, force.position, force.velocity, [shape], inputs)
        if columns is None or len(columns) != len(levels) or not np.isfinite(columns).all():
            continue
        F = np.array(columns).T
        about = F[inner] - F[inner].mean(axis=0)
        values = np.linalg.lstsq(about, wanted, rcond=1e-10)[0]
        values = np.clip(values, [q.lower for q in levels], [q.upper for q in levels])
        named = _ordered(effect, start | {q.name: float(v) for q, v in zip(levels, values, strict=True)})
        values = np.array([named[q.name] for q in levels])
        left = float(np.sum((wanted - about @ values) ** 2))
        share = 1.0 - left / max(float(np.sum(wanted**2)), 1e-300)
        if not share <= best.share:  # NaN is the first
            best = Addition(effect, named, share, F @ values)
    return best


def _ordered(effect: Effect, values: dict[str, float]) -> dict[str, float]:
    """Coefficients of which one is never below another, kept so."""
    for larger, smaller in effect.spec.order:
        values[larger] = max(values[larger], values[smaller])
    return values
