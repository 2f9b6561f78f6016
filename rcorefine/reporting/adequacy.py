"""Whether a comparison shows that something is missing: one rule for the report and the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import beta

from ..measurement import Measurement

if TYPE_CHECKING:
    from ..comparison.result import Comparison

__all__ = ["LEVEL", "shortfalls"]

LEVEL = 0.05


def shortfalls(result: Comparison, index: int = 0) -> list[str]:
    """What a model fails at, one sentence each; empty where nothing stands out.

    Parameters
    ----------
    result : Comparison
        Models beside a record.
    index : int
        Which of the models.

    Returns
    -------
    list of str
        The rows of `Comparison.failures` in words. Where a comparison has none: the frequencies
        at which the residual runs with the inputs. Coherence compares the two frequency by
        frequency, so the color of the sensor noise plays no part; the level of 5 % is divided by
        the number of points.

    Notes
    -----
    Without a connection the squared multiple coherence of n_w inputs over m averages has a beta
    distribution with parameters n_w and m - n_w (Bendat and Piersol, Random Data, sec. 9.2).
    """
    failures: Any = getattr(result.select(index) if result.several else result, "failures", None)
    if failures is not None:
        return [str(row.sentence) for row in failures]
    return _coherent(result, index)


def _coherent(result: Comparison, index: int) -> list[str]:
    data = result.data
    residual = data.outputs - result.runs[index]
    moving = [i for i, row in enumerate(data.inputs) if np.ptp(row) > 0]
    # a free decay has no input to run with; its simulated outputs take the place
    drive = data.inputs[moving] if moving else result.runs[index]
    names = [data.input_labels[i] for i in moving] or [f"simulated {n}" for n in data.output_labels]
    if not np.ptp(residual, axis=1).any() or not (np.ptp(drive, axis=1) > 0).all():
        return []
    response = Measurement(
        drive, residual, dt=data.dt, input_labels=names, output_labels=data.output_labels
    ).frequency_response()
    chance = (
        beta.sf(response.coherence, len(names), response.n_averages - len(names)) * response.coherence.size
    )
    found = []
    for i, label in enumerate(data.output_labels):
        k = int(np.argmin(chance[i]))
        if chance[i, k] < LEVEL:
            found.append(
                (
                    float(chance[i, k]),
                    f"the residual of {label} runs with {' and '.join(names)} near "
                    f"{response.omega[k] / (2 * np.pi):.3g} Hz (coherence {response.coherence[i, k]:.2f}, "
                    f"p = {chance[i, k]:.1g})",
                )
            )
    return [sentence for _, sentence in sorted(found)]


def best_of(result: Comparison) -> int:
    """Index of the model that fits best, mean over the outputs."""
    fits = np.atleast_2d(result.fit)
    means = np.where(np.isnan(fits).all(axis=1), -np.inf, np.nan_to_num(fits, nan=0.0).mean(axis=1))
    return int(np.argmax(means))
