"""Filters that whiten residuals, common to them and to their regressors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ..exceptions import DataError
from ..systems.linear import Array
from .autoregression import autoregression

_HUBER = 1.345  # times the standard deviation; of normal noise 95 % of the efficiency is kept
_HEAVY = 5.0  # excess kurtosis, in its standard deviations, from which samples count as unequally noisy


def innovations(a: Array, signal: Array) -> Array:
    """Return the innovations of a signal under a whitening filter.

    The shape is (N,) or (N, k). The signal is taken as zero before its first sample.
    """
    if a.size == 1:
        return signal
    if signal.ndim == 1:
        return np.convolve(signal, a)[: signal.size]
    left = np.zeros_like(signal)
    for j in np.flatnonzero(signal.any(axis=0)):  # an initial state is felt in its own window only
        left[:, j] = np.convolve(signal[:, j], a)[: len(signal)]  # a third of lfilter's time in windows
    return left


def whitened(signal: Array) -> Array:
    """Return the innovations of a signal (N,) under its own model.

    The mean is removed. The innovations begin at the first sample with a whole past.
    """
    a, _ = autoregression(signal)
    return innovations(a, signal - signal.mean())[a.size - 1 :]


@dataclass(frozen=True, slots=True, eq=False)
class Whitener:
    """Autoregressive filters, one per output, for residuals and regressors.

    Attributes
    ----------
    filters : tuple of ndarray
        Whitening polynomials, leading coefficient 1.
    scales : ndarray, shape (n_y,)
        Standard deviation of each innovation.
    """

    filters: tuple[Array, ...]
    scales: Array

    @classmethod
    def fit(
        cls,
        residuals: Sequence[Array],
        *,
        order: int | None = None,
        most: int | None = None,
        floor: float = 0.0,
    ) -> Whitener:
        """Filters from residuals, each of shape (n_y, N).

        Parameters
        ----------
        residuals : sequence of ndarray
            One for each record.
        order, most : int, optional
            As of `autoregression`.
        floor : float
            Standard deviation below which an innovation is rounding.
        """
        models = [autoregression(row, order=order, most=most) for row in np.concatenate(residuals, axis=1)]
        scales = np.sqrt([variance + floor**2 for _, variance in models])
        return cls(tuple(a for a, _ in models), np.where(scales > 0, scales, 1.0))

    @property
    def orders(self) -> tuple[int, ...]:
        """Order of each filter, 0 for white."""
        return tuple(a.size - 1 for a in self.filters)

    def of_output(self, i: int, signal: Array) -> Array:
        """Whiten a signal (N,) or (N, k) of one output.

        The result begins at the first sample with a whole past.
        """
        a = self.filters[i]
        with np.errstate(over="ignore"):  # the column of an enormous unit is as enormous
            return np.asarray(innovations(a, signal)[a.size - 1 :] / self.scales[i])

    def apply(self, blocks: Sequence[Array]) -> Array:
        """Whiten blocks of shape (n_y, N) or (n_y, N, k) and stack their rows.

        The first samples of each block, where the filter has no past, are left out.

        Raises
        ------
        DataError
            If that leaves none.
        """
        rows = [self.of_output(i, block[i]) for block in blocks for i in range(len(self.filters))]
        white = np.concatenate(rows, axis=0)
        if not len(white):
            raise DataError(
                f"free runs of {max(block.shape[1] for block in blocks)} samples are too short to test: the "
                "noise is correlated for longer; give a longer horizon, or a longer record"
            )
        return white

    def log_likelihood(self, n_samples: int) -> float:
        """Return the log-likelihood of the fitted residual, up to a constant.

        `n_samples` is the number of its samples.
        """
        return -n_samples * float(np.sum(np.log(self.scales)))

    def outputs(self, blocks: Sequence[Array]) -> NDArray[np.intp]:
        """Output that each row of `apply` belongs to."""
        orders = self.orders
        return np.concatenate([np.full(b.shape[1] - p, i) for b in blocks for i, p in enumerate(orders)])


def huber_weights(residual: Array, outputs: NDArray[np.intp]) -> Array | None:
    """Return the square roots of Huber's weights, or None.

    The result is None where the samples look equally noisy.

    Parameters
    ----------
    residual : ndarray, shape (N,)
        Whitened residual.
    outputs : ndarray of int, shape (N,)
        Output that each sample belongs to; each has a scale of its own.

    Returns
    -------
    ndarray or None

    Notes
    -----
    A few large samples hide what the many others show. Weighted, both count by what they can
    say. The weights follow the size of the residual, not its sign, so they favor no column.
    """
    weights, heavy = np.ones(residual.size), False
    for i in np.unique(outputs):
        mine = outputs == i
        r = residual[mine]
        known = r[r != 0.0]  # a sample that is not judged is exactly zero
        scale = float(np.median(np.abs(known))) / stats.norm.ppf(0.75) if known.size else 0.0
        if scale <= 0.0:
            continue
        square = (known / scale) ** 2
        excess = float(np.mean(square**2) / np.mean(square) ** 2) - 3.0
        heavy = heavy or excess > _HEAVY * np.sqrt(24.0 / known.size)
        weights[mine] = np.sqrt(np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(r), 1e-9 * scale)))
    return weights if heavy else None
