"""Effect of each candidate on the outputs.

Candidates act as forces along the estimated motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np

from ...data.measurement import Measurement
from ...effects.effect import Effect, as_effects
from ...effects.formula import FormulaLaw
from ...engine.engine import Engine
from ...engine.matrices import entry_among
from ...engine.point import linearized
from ...engine.structure import Structure
from ...exceptions import ModelError
from ...inference.starts import Motion, law_widths, shape_starts
from ...models.library import effect_library
from ...models.ports import felt
from ...systems.discretization import discretize
from ...systems.linear import Array
from ..samples import Integers
from .baseline import Numbers
from .kernels import CODES, Columns, forces

_MOST_SHAPES = 3  # of a law with a gap, a limit or a fading speed


@dataclass(frozen=True, slots=True, eq=False)
class Bank:
    """Columns of all candidates and of uncertain model parameters.

    Attributes
    ----------
    effects : tuple of Effect
        Candidates, then numbers of the model that are none.
    owner : ndarray of int, shape (k,)
        Effect of each column.
    rows : ndarray, shape (2, k, n + n_w)
        What each column senses of states and inputs: d and v.
    codes, values, widths, pick
        Law of each column, as in `kernels.forces`.
    drive : ndarray, shape (2, n, k)
        What a unit force does to the states, falling from one to zero and rising.
    through : ndarray, shape (n_y, k)
        What it does to the outputs at once.
    names : tuple of str
        Coefficient that each column stands for.
    Phi, C : ndarray
        Transition and output matrix that forces pass, (n, n) and (n_y, n).
    scale : ndarray, shape (k,)
        Unit in which each coefficient is counted, so that forces have unit size.
    watched : int
        Columns of the candidates, which come first.
    numbers : ndarray of int, shape (p,)
        Columns of the doubtful numbers.
    root : ndarray, shape (p, p)
        Root R of the covariance R R' of these, in the units of `scale`.
    """

    effects: tuple[Effect, ...]
    owner: Annotated[Integers, "k"]
    rows: Annotated[Array, "2 k sensed"]
    codes: Annotated[Integers, "k"]
    values: Annotated[Array, "k 4"]
    widths: Annotated[Array, "k"]
    pick: Annotated[Integers, "k", 0, 3]
    drive: Annotated[Array, "2 n k"]
    through: Annotated[Array, "ny k"]
    names: tuple[str, ...]
    Phi: Annotated[Array, "n n"]
    C: Annotated[Array, "ny n"]
    scale: Annotated[Array, "k"]
    watched: int
    numbers: Annotated[Integers, "p"]
    root: Annotated[Array, "p p"]

    @property
    def candidates(self) -> tuple[Effect, ...]:
        """Candidate effects that are monitored."""
        return self.effects[: int(self.owner[self.watched - 1]) + 1]

    @property
    def columns(self) -> Columns:
        """Laws of the columns for the kernels of this process.

        A law is 0 where there is none to evaluate. Addresses (of a law, of a table) hold in one process only,
        so they are never part of a bank.
        """
        laws, values = np.zeros(self.size, dtype=np.int64), self.values.copy()
        for j in np.flatnonzero((self.codes < 100) | (self.codes == CODES["change"])):
            spec = self.effects[self.owner[j]].spec
            if isinstance(spec, FormulaLaw):
                laws[j] = spec.code
                for name in spec.addresses:
                    values[j, spec.row.index(name)] = spec.constants[name]
        return Columns(self.rows, self.codes, laws, values, self.widths, self.pick)

    @property
    def size(self) -> int:
        """Number of columns."""
        return int(self.owner.size)


class _Place(NamedTuple):
    """Place of an effect in the model.

    d, v : what it senses of [x; w]; act, through : where its force acts; hold : that of an input.
    """

    d: Array
    v: Array
    act: Array
    through: Array
    hold: str = "foh"


class _Column(NamedTuple):
    """Law of one column: its coefficients, and which of them it stands for."""

    owner: int
    name: str
    code: int
    place: _Place
    values: tuple[float, ...] = ()
    width: float = 1.0
    pick: int = 0


def checked_candidates(model: Any, given: Sequence[Effect] | None) -> tuple[Effect, ...]:
    """Effects that can be watched for, by default those of the library."""
    # effects that act as forces along the estimated motion
    if given is None:
        return tuple(e for e in effect_library(model) if e.spec.along_motion)
    effects = tuple(as_effects(given, "candidates"))
    if not effects:
        raise ModelError("candidates is empty: name at least one Effect, or leave candidates out")
    for effect in effects:
        model.check(effect)
        if not effect.spec.along_motion:
            raise ModelError(
                f"{effect.label} cannot be watched for: it is no force along the model's motion; "
                "use diagnose() on a record"
            )
        if effect.law is not None and len(effect.coefficients) > 1:
            raise ModelError(f"{effect.label} can be watched for with one coefficient only, its scale")
    if len(set(effects)) < len(effects):
        raise ModelError("a candidate is named twice; give each effect once")
    return effects


def build_bank(
    numbers: Numbers,
    candidates: Sequence[Effect],
    data: Measurement,
    hold: str,
    gain: Array,
) -> Bank:
    """Columns of the candidates.

    Parameters
    ----------
    numbers : Numbers
        Healthy model, and what is known of it but for a doubt.
    candidates : sequence of Effect
        What may come.
    data : Measurement
        Healthy stretch, for the shapes of laws with a gap or a limit.
    hold : str
        Input between samples.
    gain : ndarray, shape (n, n_y)
        Gain of the observer.

    Returns
    -------
    Bank
    """
    # candidates first, then the effects whose parameters are uncertain
    effects = tuple(dict.fromkeys([*candidates, *(effect for effect, _ in numbers.moving)]))
    structure, theta = numbers.structure, numbers.theta
    # columns of all effects: what they sense, their law and where they act
    motion = Motion(structure, theta, data)
    A = _linearize_along(structure, theta, data, gain)
    found: list[_Column] = []
    for owner, effect in enumerate(effects):
        place = _place(structure, theta, A, effect, hold)
        found += _columns(structure, place, owner, effect, motion)
    owner_of, names, codes, places, values, widths, pick = zip(*found, strict=True)
    d, v, act, through, holds = zip(*places, strict=True)
    n, k = structure.n_states, len(found)
    # forces pass to the states over one sample: those of inputs with their hold, others linear
    drive, acts = np.zeros((2, n, k)), np.array(act).T
    for own in set(holds):
        which = np.array(holds) == own
        _, drive[0][:, which], drive[1][:, which] = discretize(A, acts[:, which], data.dt, own)
    bank = Bank(
        effects=effects,
        owner=np.array(owner_of, dtype=np.int64),
        rows=np.array([d, v]),
        codes=np.array(codes, dtype=np.int64),
        values=np.array([(*row, 0.0, 0.0, 0.0, 0.0)[:4] for row in values]),
        widths=np.array(widths),
        pick=np.array(pick, dtype=np.int64),
        drive=drive,
        through=np.ascontiguousarray(np.array(through).T),
        names=names,
        Phi=np.ascontiguousarray(discretize(A, np.zeros((n, 1)), data.dt)[0]),
        C=np.ascontiguousarray(structure.matrices(theta).C.astype(float)),
        scale=np.ones(k),
        watched=sum(owner < len(candidates) for owner in owner_of),
        numbers=np.zeros(0, dtype=np.int64),
        root=np.zeros((0, 0)),
    )
    return _with_numbers(bank, numbers, _unit_scales(bank, structure, theta, data, gain))


def _with_numbers(bank: Bank, numbers: Numbers, unit: Array) -> Bank:
    """Return the bank in units of its forces.

    It knows which of its columns are uncertain parameters.
    """
    # a law that has nothing to work on here, as hysteresis without a displacement
    idle = unit == 0
    bank = replace(bank, scale=unit, codes=np.where(idle, CODES["constant"], bank.codes))
    # uncertain parameters are columns too: which ones, and the square root of their covariance
    columns = [(bank.effects[owner], name) for owner, name in zip(bank.owner, bank.names, strict=True)]
    at = np.array([columns.index(coefficient) for coefficient in numbers.moving], dtype=np.int64)
    felt = (unit[at] > 0) & (np.diag(numbers.covariance) > 0)
    known = numbers.covariance[np.ix_(felt, felt)]
    # eigenvectors of the correlation: P = root root', in the units of the columns
    spread = np.sqrt(np.diag(known))
    values, vectors = np.linalg.eigh(known / np.outer(spread, spread))
    root = (spread / unit[at][felt])[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return replace(bank, numbers=at[felt], root=np.ascontiguousarray(root))


def _unit_scales(bank: Bank, structure: Structure, theta: Array, data: Measurement, gain: Array) -> Array:
    """Return one over the rms force of each column.

    The force is per unit of the coefficient. The result is 0 where there is no force.
    """
    # motion of the healthy data by the observer
    run = Engine(structure, data, substeps=2 if structure.n_ports else 1).run(
        theta, sensitivity=False, gain=gain, histories=True, check=False
    )
    X = np.ascontiguousarray(np.vstack([np.nan_to_num(run.states), data.inputs]).T)
    # force of each column along it, per unit of its coefficient
    F, inner = np.zeros((data.n_samples, bank.size)), np.full((3, bank.size), np.nan)
    inner[0] = 0.0
    forces(X, bank.columns, structure.n_states, 1.0 / data.dt, inner, F)
    # columns in units of their rms force
    size = np.sqrt(np.mean(F**2, axis=0))
    seen = np.isfinite(size) & (size > 0)
    return np.where(seen, 1.0 / np.where(seen, size, 1.0), np.where(np.isfinite(size), 1.0, 0.0))


def _linearize_along(structure: Structure, theta: Array, data: Measurement, gain: Array) -> Array:
    """Return A of the healthy model, linearized along the data.

    Each nonlinear force is replaced by its best linear fit.
    """
    if structure.n_ports == 0:
        return structure.matrices(theta).A.astype(float)
    run = Engine(structure, data, substeps=2).run(
        theta, sensitivity=False, gain=gain, histories=True, check=False
    )
    # slopes of the force laws over the motion
    return linearized(structure, theta, run, data.inputs)[0]


def _place(structure: Structure, theta: Array, A: Array, effect: Effect, hold: str) -> _Place:
    """Place of an effect in the model.

    The model is linearized as `A`.
    """
    m, linear, law = structure.matrices(theta), structure.linear_model, effect.spec
    n, nw, ny = structure.n_states, structure.n_inputs, structure.n_outputs
    B, C, D = m.B[:, :nw].astype(float), m.C.astype(float), m.D[:, :nw].astype(float)
    # row vectors over [x; w]: d is the displacement that the law senses, v the velocity
    nothing, unit, rate = np.zeros(n + nw), np.eye(n + nw), structure.model.output_rate
    # entry of a linear model: the coefficient times state or input `column` drives `row`
    if "any" in law.where and law.is_parameter:
        row, column = entry_among(structure, effect.place)
        act, read = np.split(np.eye(n + ny)[row], [n])
        return _Place(nothing, unit[column], act, rate @ act[: rate.shape[1]] + read)
    # effect of an input or an output: it acts where the signal does and senses it
    if law.at_channel:
        if "input" in law.where:
            i = linear.input_labels.index(effect.place)
            place = _Place(nothing, unit[n + i], B[:, i], D[:, i], hold)
        else:
            i = linear.output_labels.index(effect.place)
            place = _Place(nothing, np.concatenate([C[i], D[i]]), np.zeros(n), np.eye(ny)[i])
        return place if law.signal else place._replace(d=place.v, v=nothing)
    # force at a port: relative velocity and displacement, in the outputs by the acceleration
    port = structure.model.port(effect.place)
    pad = (0, n - port.act.size)
    act = np.pad(port.act, pad)
    d = np.concatenate([np.pad(port.position, pad), port.position_input])
    v = np.concatenate([np.pad(port.velocity, pad), port.velocity_input])
    # inertial force: the velocity rows become acceleration rows, v' A x + v' B w
    if law.inertial:
        d, v = nothing, np.concatenate([v[:n] @ A, v[:n] @ B + port.acceleration_input])
    elif "acceleration" in law.senses:  # what fills a store
        d = v[:n] @ np.hstack([A, B]) / -(v[:n] @ act)
    return _Place(d, v, act, felt(port, rate))


def _columns(
    structure: Structure, place: _Place, owner: int, effect: Effect, motion: Motion
) -> list[_Column]:
    """Columns of one effect.

    There is one for each strength, in each shape worth trying.
    """
    law, first = effect.spec, effect.coefficients[0]
    # laws without a formula of their own: one column per shape
    if law.signal:
        code = CODES[law.signal]
        if not (law.shaping and law.at_channel):
            return [_Column(owner, first, code, place)]
        shapes = _shapes(structure, effect, motion)
        return [_Column(owner, first, code, place, (0.0, shape.get(first, 0.0))) for shape in shapes]
    width = 1.0
    if not law.at_channel:
        width = law_widths(Structure(structure.model, [effect]), motion).get(0, 1.0)
    # other laws: a column for each coefficient that is a factor of the force
    names = enumerate(effect.coefficients)
    strengths = [(c, name) for c, name in names if name not in {*law.shaping, *effect.fixed}]
    assert isinstance(law, FormulaLaw)
    found = []
    for shape in _shapes(structure, effect, motion):
        # addresses of tables are filled in by each process
        known = {**effect.constants, **shape, **dict.fromkeys(law.addresses, 0.0)}
        row = tuple(float(known.get(name) or 0.0) for name in law.row)
        # a law without such a coefficient: its change against the displacement alone
        for c, name in strengths or [(0, "")]:
            code = CODES["change"] * (not name)
            found.append(_Column(owner, name or first, code, place, row, width, c))
    return found


def _shapes(structure: Structure, effect: Effect, motion: Motion) -> list[dict[str, float]]:
    """Return the coefficients that shape a force law, fixed ones included.

    They are its gap, limit or fading speed.
    """
    # starting values for this motion, each set once
    probe = Structure(structure.model, [effect])
    sets: list[dict[str, float]] = []
    for point in shape_starts(probe, probe.start(), motion):
        own = zip(probe.parameters, map(float, point), strict=True)
        shape = {**effect.fixed, **{q.name: value for q, value in own if q.name in effect.spec.shaping}}
        if shape not in sets:
            sets.append(shape)
    return sets[:_MOST_SHAPES]
