"""Models against a measured frequency response, without a record in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..data.frequency_response import FrequencyResponse
from ..data.response_record import ResponseRecord, as_responses
from ..engine.amplitude_response import ResponseEngine
from ..engine.simulation import structure_of
from ..results import Options, Result, picture, show
from ..systems.linear import Array, LinearModel
from ..systems.response import as_sampled, frequency_response
from .signals import fit_percent


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyComparison(Result):
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
    linear : bool
        Whether `responses` are those of the linear parts: no delay and no nonlinear effect is in a model.
    """

    names: tuple[str, ...]
    models: tuple[LinearModel, ...]
    measured: FrequencyResponse
    responses: NDArray[np.complex128]
    several: bool
    linear: bool = True

    def _per_model(self, array: NDArray[Any]) -> NDArray[Any]:
        # leading axis over the models only where a list was given
        return array if self.several else array[0]

    @property
    def residual(self) -> NDArray[np.complex128]:
        """Measured minus model, shape (n_y, n_w, n_omega) or (n_models, ...)."""
        return self._per_model(self.measured.response[None] - self.responses)

    @property
    def fit(self) -> Array:
        """Fit in percent over frequency, shape (n_y, n_w) or (n_models, n_y, n_w).

        100 (1 - norm(G - Gh) / norm(G - mean(G))) of the complex responses.
        """
        # as for time signals, with complex values
        return self._per_model(fit_percent(self.measured.response[None], self.responses))

    @property
    def over_noise(self) -> Array:
        """RMS of the residual relative to the standard deviation of the noise.

        It is taken over real and imaginary parts, shape as `fit`. It is 1 where only noise is left, and NaN
        where `std` of the response is not known.
        """
        # std holds for real and imaginary part each: half of the squared magnitude
        std = self.measured.std
        error = np.abs(self.measured.response[None] - self.responses)
        if std is None or not std.all():
            return self._per_model(np.full(error.shape[:-1], np.nan))
        return self._per_model(np.sqrt(0.5 * np.mean((error / std) ** 2, axis=-1)))

    @property
    def relative_error(self) -> Array:
        """Magnitude of G/G_measured - 1 at each frequency.

        Shape (n_y, n_w, n_omega) or (n_models, ...).
        """
        # relative to the measured response, infinite at its zeros
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._per_model(np.abs(self.responses / self.measured.response[None] - 1.0))

    @property
    def worst(self) -> Array:
        """Frequency in rad/s of the largest error, shape as `fit`.

        The error is taken relative to the largest magnitude.
        """
        # frequency of the largest absolute error
        error = np.abs(self.measured.response[None] - self.responses)
        return self._per_model(self.measured.omega[np.argmax(error, axis=-1)])

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


@dataclass(frozen=True, slots=True, eq=False)
class LevelComparison(Result):
    """Models beside measured frequency responses at several amplitudes.

    Attributes
    ----------
    levels : tuple of FrequencyComparison
        One for each response, in the order in which they were given.
    """

    levels: tuple[FrequencyComparison, ...]

    @property
    def fit(self) -> Array:
        """Fit of each response in percent, for each amplitude.

        Shape (n_levels, ...), and then as `FrequencyComparison.fit`.
        """
        return np.array([level.fit for level in self.levels])

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Draw the Bode plot of points and models at each amplitude.

        Parameters
        ----------
        ax : array of Axes, optional
            Axes to draw in, shape (2 n_y, n_w).
        label : str or sequence of str, optional
            Labels of the amplitudes.

        Returns
        -------
        ControlPlot
            Lines, axes, figure.
        """
        return show(self, "plot", **options)


def compare_responses(
    given: Sequence[Any], models: Sequence[LinearModel], data: Any, *, several: bool
) -> FrequencyComparison | LevelComparison:
    """Compare models with a measured frequency response.

    Channels are matched by name, otherwise by position.

    Parameters
    ----------
    given : sequence
        Models.
    models : sequence of LinearModel
        Linear parts, names unique.
    data : FrequencyResponseData, FrequencyResponse, or list of them
        Measured response, or one for each of several amplitudes.
    several : bool
        Whether a list of models was given.

    Returns
    -------
    FrequencyComparison or LevelComparison

    Raises
    ------
    control.ControlDimension
        If channels do not fit.
    """
    # amplitude by amplitude
    found = [_compare_one(given, models, measured, several) for measured in as_responses(data)]
    return LevelComparison(tuple(found)) if isinstance(data, (list, tuple)) else found[0]


def _compare_one(
    given: Sequence[Any], models: Sequence[LinearModel], measured: FrequencyResponse, several: bool
) -> FrequencyComparison:
    straight, responses, linear = [], [], True
    for each, model in zip(given, models, strict=True):
        # channels in the order of the measured response: rows are outputs, columns inputs
        rows = _order("output", model.output_labels, measured.output_labels, model.name)
        columns = _order("input", model.input_labels, measured.input_labels, model.name)
        flat = model.with_arrays(
            B=model.B[:, columns], C=model.C[rows], D=model.D[np.ix_(rows, columns)],
            input_labels=measured.input_labels, output_labels=measured.output_labels,
        )  # fmt: skip
        straight.append(flat)
        # nonlinear models by harmonic balance; sampled ones with the hold of the measurement
        whole = _with_effects(each, model, measured)
        if whole is None:
            seen = as_sampled(flat, measured.dt, measured.hold) if measured.dt > 0 else flat
            responses.append(frequency_response(seen, measured.omega))
        else:
            responses.append(whole[np.ix_(rows, columns)])
            linear = False
    names = tuple(model.name for model in models)
    return FrequencyComparison(names, tuple(straight), measured, np.array(responses), several, linear)


def _with_effects(
    given: Any, linear: LinearModel, measured: FrequencyResponse
) -> NDArray[np.complex128] | None:
    """Return the frequency response of a model with its nonlinear effects.

    None if the linear part of the model holds all effects.
    """
    # only a model with effects can be nonlinear
    if getattr(given, "simulation_structure", None) is None:
        return None
    structure, theta, _ = structure_of(given)
    if structure.is_linear or structure.field is not None:
        return None
    # response at the amplitude of the measurement
    record = ResponseRecord.plain(measured, linear)
    return ResponseEngine(structure, record).response(theta, derivatives=False)[0]


def _order(what: str, own: Sequence[str], wanted: Sequence[str], name: str) -> list[int]:
    # by label, otherwise by position
    if set(wanted) <= set(own):
        return [list(own).index(label) for label in wanted]
    if len(own) != len(wanted):
        raise ct.ControlDimension(
            f"model {name!r} has {len(own)} {what}(s) ({', '.join(own)}) and the response {len(wanted)} "
            f"({', '.join(wanted)}); name both alike, or give as many"
        )
    return list(range(len(own)))
