"""What the monitor says: the alarm, and the rows of its ranking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ...effects.effect import Effect
from ...views.tables import number

if TYPE_CHECKING:
    from .monitor import Monitor

__all__ = ["Alarm", "MonitorRow", "summary"]

_SHOWN = 8


@dataclass(frozen=True, slots=True)
class MonitorRow:
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
class Alarm:
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
        return self.sentence


def summary(monitor: Monitor) -> dict[str, Any]:
    """Title, table and notes of a monitor, for text and HTML."""
    n, name = monitor.n_samples, monitor._structure.linear_model.name
    stream = monitor._stream
    state = monitor.alarm
    if stream is None:
        head = f"learning, {n} of {monitor.learn} samples"
    elif state is not None:
        head = "ALARM"
    else:
        head = "a threshold was crossed, the name is not clear yet" if monitor._watch.busy else "no alarm"
    title = f"Monitor of {name!r}: {head}\n{n} samples ({n * monitor.dt:.6g} s)"
    rows = []
    for row in monitor.ranking[:_SHOWN]:
        first = next(iter(row.coefficients))
        unit = monitor._structure.model.unit(row.effect, first)
        figure = f"{number(row.coefficients[first])} +/- {number(row.std[first], 2)} {unit}".rstrip()
        rows.append([row.effect.label, figure, f"{row.probability:.3f}", number(row.log_likelihood, 3)])
    notes = [state.sentence] if state is not None else []
    notes += list(monitor.remarks)
    notes += [f"Ended: {alarm.sentence}" for alarm in monitor.past_alarms[-2:]]
    if stream is not None:
        ratio = float(monitor.statistic[-1]) if monitor.statistic.size else 0.0
        force = stream.healthy.ratio
        noise = "white" if not any(stream.healthy.orders) else f"AR({max(stream.healthy.orders)})"
        notes.append(
            f"The largest statistic stands at {ratio:.2f} of its threshold. Healthy noise: {noise}"
            + (f", unmeasured force about {100 * force:.2g} % of the input." if force else ".")
        )
        notes.append(
            "probability: of each candidate among all and nothing, alike before; gain: log-likelihood over "
            "the healthy model; " + ("figures fitted since the change." if state else "figures linearized.")
        )
    every = 1e5 / monitor.false_alarms
    notes.append(
        f"Stated: at most {monitor.false_alarms:g} false alarms in 100 000 healthy samples, one in "
        f"{_duration(every * monitor.dt)}."
    )
    return {
        "headers": ["candidate", "coefficient", "probability", "gain"],
        "rows": rows,
        "title": title,
        "notes": notes,
        "left": 1,
    }


def _duration(seconds: float) -> str:
    for size, word in ((86400 * 365, "years"), (86400, "days"), (3600, "hours"), (60, "minutes")):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {word}"
    return f"{seconds:.3g} s"
