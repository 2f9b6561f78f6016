"""Samples of the stream in sequence: test, alarm and history rows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...systems.linear import Array
from ..gaps import Block
from .sequential_test import Watch
from .standing import find_state, shares, standing
from .stream import Stream

__all__ = ["ROWS", "Course", "watch_block"]

_CHUNK = 2048  # samples at a time


def watch_block(stream: Stream, watch: Watch, course: Course, block: Block, position: int = 0) -> None:
    """Process a block from `position` on, and act on the test result.

    Parameters
    ----------
    stream : Stream
        Observer, bank and windows.
    watch : Watch
        The alarm, or what goes before one.
    course : Course
        Gets a row where one is due.
    block : Block
        Samples.
    position : int, optional
        First sample to take.
    """
    total = len(block.inputs)
    while position < total:
        here = stream.n_samples
        until = min(here + total - position, here + _CHUNK, course.due(here))
        healthy = not watch.busy
        if not healthy:
            until = min(until, watch.next_event(here))
        if stream.find_at > here:
            until = min(until, stream.find_at)
        part = block.part(position, position + until - here)
        done, ratio = stream.advance(part.inputs, part.outputs, part.use, part.known, stop=healthy)
        position += done
        if healthy and ratio[-1] > 1.0:
            watch.ring(stream)
        elif not healthy and stream.n_samples >= watch.next_event(here):
            watch.attend(stream)
        if stream.n_samples == stream.find_at:
            find_state(stream)
        if stream.n_samples % course.stride == 0:
            course.add(stream.n_samples, _row(stream, watch))


def _row(stream: Stream, watch: Watch) -> Array:
    """Return a history row: probabilities, statistic and coefficient.

    The statistic is divided by its threshold. The standard deviation of the coefficient comes last.
    """
    ratio, gains = standing(stream)
    if watch.gains is None:
        p, value, std = shares(float(gains.max()), gains), math.nan, math.nan
    else:
        p, value, std = shares(watch.change(stream), watch.gains), watch.value, watch.std
    return np.concatenate([p, [ratio, value, std]])


ROWS = 2048


class Course:
    """History rows at equal steps.

    When it is full, every other row is dropped and the step doubles.

    Parameters
    ----------
    width : int
        Figures per row.
    stride : int
        Samples between rows to begin with.
    """

    def __init__(self, width: int, stride: int) -> None:
        self.stride = stride
        self.rows = np.zeros((ROWS, width))
        self.samples = np.zeros(ROWS, dtype=np.int64)
        self.count = 0

    def due(self, sample: int) -> int:
        """Number of samples taken at which the next row is due."""
        return (sample // self.stride + 1) * self.stride

    def add(self, sample: int, row: Array) -> None:
        """Keep a row, if it is due."""
        if sample % self.stride:
            return
        if self.count == ROWS:
            self.stride *= 2
            kept = self.samples % self.stride == 0
            n = self.count = int(kept.sum())
            rows, samples = np.zeros_like(self.rows), np.zeros_like(self.samples)
            rows[:n], samples[:n] = self.rows[kept], self.samples[kept]
            self.rows, self.samples = rows, samples  # new ones: what a failed update goes back to stays
            if sample % self.stride:
                return
        self.rows[self.count], self.samples[self.count] = row, sample
        self.count += 1

    def content(self) -> dict[str, Any]:
        """All as plain arrays."""
        return {
            "stride": self.stride,
            "rows": self.rows[: self.count].copy(),
            "samples": self.samples[: self.count].copy(),
        }

    @classmethod
    def restored(cls, content: dict[str, Any]) -> Course:
        """The course that `content` was taken from."""
        rows = content["rows"]
        course = cls(rows.shape[1], int(content["stride"]))
        course.count = len(rows)
        course.rows[: course.count], course.samples[: course.count] = rows, content["samples"]
        return course
