"""Confirmation of a model on further records.

They are best taken at another amplitude.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Unpack

import control as ct
import numpy as np

from ..arguments import as_mapping, as_number, as_share, as_vector
from ..data.measurement import Measurement
from ..data.records import amplitude, as_records
from ..data.signals import over_time
from ..effects.effect import Effect, as_effects
from ..engine.observer import observer_gain
from ..engine.simulation import check_channels
from ..exceptions import DataError, IdentifiabilityWarning, unheard
from ..inference.assembly import check_settings, windows
from ..inference.covariance import pseudo_inverse, standard_deviations, wald
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel, coefficient_covariance, evaluated, fitted_from
from ..inference.levels import levels
from ..inference.parameters import EstimatedParameter
from ..inference.problem import descend
from ..inference.refinement import Refinement
from ..inference.sensitivities import candidate_columns
from ..inference.starts import Motion
from ..models.library import effect_library
from ..models.operating_point import ordered_record
from ..refinement.refine import refit
from ..results import Options, Result, Row, chance, picture, show
from ..systems.linear import Array
from .beside import Beside
from .case import not_held
from .dead_sensors import check_moving
from .noise import error_shares, in_percent
from .residual_tests import TestedResidual, overall, run_tests

_ROUNDS = 3  # descents, each under the whitening of the one before


def confirm(
    model: Refinement,
    data: Sequence[Measurement],
    *,
    candidates: Sequence[Effect] | None = None,
    tolerance: float = 0.0,
    noise: float | Sequence[float] | None = None,
    force_ratio: float = 0.0,
    significance: float = 0.005,
    matters: float | None = None,
    scales_with: Mapping[str, str | Sequence[float]] | None = None,
) -> Confirmation:
    """Test a refined model on further records.

    They are best taken at another amplitude. The model is fitted to each record alone. An effect that only
    mimics the true one on one record needs other coefficients on another, or leaves a residual there.

    Parameters
    ----------
    model : Refinement
        Model with the effects in question: of `refine`, or `RankedEffect.refinement`. Of a model without
        any, the residual alone is tested.
    data : sequence of Measurement
        The record that taught them first, then the others; two at least.
    candidates : sequence of Effect, optional
        What else the residual is tested for, default `effect_library(model)`.
    tolerance : float
        Relative prior sd of the linear parameters, as in `refine`.
    noise : float or sequence of float, optional
        Known sensor noise (standard deviation per output).
    force_ratio : float
        Unmeasured force over the measured one in the first record that is allowed for, as
        `Diagnosis.force_ratio` says it; taken to be as large in the other records.
    significance : float
        Level below which the effects are refuted.
    matters : float, optional
        As in `diagnose`: share of the spread of an output, default .01. What a test finds does not refute the
        effects if the error of the model, or what the coefficients of the first record change, is smaller.
    scales_with : mapping, optional
        Effects whose size changes in proportion to a condition, by ``"kind@place"``: a number per record, or
        the name of a signal of the records (its mean counts). For example
        ``{"coulomb_friction@shaft": "load"}``. All other coefficients must keep their values.

    Returns
    -------
    Confirmation
        Verdict, and the coefficients from every record.

    Raises
    ------
    control.ControlArgument
        If there is only one record, or `scales_with` names an effect or a signal that does not exist.
    DataError
        If a condition is zero or changes its sign between records.

    Notes
    -----
    Wald test ``(t1 - t2)' (C1 + C2)^-1 (t1 - t2)`` of the effects' coefficients with the
    covariances of generalized least squares, and the residual tests of `diagnose` on each
    further residual. Offsets and linear parameters that float may differ between records. With
    `scales_with`, t1 is multiplied by the ratio of the conditions, and C1 by its square.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> true = rco.mass_spring_damper([1.0], [0.4], [80.0], sensors="displacement")
    >>> rng = np.random.default_rng(0)
    >>> records = []
    >>> for size in (10.0, 20.0):
    ...     force = size * rng.standard_normal(1500)
    ...     y = rco.simulate(true, rco.Measurement(force, np.zeros(1500), dt=0.02), "zero").outputs[0]
    ...     records.append(rco.Measurement(force, y + 0.02 * rng.standard_normal(1500), dt=0.02))
    >>> softer = rco.refine(model, records[0], [rco.Effect("stiffness", "link1")])
    >>> rco.confirm(softer, records).verdict
    'confirmed'
    """
    if not isinstance(model, Refinement):
        raise ct.ControlArgument(f"model must be a Refinement, not {type(model).__name__}; call refine first")
    force_ratio = as_number(force_ratio, "force_ratio", least=0.0)
    significance = as_share(significance, "significance")
    matters = levels().matters if matters is None else as_number(matters, "matters", least=0.0)
    # settings, records and channels
    check_settings(model.physical_model, tolerance=tolerance, noise=noise)
    records = as_records(data)
    if len(records) < 2:
        raise ct.ControlArgument("data holds one record; give the one that taught the effects and another")
    ordered = [ordered_record(model.physical_model, r) for r in records]
    for number, record in enumerate(ordered, 1):
        check_channels(model.physical_model.linear, record)
        check_moving([record], [f"record {number}"])
    # coefficients of the added effects, and conditions that scale them
    own = [i for i, row in enumerate(model.parameters) if row.role == "effect"]
    conditions, factors = _conditions(model, own, records, scales_with)
    library = effect_library(model.physical_model) if candidates is None else candidates
    rest = not_held(as_effects(library, "candidates"), model.effects)
    # each record alone: fit under process noise relative to its amplitude, agreement, tests
    sizes = [amplitude(record) or 1.0 for record in ordered]
    fits = [
        _alone(model, record, own, force_ratio * sizes[0] / size, tolerance, noise)
        for record, size in zip(ordered, sizes, strict=True)
    ]
    estimates = _estimates(records, sizes, fits, factors, rest, significance)
    rows = [model.parameters[i] for i in own]
    what = _what(rows, scales_with)
    verdict, p_value, message = _concluded(what, estimates, significance, matters)
    names, units = tuple(row.name for row in rows), tuple(row.unit for row in rows)
    return Confirmation(verdict, p_value, names, units, tuple(estimates), significance, message, conditions)


def _concluded(
    what: str, estimates: Sequence[RecordEstimate], significance: float, matters: float
) -> tuple[str, float, str]:
    """Return verdict, p-value and message from the estimates of all records."""
    first, *further = estimates
    # Bonferroni over the further records
    p_value = min(1.0, len(further) * min(min(e.agreement, e.residual) for e in further))
    # refuted if a test fails in one record and the deviation matters
    level = significance / len(further)
    against = [
        e
        for e in further
        if (e.agreement < level and e.change > matters) or (e.residual < level and e.error > matters)
    ]
    if against:
        return "refuted", p_value, _refutation(what, first, against, p_value, significance)
    return "confirmed", p_value, _confirmation(what, further, p_value, significance, matters)


class _Alone(NamedTuple):
    """A model fitted to one record alone.

    Attributes
    ----------
    tested : TestedResidual
        Its residual, under the process noise of the record.
    theta, C : ndarray
        Coefficients of the effects, and their covariance.
    """

    tested: TestedResidual
    theta: Array
    C: Array


def _estimates(
    records: Sequence[Measurement],
    sizes: Sequence[float],
    fits: Sequence[_Alone],
    factors: Array,
    rest: Sequence[Effect],
    significance: float,
) -> list[RecordEstimate]:
    """Return what each record says of the effects."""
    several, first = len({record.name for record in records}) > 1, fits[0]
    found = []
    for i, (record, size, alone, f) in enumerate(zip(records, sizes, fits, factors, strict=True)):
        # Wald test of the difference; both covariances add
        off = alone.theta - f * first.theta
        agreement = wald(off, f[:, None] * first.C * f + alone.C) if i else 1.0
        tests = tuple(_tested(alone.tested, rest))
        # what the tests find, as a share of each output
        left = error_shares(alone.tested, tests, significance)
        name, sd = record.name if several else f"record {i + 1}", standard_deviations(alone.C)
        change, error = _change(alone, off), max((one.model for one in left), default=np.inf)
        level, residual = size / sizes[0], overall(tests)
        found.append(
            RecordEstimate(name, level, alone.theta, sd, agreement, tests, residual, f, change, error)
        )  # fmt: skip
    return found


def _change(alone: _Alone, off: Array) -> float:
    """Return the largest share of an output that other coefficients change.

    All else is estimated with them: the sum of squares of the innovations rises by ``off' C^-1 off``.
    """
    tested, C = alone.tested, alone.C
    # rise of the cost if the coefficients of the first record are used
    known = np.isfinite(np.diag(C))
    if not known.any() or not off.any():
        return 0.0
    rise = float(off[known] @ pseudo_inverse(C[np.ix_(known, known)])[0] @ off[known])
    problem = tested.fitted.problem
    spread = over_time(np.std, np.hstack([record.outputs for record in problem.records]))
    sizes = tested.whitener.scales / problem.weights / np.where(spread > 0, spread, np.inf)
    return float(sizes.max() * np.sqrt(rise / max(tested.residual.size, 1)))


def _conditions(
    model: Refinement, own: Sequence[int], records: Sequence[Measurement], asked: Mapping[str, Any] | None
) -> tuple[dict[str, tuple[float, ...]], Array]:
    """Return the conditions, and the factors that follow from them.

    Conditions are those of each effect that changes with one, in each record. Factors are those of each
    coefficient (columns) in each record (rows), relative to the first one.
    """
    structure = model.simulation_structure()[0]
    parameters = [structure.parameters[i] for i in own]
    keys = [f"{e.kind}@{e.place}" for e in (structure.effects[q.effect] for q in parameters)]
    # factor of each coefficient: its condition over that of the first record
    found, factors = {}, np.ones((len(records), len(own)))
    for key, given in as_mapping(asked, "scales_with", "conditions").items():
        if key not in keys:
            raise ct.ControlArgument(
                f"scales_with names {key!r}; the effects of the model are "
                f"{', '.join(sorted(set(keys))) or 'none'}"
            )
        if isinstance(given, str):
            values = np.array([_mean_of(record, given) for record in records])
        else:
            values = as_vector(given, f"scales_with[{key!r}]", len(records))
        if not (np.all(values > 0) or np.all(values < 0)):
            raise DataError(
                f"scales_with[{key!r}] is {', '.join(f'{v:.4g}' for v in values)}: a condition must be "
                "nonzero and of one sign in all records"
            )
        found[key] = tuple(map(float, values))
        for k, q in enumerate(parameters):
            if keys[k] == key and q.name not in structure.effects[q.effect].spec.shaping:
                factors[:, k] = values / values[0]
    return found, factors


def _mean_of(record: Measurement, label: str) -> float:
    """Return the mean of a signal of a record, by its name."""
    labels = [*record.input_labels, *record.output_labels]
    if label not in labels:
        raise ct.ControlArgument(
            f"scales_with names the signal {label!r}; record {record.name!r} has {', '.join(labels)}"
        )
    return float(np.nanmean(np.concatenate([record.inputs, record.outputs])[labels.index(label)]))


def _what(rows: Sequence[EstimatedParameter], scaled: Mapping[str, Any] | None) -> str:
    """Name the effects, each with the condition that it changes with."""
    ways = {
        key.replace("@", " at ", 1): f" in proportion to {by if isinstance(by, str) else 'the condition'}"
        for key, by in (scaled or {}).items()
    }
    labels = dict.fromkeys(f"{row.kind} at {row.place}" for row in rows)
    return " with ".join(label + ways.get(label, "") for label in labels)


def _confirmation(
    what: str, further: Sequence[RecordEstimate], p_value: float, level: float, matters: float
) -> str:
    """Return what is confirmed, with a caution if the amplitudes are similar."""
    what = what or "model without an added effect"
    other = any(abs(np.log(e.level)) > 0.25 for e in further)
    caution = "" if other else " The amplitudes are similar, so a similar effect could pass, too."
    if p_value >= level:
        return f"The same {what} explains every record ({chance(p_value, 'p')}).{caution}"
    left = in_percent(max(max(e.change, e.error) for e in further))
    return (
        f"The same {what} explains every record to {left} of the motion; the tests find an error "
        f"({chance(p_value, 'p')}), but less than what matters ({in_percent(matters)}).{caution}"
    )


def _refutation(
    what: str, first: RecordEstimate, against: Sequence[RecordEstimate], p_value: float, level: float
) -> str:
    """Return what refutes a model: the record that deviates most."""
    worst = min(against, key=lambda e: min(e.agreement, e.residual))
    other = worst.agreement <= worst.residual
    why, size = ("other coefficients", worst.change) if other else ("something more", worst.error)
    much = f", {in_percent(size)} of the motion" if np.isfinite(size) else ""
    verdict = f"{what or 'The model without an added effect'} is refuted: {worst.name} needs {why}"
    verdict = f"{verdict} ({chance(p_value, 'p')}{much})."
    if first.residual < level:
        return f"{verdict} It does not explain the first record either ({chance(first.residual, 'p')})."
    return f"{verdict} It only mimics what is missing." if what else verdict


def _alone(
    model: Refinement, record: Measurement, effects: list[int], ratio: float, tolerance: float, noise: Any
) -> _Alone:
    """Fit the model to one record alone.

    `effects` are the positions of the coefficients of the effects.
    """
    # ordinary fit first, as a start
    with unheard(IdentifiabilityWarning):
        own = refit(model, [record], elsewhere=False, tolerance=tolerance, noise=noise)
    fitted = fitted_from(
        own, windows(own.physical_model, [record], None)[0], tolerance=tolerance, noise=noise
    )
    problem, point = fitted.problem, fitted.point
    # with process noise: iterate descent and whitening under the Kalman gain
    gain = observer_gain(fitted.structure, model.theta, problem.records[0], ratio) if ratio > 0 else None
    for _ in range(_ROUNDS):
        whitener = problem.whitener([r for r, _ in evaluated(problem, point, gain)])
        point = descend(problem, point, gain=gain, whitener=whitener, evaluations=10, tolerance=1e-8).point
    # sandwich covariance with the final whitening
    blocks = evaluated(problem, point, gain)
    C = coefficient_covariance(problem, blocks, problem.whitener([r for r, _ in blocks]))
    fitted = FittedModel(own, problem, point, tolerance)
    if gain is not None:
        fitted._gains[ratio] = gain
    return _Alone(TestedResidual(fitted, ratio), fitted.theta[effects], C[np.ix_(effects, effects)])


def _tested(tested: TestedResidual, rest: Sequence[Effect]) -> list[FTest]:
    fitted, ratio = tested.fitted, tested.ratio
    motions = [Motion(fitted.structure, fitted.theta, record) for record in fitted.problem.records]
    # candidates, then free forces at the places of the effects
    scored = candidate_columns(fitted, rest, motions[0], (ratio,))
    roles = fitted.refinement.roles
    places = [e.place for e, role in zip(fitted.structure.effects, roles, strict=True) if role == "effect"]
    # none of these: a law that only mimics leaves a force of its own behind
    free = [test for place in dict.fromkeys(places) for test in Beside(tested, place).tests()]
    return [*run_tests(tested, scored, motions), *free]


@dataclass(frozen=True, slots=True, eq=False)
class RecordEstimate(Row):
    """The model fitted to one record alone.

    Attributes
    ----------
    name : str
        Name of the record.
    level : float
        Its amplitude over that of the first record: rms of the inputs, in free decays of the outputs.
    coefficients, std : ndarray, shape (p,)
        Of the effects.
    agreement : float
        p-value that they are those of the first record, 1 for the first itself.
    tests : tuple of FTest
        Tests of the residual.
    residual : float
        p-value of all of them together.
    factors : ndarray, shape (p,)
        Ratio of each coefficient to that of the first record if the law is the same; 1 without a condition.
    change : float
        What the coefficients of the first record change of an output, as a share of its spread.
    error : float
        At most this share of the spread of an output is an error of the model.
    """

    name: str
    level: float
    coefficients: Array
    std: Array
    agreement: float
    tests: tuple[FTest, ...]
    residual: float
    factors: Array
    change: float = 0.0
    error: float = np.inf


@dataclass(frozen=True, slots=True, eq=False)
class Confirmation(Result):
    """Agreement of the effects and their coefficients over all records.

    Attributes
    ----------
    verdict : str
        "confirmed" or "refuted".
    p_value : float
        The smallest of agreement and residual over the further records, corrected for
        their number.
    names : tuple of str
        Coefficients that were compared.
    units : tuple of str
        Their units.
    estimates : tuple of RecordEstimate
        One per record.
    significance : float
        Level.
    message : str
        The outcome in a sentence.
    conditions : dict
        For each effect that changes in proportion to a condition (``"kind@place"``) the condition in each
        record.
    """

    verdict: str
    p_value: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    estimates: tuple[RecordEstimate, ...]
    significance: float
    message: str
    conditions: dict[str, tuple[float, ...]] = field(default_factory=dict)

    def sentences(self) -> list[str]:
        """Return the findings, one sentence each.

        Returns
        -------
        list of str
        """
        return [
            self.message,
            "agreement: chance of such a difference from the first record if the law is the same; residual: "
            "p-value of the tests on what the refitted model leaves; level: amplitude over that of "
            "the first.",
        ]

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Coefficients from each record alone, with their 95 % intervals.

        Parameters
        ----------
        ax : Axes or array of Axes, optional
            Where to draw, one per coefficient.
        label : str, optional
            Label of the estimates.
        show_legend : bool, optional
            Force the legend on or off; default: on where a label is given.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)
