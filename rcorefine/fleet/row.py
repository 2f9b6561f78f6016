"""Row of a survey: the result of one record as plain values.

It is small enough to send, and to keep by the million.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ..effects.effect import Effect
from ..results import Row

__all__ = ["Estimate", "SurveyRow"]


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
