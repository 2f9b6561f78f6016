"""Damage localization: places and sizes of changes in a structure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..arguments import as_choice, as_number, as_share, as_state
from ..arithmetic import own_arithmetic
from ..data.measurement import Measurement
from ..data.records import as_records
from ..diagnosis.dead_sensors import without_dead_sensors
from ..effects.channels import OutputGain
from ..effects.dampers import Damping
from ..effects.effect import Effect
from ..engine.simulation import check_channels
from ..engine.structure import Structure
from ..exceptions import DataError, ExcitationWarning, IdentifiabilityWarning, warn
from ..inference.assembly import assemble, check_settings, offset_variants
from ..inference.refinement import Refinement
from ..inference.starts import estimated_motion
from ..inference.windows import windows
from ..models.conversion import as_physical
from ..models.operating_point import ordered_record, refuse_point
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array
from .assessment import assessed
from .candidates import as_candidates, candidate_effects, default_rule, nominal_values
from .damage_map import DamageMap
from .decision import decide
from .hypotheses import Setting, named_hypotheses, rank_hypotheses
from .residual import residual_tests

__all__ = ["localize_damage"]

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
    physical, base, substeps = _baseline(model)
    nominal = nominal_values(model, physical)
    rule = damping or default_rule(physical, nominal)
    effects = candidate_effects(physical, candidates, rule)
    records, said = as_records(data), ""
    watched = without_dead_sensors(model, records)
    if watched is not None:
        noise, said = watched.noise(noise), " ".join(watched.said)
        records = [watched.record(record) for record in records]
        physical, base, substeps = _baseline(watched.model)
        warn(said, ExcitationWarning)
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
    records = [ordered_record(physical, r) for r in records]
    for record in records:
        check_channels(physical.linear, record)
        record.check_excitation("localize_damage")
        for label, y in zip(record.output_labels, record.outputs, strict=True):
            if np.ptp(y) == 0:
                raise DataError(f"output {label!r} of record {record.name!r} never changes; check the sensor")
    with own_arithmetic():
        segments, note = windows(physical, records, horizon)
        motion = estimated_motion(Structure(physical, base), np.zeros(0), records[0])
        nuisances, spreads = _nuisances(physical, base, effects, rule, nominal, tolerance, offset, records[0])
        setting = Setting(
            physical, base, nuisances, spreads, rule == "ratio", tuple(segments),
            noise, initial, substeps, motion, nominal,
        )  # fmt: skip
        joint = setting.joint(effects)
        rows = as_candidates(joint.structure, effects, nominal, tolerance, least)
        joint.start()
        decision = decide(joint, rows, significance)
        ranking = () if scenarios is None else rank_hypotheses(setting, scenarios)
        tests = residual_tests(joint)
        note = " ".join(filter(None, [said, note]))
        result = assessed(joint, rows, decision, tests, rule, significance, power, ranking, note)
    for group in result.groups:
        warn(f"the record cannot distinguish these changes: {', '.join(group)}", IdentifiabilityWarning)
    return result


def _baseline(model: Any) -> tuple[PhysicalModel, tuple[Effect, ...], int]:
    """Return the undamaged structure, its fixed effects and substeps.

    Effects that a `Refinement` found stay at their values.
    """
    if not isinstance(model, Refinement):
        return refuse_point(as_physical(model), "localize_damage"), (), 1
    refuse_point(model.physical_model, "localize_damage")
    structure, theta, substeps = model.simulation_structure()
    held = []
    for index, effect in enumerate(structure.effects):
        if model.roles[index] == "offset":
            continue  # of that record, not of the structure
        values = {name: float(structure.value(theta, index, name)) for name in effect.coefficients}
        constants = {"width": structure.constants[index]} if index in structure.constants else {}
        held.append(effect.replace(start={}, prior={}, fixed={**effect.fixed, **constants, **values}))
    return model.physical_model, tuple(held), substeps


def _nuisances(
    physical: PhysicalModel,
    base: Sequence[Effect],
    effects: Sequence[Effect],
    rule: str,
    nominal: Mapping[tuple[str, str], float],
    tolerance: float,
    offset: bool,
    record: Measurement,
) -> tuple[tuple[Effect, ...], tuple[float, ...]]:
    """Return the nuisance effects and their prior standard deviations.

    These are offsets, sensor gains and linear parameters, estimated together with the changes.
    """
    chosen = assemble(physical, [], effects, (), tolerance, offset_variants(physical, record, offset)[-1])
    roles = [
        (e, role)
        for e, role in chosen[len(effects) :]
        if not (role == "linear" and e.kind == Damping.name and rule == "ratio")
    ]
    gains = [Effect(OutputGain.name, label) for label in physical.linear.output_labels]
    roles += [(gain, "gain") for gain in gains if gain not in base]
    return tuple(e for e, _ in roles), tuple(_spread(e, role, nominal, tolerance) for e, role in roles)


def _spread(effect: Effect, role: str, nominal: Mapping[tuple[str, str], float], tolerance: float) -> float:
    """Prior standard deviation of a nuisance."""
    if role != "linear":
        return _CALIBRATION if role == "gain" else np.inf
    size = 1.0 if effect.spec.relative else abs(nominal.get((effect.kind, effect.place), 0.0))
    return tolerance * size if size > 0 else np.inf
