"""Sensitivity of the residual to each candidate and generic fault."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..effects.effect import Effect, unit_forces
from ..effects.law import Law
from ..engine.amplitude_response import ResponseEngine, engine_on
from ..engine.controlled import sample_jumps
from ..engine.engine import Engine
from ..engine.linear import linear_responses
from ..engine.point import resting
from ..engine.structure import Structure
from ..models.ports import felt
from ..systems.discretization import discretize
from ..systems.linear import Array
from .fitted import FittedModel
from .problem import Problem
from .starts import Motion, law_widths, shape_starts

_DIVERGED = 1e100  # columns above this, in units of the noise, would overflow when squared


@dataclass(eq=False)
class Candidate:
    """Candidate effect with its sensitivities and its problem.

    The problem is made on demand.
    """

    effect: Effect
    columns: dict[float, list[Array]]  # by observer ratio: blocks (n_y, N, k) per record
    fitted: FittedModel
    motion: Motion
    _made: tuple[Problem, list[Array]] | None = None

    def _make(self) -> tuple[Problem, list[Array]]:
        if self._made is None:
            # problem with the effect absent, one starting point for each shape
            problem, point = self.fitted.extended([self.effect], self.motion)
            theta = problem.unpack(point)[0]
            p = self.fitted.structure.n_parameters
            starts, known = [], len(self.fitted.structure.effects)
            for shape in shape_starts(problem.structure, theta, self.motion, known):
                shifted = point.copy()
                shifted[p : theta.size] = shape[p:]
                starts.append(problem.inside(shifted))
            self._made = problem, starts
        return self._made

    @property
    def problem(self) -> Problem:
        """Estimation problem with the effect added."""
        return self._make()[0]

    @property
    def starts(self) -> list[Array]:
        """Points to start from: the effect absent, in each shape worth trying."""
        return self._make()[1]


def candidate_columns(
    fitted: FittedModel, effects: Sequence[Effect], motion: Motion, ratios: Sequence[float]
) -> list[Candidate]:
    """Sensitivity of the residual to each candidate about the fitted model.

    Linear candidates ride along in one simulation, each absent yet with its derivative
    carried; the forces of nonlinear laws are taken along the motion and sent through the
    linearized model; what sits in the signal path has a simulation of its own.

    Parameters
    ----------
    fitted : FittedModel
        Model at its minimum.
    effects : sequence of Effect
        Candidates.
    motion : Motion
        Estimated motion, for the shapes of the laws.
    ratios : sequence of float
        Observer ratios, 0 for the free run.

    Returns
    -------
    list of Candidate
    """
    found = [Candidate(effect, {}, fitted, motion) for effect in effects]
    # three kinds: a simulation of its own, parameters in one simulation, force laws along the motion
    alone: list[Candidate] = []
    riders: list[Candidate] = []
    laws: list[tuple[Candidate, list[dict[str, float]]]] = []
    for each in found:
        if _runs_alone(fitted, each.effect.spec):
            alone.append(each)
        elif each.effect.spec.is_parameter:
            riders.append(each)
        else:
            laws.append((each, _shapes(each)))
    for ratio in dict.fromkeys(ratios):
        for each in alone:
            each.columns[ratio] = _own_columns(each, ratio)
        # one simulation carries the derivatives by all parameters
        blocks = parameter_columns(fitted, [each.effect for each in riders], motion, ratio) if riders else []
        for j, each in enumerate(riders):
            each.columns[ratio] = [block[:, :, j : j + 1] for block in blocks]
        # forces of all laws go through the linearized model together
        _law_columns(fitted, laws, ratio)
    for each in found:
        each.columns = {ratio: _bounded(blocks) for ratio, blocks in each.columns.items()}
    return found


def _bounded(blocks: list[Array]) -> list[Array]:
    """Set columns that diverge in one of the records to zero."""
    largest = np.max([np.abs(block).max(axis=(0, 1)) for block in blocks], axis=0)
    return [np.where(largest < _DIVERGED, block, 0.0) for block in blocks]


def _runs_alone(fitted: FittedModel, law: Law) -> bool:
    """Return whether an effect needs a simulation of its own.

    Effects at channels and on nonlinear models do.
    """
    if not fitted.problem.in_time or law.secant or law.at_channel:
        return True
    filling = "acceleration" in law.senses and not law.linear
    return filling or (fitted.structure.field is not None and not law.is_parameter)


def _law_columns(
    fitted: FittedModel, laws: list[tuple[Candidate, list[dict[str, float]]]], ratio: float
) -> None:
    """Compute the columns of nonlinear effects at places.

    They are the outputs that the forces of the effects along the motion would add.
    """
    gain = fitted.gain(ratio)
    for record, data in enumerate(fitted.problem.records):
        forces: list[tuple[str, Array]] = []
        owners: list[Candidate] = []
        for candidate, shapes in laws:
            # force of a unit coefficient in each shape, along the motion
            effect = candidate.effect
            d, v = fitted.port(effect.place, ratio, record)
            columns = unit_forces(effect, d, v, shapes, data.inputs, resting(fitted.structure, effect.place))
            if columns is None:
                candidate.columns[ratio] = _own_columns(candidate, ratio)
                continue
            forces += [(effect.place, column) for column in columns]
            owners += [candidate] * len(columns)
        if not forces:
            continue
        # outputs that these forces add, (n_y, N, k)
        out = force_responses(fitted, record, forces, gain)
        for candidate in dict.fromkeys(owners):
            mine = np.array([owner is candidate for owner in owners])
            candidate.columns.setdefault(ratio, []).append(out[:, :, mine])


def _shapes(candidate: Candidate) -> list[dict[str, float]]:
    """Values of the coefficients that shape the law, each set worth trying."""
    effect = candidate.effect
    structure = Structure(candidate.fitted.structure.model, [effect])
    sets: list[dict[str, float]] = []
    # effect alone on the model: its shapes do not depend on the other effects
    for theta in shape_starts(structure, structure.start(), candidate.motion):
        shape = {
            q.name: float(theta[i])
            for i, q in enumerate(structure.parameters)
            if q.name in effect.spec.shaping
        }
        if shape not in sets:
            sets.append(shape)
    return sets


def parameter_columns(
    fitted: FittedModel, effects: Sequence[Effect], motion: Motion, ratio: float
) -> list[Array]:
    """Columns (n_y, N, k) per record of changes of the model's own parameters."""
    structure, theta, engines = _carrier(fitted, effects, motion)
    # columns after those of the fitted coefficients
    p = fitted.structure.n_parameters
    return [b[:, :, p:] for b in _sensitivities(fitted, structure, theta, engines, fitted.gain(ratio))]


