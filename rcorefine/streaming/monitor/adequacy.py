"""Adequacy of the healthy model on the samples that it learned from.

It says how far the model deviates from these samples and what to do about it.
"""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...comparison.metrics import fit_percent
from ...data.measurement import Measurement
from ...effects.effect import Effect
from ...engine.engine import Engine
from ...engine.initial_state import estimate_initial_state
from ...inference.assembly import nominal_size
from ...inference.levels import levels
from ...results import Row
from ...systems.linear import Array
from .baseline import FREE
from .numbers import Numbers
from .standing import linear_estimates
from .stream import Stream

__all__ = ["Adequacy", "adequacy_of", "explained"]

_SHOWN = 3  # numbers in the sentence


@dataclass(frozen=True, slots=True)
class Adequacy(Row):
    """Adequacy of the healthy model after the learning phase.

    It is the value of `Monitor.adequacy`.

    Attributes
    ----------
    fit : tuple of float
        Of each output by the model as it was given, in percent: 100 (1 - |y - yh| / |y - mean y|) of
        the free run; of the prediction one sample ahead where the model has no free run.
    fit_moved : tuple of float
        The same with the numbers of the model moved to where the samples want them.
    moved : dict
        Number and its relative change, those that were moved by more than 3 standard deviations.
    missing : Effect or None
        Candidate for which what is left asks.
    score : float
        How many standard deviations that is.
    adequate : bool
        Whether no candidate is missing and no number was moved by more than twice the tolerance.
    sentence : str
        All that in words, with the line of code that comes first where it is not adequate.
    """

    fit: tuple[float, ...]
    fit_moved: tuple[float, ...]
    moved: dict[str, float]
    missing: Effect | None
    score: float
    adequate: bool
    sentence: str

    def __str__(self) -> str:
        return textwrap.fill(self.sentence, 80)


def explained(
    numbers: Numbers, theta: Array, data: Measurement, use: NDArray[np.uint8], gain: Array
) -> Array:
    """Return the fit of each output in percent, shape (n_y,).

    It is that of the free run if there is one.
    """
    n = numbers.structure.n_states
    step = numbers.structure.discretize(theta, data.dt, derivatives=False).M[:, :n]
    free = float(np.abs(np.linalg.eigvals(step)).max(initial=0.0)) <= FREE
    engine, there = Engine(numbers.structure, data, substeps=numbers.substeps), use > 0
    K = None if free or not gain.any() else gain
    x0 = estimate_initial_state(engine, theta, gain=K, use=there)
    run = engine.run(theta, x0, sensitivity=False, gain=K, use=there, check=False)
    rows = zip(data.outputs, run.outputs, there.T, strict=True)
    return np.array([fit_percent(y[known], yh[known]) for y, yh, known in rows])


def adequacy_of(
    stream: Stream, given: Numbers, numbers: Numbers, tolerance: float, fits: tuple[Array, Array], dt: float
) -> Adequacy:
    """Judge the healthy model by the samples that were learned from.

    Parameters
    ----------
    stream : Stream
        After these samples.
    given, numbers : Numbers
        As they were, and as they were moved.
    tolerance : float
        Relative standard deviation of the numbers.
    fits : tuple of two ndarray, each of shape (n_y,)
        `explained` before and after.
    dt : float
        Sampling time [s].

    Returns
    -------
    Adequacy
    """
    change = (numbers.theta - given.theta)[numbers.loose]
    clear = np.abs(change) > levels().moved * np.sqrt(np.maximum(np.diag(numbers.covariance), 0.0))
    moved: dict[str, float] = {}
    for (effect, name), value, theta, seen in zip(
        numbers.moving, change, given.theta[numbers.loose], clear, strict=True
    ):
        size = nominal_size(numbers.structure, effect) or abs(float(theta))
        if seen and size > 0:
            moved[effect.label if len(effect.free) == 1 else f"{effect.label}: {name}"] = float(value) / size
    _, _, gains = linear_estimates(stream, 0)
    best = int(np.argmax(gains))
    score = math.sqrt(2 * max(float(gains[best]), 0.0))
    lacks = score >= stream.windows.levels[-1]
    missing = stream.bank.effects[stream.bank.owner[best]] if lacks else None
    far = max(map(abs, moved.values()), default=0.0) > levels().moved_wide * tolerance > 0
    before, after = (tuple(map(float, fit)) for fit in fits)
    sentence = _sentence(before, after, moved, missing, score, far, dt)
    return Adequacy(before, after, moved, missing, score, missing is None and not far, sentence)


def _sentence(
    before: tuple[float, ...],
    after: tuple[float, ...],
    moved: dict[str, float],
    missing: Effect | None,
    score: float,
    far: bool,
    dt: float,
) -> str:
    figures = [" and ".join(f"{one:.1f} %" for one in fit) for fit in (before, after)]
    said = f"The model explains {figures[0]} of the learning phase."
    if moved:
        largest = sorted(moved, key=lambda name: -abs(moved[name]))[:_SHOWN]
        by = ", ".join(f"{name} by {100 * moved[name]:+.2g} %" for name in largest)
        by += ", ..." if len(moved) > _SHOWN else ""
        said += f" With re-estimated parameters ({by}) it explains {figures[1]}."
    if missing is None and not far:
        return said + " The residual cannot be distinguished from noise: the model is adequate."
    effects = "" if missing is None else f"[rco.Effect({missing.kind!r}, {missing.place!r})], "
    if missing is not None:
        said += (
            f" {missing.label} or a similar effect is missing ({score:.0f} standard deviations). Changes "
            "that resemble it are detected late."
        )
    else:
        said += " The changes are larger than the tolerance allows."
    return (
        said + f" Next: better = rco.refine(model, healthy_record, {effects}free='linear'), then "
        f"rco.Monitor(better, dt={dt:.6g})."
    )
