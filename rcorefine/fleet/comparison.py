"""Rows of a survey, and the comparison of machines.

The comparison finds common effects, individual ones, and trends. A row is the result of one record as plain
values, small enough to send and to keep by the million.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rcorefine import Effect

from ..arguments import Array
from ..results import Row
from . import pooling


@dataclass(frozen=True, slots=True)
class Estimate(Row):
    """A coefficient as one record has it.

    Attributes
    ----------
    kind, place, name : str
        Effect, place, and name of the coefficient or parameter.
    value, std : float
        Estimate (of a parameter of the model: the change of it) and standard deviation, in `unit`.
    unit : str
        Unit, "" where unknown.
    """

    kind: str
    place: str
    name: str
    value: float
    std: float
    unit: str

    @property
    def key(self) -> tuple[str, str, str]:
        """Which coefficient it is."""
        return self.kind, self.place, self.name


@dataclass(frozen=True, slots=True)
class SurveyRow(Row):
    """Result of one record of one machine.

    Rows are equal if all their values but the seconds are equal.

    Attributes
    ----------
    machine, record : str
        Names; that of a file is its name without suffix.
    number : int
        The machine's records count from 0, in order of time.
    start : float or None
        Time of the first sample in s; None where the record could not be read.
    verdict : str or None
        Of the task: as `Diagnosis.verdict` or `Improvement.verdict`; of a localization "changed", "unchanged"
        or "unexplained"; of a refinement "fitted" or "doubtful". None where it failed.
    effect, place : str or None
        The effect that was found, the surest of several, and where.
    coefficient, std : float or None
        Its first coefficient and the standard deviation, in `unit`.
    unit : str
        Unit, "" where unknown.
    probability : float or None
        Of the effect, where the task gives one.
    seconds : float
        Wall time on the worker, reading included.
    error : str or None
        Why there is no answer.
    estimates : tuple of Estimate
        All coefficients that enter the comparison of the fleet.
    effects : tuple of Effect
        All effects that were found.
    sentences : tuple of str
        What was found, in words.
    """

    machine: str
    record: str
    number: int
    start: float | None = None
    verdict: str | None = None
    effect: str | None = None
    place: str | None = None
    coefficient: float | None = None
    std: float | None = None
    unit: str = ""
    probability: float | None = None
    seconds: float = field(default=0.0, compare=False)
    error: str | None = None
    estimates: tuple[Estimate, ...] = ()
    effects: tuple[Effect, ...] = ()
    sentences: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Effect and place; "" where none was found."""
        return " at ".join(part for part in (self.effect, self.place) if part)


@dataclass(frozen=True, slots=True)
class MachineEffect(Row):
    """A coefficient of one machine, beside the fleet's.

    Attributes
    ----------
    machine : str
        Name.
    n_records : int
        Records that have an estimate.
    value, std : float
        Mean over the machine's records and its standard error.
    pooled, pooled_std : float
        The same drawn toward the fleet as far as the errors ask for it; for a machine that stands out,
        its own.
    deviation : float or None
        Difference to the other machines over its standard deviation; None where fewer than three others
        are there to compare with.
    p_value : float or None
        Of such a deviation, times the number of machines.
    stands_out : bool
        Whether the coefficient is another than that of the rest.
    """

    machine: str
    n_records: int
    value: float
    std: float
    pooled: float
    pooled_std: float
    deviation: float | None
    p_value: float | None
    stands_out: bool


@dataclass(frozen=True, slots=True)
class FleetEffect(Row):
    """Coefficient of an effect over the fleet.

    Mean and spread are those of the machines that do not stand out.

    Attributes
    ----------
    kind, place, name, unit : str
        Effect, place, coefficient, unit.
    sort : str
        "common" (more than half of the machines have it, and their mean is not zero), "own" (not
        common, but one machine or a few have it), "unclear".
    n_machines : int
        Machines that were examined, whether they have an estimate or not.
    mean, std : float
        Mean over the machines and its standard error.
    spread : float
        Standard deviation between machines, beyond the errors.
    p_value : float
        Of a mean of zero, Holm over the effects.
    p_alike : float
        Of such differences between machines where there are none.
    machines : tuple of MachineEffect
        Those that have an estimate.
    """

    kind: str
    place: str
    name: str
    unit: str
    sort: str
    n_machines: int
    mean: float
    std: float
    spread: float
    p_value: float
    p_alike: float
    machines: tuple[MachineEffect, ...]

    @property
    def label(self) -> str:
        """Effect and place, and the coefficient where it is called otherwise."""
        name = "" if self.name == self.kind else f" ({self.name})"
        return f"{self.kind} at {self.place}{name}"

    @property
    def standing_out(self) -> tuple[MachineEffect, ...]:
        """Machines whose coefficient is another than that of the rest."""
        return tuple(m for m in self.machines if m.stands_out)


@dataclass(frozen=True, slots=True)
class Trend(Row):
    """A coefficient of one machine over its records.

    Attributes
    ----------
    machine, kind, place, name, unit : str
        Whose, and which.
    n_records : int
        Records with an estimate.
    slope, std : float
        Change per `per`, and its standard deviation.
    per : str
        "s" where the records begin later and later, else "record".
    p_value : float
        Of a slope as large where nothing changes, Holm over machines and coefficients.
    grows : bool
        Whether it changes with time: at the level of the survey.
    """

    machine: str
    kind: str
    place: str
    name: str
    unit: str
    n_records: int
    slope: float
    std: float
    per: str
    p_value: float
    grows: bool

    @property
    def label(self) -> str:
        """Effect and place."""
        return f"{self.kind} at {self.place}"