def _carrier(
    fitted: FittedModel, effects: Sequence[Effect], motion: Motion
) -> tuple[Structure, Array, list[Engine | ResponseEngine]]:
    old = fitted.refinement
    # model with all effects; the added ones are absent
    base = Structure(old.physical_model, [*old.effects, *effects])
    widths = law_widths(base, motion)
    widths.update(old.constants)
    structure = Structure(old.physical_model, base.effects, constants=widths)
    theta = np.concatenate([fitted.theta, structure.start()[fitted.theta.size :]])
    engines = [engine_on(structure, r, substeps=old.substeps) for r in fitted.problem.records]
    return structure, theta, engines


def _sensitivities(
    fitted: FittedModel,
    structure: Structure,
    theta: Array,
    engines: Sequence[Engine | ResponseEngine],
    gain: Array | None,
) -> list[Array]:
    starts = fitted.problem.unpack(fitted.point)[1]
    blocks = []
    for engine, start in zip(engines, starts, strict=True):
        # states of the added effects start at zero, and no observer corrects them
        x0 = np.pad(start, (0, structure.n_states - start.size))
        K = None if gain is None else np.pad(gain, ((0, structure.n_states - gain.shape[0]), (0, 0)))
        run = engine.run(theta, x0, gain=K, check=False)
        blocks.append(np.nan_to_num(run.sensitivity) * fitted.problem.weights[:, None, None])
    return blocks


def _own_columns(candidate: Candidate, ratio: float) -> list[Array]:
    fitted, problem = candidate.fitted, candidate.problem
    p, secant = fitted.problem.n_theta, candidate.effect.spec.secant
    gain = fitted.gain(ratio)
    K = None if gain is None else np.pad(gain, ((0, problem.n_states - gain.shape[0]), (0, 0)))
    wide: list[list[Array]] = [[] for _ in problem.records]
    # one block of columns for each starting point
    for start in candidate.starts:
        theta, states = problem.unpack(start)
        if not problem.in_time and not secant:
            for engine, base in zip(problem.engines, fitted.problem.engines, strict=True):
                engine.begin(base)  # the effect is absent: start from the solution of the model
        judged = fitted.problem.judged(fitted.theta) if secant else problem.judged(theta)
        for i, engine in enumerate(problem.engines):
            # a secant is a difference and needs no derivatives
            run = engine.run(theta, states[i], sensitivity=not secant, gain=K, check=False)
            weights = problem.weights[:, None] * judged[i]
            # secant: residual with the effect less that without
            if secant:
                change = weights * (run.outputs - engine.data.outputs) - fitted.blocks(ratio)[i][0]
                column = change[:, :, None]
            else:
                column = weights[:, :, None] * run.sensitivity[:, :, p:]
            sound = np.isfinite(column[~np.isnan(judged[i])]).all()
            ok = run.blew_up < 0 and np.isfinite(run.outputs).all() and sound
            wide[i].append(column if ok else np.zeros_like(column))
    return [np.concatenate(parts, axis=2) for parts in wide]


