"""What a monitor shows: alarms, and the course of its probabilities."""

from __future__ import annotations

from typing import Unpack

import control as ct
import numpy as np

from ...effects.effect import Effect
from ...results import Options, picture, show
from ...systems.linear import Array
from .alarm import Alarm, MonitorRow
from .course import Course
from .sequential_test import Watch
from .standing import linear_rows
from .stream import Stream

__all__ = ["Readings"]


class Readings:
    """Properties of `Monitor` that read what it found; none changes it."""

    dt: float
    candidates: tuple[Effect, ...]
    _count: int
    _stream: Stream | None
    _watch: Watch
    _course: Course

    @property
    def n_samples(self) -> int:
        """Number of samples taken."""
        return self._count

    @property
    def alarm(self) -> Alarm | None:
        """The alarm that is on, or None."""
        return self._watch.alarm

    @property
    def past_alarms(self) -> tuple[Alarm, ...]:
        """Alarms that have ended, the last 100."""
        return tuple(self._watch.past)

    @property
    def timepts(self) -> Array:
        """Times of the rows of `probability`."""
        c = self._course
        return np.asarray((c.samples[: c.count] - 1) * self.dt)

    @property
    def probability(self) -> Array:
        """Course of the probabilities at `timepts`, shape (1 + n_candidates, n_rows).

        The first row is "nothing has changed": one half where the statistic stands at its
        threshold. The others follow in the order of `candidates`. At most 2048
        rows are kept; a longer stream is thinned.
        """
        c = self._course
        return c.rows[: c.count, : 1 + len(self.candidates)].T.copy()

    @property
    def statistic(self) -> Array:
        """Course of the largest statistic over its threshold at `timepts`, shape (n_rows,)."""
        c = self._course
        return c.rows[: c.count, -3].copy()

    @property
    def coefficient(self) -> Array:
        """Course of the named effect's first coefficient and its standard deviation, (2, n_rows).

        NaN while no alarm is on.
        """
        c = self._course
        return c.rows[: c.count, -2:].T.copy()

    @property
    def ranking(self) -> tuple[MonitorRow, ...]:
        """All candidates, the most probable first; empty during the learning phase."""
        if self._stream is None:
            return ()
        if self._watch.rows:
            return tuple(self._watch.rows)
        return tuple(linear_rows(self._stream))

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Draw statistic, probabilities and the coefficient of the named effect over time.

        Parameters
        ----------
        ax : array of Axes, shape (3, 1), optional
            Where to draw.
        label : str or sequence of str, optional
            Labels of the probabilities shown, "nothing" first.

        Returns
        -------
        ControlPlot
            Lines, axes and figure.

        Raises
        ------
        DataError
            During the learning phase, when there is nothing to draw yet.
        """
        return show(self, "plot", **options)
