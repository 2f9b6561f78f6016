"""After the alarm: name the change, follow it, and notice when it is gone."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from ...inference.levels import levels
from ...models.physical_model import PhysicalModel
from ...systems.linear import Array
from ...words import with_error
from .alarm import Alarm, MonitorRow
from .standing import change_of, fit_all, fit_one, linear_estimates, shares, standing
from .stream import Stream

__all__ = ["Watch"]

_SETTLE = 4  # periods in which more samples tell the time of the change better
_FOLLOW = 8  # periods over which the coefficient is followed
_MOST_PAST = 100
_KEPT = 1e-6  # probability up to which a fit is gone on from


@dataclass(eq=False)
class Watch:
    """State of the alarm.

    Parameters
    ----------
    period : int
        Samples in a period of the first mode.
    dt : float
        Sampling time [s].
    false_alarms : float
        Stated number per 100 000 samples.
    patience : float
        Periods that an alarm may wait for a clear name.
    room : int
        Samples that the stream keeps.
    """

    period: int
    dt: float
    false_alarms: float
    patience: float
    room: int
    found: Alarm | None = None
    confirmed: bool = False
    crossed: int = 0
    mean: Array = field(default_factory=lambda: np.zeros(0))
    misfit: float = float("inf")
    place: str = ""  # that led at the last look
    past: list[Alarm] = field(default_factory=list)
    rows: list[MonitorRow] = field(default_factory=list)
    gains: Array | None = None  # log-likelihoods of all candidates since the change
    next_naming: int = 0
    next_follow: int = 0
    value: float = float("nan")
    std: float = float("nan")

    @property
    def busy(self) -> bool:
        """Return whether the structure counts as changed.

        This is so after a threshold was crossed, until the structure counts as healthy again.
        """
        return self.found is not None

    @property
    def alarm(self) -> Alarm | None:
        """The alarm, once it has a name."""
        return self.found if self.confirmed else None

    def next_event(self, sample: int) -> int:
        """Number of samples at which something is to be done, while `busy`."""
        return max(min(self.next_naming, self.next_follow), sample + 1)

    def ring(self, stream: Stream) -> None:
        """Take note that a threshold was crossed at the last sample taken."""
        sample = stream.n_samples - 1
        since, columns = change_of(stream)
        levels = stream.windows.levels
        score = np.abs(stream.memory["N"]) / np.sqrt(stream.variances())
        window = int(np.argmax((score / levels[:, None]).max(axis=1)))
        owner = int(stream.bank.owner[int(np.argmax(columns))])
        self.found = Alarm(
            sample=sample,
            time=sample * self.dt,
            crossed=sample * self.dt,
            since_sample=since,
            since=since * self.dt,
            effect=stream.bank.effects[owner],
            coefficients={},
            std={},
            probability=float("nan"),
            statistic=float(score[window].max()),
            threshold=float(levels[window]),
            false_alarms=self.false_alarms,
            ended=None,
            sentence="",
        )
        self.crossed, self.confirmed, self.misfit, self.place = sample, False, float("inf"), ""
        self.mean = stream.memory["mean_e"].copy()
        self.next_naming = self._look(sample + 1, sample + 1 if self.patience == 0 else 0)
        self.next_follow = sample + 1 + 4 * self.period
        if self.patience == 0:
            self.attend(stream)

    def _look(self, sample: int, least: int = 0) -> int:
        """Return the sample at which the ranking is updated next.

        Updates come after 1/2, 1, 2, 4, ... periods, then once per memory.
        """
        age = sample - self.crossed
        step = max(self.period // 2, 1)
        while step <= age:
            step *= 2
        return max(least, self.crossed + min(step, age + self.room))

    def attend(self, stream: Stream) -> None:
        """Do what is due."""
        sample = stream.n_samples
        assert self.found is not None
        if sample >= self.next_naming:
            settle = sample - self.crossed <= _SETTLE * self.period
            self.name(stream, settle=settle)
            self.next_naming = self._look(sample + 1)
            if not self.confirmed:
                waited = sample - 1 - self.crossed
                if self._sure() or waited >= self.patience * self.period:
                    self.confirmed = True
                    self.found = replace(self.found, sample=sample - 1, time=(sample - 1) * self.dt)
                    self._state(stream.observer.structure.model)
                else:
                    last = self.crossed + 1 + round(self.patience * self.period)
                    self.next_naming = min(self.next_naming, last)
        if sample >= self.next_follow:
            self.next_follow = sample + 4 * self.period
            self.follow(stream)

    def _sure(self) -> bool:
        """Return whether one place clearly explains the change.

        It must have nearly all of the probability, twice in a row.
        """
        places: dict[str, float] = {}
        for row in self.rows:
            places[row.effect.place] = places.get(row.effect.place, 0.0) + row.probability
        place = max(places, key=lambda name: places[name])
        before, self.place = self.place, place
        level = levels()
        clear = places[place] > level.alarm_place * sum(places.values()) and self.misfit < level.alarm_left
        return clear and place == before

    def name(self, stream: Stream, *, settle: bool) -> None:
        """Fit the candidates to the samples since the change, and rank them."""
        assert self.found is not None
        since = self.found.since_sample
        if settle:
            since = min(change_of(stream)[0], self.crossed)
        before = {
            row.effect: np.array(list(row.coefficients.values()))
            for row in self.rows
            if row.fitted and row.probability > _KEPT
        }
        window = _FOLLOW * self.period
        scored, since, misfit = fit_all(
            stream, since, self.mean, before, latest=self.crossed if settle else None, window=window
        )
        worst, least = levels().alarm_left * self.misfit, levels().alarm_worth
        if not settle and (not scored or misfit > worst or scored[0][1] < least):
            return  # the change itself is changing, or going: the name that fitted well stays
        self.misfit = misfit
        self.found = replace(self.found, since_sample=since, since=since * self.dt)
        estimates, spreads, gains = linear_estimates(stream, since)
        effects, owner = stream.bank.candidates, stream.bank.owner
        fitted = {fit.effect: (fit, gain) for fit, gain in scored}
        worst = min((gain for _, gain in scored), default=math.inf)
        all_gains = np.zeros(len(effects))
        rows: list[MonitorRow] = []
        for i, effect in enumerate(effects):
            own = np.flatnonzero(owner == i)
            if effect in fitted:
                fit, gain = fitted[effect]
                names, values, stds = effect.free, fit.coefficients, fit.std
            else:
                best = own[int(np.argmax(gains[own]))]
                # the linear figure of one that was not worth a fit: not above those that were
                gain = min(float(gains[best]), worst)
                names, values, stds = (stream.bank.names[best],), estimates[[best]], spreads[[best]]
            all_gains[i] = gain
            coefficients = dict(zip(names, map(float, values), strict=True))
            std = dict(zip(names, map(float, stds), strict=True))
            rows.append(MonitorRow(effect, coefficients, std, 0.0, float(gain), effect in fitted))
        p = shares(self.change(stream), all_gains)[1:]
        rows = [replace(row, probability=float(share)) for row, share in zip(rows, p, strict=True)]
        self.rows = sorted(rows, key=lambda row: (-row.probability, -row.log_likelihood))
        self.gains = all_gains
        self._state(stream.observer.structure.model)

    def change(self, stream: Stream) -> float:
        """Return the log-likelihood ratio of a change, 0 at the threshold.

        It is never less than its value at the alarm.
        """
        assert self.found is not None
        at_alarm = 0.5 * (self.found.statistic**2 - self.found.threshold**2)
        return max(at_alarm, float(standing(stream)[1].max()))

    def _state(self, model: PhysicalModel) -> None:
        """Write the best row into the alarm.

        If several rows explain the change equally well at that place, the simplest is taken.
        """
        assert self.found is not None
        best, near = self.rows[0], 0.5 * levels().rival
        alike = [
            row
            for row in self.rows
            if row.fitted == best.fitted
            and row.effect.place == best.effect.place
            and row.log_likelihood > best.log_likelihood - near
        ]
        row = min(alike, key=lambda one: len(one.coefficients))
        first = next(iter(row.coefficients))
        self.value, self.std = row.coefficients[first], row.std[first]
        found = replace(
            self.found,
            effect=row.effect,
            coefficients=row.coefficients,
            std=row.std,
            probability=row.probability,
        )
        others = tuple(other.effect.kind for other in alike if other is not row)
        self.found = replace(found, sentence=_sentence(found, model, others))

    def follow(self, stream: Stream) -> None:
        """Fit the named effect to the last periods alone.

        End the alarm if the effect is gone.
        """
        assert self.found is not None
        index = stream.bank.effects.index(self.found.effect)
        sample, reach = stream.n_samples, _FOLLOW * self.period
        start = sample - reach
        if start < self.found.since_sample or not self.confirmed:
            return
        before = np.array(list(self.found.coefficients.values()))
        fit, nothing = fit_one(stream, index, start, self.mean, before)
        if not fit.coefficients.size or not np.isfinite(fit.std[0]):
            return
        self.value, self.std = float(fit.coefficients[0]), float(fit.std[0])
        expected = abs(float(before[0]))
        level = levels()
        small = abs(self.value) < max(level.alarm_gone * self.std, 0.1 * expected)
        plain = nothing.cost < min(level.alarm_left * nothing.points, fit.cost + level.alarm_worth)
        if small and plain and level.alarm_missed * self.std < expected:
            self.end(stream, start, nothing.state)

    def end(self, stream: Stream, start: int, state: Array) -> None:
        """End the alarm and return to the healthy state.

        `state` is the healthy state at sample `start`.
        """
        assert self.found is not None
        gone = replace(self.found, ended=stream.n_samples * self.dt)
        if self.confirmed:
            self.past = [
                *self.past,
                replace(gone, sentence=_sentence(gone, stream.observer.structure.model)),
            ][-_MOST_PAST:]
        self.found, self.confirmed, self.rows, self.gains = None, False, [], None
        self.value = self.std = float("nan")
        stream.restart(start, state)


def _sentence(alarm: Alarm, model: PhysicalModel, others: tuple[str, ...] = ()) -> str:
    figures = ", ".join(
        f"{name} {with_error(value, alarm.std[name], model.unit(alarm.effect, name))}"
        for name, value in alarm.coefficients.items()
    )
    alike = f"; {', '.join(others)} would explain it as well" if others else ""
    ended = "" if alarm.ended is None else f" It was gone by t = {alarm.ended:.6g} s."
    return (
        f"Alarm at t = {alarm.time:.6g} s: {alarm.effect.label} since about t = {alarm.since:.6g} s "
        f"({figures}; probability {alarm.probability:.2f}{alike}).{ended}"
    )
