"""Results of a model comparison."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Unpack

import control as ct
import numpy as np

from ..arguments import as_whole, shown
from ..data.measurement import Measurement
from ..inference.refinement import percent
from ..results import Options, Result, picture, show
from ..systems.linear import Array, LinearModel
from .failure_map.frequency import LineLevels, line_levels
from .failure_map.record import Places
from .signals import fit_percent, root_mean_square

if TYPE_CHECKING:
    from ..data.frequency_response import FrequencyResponse
    from .failure_map.search import FailureMap


KINDS = ("time", "bode", "residual", "horizon", "map", "decay")


@dataclass(frozen=True, slots=True, eq=False)
class Comparison(Result):
    """Models beside the record that they were simulated on.

    Arrays have a leading axis over the models where `compare` was given a
    list, and none where it was given one model.

    Attributes
    ----------
    names : tuple of str
        Names of the models, made unique.
    models : tuple of LinearModel
        Their linear parts, channels in the record's order.
    data : Measurement
        The record, with the outputs that were compared.
    runs : ndarray of shape (n_models, n_y, N)
        Simulated outputs.
    states : tuple of ndarray of shape (n, N)
        Simulated states of each model.
    places : tuple of Places or None
        Where forces could act on each model; None where they are still to be
        found in its matrices.
    initial_states : tuple of ndarray of shape (n_windows, n)
        Initial state of each model at the start of each window.
    starts : tuple of int
        First sample of each window; (0,) for one free run.
    horizon : float or None
        Length of the windows in s as asked for.
    x0 : str
        "estimate", "zero" or "given".
    holds : tuple of str
        How each model takes the inputs between samples: as the record declares, or
        as the model itself was found to.
    notes : tuple of str
        Channels that were reordered or left out, holds that differ.
    several : bool
        Whether a list of models was compared.
    looped : bool
        Whether `runs` are those of the loop with a controller.
    led : bool
        Whether a model has no free run over the record, so that `runs` are predictions one sample ahead.
    """

    names: tuple[str, ...]
    models: tuple[LinearModel, ...]
    data: Measurement
    runs: Array
    states: tuple[Array, ...]
    places: tuple[Places | None, ...]
    initial_states: tuple[Array, ...]
    starts: tuple[int, ...]
    horizon: float | None
    x0: str
    holds: tuple[str, ...]
    notes: tuple[str, ...]
    several: bool
    looped: bool = False
    led: bool = False
    # searched once, when first asked for
    _found: dict[int, FailureMap] = field(default_factory=dict, init=False, repr=False)

    def _per_model(self, array: Array) -> Array:
        # leading axis over the models only where a list was given
        return array if self.several else array[0]

    @property
    def fit(self) -> Array:
        """Fit in percent, shape (n_y,) or (n_models, n_y).

        100 (1 - norm(y - yh) / norm(y - mean(y))); NaN for a constant output.
        """
        # NRMSE fit, per model and output
        return self._per_model(fit_percent(self.data.outputs[None], self.runs))

    @property
    def nrmse(self) -> Array:
        """Error over the spread of the output, 1 - fit/100, same shape."""
        return 1.0 - self.fit / 100.0

    @property
    def rmse(self) -> Array:
        """Root mean square of the residual in output units.

        Shape (n_y,) or (n_models, n_y).
        """
        return self._per_model(root_mean_square(self.data.outputs[None] - self.runs))

    @property
    def residual(self) -> Array:
        """Measured minus simulated, shape (n_y, N) or (n_models, n_y, N)."""
        # measured minus simulated, (n_models, n_y, N)
        return self._per_model(self.data.outputs[None] - self.runs)

    @property
    def simulated(self) -> Array:
        """Simulated outputs, shape (n_y, N) or (n_models, n_y, N)."""
        return self._per_model(self.runs)

    @property
    def failures(self) -> Any:
        """Failures of the model: a `FailureMap`, or a tuple with one per model.

        Rows of dimension, where, measure, statistic, p_value, share of the
        error and a sentence, the most telling first; empty where the record
        gives no reason to doubt the model, whatever the color of the noise.
        Searched when first asked for, which takes a second or so per model.
        """
        maps = tuple(failures_of(self, index) for index in range(len(self.names)))
        return maps if self.several else maps[0]

    @property
    def best(self) -> int:
        """Position of the model that fits best, by the mean fit over the outputs."""
        # a model without any fit comes last
        fits = np.atleast_2d(self.fit)
        means = np.where(np.isnan(fits).all(axis=1), -np.inf, np.nan_to_num(fits, nan=0.0).mean(axis=1))
        return int(np.argmax(means))

    @property
    def legend(self) -> str:
        """Meaning of the columns of the table."""
        return (
            "fit = 100 (1 - |y - yh| / |y - mean(y)|): 100 % is perfect, 0 % is no better than the mean of "
            "the output. RMSE: root mean square of the residual (measured minus simulated), in the unit of "
            "the output. bias: mean of the residual. largest: its largest value, with the time."
        )

    @property
    def line_levels(self) -> LineLevels | None:
        """Noise, even and odd distortion of the record, line by line.

        None if no input is periodic.
        """
        # needs a periodic input: noise from the scatter over periods
        return line_levels(self.data)

    @property
    def responses(self) -> tuple[ct.TimeResponseData, ...]:
        """Simulated outputs as `control.TimeResponseData`, one per model."""
        # one response object per model, time as in the record
        return tuple(
            ct.TimeResponseData(
                self.data.timepts.copy(),
                run.copy(),
                inputs=self.data.inputs.copy(),
                output_labels=list(self.data.output_labels),
                input_labels=list(self.data.input_labels),
                issiso=self.data.n_inputs == self.data.n_outputs == 1,
                sysname=name,
            )
            for name, run in zip(self.names, self.runs, strict=True)
        )

    def seen_by(self, index: int) -> Measurement:
        """The record with the hold by which one of the models takes its inputs.

        Parameters
        ----------
        index : int
            Position of the model in `names`.

        Returns
        -------
        Measurement
        """
        # input held as the model was fitted
        return self.data.with_hold(self.holds[as_whole(index, "index", most=len(self.holds) - 1)])

    def select(self, name: str | int) -> Comparison:
        """Comparison of one of the models.

        Parameters
        ----------
        name : str or int
            Name, or position in `names`.

        Returns
        -------
        Comparison
            With arrays of shape (n_y, ...).

        Raises
        ------
        control.ControlArgument
            If there is no such model; the message lists those that exist.
        """
        # by name, or by index as in a list
        if isinstance(name, str) and name in self.names:
            index = self.names.index(name)
        elif (
            isinstance(name, int)
            and not isinstance(name, bool)
            and -len(self.names) <= name < len(self.names)
        ):
            index = name % len(self.names)
        else:
            raise ct.ControlArgument(f"no model {shown(name)}; there are {', '.join(map(repr, self.names))}")
        # all fields with an axis over the models
        fields = ("names", "models", "holds", "runs", "states", "places", "initial_states")
        return replace(self, **{key: getattr(self, key)[index:][:1] for key in fields}, several=False)

    @picture
    def plot(
        self,
        kind: str = "time",
        *,
        measured: FrequencyResponse | None = None,
        omega: Any = None,
        **options: Unpack[Options],
    ) -> ct.ControlPlot:
        """Draw the record and the models.

        Parameters
        ----------
        kind : {"time", "bode", "residual", "horizon", "map", "decay"}
            "time": measured and simulated outputs, fit % in the legend, and a
            row of residuals; of a record too long to be read, where models
            and record differ most (``set_xlim`` of the axes shows the rest).
            "bode": frequency responses of the models' linear parts as the
            record sees them (its dt and hold), measured points with a band of
            two standard deviations, and a row with the relative error.
            "residual": correlation of the residuals with
            themselves and with each input, negative lags included.
            "horizon": error against how far ahead is predicted, from one
            step to the free run. "map": `failures` as a picture.
            "decay": of a free decay, amplitude and period against time, damping
            ratio and frequency against amplitude.
        measured : FrequencyResponse, optional
            For "bode": measured response in place of
            ``data.frequency_response()``, e.g. with another segment length.
        omega : array_like, optional
            For "bode": frequencies in rad/s of the models' curves.
        ax : array of Axes, optional
            Axes to draw in, shape (2 n_y, 1) for "time", (3 n_y, n_w) for
            "bode", (n_y, 1 + n_w) for "residual", (n_y, 1) for "horizon",
            (4, n_models) for "map", (2 n_y, 2) for "decay".
        label : str or sequence of str, optional
            Labels of the models in place of their names.

        Returns
        -------
        ControlPlot
            Lines, axes, figure.

        Raises
        ------
        control.ControlArgument
            If `kind` is unknown.
        DataError
            For "bode": if the record is too short or does not excite.
        """
        return show(self, "plot", kind, measured=measured, omega=omega, **options)

    def __repr__(self) -> str:
        fits = np.atleast_2d(self.fit).mean(axis=1)
        listed = [f"{name!r} {percent(fit, fit)}" for name, fit in zip(self.names, fits, strict=True)]
        return f"<Comparison on {self.data.name!r}: {', '.join(listed)}>"


def failures_of(result: Comparison, index: int = 0) -> FailureMap:
    """Return the failure map of one of the models; empty where it is adequate."""
    from .failure_map.search import failure_map

    # search each model once
    if index not in result._found:
        result._found[index] = failure_map(result, index)
    return result._found[index]
