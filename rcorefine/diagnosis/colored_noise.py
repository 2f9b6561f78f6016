"""Residuals that pass the tests only as colored noise.

A missing effect may explain what otherwise has to be noise of a suitable color.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..inference.levels import Levels, levels
from ..systems.linear import Array
from ..words import frequency_text
from .residual_tests import TestedResidual

__all__ = ["is_drowned", "left_to_noise", "spectral_line"]

_LOBE, _BESIDE = 2, 12  # bins of a Hann window's line on either side, and of what is compared with it
_PARTS = 8  # of the record, in each of which the line stands
_SHORTEST = 200  # samples


def spectral_line(residuals: Sequence[Array], dt: float) -> tuple[float, float] | None:
    """Frequency of the line that makes up most of a residual, if there is one.

    Parameters
    ----------
    residuals : sequence of ndarray of shape (n_y, N)
        Of each record; the longest is looked at.
    dt : float
        Sampling time (s).

    Returns
    -------
    frequency, share : float
        In Hz, and of the power of that output; None where no line stands out that keeps its phase.
    """
    longest = max(residuals, key=lambda block: block.shape[1])
    found = [line for row in longest if (line := _line(row - row.mean(), dt)) is not None]
    return max(found, key=lambda line: line[1], default=None)


def _line(row: Array, dt: float) -> tuple[float, float] | None:
    n = row.size
    if n < _SHORTEST or not row.any():
        return None
    window = np.hanning(n)
    power = np.abs(np.fft.rfft(window * row)) ** 2
    k = int(np.argmax(power[_LOBE + 1 : -_BESIDE])) + _LOBE + 1
    near = slice(k - _LOBE, k + _LOBE + 1)
    beside = np.concatenate([power[max(k - _BESIDE, 1) : near.start], power[near.stop : k + _BESIDE + 1]])
    level = levels()
    if power[k] < level.line * beside.mean() or power[near].sum() < level.line_share * power.sum():
        return None
    bins = k + np.linspace(-1.0, 1.0, 81)
    waves = np.exp(-2j * np.pi * np.outer(bins, np.arange(n)) / n)
    best = int(np.argmax(np.abs(waves @ (window * row))))
    parts = np.array([part.mean() for part in np.array_split(waves[best] * row, _PARTS)])
    if np.abs(parts - parts.mean()).max() > level.line_drift * abs(parts.mean()):
        return None
    return float(bins[best] / (n * dt)), float(power[near].sum() / power.sum())


def left_to_noise(tested: TestedResidual, levels: Levels) -> str:
    """Describe a large residual that passes for colored noise.

    The error of a model may look like that.

    Parameters
    ----------
    tested : TestedResidual
        Residual that passed.
    levels : Levels
        How much of it may be color.

    Returns
    -------
    str
        What that is in words, empty where little does.
    """
    fit, memory = _fit_and_memory(tested)
    if memory == 0.0 or (fit >= levels.colored_fit and memory < levels.colored_size):
        return ""
    run = "The prediction" if tested.fitted.refinement.led else "The free run"
    problem = tested.fitted.problem
    residuals = tested.fitted.residuals(tested.ratio)
    line = spectral_line(residuals, problem.records[0].dt) if problem.in_time else None
    pure = ""
    if line is not None:
        at, share = frequency_text(2 * np.pi * line[0]), line[1]
        pure = (
            f" {100 * share:.0f} % of the residual is a line at {at}: an unmeasured force or a disturbance "
            "of that frequency."
        )
    lasts = ""
    if problem.in_time:
        # until the slowest mode of the filters forgets itself to 1/e
        slowest = max(float(np.abs(np.roots(a)).max()) for a in tested.whitener.filters if a.size > 1)
        forgotten = -problem.records[0].dt / float(np.log(min(slowest, 1.0 - 1e-9)))
        lasts = f" of about {float(f'{forgotten:.2g}'):g} s"
    return (
        f"{run} explains only {fit:.3g} % of the record. The residual cannot be distinguished from colored "
        f"noise with a time constant{lasts}; it is {memory:.2g} times as large as its innovations.{pure} If "
        "neither the sensor nor a disturbance drifts like that, the model is wrong. Repeat the record: an "
        "error that returns is an error of the model. Steps up and down, or a sweep, show what it is."
    )


def is_drowned(tested: TestedResidual, levels: Levels) -> bool:
    """Return whether colored noise leaves too little of the fit.

    The residual passes the tests as colored noise, but the fit is low.
    """
    fit, memory = _fit_and_memory(tested)
    return fit < levels.drowned and memory >= levels.colored_size


def _fit_and_memory(tested: TestedResidual) -> tuple[float, float]:
    """Return the worst fit in percent and the color of the residual.

    The color is the size of the residual relative to its innovation, 0 where no output has colored noise.
    """
    refined, orders = tested.fitted.refinement, np.array(tested.whitener.orders)
    whole = np.hstack(tested.fitted.residuals(tested.ratio)).std(axis=1)
    memory = float(np.max(whole / tested.whitener.scales, where=orders > 0, initial=0.0))
    return float(refined.fit[np.isfinite(refined.fit)].min(initial=100.0)), memory
