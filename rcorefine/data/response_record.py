"""Measured frequency response as a record.

Its rows are real and imaginary parts, divided by the standard deviation of their noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..arguments import as_list
from ..systems.linear import Array, LinearModel
from .channels import match_channels, record_for
from .frequency_response import FrequencyResponse
from .measurement import Measurement
from .record import FrequencyRecord

Places = NDArray[np.integer[Any]]
_ROUNDING = 1e-9  # of the response: no point is known better
_CORRELATED = 3  # neighboring lines of a Hann window are; every third one is on its own
_BIAS = 1.0 / 6.0  # of the second difference of neighboring lines: what a Hann window flattens


@dataclass(frozen=True, slots=True, eq=False)
class ResponseRecord(FrequencyRecord):
    """Measured frequency response in units of its noise.

    The channels are in the order of a model.

    Attributes
    ----------
    measured : FrequencyResponse
        The response.
    noise : ndarray, shape (n_y, N)
        Standard deviation of each entry of `outputs`, before it was divided by.
    known : bool
        Whether that is its size; else only how it is spread over the points, and the residual says
        how large it is.
    note : str
        Where it comes from, and what was left out.

    Notes
    -----
    N = 2 n_w n_omega: for each input the real parts at all frequencies; then the imaginary ones.
    """

    measured: FrequencyResponse
    noise: Array
    known: bool
    note: str

    @classmethod
    def of(cls, measured: FrequencyResponse, model: LinearModel) -> ResponseRecord:
        """Return the response in the order of a model's channels.

        The record includes what is known of the noise.

        Raises
        ------
        control.ControlDimension
            If a channel of the model was not measured.
        """
        rows, columns = _channels(measured, model)
        lines = np.arange(measured.omega.size)
        note = ""
        if measured.segment_length:  # by a window, under which neighbors share their noise
            lines = lines[_CORRELATED // 2 :: _CORRELATED]
            note = "Of the lines of a record every third counts: a window makes neighbors alike."
        straight = _picked(measured, rows, columns, lines)
        std, known, said = _noise(straight)
        if measured.segment_length:
            std = np.sqrt(
                std**2 + 0.5 * np.abs(_BIAS * _curvature(measured)[np.ix_(rows, columns, lines)]) ** 2
            )
        std = np.maximum(std, _ROUNDING * np.sqrt(np.mean(straight.magnitude**2, axis=(1, 2), keepdims=True)))
        std += std == 0  # an output that is zero has no rounding
        both = np.hstack([std, std]).reshape(len(std), -1)
        return cls(straight, both, known, " ".join(part for part in (note, said) if part))

    @classmethod
    def plain(cls, measured: FrequencyResponse, model: LinearModel) -> ResponseRecord:
        """All points in the order of a model's channels, each as good as another."""
        straight = _picked(measured, *_channels(measured, model), np.arange(measured.omega.size))
        n_y, n_w, n = straight.response.shape
        return cls(straight, np.ones((n_y, 2 * n_w * n)), False, "")

    @property
    def outputs(self) -> Array:
        """Real and imaginary parts over their noise, shape (n_y, N)."""
        return coded(self.measured.response) / self.noise

    @property
    def inputs(self) -> Array:
        """Peak of the sine behind each entry, shape (n_w, N).

        1 where the peak is not known.
        """
        peaks = np.ones(self.omega.size) if self.measured.amplitude is None else self.measured.amplitude
        n_w = self.measured.ninputs
        return np.tile(peaks, (n_w, 2 * n_w))

    @property
    def omega(self) -> Array:
        """Frequencies in rad/s, shape (n_omega,)."""
        return self.measured.omega

    @property
    def n_samples(self) -> int:
        """Entries of a row."""
        return int(self.noise.shape[1])

    @property
    def dt(self) -> float:
        """Sampling time in s that would just reach the highest frequency."""
        return float(np.pi / self.omega[-1])

    @property
    def name(self) -> str:
        """Name of the response."""
        return self.measured.name

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return int(self.noise.shape[0])

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return int(self.measured.ninputs)

    @property
    def output_labels(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.measured.output_labels

    @property
    def input_labels(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.measured.input_labels

    @property
    def output_units(self) -> tuple[str, ...]:
        """Units of the outputs."""
        return self.measured.output_units

    def points(self, rows: Array) -> NDArray[np.complex128]:
        """Return rows (n_y, N) as complex points (n_y, n_w, n_omega).

        The rows are in units of the noise.
        """
        parts = (rows * self.noise).reshape(self.n_outputs, 2, self.n_inputs, -1)
        return np.asarray(parts[:, 0] + 1j * parts[:, 1])

    @property
    def error_units(self) -> tuple[str, ...]:
        """Standard deviations of the noise as units of the error."""
        return ("std",) * self.n_outputs

    def deviation(self, *_: Any) -> Self:
        """Return the record itself: a response has no level."""
        return self

    def check_excitation(self, purpose: str) -> tuple[str, ...]:
        """Return nothing: each input of a response moves."""
        return ()

    def lines(self, kept: Places) -> ResponseRecord:
        """Some of the frequencies, by their numbers."""
        shape = (self.n_outputs, 2 * self.n_inputs, self.omega.size)
        noise = self.noise.reshape(shape)[:, :, kept].reshape(self.n_outputs, -1)
        return replace(self, measured=some_lines(self.measured, kept), noise=noise)


def ordered(data: Any, model: LinearModel) -> Any:
    """Return a record in the order of a model's channels."""
    if isinstance(data, Measurement):
        return record_for(data, match_channels(model, data))
    return data if isinstance(data, ResponseRecord) else ResponseRecord.of(data, model)


def coded(points: NDArray[np.complex128]) -> Array:
    """Return complex points as rows of real and imaginary parts.

    Shape (n_y, n_w, n_omega) becomes (n_y, 2 n_w n_omega).
    """
    return np.concatenate([points.real, points.imag], axis=1).reshape(points.shape[0], -1)


def as_responses(data: Any) -> list[FrequencyResponse]:
    """One frequency response or several, as a list.

    Raises
    ------
    control.ControlArgument
        If one is something else.
    """
    given = (
        [data]
        if isinstance(data, ct.FrequencyResponseData)
        else as_list(data, "data", "FrequencyResponse objects")
    )
    for i, one in enumerate(given):
        if isinstance(one, Measurement):
            raise ct.ControlArgument(
                f"data[{i}] is a Measurement among frequency responses; give records in time, or responses "
                "alone (data.frequency_response())"
            )
    return [one if isinstance(one, FrequencyResponse) else FrequencyResponse.from_frd(one) for one in given]


def some_lines(measured: FrequencyResponse, lines: Places) -> FrequencyResponse:
    """Some of the frequencies of a response, by their numbers."""
    return _picked(measured, np.arange(measured.noutputs), np.arange(measured.ninputs), lines)


def _channels(measured: FrequencyResponse, model: LinearModel) -> tuple[Places, Places]:
    """Output and input of the response for each of the model's."""
    channels = match_channels(model, measured)
    rows, columns = list(channels.outputs), list(channels.inputs)
    if -1 in rows:
        missing = [label for label, row in zip(model.output_labels, rows, strict=True) if row < 0]
        raise ct.ControlDimension(
            f"response {measured.name!r} lacks {', '.join(missing)} of model {model.name!r}; build the model "
            "with the outputs that were measured"
        )
    return np.array(rows), np.array(columns)


def _picked(measured: FrequencyResponse, rows: Places, columns: Places, lines: Places) -> FrequencyResponse:
    """Some channels and frequencies of a response."""
    at = np.ix_(rows, columns, lines)
    places = {"input_labels": columns, "output_labels": rows, "input_units": columns, "output_units": rows}
    own: dict[str, Any] = {x: [getattr(measured, x)[k] for k in which] for x, which in places.items()}
    own |= {x: getattr(measured, x) for x in ("segment_length", "n_omitted", "dt", "hold", "name")}
    return FrequencyResponse(
        measured.response[at],
        measured.omega[lines],
        std=None if measured.std is None else measured.std[at],
        coherence=None if measured.coherence is None else measured.coherence[np.ix_(rows, lines)],
        amplitude=None if measured.amplitude is None else measured.amplitude[lines],
        n_averages=measured.n_averages if np.isfinite(measured.n_averages) else None,
        **own,
    )


def _noise(measured: FrequencyResponse) -> tuple[Array, bool, str]:
    """Return the standard deviation of each point and its source.

    The flag is True if the size is known, and False if only the relative size is.
    """
    if measured.std is not None and measured.std.any():
        return measured.std, True, ""
    if measured.coherence is not None and measured.coherence.min() < 1.0 and measured.ninputs == 1:
        share = np.clip(measured.coherence, 1e-6, 1.0 - 1e-9)[:, None]
        spread = measured.magnitude * np.sqrt((1.0 - share) / share)
        return spread, False, "The noise is spread as the coherence says; its size is that of the residual."
    said = (
        "No noise is given (std=): a constant part and one in proportion are taken as neighboring points "
        "scatter; their size is that of the residual."
    )
    return _scatter(measured), False, said


def _curvature(measured: FrequencyResponse) -> NDArray[np.complex128]:
    """Return the second difference of the response at each point.

    It is -2 times the distance from the line between the neighbors. The ends copy the point next to them.
    """
    g, w = measured.response, measured.omega
    found = np.zeros(g.shape, complex)
    if w.size > 2:
        share = (w[1:-1] - w[:-2]) / (w[2:] - w[:-2])
        found[..., 1:-1] = 2.0 * (g[..., :-2] * (1.0 - share) + g[..., 2:] * share - g[..., 1:-1])
        found[..., 0], found[..., -1] = found[..., 1], found[..., -2]
    return found


def _scatter(measured: FrequencyResponse) -> Array:
    """Estimate constant and proportional noise from neighboring points.

    The sizes are relative, for each output and input.
    """
    square, power = np.abs(_curvature(measured)) ** 2, measured.magnitude**2
    floor = 1e-6 * power.mean(axis=2)
    found = np.empty(power.shape)
    for i, j in np.ndindex(power.shape[:2]):
        small = power[i, j] <= np.median(power[i, j])
        (s1, p1), (s2, p2) = (
            (float(np.median(square[i, j, part])), float(np.median(power[i, j, part])))
            if part.any()
            else (0.0, 0.0)
            for part in (small, ~small)
        )
        slope = max((s2 - s1) / (p2 - p1), 0.0) if p2 > p1 else 0.0
        found[i, j] = np.sqrt(max(s1 - slope * p1, 0.0) + slope * power[i, j] + 1e-6 * floor[i, j])
    return found