def generic_forces(fitted: FittedModel, ratio: float, record: int) -> list[tuple[str, Array]]:
    """Return generic forces of unlisted effects at every place.

    Each entry is (place, force of shape (N,)). The force laws are in no library.
    """
    forces = []
    for port in fitted.structure.model.ports:
        d, v = fitted.port(port.name, ratio, record)
        rms_d, rms_v = (float(np.sqrt(np.mean(s**2))) or 1.0 for s in (d, v))
        # in units of the rms motion
        d, v = d / rms_d, v / rms_v
        laws = [v, np.sign(v), v * np.abs(v), v**3, np.abs(v)]
        if port.position.any() or port.position_input.any():
            laws += [d, d * d, d**3, d * np.abs(d), d**5, np.abs(d), d * np.abs(v), np.abs(d) * v, d * d * v]
        forces += [(port.name, law) for law in laws]
    return forces


def slow_forces(fitted: FittedModel, ratio: float, record: int) -> list[tuple[str, Array]]:
    """Forces of stiffness and damping that change over the record."""
    # slow functions of time: linear, quadratic, one period of sine and cosine
    t = np.linspace(-1.0, 1.0, fitted.problem.records[record].n_samples)
    shapes = [t, t * t, np.sin(2 * np.pi * t), np.cos(2 * np.pi * t)]
    forces = []
    for port in fitted.structure.model.ports:
        moved = [signal for signal in fitted.port(port.name, ratio, record) if np.any(signal)]
        forces += [(port.name, signal * shape) for signal in moved for shape in shapes]
    return forces


def force_responses(
    fitted: FittedModel, record: int, forces: Sequence[tuple[str, Array]], gain: Array | None = None
) -> Array:
    """Return the outputs that small forces at places would add.

    The model is linearized. The shape is (n_y, N, k), in units of the noise.

    Inputs may be named instead of places; the added signals then have the hold of the inputs.
    """
    structure, data = fitted.structure, fitted.problem.records[record]
    if not forces:
        return np.zeros((structure.n_outputs, data.n_samples, 0))
    # linearized along the motion
    A, C0 = fitted.linearized()
    linear = structure.linear_model
    n, n0 = structure.n_states, linear.n_states
    names = list(dict.fromkeys(name for name, _ in forces))
    places = {port.name for port in structure.model.ports}
    # a force at a place, or a signal added to an input
    if forced := not set(names) <= set(linear.input_labels) - places:
        ports = [structure.model.port(name) for name in names]
        pairs = [(port.act, felt(port, structure.model.output_rate)) for port in ports]
    else:
        pairs = [(linear.B[:, j], linear.D[:, j]) for j in map(linear.input_labels.index, names)]
    unique = np.column_stack([np.pad(act, (0, n - n0)) for act, _ in pairs])
    through = np.column_stack([column for _, column in pairs])
    # forces run straight between the samples, inputs as their hold says
    Phi, G0, G1 = discretize(A, unique, data.dt, "foh" if forced else data.hold)
    # controller in the loop: its states jump at the samples
    jumps = sample_jumps(structure, data.dt)
    Phi = jumps @ Phi if jumps.size else Phi
    where = [names.index(name) for name, _ in forces]
    drives, F = (G0[:, where], G1[:, where]), np.array([force for _, force in forces]).T  # (N, k)
    # responses from rest, in units of the noise
    there = ~np.isnan(data.outputs.T)
    out = linear_responses(Phi, drives, C0, through[:, where], F, gain=gain, use=there)
    with np.errstate(over="ignore"):  # a unit of a coefficient may have an enormous effect
        found = np.asarray(np.moveaxis(out, 0, 1) * fitted.problem.weights[:, None, None])
    # where there are gaps NaN stands for these, not for a response without bounds
    found[np.isnan(found) & ~there.all()] = np.inf
    return found
