"""Model error model: the response from input to residual, with its band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ..data.measurement import Measurement
from ..data.welch import estimate_frequency_response
from ..results import Row
from ..systems.linear import Array
from ..systems.response import as_sampled, frequency_response

if TYPE_CHECKING:
    from .result import Comparison

__all__ = ["ModelError", "model_error"]


@dataclass(frozen=True, slots=True, eq=False)
class ModelError(Row):
    """Response from the inputs to the residual of a model.

    Attributes
    ----------
    name : str
        Model.
    omega : ndarray of shape (n_omega,)
        Frequencies in rad/s.
    error : complex ndarray of shape (n_y, n_w, n_omega)
        Measured response minus the model's, estimated from the residual, so
        that what the model explains leaks into no neighboring frequency.
    model : complex ndarray of shape (n_y, n_w, n_omega)
        Response of the model as the record sees it.
    band : ndarray of shape (n_y, n_w, n_omega)
        Radius within which the error of a correct model stays at each
        frequency with 95 %.
    simultaneous : ndarray of shape (n_y, n_w, n_omega)
        Radius within which it stays at all frequencies together with 95 %.
    """

    name: str
    omega: Array
    error: NDArray[np.complex128]
    model: NDArray[np.complex128]
    band: Array
    simultaneous: Array

    @property
    def relative(self) -> Array:
        """Size of the error over that of the model, shape (n_y, n_w, n_omega)."""
        size = np.abs(self.model)
        ratio = np.divide(np.abs(self.error), size, out=np.full(size.shape, np.nan), where=size > 0)
        return np.asarray(ratio)

    @property
    def differs(self) -> NDArray[np.bool_]:
        """Points at which the error leaves the simultaneous band.

        Shape (n_y, n_w, n_omega).
        """
        return np.asarray(np.abs(self.error) > self.simultaneous)


def model_error(comparison: Comparison, model: int = 0, *, segment_length: int | None = None) -> ModelError:
    """Estimate the response from inputs to residual, with 95 % bands.

    Parameters
    ----------
    comparison : Comparison
        Models on a record.
    model : int
        Which of the models.
    segment_length : int, optional
        Samples per averaged segment; default about N/8.

    Returns
    -------
    ModelError

    Raises
    ------
    DataError
        If the record is too short or an input does not vary.

    Notes
    -----
    The error of an H1 estimate over its standard deviation is distributed as
    the root of F with 2 and 2 (m - n_w) degrees of freedom, m the effective
    number of averages (Bendat and Piersol, Random Data, ch. 9).

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> w = rng.standard_normal(4000)
    >>> plant = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0)
    >>> y = rco.simulate(plant, rco.Measurement(w, w, dt=0.1), "zero").outputs[0]
    >>> data = rco.Measurement(w, y + 0.02 * rng.standard_normal(4000), dt=0.1)
    >>> bool(model_error(rco.compare(plant, data)).differs.any())
    False
    """
    data = comparison.seen_by(model)
    residual = Measurement(
        data.inputs, data.outputs - comparison.runs[model], dt=data.dt, hold=data.hold,
        input_labels=data.input_labels, output_labels=data.output_labels,
    )  # fmt: skip
    found = estimate_frequency_response(residual, segment_length=segment_length)
    free = 2.0 * (found.n_averages - data.n_inputs)
    # std is that of one component: the squared radius over 2 std^2 follows F
    radius = found.std * np.sqrt(2.0 * stats.f.ppf(0.95, 2, free))
    count = found.response.size
    wide = found.std * np.sqrt(2.0 * stats.f.isf(1.0 - 0.95 ** (1.0 / count), 2, free))
    seen = as_sampled(comparison.models[model], data.dt, data.hold)
    return ModelError(
        comparison.names[model],
        found.omega,
        found.response,
        frequency_response(seen, found.omega),
        radius,
        wide,
    )
