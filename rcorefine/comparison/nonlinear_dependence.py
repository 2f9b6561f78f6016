"""Nonlinear dependence of a residual on the input and the past.

It is tested by correlations of higher order.
"""

from __future__ import annotations

from collections.abc import Sequence

import control as ct
import numpy as np
from numpy.typing import ArrayLike

from ..inference.whitening import whitened
from .correlation import lag_count, residual_and_inputs, signal_names, signal_rows, standardized
from .residual_tests import TestTable, portmanteau

__all__ = ["higher_order_correlation"]


def higher_order_correlation(
    residual: ArrayLike,
    inputs: ArrayLike,
    outputs: ArrayLike | None = None,
    lags: int = 20,
    *,
    labels: Sequence[str] | None = None,
    input_labels: Sequence[str] | None = None,
) -> TestTable:
    """Test for nonlinear dependence that linear correlations cannot see.

    Parameters
    ----------
    residual : array_like of shape (N,) or (n_y, N)
        Residuals, time last.
    inputs : array_like of shape (N,) or (n_w, N)
        Inputs over the same time.
    outputs : array_like of shape (N,) or (n_y, N), optional
        Measured outputs; adds the two tests of Billings and Zhu.
    lags : int
        Largest lag.
    labels, input_labels : sequence of str, optional
        Names.

    Returns
    -------
    TestTable
        Rows, each with means taken out and both signals whitened:
        "u^2, e" and "u^2, e^2" (Billings and Voon), "|u|, |e|" and
        "|e|, |e|" (omnidirectional: Zhang, Zhu and Longden), "y e, e^2"
        without lag 0 and "y e, u^2" (Billings and Zhu).

    Notes
    -----
    e stands for the innovations of the residual: whitened, so that coloured
    noise passes.

    References
    ----------
    Billings and Voon, Int. J. Control 44 (1986) 235; Billings and Zhu, Int.
    J. Control 62 (1995) 1201; Zhang, Zhu and Longden, Int. J. Control 80 (2007).

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> u, noise = rng.standard_normal((2, 3000))
    >>> [row.test for row in higher_order_correlation(0.3 * u**2 + noise, u).failed()][0]
    'u^2, e'
    """
    e, u = residual_and_inputs(residual, inputs)
    y = None if outputs is None else signal_rows(outputs, "outputs")
    if y is not None and y.shape != e.shape:
        raise ct.ControlDimension(f"outputs have shape {y.shape} and residuals {e.shape}")
    count = lag_count(lags, e.shape[1] // 2)
    every, both = range(count + 1), range(1, count + 1)
    rows = []
    for i, (out, row) in enumerate(zip(signal_names(labels, e.shape[0], "e"), e, strict=True)):
        if np.ptp(row) == 0.0:
            continue
        innovation = whitened(row)
        innovation = innovation / innovation.std()
        size = innovation.size
        rows.append(portmanteau("|e|, |e|", out, np.abs(innovation), np.abs(innovation), both, white=True))
        if y is not None:
            product = innovation * standardized(y[i][-size:])
            squared = innovation**2
            rows.append(portmanteau("y e, e^2", out, squared, product, both, white=True))
        for source, drive in zip(signal_names(input_labels, u.shape[0], "u"), u, strict=True):
            w, pair = standardized(drive[-size:]), f"{source} -> {out}"
            rows.append(portmanteau("u^2, e", pair, w**2, innovation, every))
            rows.append(portmanteau("u^2, e^2", pair, w**2, innovation**2, every))
            rows.append(portmanteau("|u|, |e|", pair, np.abs(w), np.abs(innovation), every))
            if y is not None:
                rows.append(portmanteau("y e, u^2", pair, w**2, product, every))
    return TestTable(
        tuple(rows),
        "A failure means that the residual depends on input or past in a way that no linear model explains.",
    )
