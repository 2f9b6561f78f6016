"""Measured frequency response with coherence and standard deviation: python-control's, and more."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..arguments import as_choice
from ..exceptions import DataError
from ..results import Options, Result, picture, show
from ..systems.linear import Array

__all__ = ["FrequencyResponse"]


class FrequencyResponse(Result, ct.FrequencyResponseData):  # type: ignore[misc]
    """Frequency response estimated from a record, with its uncertainty.

    It passes wherever python-control takes a `FrequencyResponseData`; what is computed
    from it there is a plain one.

    Parameters
    ----------
    omega : ndarray of shape (n_omega,)
        Frequencies in rad/s.
    response : complex ndarray of shape (n_y, n_w, n_omega)
        H1 estimate, outputs per input.
    coherence : ndarray of shape (n_y, n_omega)
        Share of each output's power that all inputs together explain, from
        0 to 1 (with one input the ordinary coherence).
    std : ndarray of shape (n_y, n_w, n_omega)
        Standard deviation of the magnitude, in its unit; see Notes.
    n_averages : float
        Effective number of independent segments.
    segment_length : int
        Samples per segment.
    n_omitted : int
        Frequencies left out because an input holds no power there.
    dt : float
        Sampling time of the record in s.
    hold : str
        Hold of the record's inputs.
    input_labels, output_labels, input_units, output_units : tuple of str
        As in the record; dots, which python-control does not allow in names, become
        underscores.
    name : str
        Name of the record.

    Notes
    -----
    The standard deviation holds the random error (noise, and whatever is not
    linear in the inputs). It does not hold the bias of too short segments: a
    resonance narrower than the resolution `resolution` is flattened.
    """

    omega: Array
    dt: float
    name: str

    def __init__(
        self,
        *,
        omega: Array,
        response: NDArray[np.complex128],
        coherence: Array,
        std: Array,
        n_averages: float,
        segment_length: int,
        n_omitted: int,
        dt: float,
        hold: str,
        input_labels: Sequence[str],
        output_labels: Sequence[str],
        input_units: tuple[str, ...],
        output_units: tuple[str, ...],
        name: str,
    ) -> None:
        super().__init__(
            response,
            omega,
            dt=dt,
            name=_undotted(name),
            inputs=[_undotted(label) for label in input_labels],
            outputs=[_undotted(label) for label in output_labels],
        )
        self.coherence, self.std = coherence, std
        self.n_averages, self.segment_length, self.n_omitted = n_averages, segment_length, n_omitted
        self.hold, self.input_units, self.output_units = hold, input_units, output_units

    @classmethod
    def from_frd(cls, response: ct.FrequencyResponseData, *, hold: str | None = None) -> FrequencyResponse:
        """Take a measured response whose uncertainty is not known.

        Parameters
        ----------
        response : FrequencyResponseData
            Measured response with positive frequencies.
        hold : {"zoh", "foh", "bandlimited"}, optional
            How the inputs ran between samples; default "zoh" where the
            response has a sampling time, else "bandlimited" (continuous).

        Returns
        -------
        FrequencyResponse
            With `std` 0 and `coherence` 1.

        Raises
        ------
        control.ControlArgument
            If `response` is something else.
        DataError
            If a point is not finite or a frequency not positive.

        Examples
        --------
        >>> frd = ct.frd([1.0, 0.5], [1.0, 2.0], name="analyzer")
        >>> FrequencyResponse.from_frd(frd).name
        'analyzer'
        """
        if not isinstance(response, ct.FrequencyResponseData):
            raise ct.ControlArgument(
                f"a measured response is a FrequencyResponse or control.FrequencyResponseData, "
                f"not {type(response).__name__}; from a record take data.frequency_response()"
            )
        if hold is not None:
            as_choice(hold, "hold", ("zoh", "foh", "bandlimited"))
        omega = np.array(response.omega, dtype=float)
        values = np.array(response.frdata, dtype=complex)
        if not np.isfinite(values).all() or not (np.isfinite(omega) & (omega > 0)).all():
            raise DataError(
                f"response {response.name!r} holds points that are not finite or frequencies that are not "
                "positive; leave them out"
            )
        sampled = response.dt not in (None, True) and response.dt > 0
        return cls(
            omega=omega,
            response=values,
            coherence=np.ones((values.shape[0], omega.size)),
            std=np.zeros(values.shape),
            n_averages=float("nan"),
            segment_length=0,
            n_omitted=0,
            dt=float(response.dt) if sampled else 0.0,
            hold=hold or ("zoh" if sampled else "bandlimited"),
            input_labels=tuple(response.input_labels),
            output_labels=tuple(response.output_labels),
            input_units=("",) * values.shape[1],
            output_units=("",) * values.shape[0],
            name=str(response.name),
        )

    # python-control looks the points of a measured response up by their frequency, on the imaginary
    # axis; on the unit circle, where a sampling time would send it, it knows none of them.
    def isctime(self, strict: bool = False) -> bool:
        """Whether points are named by their frequency: always."""
        return True

    def isdtime(self, strict: bool = False) -> bool:
        """Whether points are named by where they lie on the unit circle: never."""
        return False

    @property
    def response(self) -> NDArray[np.complex128]:
        """Complex response of shape (n_y, n_w, n_omega)."""
        values: NDArray[np.complex128] = self.frdata
        return values

    @property
    def input_labels(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(self.input_index)

    @property
    def output_labels(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(self.output_index)

    @property
    def magnitude(self) -> Array:
        """Magnitude of shape (n_y, n_w, n_omega), output unit per input unit."""
        size: Array = np.abs(self.response)
        return size

    @property
    def phase(self) -> Array:
        """Phase of shape (n_y, n_w, n_omega) in rad, within -pi and pi."""
        return np.angle(self.response)

    @property
    def phase_std(self) -> Array:
        """Standard deviation of the phase in rad, at most that of a uniform phase."""
        size = self.magnitude
        ratio = np.divide(self.std, size, out=np.full_like(self.std, np.inf), where=size > 0)
        limited: Array = np.minimum(ratio, np.pi / np.sqrt(3.0))
        return limited

    @property
    def resolution(self) -> float:
        """Distance of the segments' frequency lines in rad/s; NaN where there were no segments."""
        if self.segment_length == 0:
            return float("nan")
        return 2.0 * np.pi / (self.segment_length * self.dt)

    @property
    def frd(self) -> ct.FrequencyResponseData:
        """The response alone, a plain `control.FrequencyResponseData` that keeps dt, name and labels."""
        return ct.frd(
            self.response.copy(),
            self.omega.copy(),
            dt=self.dt,
            name=self.name,
            inputs=list(self.input_labels),
            outputs=list(self.output_labels),
        )

    def __repr__(self) -> str:
        return (
            f"<FrequencyResponse {self.name!r}: {self.ninputs} input(s), {self.noutputs} output(s), "
            f"{self.omega.size} frequencies, dt={self.dt:g}>"
        )

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Bode plot with the band of two standard deviations, and the coherence.

        Parameters
        ----------
        ax : array of Axes, optional
            Axes to draw in, of the shape that a call without it returns.
        label : str, optional
            Label of the curve; default the record's name.

        Returns
        -------
        ControlPlot
            Lines, axes (3 rows per output: magnitude, phase, coherence), figure.
        """
        return show(self, "plot", **options)


def _undotted(name: str) -> str:
    return name.replace(".", "_")
