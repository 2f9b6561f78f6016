"""Checks of a record without a model.

They find constant, repeated, clipped, coarse and lost samples.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...data.measurement import Measurement
from ...data.range_ends import clipped, coarse_noise, resolution, runs
from ...systems.linear import Array
from .row import LOOK, OK, STOP, CheckRow

__all__ = ["signal_rows"]

_SAME = 1.0 - 1e-9  # correlation from which two signals are one
_COARSE = 2.0  # steps of the converter over the noise
_FEW = 0.1  # of the standard deviation: a step from which on a signal has but few levels
_JUMP = 2.5  # steps of a coarse signal: its own, through zero, are smaller


def signal_rows(data: Measurement) -> Iterator[CheckRow]:
    """Rows on each signal of a record.

    Parameters
    ----------
    data : Measurement
        Record.

    Yields
    ------
    CheckRow
    """
    named = [
        *zip(data.input_labels, data.inputs, strict=True),
        *zip(data.output_labels, data.outputs, strict=True),
    ]
    still = [label for label, row in named if np.ptp(row) == 0]
    whole = len([label for label in data.input_labels if label in still]) == data.n_inputs
    for label in still:
        stop = label in data.output_labels or (whole and not data.outputs.std(axis=1).any())
        yield CheckRow(
            STOP if stop else LOOK, "motion", label, "constant",
            f"{label} never changes, so the record contains no information about it.",
        )  # fmt: skip
    if not still:
        yield CheckRow(
            OK, "motion", "", f"{len(named)} signals move", "Every signal changes over the record."
        )
    yield from _repeated([(label, row) for label, row in named if label not in still])
    for label, y in zip(data.output_labels, data.outputs, strict=True):
        if label not in still:
            yield from _output_rows(label, y)
    for label, w in zip(data.input_labels, data.inputs, strict=True):
        if label not in still and (w.min() >= 0 or w.max() <= 0) and abs(w.mean()) > 0.2 * np.abs(w).max():
            yield CheckRow(
                LOOK, "sign", label, f"{w.min():.3g} to {w.max():.3g}",
                f"{label} never changes sign, so effects that differ by direction may not be "
                "distinguishable.",
            )  # fmt: skip


def _repeated(named: list[tuple[str, Array]]) -> Iterator[CheckRow]:
    centered = {label: row - row.mean() for label, row in named}
    for i, (one, a) in enumerate(centered.items()):
        for other, b in list(centered.items())[i + 1 :]:
            like = float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b))
            if abs(like) > _SAME:
                yield CheckRow(
                    LOOK, "repeated", f"{one}, {other}", f"correlation {like:.3g}",
                    f"{one} and {other} are the same signal up to scale, so the data cannot distinguish "
                    "their effects.",
                )  # fmt: skip


def _output_rows(label: str, y: Array) -> Iterator[CheckRow]:
    side = clipped(y)
    if side is not None:
        yield CheckRow(
            LOOK, "clipping", label, f"{side[1]} samples at {side[0]:.4g}",
            f"{label} stays at exactly {side[0]:.4g} for up to {side[1]} samples: the sensor may be clipped "
            "(output_saturation, output_range), or a stop holds it.",
        )  # fmt: skip
    step, spread = resolution(y), float(y.std())
    few = step > _FEW * spread
    if few or step > _COARSE * max(coarse_noise(y), step / 4.0):
        count = f"{np.unique(y).size} levels, " if few else ""
        said = f"{step / spread:.2g} of its standard deviation" if few else "more than its noise"
        yield CheckRow(
            LOOK, "resolution", label, f"{count}steps of {step:.3g}",
            f"{label} has {count}steps of {step:.3g} ({said}): smaller changes cannot be seen.",
        )  # fmt: skip
    lost = _lost(y)
    if lost:
        yield CheckRow(
            LOOK, "dropouts", label, f"{lost} samples read 0",
            f"{label} jumps to exactly 0 and back in {lost} samples: the sensor or its connection dropped "
            "out. Mark these samples as missing if possible.",
        )  # fmt: skip


def _lost(y: Array) -> int:
    """Samples that read exactly zero between neighbors that do not."""
    first, end = runs(y == 0.0)
    inner = (first > 0) & (end < y.size)
    first, end = first[inner], end[inner]
    far = max(0.5 * y.std(), _JUMP * resolution(y))
    jumps = (np.abs(y[first - 1]) > far) & (np.abs(y[end]) > far) if first.size else np.zeros(0, dtype=bool)
    return int(np.sum((end - first)[jumps]))
