"""Whether an effect takes away what else would have to be noise of a color that suits it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..inference.basis import in_own_units, project
from ..inference.levels import Levels, levels
from ..inference.sensitivities import Candidate
from ..inference.whitening import Whitener
from ..systems.linear import Array
from ..words import frequency_text
from .residual_tests import TestedResidual
from .spectral_line import spectral_line

__all__ = ["gain_over_color", "is_drowned", "left_to_noise", "takes_error_for_color"]


def gain_over_color(battery: TestedResidual, candidates: Sequence[Candidate]) -> float:
    """Log-likelihood that the best candidate gains where the noise is what it leaves.

    Parameters
    ----------
    battery : TestedResidual
        Residual of the model.
    candidates : sequence of Candidate
        With columns at its ratio.

    Returns
    -------
    float
        Each column paid for by half the log of the number of samples. 0 where the residual is
        white, for then its tests say the same, and where every candidate leaves most of the color.

    Notes
    -----
    A filter fitted to a residual makes noise of all of it. A fault near a resonance, where the
    columns of the fault pass the filter as little, then passes every test. So each side has a
    filter of its own here, that of the candidate fitted to what ordinary least squares leaves.
    Noise near that resonance that has nothing to do with the candidate keeps its color without it.
    """
    if not any(battery.whitener.orders):
        return 0.0
    residuals = battery.fitted.residuals(battery.ratio)
    plain = TestedResidual(battery.fitted, battery.ratio, Whitener.fit(residuals, order=0))
    n, best = sum(r.shape[1] for r in residuals), 0.0
    none, color = _likelihood(plain.left, residuals)
    for candidate in candidates:
        if battery.ratio not in candidate.columns:
            continue
        columns = project(in_own_units(plain.whiten(candidate.columns[battery.ratio])), plain.basis)
        x, _, rank, _ = np.linalg.lstsq(columns, plain.left, rcond=1e-7)
        reached, left = _likelihood(plain.left - columns @ x, residuals)
        if left < levels().color_left * color:
            best = max(best, reached - 0.5 * int(rank) * float(np.log(n)) - none)
    return best


def takes_error_for_color(battery: TestedResidual, candidates: Sequence[Candidate], levels: Levels) -> bool:
    """Whether a residual that passes may be a model error: much of it is color, or a candidate fits it."""
    return left_to_noise(battery, levels) != "" or gain_over_color(battery, candidates) >= levels.color


def left_to_noise(battery: TestedResidual, levels: Levels) -> str:
    """Where much of a residual passes for noise with a memory: the error of a model may look like that.

    Parameters
    ----------
    battery : TestedResidual
        Residual that passed.
    levels : Levels
        How much of it may be color.

    Returns
    -------
    str
        What that is in words, empty where little does.
    """
    fit, memory = _fit_and_memory(battery)
    if memory == 0.0 or (fit >= levels.colored_fit and memory < levels.colored_size):
        return ""
    run = "The prediction" if battery.fitted.refinement.led else "The free run"
    problem = battery.fitted.problem
    residuals = battery.fitted.residuals(battery.ratio)
    line = spectral_line(residuals, problem.records[0].dt) if problem.in_time else None
    pure = ""
    if line is not None:
        at, share = frequency_text(2 * np.pi * line[0]), line[1]
        pure = (
            f" {100 * share:.0f} % of that rest is a line at {at}: an unmeasured force or a "
            "disturbance of that frequency."
        )
    lasts = ""
    if problem.in_time:
        # samples after which the slowest mode of the filters has decayed to 1/e
        slowest = max(float(np.abs(np.roots(a)).max()) for a in battery.whitener.filters if a.size > 1)
        samples = -1.0 / float(np.log(min(slowest, 1.0 - 1e-9)))
        lasts = f" of about {float(f'{samples * problem.records[0].dt:.2g}'):g} s"
    return (
        f"{run} explains only {fit:.3g} % of the record. The rest passes for noise with a memory{lasts}, "
        f"{memory:.2g} times as large as what is new in each sample: that is why no test fires.{pure} If "
        "neither the sensor nor anything unmeasured (a draft, a load) wanders like that, the model is wrong "
        "there: what comes again when the record is repeated is the model's, and one with steps up and down, "
        "or a sweep, shows what it is."
    )


def is_drowned(battery: TestedResidual, levels: Levels) -> bool:
    """Whether a residual that passes for noise with a memory leaves too little of the record explained."""
    fit, memory = _fit_and_memory(battery)
    return fit < levels.drowned and memory >= levels.colored_size


def _fit_and_memory(battery: TestedResidual) -> tuple[float, float]:
    """The worst fit in percent, and a residual with a memory over what is new in it, 0 where none has one."""
    refined, orders = battery.fitted.refinement, np.array(battery.whitener.orders)
    whole = np.hstack(battery.fitted.residuals(battery.ratio)).std(axis=1)
    memory = float(np.max(whole / battery.whitener.scales, where=orders > 0, initial=0.0))
    return float(refined.fit[np.isfinite(refined.fit)].min(initial=100.0)), memory


def _likelihood(stacked: Array, like: Sequence[Array]) -> tuple[float, float]:
    """Log-likelihood under a filter of its own, of a residual stacked as blocks of these shapes are.

    Beside it, what of that the color of the filter gains.
    """
    ends = np.cumsum([r.size for r in like])[:-1]
    blocks = [part.reshape(r.shape) for part, r in zip(np.split(stacked, ends), like, strict=True)]
    n = sum(r.shape[1] for r in like)
    own = Whitener.fit(blocks).log_likelihood(n)
    return own, own - Whitener.fit(blocks, order=0).log_likelihood(n)
