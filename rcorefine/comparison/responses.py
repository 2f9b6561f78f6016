"""Models against a measured frequency response, without a record in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..data.frequency_response import FrequencyResponse
from ..results import Options, Reported, picture, show
from ..systems.linear import Array, LinearModel
from ..systems.response import as_sampled, frequency_response

__all__ = ["FrequencyComparison", "compare_responses"]


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyComparison(Reported):
    """Models beside a measured frequency response.

    Arrays have a leading axis over the models where `compare` was given a
    list, and none where it was given one model.

    Attributes
    ----------
    names : tuple of str
        Names of the models, made unique.
    models : tuple of LinearModel
        Their linear parts.
    measured : FrequencyResponse
        Measured response.
    responses : complex ndarray of shape (n_models, n_y, n_w, n_omega)
        Responses of the models at the measured frequencies.
    several : bool
        Whether a list of models was compared.
    """

    names: tuple[str, ...]
    models: tuple[LinearModel, ...]
    measured: FrequencyResponse
    responses: NDArray[np.complex128]
    several: bool

    def _shaped(self, array: NDArray[Any]) -> NDArray[Any]:
        return array if self.several else array[0]

    @property
    def residual(self) -> NDArray[np.complex128]:
        """Measured minus model, shape (n_y, n_w, n_omega) or (n_models, ...)."""
        return np.asarray(self._shaped(self.measured.response[None] - self.responses))

    @property
    def fit(self) -> Array:
        """Fit in percent over frequency, shape (n_y, n_w) or (n_models, n_y, n_w).

        100 (1 - norm(G - Gh) / norm(G - mean(G))) of the complex responses.
        """
        mean = self.measured.response.mean(axis=-1, keepdims=True)
        spread = np.linalg.norm(self.measured.response - mean, axis=-1)
        error = np.linalg.norm(self.measured.response[None] - self.responses, axis=-1)
        spread = np.broadcast_to(spread, error.shape)
        ratio = np.divide(error, spread, out=np.full(error.shape, np.nan), where=spread > 0)
        return np.asarray(self._shaped(100.0 * (1.0 - ratio)))

    @property
    def relative_error(self) -> Array:
        """Size of G/G_measured - 1 at each frequency, shape (n_y, n_w, n_omega) or (n_models, ...)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self._shaped(np.abs(self.responses / self.measured.response[None] - 1.0)))

    @property
    def worst(self) -> Array:
        """Frequency in rad/s of the largest error over the largest magnitude, shape as `fit`."""
        error = np.abs(self.measured.response[None] - self.responses)
        return np.asarray(self._shaped(self.measured.omega[np.argmax(error, axis=-1)]))

    @picture
    def plot(
        self,
        *,
        omega: Any = None,
        **options: Unpack[Options],
    ) -> ct.ControlPlot:
        """Bode plot of all models and the measured points, with an error row.

        Parameters
        ----------
        omega : array_like, optional
            Frequencies in rad/s of the models' curves.
        ax : array of Axes, optional
            Axes to draw in, shape (3 n_y, n_w).
        label : str or sequence of str, optional
            Labels of the models in place of their names.

        Returns
        -------
        ControlPlot
            Lines, axes, figure.
        """
        return show(self, "plot", omega=omega, **options)


def compare_responses(
    models: Sequence[LinearModel], data: ct.FrequencyResponseData | FrequencyResponse, *, several: bool
) -> FrequencyComparison:
    """Compare models with a measured response; channels by name, else by position.

    Parameters
    ----------
    models : sequence of LinearModel
        Linear parts, names unique.
    data : FrequencyResponseData or FrequencyResponse
        Measured response.
    several : bool
        Whether a list was given.

    Returns
    -------
    FrequencyComparison

    Raises
    ------
    control.ControlDimension
        If channels do not fit.
    """
    measured = data if isinstance(data, FrequencyResponse) else FrequencyResponse.from_frd(data)
    straight = [_ordered(model, measured) for model in models]
    seen = [as_sampled(m, measured.dt, measured.hold) if measured.dt > 0 else m for m in straight]
    return FrequencyComparison(
        names=tuple(m.name for m in models),
        models=tuple(straight),
        measured=measured,
        responses=np.array([frequency_response(m, measured.omega) for m in seen]),
        several=several,
    )


def _ordered(model: LinearModel, measured: FrequencyResponse) -> LinearModel:
    """The model with its channels in the order of the response."""
    rows = _order("output", model.output_labels, measured.output_labels, model.name)
    columns = _order("input", model.input_labels, measured.input_labels, model.name)
    return model.with_arrays(
        B=model.B[:, columns], C=model.C[rows], D=model.D[np.ix_(rows, columns)],
        input_labels=measured.input_labels, output_labels=measured.output_labels,
    )  # fmt: skip


def _order(what: str, own: Sequence[str], wanted: Sequence[str], name: str) -> list[int]:
    if set(wanted) <= set(own):
        return [list(own).index(label) for label in wanted]
    if len(own) != len(wanted):
        raise ct.ControlDimension(
            f"model {name!r} has {len(own)} {what}(s) ({', '.join(own)}) and the response {len(wanted)} "
            f"({', '.join(wanted)}); name both alike, or give as many"
        )
    return list(range(len(own)))