def fleet_effects(rows: Sequence[SurveyRow], level: float) -> tuple[FleetEffect, ...]:
    """Every coefficient that any record has, over the machines.

    Parameters
    ----------
    rows : sequence of SurveyRow
        All rows.
    level : float
        Rate of false claims: that a coefficient is common, that any machine stands out.

    Returns
    -------
    tuple of FleetEffect
        The common ones first, the surest first.
    """
    examined = len({row.machine for row in rows if row.error is None})
    known = _by_coefficient(rows)
    drafts = []
    for coefficient in known:
        pooled = [pooling.pool(values, variances) for _, values, variances in coefficient.courses.values()]
        values, variances = np.array([p.mean for p in pooled]), np.array([p.std**2 for p in pooled])
        out = pooling.standing_out(values, variances, level / len(known))
        rest = pooling.pool(values[~out], variances[~out])
        drafts.append((coefficient, values, variances, out, rest))
    p_values = _holm([rest.p_value for *_, rest in drafts])
    effects = []
    for (coefficient, values, variances, out, rest), p_value in zip(drafts, p_values, strict=True):
        most = 2 * int((~out).sum()) > examined
        common = most and p_value <= level
        sort = "common" if common else "own" if out.any() or not most else "unclear"
        effects.append(
            FleetEffect(
                *coefficient.key, coefficient.unit, sort, examined, rest.mean, rest.std, rest.spread,
                p_value, rest.p_alike, _machines(coefficient, values, variances, out, rest),
            )
        )  # fmt: skip
    order = ("common", "own", "unclear")
    return tuple(sorted(effects, key=lambda effect: (order.index(effect.sort), effect.p_value)))


def _machines(
    coefficient: _Coefficient, values: Array, variances: Array, out: NDArray[np.bool_], rest: pooling.Pooled
) -> tuple[MachineEffect, ...]:
    """Each machine beside the others."""
    std = np.sqrt(variances)
    drawn, drawn_std = pooling.shrunk(values, variances, rest)
    judged = values.size >= pooling.LEAST
    away, chance = pooling.deviations(values, variances, ~out) if judged else (std, std)
    count = int((~out).sum()) + 1
    return tuple(
        MachineEffect(
            name, len(course[0]), float(values[i]), float(std[i]),
            float(values[i] if out[i] else drawn[i]), float(std[i] if out[i] else drawn_std[i]),
            float(away[i]) if judged else None, min(1.0, float(chance[i]) * count) if judged else None,
            bool(out[i]),
        )
        for i, (name, course) in enumerate(coefficient.courses.items())
    )  # fmt: skip


def trends(rows: Sequence[SurveyRow], level: float) -> tuple[Trend, ...]:
    """Return the trend of every coefficient of every machine.

    A machine needs three estimates of the coefficient, or more.

    Parameters
    ----------
    rows, level
        As in `fleet_effects`.

    Returns
    -------
    tuple of Trend
        The surest first.
    """
    found = []
    for coefficient in _by_coefficient(rows):
        courses = {
            name: course
            for name, course in coefficient.courses.items()
            if len(course[0]) >= pooling.LEAST_TIMES
        }
        if courses:
            slope, std, p_values = pooling.slopes(list(courses.values()))
            found += [
                (coefficient, name, len(courses[name][0]), float(slope[i]), float(std[i]), float(p_values[i]))
                for i, name in enumerate(courses)
            ]
    result = [
        Trend(name, *c.key, c.unit, n, slope, std, c.per[name], p, p <= level)
        for (c, name, n, slope, std, _), p in zip(found, _holm([p for *_, p in found]), strict=True)
    ]
    return tuple(sorted(result, key=lambda trend: trend.p_value))


@dataclass(slots=True)
class _Coefficient:
    """Estimates of one coefficient for all machines.

    There are times, values and variances for each machine.
    """

    key: tuple[str, str, str]
    unit: str
    courses: dict[str, pooling.Course]
    per: dict[str, str]


def _by_coefficient(rows: Sequence[SurveyRow]) -> list[_Coefficient]:
    """All estimates, sorted by coefficient and machine."""
    of_machine: dict[str, list[SurveyRow]] = {}
    for row in rows:
        if row.error is None:
            of_machine.setdefault(row.machine, []).append(row)
    found: dict[tuple[str, str, str], _Coefficient] = {}
    for machine, mine in of_machine.items():
        starts = [row.start for row in mine if row.start is not None]
        clock = len(mine) > 1 and len(starts) == len(mine) and bool(np.all(np.diff(starts) > 0))
        entries: dict[tuple[str, str, str], list[tuple[float, float, float]]] = {}
        for row in mine:
            for e in row.estimates:
                when = row.start if clock and row.start is not None else float(row.number)
                entries.setdefault(e.key, []).append((when, e.value, e.std**2))
                found.setdefault(e.key, _Coefficient(e.key, e.unit, {}, {}))
        for key, listed in entries.items():
            times, values, variances = np.array(listed).T
            found[key].courses[machine] = (times, values, variances)
            found[key].per[machine] = "s" if clock else "record"
    return list(found.values())


def _holm(p_values: Sequence[float]) -> list[float]:
    """p-values for all together."""
    order = np.argsort(p_values, kind="stable")
    left = np.arange(len(p_values), 0, -1)
    found = np.empty(len(p_values))
    found[order] = np.maximum.accumulate(np.minimum(1.0, left * np.asarray(p_values)[order]))
    return [float(p) for p in found]
