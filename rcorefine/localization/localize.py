"""Where a structure changed, and by how much."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import control as ct
import numpy as np
from scipy.stats import norm

from ..arguments import as_choice, as_list, as_number, as_share, as_state
from ..arithmetic import own_arithmetic
from ..data.channels import match_channels, record_for
from ..data.measurement import Measurement
from ..effects.dampers import Damping
from ..effects.effect import Effect
from ..effects.output_path import OutputGain
from ..effects.springs import Stiffness
from ..engine.simulation import check_channels
from ..engine.structure import Structure
from ..exceptions import IdentifiabilityWarning, ModelError
from ..inference.assembly import assemble, check_settings, offset_variants
from ..inference.covariance import standard_deviations
from ..inference.outcome import _initial_fit
from ..inference.refinement import Refinement
from ..inference.starts import estimated_motion
from ..inference.whitening import FTest
from ..inference.windows import as_records, windows
from ..models.conversion import as_physical
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array
from .damage_map import DamageMap, DamageRow, NuisanceRow
from .damping import RATIO_NAMES, RatioStructure
from .decision import Candidate, Decision, decide
from .estimate import Joint
from .hypotheses import Setting, named_hypotheses, rank_hypotheses
from .residual import overall, residual_tests

__all__ = ["localize_damage"]

_OTHER_VALLEY = (
    "Another set of changes, at more places, would explain the record about as well (few sensors); the "
    "sparser one is given."
)
_UNEXPLAINED = (
    "The changes do not explain the record: {name} (p = {p:.1g}). Something else is missing in the model, "
    "and may have been taken for a change; diagnose() says what."
)
_UNTESTED = "The record is too short to test whether the changes explain it."
_CALIBRATION = 0.1  # relative sd of a sensor gain, where the record does not say
_RULES = ("links", "ratio", "fixed")


def localize_damage(
    model: Any,
    data: Measurement | Sequence[Measurement],
    *,
    candidates: Sequence[Any] | None = None,
    hypotheses: Mapping[str, Any] | Sequence[Any] | None = None,
    damping: str | None = None,
    significance: float = 0.01,
    power: float = 0.95,
    least: float = 0.1,
    tolerance: float = 0.0,
    offset: bool = True,
    x0: str | Array = "estimate",
    noise: float | Sequence[float] | None = None,
    horizon: float | None = None,
) -> DamageMap:
    """Find which links of a structure lost or gained stiffness or damping.

    All candidates are estimated jointly from the record; those that the record does not
    need are dropped one by one with refits, so that a neighbor that merely absorbs a part
    of the damage is not named.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        The undamaged structure, continuous time. What is no candidate is trusted.
    data : Measurement or list of Measurement
        Record of the structure as it is now, or several.
    candidates : sequence, optional
        What may have changed: `Effect` objects (``stiffness``, ``damping``, ``mass``) or names of
        places, which mean the stiffness there. Default: every link's stiffness,
        and its damping with ``damping="links"``.
    hypotheses : mapping or sequence, optional
        Damage scenarios to rank: ``{name: effects}``, or a list of lists; any
        effect of the catalogue, or the name of a place for its stiffness.
        "no damage" competes as well.
    damping : {"links", "ratio", "fixed"}, optional
        "links": each damper is a candidate of its own. "ratio": one factor on all modal damping
        ratios is estimated along, and the share of the damping that follows the damaged
        stiffness. "fixed": damping is trusted. Default: "links" where the model has
        dampers at its links, else "ratio" where it has damping, else "links".
    significance : float
        Probability that anything at all is named where nothing has changed (Holm).
    power : float
        Probability with which a change of the detection limit is shown.
    least : float
        Smallest change that counts as one, in percent.
    tolerance : float
        Relative standard deviation to which the linear parameters of the model are known. Others
        than the candidates float within it, and a candidate's change must exceed it.
    offset : bool
        Estimate a constant offset of sensors (or actuators) along. Sensor gains are always
        estimated along (a prior of 10 percent, which matters where the record cannot tell).
    x0 : {"estimate", "zero"} or ndarray of shape (n,)
        Initial state.
    noise : float or sequence of float, optional
        Known sensor noise (standard deviation per output); estimated by default.
    horizon : float, optional
        Length of the free runs in seconds, as for `refine`.

    Returns
    -------
    DamageMap
        Changes with intervals, named places, detection limits, groups, ranking.

    Raises
    ------
    ModelError
        If the model has no stiffness to look at, or a place does not exist.
    control.ControlDimension
        If the record's channels are not the model's.
    DataError
        If the record is too short, or `x0` is not finite.

    Warns
    -----
    IdentifiabilityWarning
        Names the places that the record sees only together.

    Notes
    -----
    Estimates are those of the output-error fit of `refine`, their covariance robust to coloured
    residuals. What is left passes the tests of `diagnose`, or the message says that it does not
    (`DamageMap.explained`): then something other than the candidates is wrong. With
    ``damping="ratio"`` the true rule of damping need not be known: the matrix may stay that of
    the undamaged structure, or follow the damaged one.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> c, sensors = [0.2, 0.16, 0.12], ("displacement", (1, 3))
    >>> chain = rco.mass_spring_damper([1, 1, 1], c, [10, 8, 6], force=3, sensors=sensors)
    >>> true = rco.mass_spring_damper([1, 1, 1], c, [10, 5.6, 6], force=3, sensors=sensors)
    >>> rng = np.random.default_rng(0)
    >>> force = rng.standard_normal(3000)
    >>> blank = rco.Measurement(force, np.zeros((2, 3000)), dt=0.05)
    >>> y = rco.simulate(true, blank, "zero").outputs
    >>> noisy = y + 0.02 * y.std() * rng.standard_normal(y.shape)
    >>> found = rco.localize_damage(chain, rco.Measurement(force, noisy, dt=0.05))
    >>> [(row.label, round(row.percent)) for row in found.named]
    [('stiffness at link2', -30)]
    """
    if damping is not None:
        as_choice(damping, "damping", _RULES)
    significance, power = as_share(significance, "significance"), as_share(power, "power")
    least = as_number(least, "least (in percent)", least=0.0)
    physical, base, substeps = _baseline(model)
    initial = as_state(x0, physical.linear.n_states)
    scenarios = None if hypotheses is None else named_hypotheses(hypotheses)
    check_settings(
        physical,
        tolerance=tolerance,
        offset=offset,
        noise=noise,
        horizon=horizon,
        known_start=initial is not None,
    )
    records = [record_for(r, match_channels(physical.linear, r)) for r in as_records(data)]
    for record in records:
        check_channels(physical.linear, record)
        record.check_excitation("localize_damage", stacklevel=2)
    with own_arithmetic():
        segments, note = windows(physical, records, horizon)
        nominal = _nominal(model, physical)
        rule = damping or _default_rule(physical, nominal)
        effects = _candidates(physical, candidates, rule, nominal)
        chosen = assemble(
            physical, [], effects, (), tolerance, offset_variants(physical, records[0], offset)[-1]
        )
        nuisances = [
            (e, role)
            for e, role in chosen[len(effects) :]
            if not (role == "linear" and e.kind == Damping.name and rule == "ratio")
        ]
        gains = [Effect(OutputGain.name, label) for label in physical.linear.output_labels]
        nuisances += [(gain, "gain") for gain in gains if gain not in base]
        setting = Setting(
            physical,
            base,
            tuple(e for e, _ in nuisances),
            tuple(_spread(e, role, nominal, tolerance) for e, role in nuisances),
            rule == "ratio",
            tuple(segments),
            noise,
            initial,
            substeps,
            estimated_motion(Structure(physical, base), np.zeros(0), records[0]),
            nominal,
        )
        joint = setting.joint(effects)
        rows = _as_candidates(joint.structure, effects, nominal, tolerance, least)
        joint.start()
        decision = decide(joint, rows, significance)
        ranking = () if scenarios is None else rank_hypotheses(setting, scenarios)
        tests = residual_tests(joint)
        result = _package(joint, rows, decision, tests, rule, significance, power, ranking, note)
    for group in result.groups:
        warnings.warn(
            f"the record sees only together: {', '.join(group)}", IdentifiabilityWarning, stacklevel=2
        )
    return result


def _baseline(model: Any) -> tuple[PhysicalModel, tuple[Effect, ...], int]:
    """The undamaged structure; effects that a Refinement found stay at their values."""
    if not isinstance(model, Refinement):
        return as_physical(model), (), 1
    structure, theta, substeps = model.simulation_structure()
    held = []
    for index, effect in enumerate(structure.effects):
        if model.roles[index] == "offset":
            continue  # of that record, not of the structure
        values = {name: float(structure.value(theta, index, name)) for name in effect.coefficients}
        constants = {"width": structure.constants[index]} if index in structure.constants else {}
        held.append(effect.replace(start={}, prior={}, fixed={**effect.fixed, **constants, **values}))
    return model.physical_model, tuple(held), substeps


def _nominal(model: Any, physical: PhysicalModel) -> dict[tuple[str, str], float]:
    nominal = {(q.kind, q.place): q.value for q in physical.parameters}
    if isinstance(model, Refinement):
        nominal.update({(row.kind, row.place): row.value for row in model.parameters if row.initial != 0})
    return nominal


def _default_rule(physical: PhysicalModel, nominal: Mapping[tuple[str, str], float]) -> str:
    if any(kind == Damping.name and value != 0 for (kind, _), value in nominal.items()):
        return "links"
    try:
        RatioStructure(physical)
    except ModelError:
        return "links"
    return "ratio"


def _candidates(
    physical: PhysicalModel,
    given: Sequence[Any] | None,
    rule: str,
    nominal: Mapping[tuple[str, str], float],
) -> list[Effect]:
    if given is not None:
        entries = (
            [given] if isinstance(given, str | Effect) else as_list(given, "candidates", "effects or places")
        )
        effects = [Effect(Stiffness.name, e) if isinstance(e, str) else e for e in entries]
        for effect in effects:
            if not isinstance(effect, Effect) or not effect.spec.is_element:
                raise ct.ControlArgument(
                    f"candidates are stiffness, damping or mass effects or places, not {effect!r}; "
                    "other kinds belong to hypotheses="
                )
            physical.check(effect)
        if len(set(effects)) < len(effects):
            raise ct.ControlArgument("candidates holds an effect twice; give each once")
    else:
        springs = [q.place for q in physical.parameters if q.kind == Stiffness.name and q.value != 0]
        effects = [Effect(Stiffness.name, place) for place in springs]
        if rule == "links":
            dampers = [q.place for q in physical.parameters if q.kind == Damping.name and q.value != 0]
            effects += [Effect(Damping.name, place) for place in dampers or springs]
    if not effects:
        raise ModelError(
            f"model {physical.name!r} has no stiffness at any link: use a builder such as "
            "mass_spring_damper, states in displacements and velocities, or candidates="
        )
    return effects


def _spread(effect: Effect, role: str, nominal: Mapping[tuple[str, str], float], tolerance: float) -> float:
    """Prior standard deviation of a nuisance."""
    if role != "linear":
        return _CALIBRATION if role == "gain" else np.inf
    size = 1.0 if effect.spec.relative else abs(nominal.get((effect.kind, effect.place), 0.0))
    return tolerance * size if size > 0 else np.inf


def _as_candidates(
    structure: Structure,
    effects: Sequence[Effect],
    nominal: Mapping[tuple[str, str], float],
    tolerance: float,
    least: float,
) -> list[Candidate]:
    names = {(q.kind, q.place): q.name for q in structure.model.parameters}
    found = []
    for index, effect in enumerate(effects):
        column = structure.position(index, effect.coefficients[0])
        if column < 0:
            raise ModelError(f"{effect.label} is fixed, so it cannot be a candidate")
        size = nominal.get((effect.kind, effect.place), 0.0)
        found.append(
            Candidate(
                column,
                effect.kind,
                effect.place,
                names.get((effect.kind, effect.place), effect.label),
                size,
                structure.unit(structure.parameters[column]),
                tolerance * abs(size),
                least / 100.0 * abs(size),
            )
        )
    return found


def _package(
    joint: Joint,
    candidates: Sequence[Candidate],
    decision: Decision,
    tests: tuple[FTest, ...],
    rule: str,
    significance: float,
    power: float,
    ranking: Any,
    note: str,
) -> DamageMap:
    structure, m = joint.structure, len(candidates)
    left = max(m - len(decision.named), 1)
    reach = norm.isf(significance / (2 * left)) + norm.ppf(power)
    rows = []
    for i, c in enumerate(candidates):
        share = 100.0 / c.nominal if c.nominal else np.nan
        limit = float(max(reach * np.hypot(decision.std[i], c.tolerated), c.floor))
        rows.append(
            DamageRow(
                c.name,
                c.kind,
                c.place,
                c.nominal,
                c.unit,
                float(decision.change[i]),
                float(decision.std[i]),
                float(decision.joint[i]),
                float(decision.joint_std[i]),
                float(decision.change[i] * share),
                float(decision.std[i] * abs(share)),
                float(decision.p_value[i]),
                limit,
                float(limit * abs(share)),
                i in decision.named,
                tuple(candidates[j].label for j in decision.rivals.get(i, ())),
            )
        )
    residual = joint.residual
    measured = np.concatenate([r.outputs for r in joint.records], axis=1)
    size = np.linalg.norm(measured - measured.mean(axis=1, keepdims=True), axis=1)
    theta = joint.theta
    matrices = structure.matrices(theta.astype(float))
    nw = structure.n_inputs
    linear = structure.linear_model.with_arrays(
        A=matrices.A, B=matrices.B[:, :nw], C=matrices.C, D=matrices.D[:, :nw],
        state_labels=tuple(structure.state_labels()),
    )  # fmt: skip
    return DamageMap(
        name=structure.linear_model.name,
        rows=tuple(rows),
        groups=tuple(tuple(candidates[i].label for i in group) for group in decision.groups),
        ranking=ranking,
        nuisances=_nuisances(joint, candidates),
        covariance=decision.joint_covariance,
        linear=linear,
        damping=rule,
        significance=significance,
        power=power,
        fit=100.0 * (1.0 - np.linalg.norm(residual, axis=1) / np.where(size > 0, size, np.nan)),
        rmse=np.sqrt(np.mean(residual**2, axis=1)),
        initial_fit=_initial_fit(Structure(structure.model), joint.records),
        residual_orders=joint.orders,
        tests=tests,
        n_samples=measured.shape[1],
        duration=sum(r.n_samples * r.dt for r in joint.records),
        success=joint.converged,
        message=" ".join(
            part
            for part in (
                "Converged." if joint.converged else "Not converged; the figures may be off.",
                _explained(tests, significance),
                _OTHER_VALLEY if decision.other_valley else "",
                note,
            )
            if part
        ),
    )


def _explained(tests: Sequence[FTest], significance: float) -> str:
    """What the residual says about the changes, "" where it is noise."""
    if not tests:
        return _UNTESTED
    if overall(tests) >= significance:
        return ""
    worst = min((test for test in tests if test.dof), key=lambda test: test.p_value)
    return _UNEXPLAINED.format(name=worst.name, p=worst.p_value)


def _nuisances(joint: Joint, candidates: Sequence[Candidate]) -> tuple[NuisanceRow, ...]:
    structure = joint.structure
    taken = {c.column for c in candidates}
    named = np.array([c.column for c in candidates if joint.theta[c.column] != 0], dtype=np.int64)
    active = np.ones(structure.n_parameters, dtype=bool)
    active[[c.column for c in candidates]] = False
    active[named] = True
    columns = joint.columns(active)
    spread = standard_deviations(joint.information().covariance(columns))
    rows = []
    for i, parameter in enumerate(structure.parameters):
        if i in taken:
            continue
        std = float(spread[int(np.flatnonzero(columns == i)[0])])
        value = float(joint.theta[i])
        if parameter.label == RATIO_NAMES[0]:
            rows.append(NuisanceRow("damping, times the model's", 1.0 + value, std, ""))
        elif parameter.label == RATIO_NAMES[1]:
            rows.append(NuisanceRow("share of it that follows the stiffness", value, std, ""))
        else:
            rows.append(NuisanceRow(parameter.label, value, std, structure.unit(parameter)))
    return tuple(rows)
