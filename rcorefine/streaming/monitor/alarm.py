"""Alarm of the monitor, and the rows of its ranking."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

from ...effects.effect import Effect
from ...results import Row

__all__ = ["Alarm", "MonitorRow"]


@dataclass(frozen=True, slots=True)
class MonitorRow(Row):
    """One candidate of `Monitor.ranking`.

    Attributes
    ----------
    effect : Effect
        Candidate.
    coefficients : dict
        Name and estimate, in the units of the model.
    std : dict
        Standard deviations.
    probability : float
        Share among the candidates and "nothing", all of which are as likely before.
    log_likelihood : float
        Gain of log-likelihood over the healthy model, since the change.
    fitted : bool
        Whether the estimate is a nonlinear fit (after an alarm), or the linear one of the bank.
    """

    effect: Effect
    coefficients: dict[str, float]
    std: dict[str, float]
    probability: float
    log_likelihood: float
    fitted: bool


@dataclass(frozen=True, slots=True)
class Alarm(Row):
    """A change that chance does not explain.

    Attributes
    ----------
    sample : int
        Sample at which the alarm was raised, counted from the start of the stream.
    time : float
        The same in seconds.
    crossed : float
        Time [s] at which the threshold was crossed; the alarm then waits for a clear name.
    since_sample : int
        Sample since which the structure has changed, estimated.
    since : float
        The same in seconds.
    effect : Effect
        Candidate that explains the change best.
    coefficients : dict
        Name and estimate.
    std : dict
        Standard deviations.
    probability : float
        Of this effect among all candidates and "nothing".
    statistic : float
        Largest windowed score, in standard deviations.
    threshold : float
        Level that it crossed.
    false_alarms : float
        Stated expected number of false alarms per 100 000 healthy samples.
    ended : float or None
        Time [s] at which the change was gone; None while it lasts.
    sentence : str
        All that in words.
    """

    sample: int
    time: float
    crossed: float
    since_sample: int
    since: float
    effect: Effect
    coefficients: dict[str, float]
    std: dict[str, float]
    probability: float
    statistic: float
    threshold: float
    false_alarms: float
    ended: float | None
    sentence: str

    def __str__(self) -> str:
        return textwrap.fill(self.sentence, 80)
