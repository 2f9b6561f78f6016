"""Damage localization: places and sizes of changes in a structure.

The map of a decision has confidence intervals, detection limits, and tests of the residual.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.stats import norm

from ..arguments import as_choice, as_number, as_share, as_state
from ..data.measurement import Measurement
from ..data.records import as_records
from ..data.signals import over_time
from ..diagnosis.dead_sensors import without_dead_sensors
from ..diagnosis.residual_tests import TestedResidual, run_tests
from ..diagnosis.words import failed_test
from ..effects.channels import OutputGain
from ..effects.dampers import Damping
from ..effects.effect import Effect
from ..engine.simulation import check_channels
from ..engine.structure import Structure
from ..exceptions import DataError, ExcitationWarning, IdentifiabilityWarning, own_arithmetic, warn
from ..inference.assembly import assemble, check_settings, offset_variants, windows
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel
from ..inference.outcome import _initial_fit
from ..inference.refinement import Refinement
from ..inference.sensitivities import candidate_columns
from ..inference.starts import Motion, estimated_motion
from ..models.conversion import as_physical
from ..models.library import effect_library
from ..models.links import OPEN
from ..models.operating_point import ordered_record, refuse_point
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array, LinearModel
from .candidates import (
    DamageCandidate,
    SharedSetting,
    as_candidates,
    candidate_effects,
    default_rule,
    named_hypotheses,
    nominal_values,
    rank_hypotheses,
)
from .damage_map import DamageMap, DamageRow, NuisanceRow, overall
from .damping import RATIO_NAMES, RatioStructure
from .decision import Decision, decide
from .estimate import Joint

_CALIBRATION = 0.1  # relative sd of a sensor gain, where the record does not say
_RULES = ("links", "ratio", "fixed")
_UNEXPLAINED = (
    "The changes do not explain the record: {test}. An effect is missing in the model, and a reported "
    "change may be caused by it. Run diagnose() to find the effect."
)
_UNTESTED = "The record is too short to test whether the changes explain it."
_OWN = ("change", "std", "joint", "joint_std", "p_value")  # of a row, as the decision has them
_SHORTEST = 200  # samples of a record that can be tested


def assessed(
    joint: Joint,
    candidates: Sequence[DamageCandidate],
    decision: Decision,
    tests: tuple[FTest, ...],
    rule: str,
    significance: float,
    power: float,
    ranking: Any,
    note: str,
) -> DamageMap:
    """The map of a decision."""
    # residual of the final fit
    residual = joint.residual
    return DamageMap(
        name=joint.structure.linear_model.name,
        rows=_rows(candidates, decision, significance, power),
        groups=tuple(tuple(candidates[i].label for i in group) for group in decision.groups),
        ranking=ranking,
        nuisances=_nuisance_rows(joint, candidates),
        covariance=decision.joint_covariance,
        linear=_damaged_model(joint),
        damping=rule,
        significance=significance,
        power=power,
        fit=joint.fit_percent,
        rmse=np.sqrt(over_time(np.mean, residual**2)),
        initial_fit=_initial_fit(Structure(joint.structure.model), joint.records),
        residual_orders=joint.orders,
        tests=tests,
        n_samples=residual.shape[1],
        duration=sum(r.n_samples * r.dt for r in joint.records),
        success=joint.converged,
        message=_message(joint, decision, tests, significance, note),
    )


def _rows(
    candidates: Sequence[DamageCandidate], decision: Decision, significance: float, power: float
) -> tuple[DamageRow, ...]:
    """Changes with their intervals, and what the record would have shown."""
    # detection limit: level of the significance plus quantile of the power, times the deviation
    left = max(len(candidates) - len(decision.named), 1)
    reach = norm.isf(significance / (2 * left)) + norm.ppf(power)
    rows = []
    for i, c in enumerate(candidates):
        # percent of the nominal value
        share = 100.0 / c.nominal if c.nominal else np.nan
        limit = float(max(reach * np.hypot(decision.std[i], c.tolerated), c.floor))
        rivals = tuple(candidates[j].label for j in decision.rivals.get(i, ()))
        own: dict[str, Any] = {name: float(getattr(decision, name)[i]) for name in _OWN}
        own |= {"percent": own["change"] * share, "percent_std": own["std"] * abs(share)}
        own |= {"limit": limit, "limit_percent": limit * abs(share)}
        what = c.name, c.kind, c.place, c.nominal, c.unit
        rows.append(DamageRow(*what, named=i in decision.named, rivals=rivals, **own))
    return tuple(rows)


def _damaged_model(joint: Joint) -> LinearModel:
    """The model with the changes that are named."""
    structure = joint.structure
    # matrices at the estimate: the damaged structure
    matrices = structure.matrices(joint.theta.astype(float))
    nw = structure.n_inputs
    return structure.linear_model.with_arrays(
        A=matrices.A, B=matrices.B[:, :nw], C=matrices.C, D=matrices.D[:, :nw],
        state_labels=tuple(structure.state_labels()),
    )  # fmt: skip


def _message(
    joint: Joint, decision: Decision, tests: tuple[FTest, ...], significance: float, note: str
) -> str:
    explained = "" if tests else _UNTESTED
    # the worst residual test, if the tests fail
    if tests and overall(tests) < significance:
        worst = min((test for test in tests if test.dof), key=lambda test: test.p_value)
        explained = _UNEXPLAINED.format(test=failed_test(worst))
    parts = (
        "Converged." if joint.converged else "Not converged; the values may be inaccurate.",
        explained,
        note,
    )
    return " ".join(part for part in parts if part)


def _open_note(joint: Joint, candidates: Sequence[DamageCandidate], decision: Decision) -> str:
    """Say which named springs stand for others.

    These are springs whose directions the matrices leave open.
    """
    said = {port.name: port.description for port in joint.structure.model.ports}
    places = [candidates[i].place for i in decision.named]
    still = [place for place in places if OPEN in said.get(place, "")]
    if not still:
        return ""
    return f"The springs at {', '.join(still)} {OPEN}."


def _nuisance_rows(joint: Joint, candidates: Sequence[DamageCandidate]) -> tuple[NuisanceRow, ...]:
    structure = joint.structure
    taken = [c.column for c in candidates]
    # nuisances are estimated beside the candidates that changed
    active = np.ones(structure.n_parameters, dtype=bool)
    active[taken] = joint.theta[taken] != 0
    columns, spread = joint.columns(active), joint.spread(active)
    rows = []
    for i, parameter in enumerate(structure.parameters):
        if i in taken:
            continue
        std = float(spread[int(np.flatnonzero(columns == i)[0])])
        value = float(joint.theta[i])
        # damping ratio and its share, then gains, offsets and linear parameters
        if parameter.label == RATIO_NAMES[0]:
            rows.append(NuisanceRow("damping relative to the model", 1.0 + value, std, ""))
        elif parameter.label == RATIO_NAMES[1]:
            rows.append(NuisanceRow("share of the damping proportional to stiffness", value, std, ""))
        else:
            rows.append(NuisanceRow(parameter.label, value, std, structure.unit(parameter)))
    return tuple(rows)


# ---------------------------------------------------------------------- tests


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
        If the record is too short, an output never changes, or `x0` is not finite.

    Warns
    -----
    IdentifiabilityWarning
        Names the places that the record sees only together.
    ExcitationWarning
        Names sensors that show nothing of the motion and are left out, and constant inputs.

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
    # undamaged structure, with the effects of a refinement fixed
    physical, base = _baseline(model)
    nominal = nominal_values(model, physical)
    # damping rule, then the candidates that go with it
    rule = damping or default_rule(physical, nominal)
    effects = candidate_effects(physical, candidates, rule)
    # a sensor that failed is left out and reported
    records, sensor_note = as_records(data), ""
    watched = without_dead_sensors(model, records)
    if watched is not None:
        noise, sensor_note = watched.noise(noise), " ".join(watched.said)
        records = [watched.record(record) for record in records]
        physical, base = _baseline(watched.model)
        warn(sensor_note, ExcitationWarning)
    initial = as_state(x0, physical.linear.n_states)
    # scenarios are checked before the long part
    scenarios = None if hypotheses is None else named_hypotheses(hypotheses)
    check_settings(
        physical,
        tolerance=tolerance,
        offset=offset,
        noise=noise,
        horizon=horizon,
        known_start=initial is not None,
    )
    # channels in the order of the model, all excited
    records = [ordered_record(physical, r) for r in records]
    for record in records:
        check_channels(physical.linear, record)
        record.check_excitation("localize_damage")
        for label, span in zip(record.output_labels, over_time(np.ptp, record.outputs), strict=True):
            if span == 0:
                raise DataError(f"output {label!r} of record {record.name!r} never changes; check the sensor")
    with own_arithmetic():
        # long records are cut into segments with their own initial states
        segments, note = windows(physical, records, horizon)
        motion = estimated_motion(Structure(physical, base), np.zeros(0), records[0])
        # offsets, sensor gains and linear parameters are estimated with the changes
        nuisances = _nuisances(physical, base, effects, rule, tolerance, offset, records[0])
        setting = SharedSetting(
            physical, base, nuisances, tolerance, rule == "ratio", tuple(segments),
            noise, initial, motion, nominal,
        )  # fmt: skip
        # joint estimate of all candidates, then elimination
        joint = setting.joint(effects)
        rows = as_candidates(joint.structure, effects, nominal, tolerance, least)
        decision = decide(joint, rows, significance)
        # damage scenarios, ranked by BIC
        ranking = () if scenarios is None else rank_hypotheses(setting, scenarios)
        # does anything remain in the residual?
        tests = residual_tests(joint)
        note = " ".join(filter(None, [sensor_note, _open_note(joint, rows, decision), note]))
        result = assessed(joint, rows, decision, tests, rule, significance, power, ranking, note)
    for group in result.groups:
        warn(f"the record cannot distinguish these changes: {', '.join(group)}", IdentifiabilityWarning)
    return result


def _baseline(model: Any) -> tuple[PhysicalModel, tuple[Effect, ...]]:
    """Return the undamaged structure and its fixed effects.

    Effects that a `Refinement` found stay at their values.
    """
    if not isinstance(model, Refinement):
        return refuse_point(as_physical(model), "localize_damage"), ()
    refuse_point(model.physical_model, "localize_damage")
    structure, theta, _ = model.simulation_structure()
    held = []
    for index, effect in enumerate(structure.effects):
        if model.roles[index] == "offset":
            # an offset belongs to one record, a coefficient to the structure
            continue  # of that record, not of the structure
        values = {name: float(structure.value(theta, index, name)) for name in effect.coefficients}
        constants = {"width": structure.constants[index]} if index in structure.constants else {}
        held.append(effect.replace(start={}, prior={}, fixed={**effect.fixed, **constants, **values}))
    return model.physical_model, tuple(held)


def _nuisances(
    physical: PhysicalModel,
    base: Sequence[Effect],
    effects: Sequence[Effect],
    rule: str,
    tolerance: float,
    offset: bool,
    record: Measurement,
) -> tuple[tuple[Effect, str], ...]:
    """Return the nuisance effects and their roles.

    These are offsets, sensor gains and linear parameters, estimated together with the changes.
    """
    # linear parameters within the tolerance; the damping ratio replaces the dampers
    chosen = assemble(physical, [], effects, (), tolerance, offset_variants(physical, record, offset)[-1])
    nuisances = [
        (e, role)
        for e, role in chosen[len(effects) :]
        if not (role == "linear" and e.kind == Damping.name and rule == "ratio")
    ]
    held = {(e.kind, e.place) for e in base}
    # gain of each sensor, known to 10 %
    for label in physical.linear.output_labels:
        if (OutputGain.name, label) not in held:
            nuisances.append((Effect(OutputGain.name, label, prior={"gain": _CALIBRATION}), "effect"))
    return tuple(nuisances)


class _Held(NamedTuple):
    """Attributes of a refinement that `FittedModel` needs."""

    physical_model: PhysicalModel
    effects: tuple[Effect, ...]
    constants: dict[int, float]
    roles: tuple[str, ...]
    substeps: int


def residual_tests(joint: Joint) -> tuple[FTest, ...]:
    """Test the residual at the estimate, as `diagnose` does.

    All candidates and nuisance parameters are projected out. The result is empty where a record is too short
    to test.
    """
    # tests need a past for the noise model
    if min(record.n_samples for record in joint.records) < _SHORTEST:
        return ()
    # the same problem in a plain structure, at the estimate
    physical, effects, theta = _plain(joint.structure, joint.theta)
    structure = Structure(physical, effects, constants=joint.structure.constants)
    old, role = joint.problem, ("effect",) * len(effects)
    mean, sd = old.prior_mean[: theta.size], old.prior_sd[: theta.size]
    problem = old.like(structure, priors=old.priors._replace(mean=mean, sd=sd), hold_brief=True)
    held = _Held(physical, effects, dict(structure.constants), role, old.substeps)
    starts = joint.problem.unpack(joint.point)[1]
    # project out all parameters, then test against the library of effects
    fitted = FittedModel(cast(Any, held), problem, problem.pack(theta, starts), 0.0)
    motions = [Motion(structure, theta, record) for record in joint.records]
    motions[0].companions = motions[1:]
    taken = {(effect.kind, effect.place) for effect in effects}
    library = [e for e in effect_library(physical) if (e.kind, e.place) not in taken]
    return tuple(
        run_tests(TestedResidual(fitted), candidate_columns(fitted, library, motions[0], (0.0,)), motions)
    )


def _plain(structure: Structure, theta: Array) -> tuple[PhysicalModel, tuple[Effect, ...], Array]:
    """Return the model, effects and coefficients without the damping rule.

    The state matrix holds the damping that the rule gave.
    """
    if not isinstance(structure, RatioStructure):
        return structure.model, tuple(structure.effects), theta
    # damping rule: freeze the damping that it gave in the state matrix
    laws = [structure.effects[q.effect].spec for q in structure.parameters]
    masses = [law.inertial for law in laws]
    changes = [law.is_element and not law.inertial for law in laws]
    model = structure.model
    A = structure.matrices(np.where(masses, 0.0, theta)).A.real
    C, D = model.output_state + model.output_rate @ A, model.linear.D
    ruled = replace(model, linear=model.linear.with_arrays(A=A, B=model.linear.B, C=C, D=D))
    count = structure.ratio_columns[0]
    return ruled, tuple(structure.effects[:-1]), np.where(changes, 0.0, theta)[:count]
