"""The course of the monitor, thinned as it grows so that it never takes more room."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...systems.linear import Array

__all__ = ["ROWS", "Course"]

ROWS = 2048


class Course:
    """Rows of figures at equal steps; when full, every other row goes and the step doubles.

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
