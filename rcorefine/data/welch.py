"""Frequency response of a record (H1) by Welch's method.

Coherence and standard deviation are estimated, too.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy import signal

from ..arguments import as_number, shown
from ..exceptions import DataError
from ..systems.linear import Array
from .frequency_response import FrequencyResponse
from .signals import check_whole

if TYPE_CHECKING:
    from .measurement import Measurement


# Where an input holds less than this share of its strongest line, nothing was asked of the system.
_POWER_FLOOR = 1e-10
# Coherence between inputs above which their effects cannot be told apart.
_SAME_INPUT = 1.0 - 1e-9


def estimate_frequency_response(
    data: Measurement,
    *,
    segment_length: int | None = None,
    overlap: float = 0.5,
    window: str | tuple[Any, ...] = "hann",
) -> FrequencyResponse:
    """Frequency response of a record by averaged periodograms (Welch, H1).

    Parameters
    ----------
    data : Measurement
        Record; its inputs must excite the frequencies of interest.
    segment_length : int, optional
        Samples per segment; default the power of two nearest N/8, which
        gives 10 to 22 overlapping segments. Longer: finer lines, more noise.
    overlap : float
        Share of a segment that the next one repeats, 0 <= overlap < 1.
    window : str or tuple
        Window for `scipy.signal.get_window`. For a periodic input take
        "boxcar", `overlap` = 0 and one period as `segment_length`.

    Returns
    -------
    FrequencyResponse
        Frequencies strictly between 0 and Nyquist. The mean of each segment
        is taken out, in the computation only.

    Raises
    ------
    DataError
        If an input is constant, if two inputs cannot be told apart, or if
        the record is too short for enough segments.

    Notes
    -----
    With the matrix of input spectra S_ww, G = S_yw S_ww^-1, the residual
    spectrum S_vv = S_yy - G S_wy and m effective averages, the variance of
    the complex G_ij is S_vv,i m/(m - n_w) [S_ww^-1]_jj / m, of which the
    magnitude carries half (Bendat and Piersol, Random Data, ch. 9).

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> w = np.random.default_rng(1).standard_normal(4000)
    >>> data = rco.Measurement(w, 2.0 * w, dt=0.01)
    >>> response = data.frequency_response()
    >>> bool(np.allclose(response.response, 2.0)), response.frd.dt
    (True, 0.01)
    """
    _check_varied(data)
    length = _segment_length(segment_length, data.n_samples)
    shared = int(as_number(overlap, "overlap", least=0.0, below=1.0, error=DataError) * length)
    taper = _taper(window, length)
    averages = effective_averages(data.n_samples, taper, shared)
    if averages <= data.n_inputs + 1:
        raise DataError(
            f"{data.n_samples} samples hold {averages:.1f} effective segments of {length}, too few for "
            f"{data.n_inputs} input(s); give a shorter segment_length or a longer record"
        )
    welch = {
        "fs": 1.0 / data.dt,
        "window": taper,
        "nperseg": length,
        "noverlap": shared,
        "detrend": "constant",
    }
    check_whole(data, "frequency_response")
    w, y = data.inputs, data.outputs
    # scipy's csd(a, b) is the mean of conj(A) B; leading axis frequency for the batched solves
    frequency, cross = signal.csd(w[None, :, :], y[:, None, :], **welch)
    s_yw = np.moveaxis(cross, -1, 0)
    s_ww = np.moveaxis(signal.csd(w[None, :, :], w[:, None, :], **welch)[1], -1, 0)
    s_yy = signal.welch(y, **welch)[1].T
    power = np.einsum("fii->fi", s_ww).real
    # neither 0 (the mean is taken out) nor Nyquist (its phase is not defined)
    inside = (frequency > 0) & (frequency < 0.5 / data.dt * (1.0 - 1e-9))
    kept = inside & (power > _POWER_FLOOR * power.max(axis=0)).all(axis=1)
    if not kept.any():
        raise DataError(
            "the inputs never hold power at the same frequency; excite them together or one per record"
        )
    s_yw, s_ww, s_yy, power = s_yw[kept], s_ww[kept], s_yy[kept], power[kept]
    _check_distinct(s_ww, power, data.input_labels)
    inverse = np.linalg.inv(s_ww)
    response = s_yw @ inverse
    explained = np.einsum("fij,fij->fi", response, s_yw.conj()).real
    coherence = np.clip(explained / np.maximum(s_yy, 1e-300), 0.0, 1.0)
    noise = np.maximum(s_yy - explained, 0.0) / (averages - data.n_inputs)
    variance = noise[:, :, None] * np.einsum("fii->fi", inverse).real[:, None, :]
    return FrequencyResponse(
        np.ascontiguousarray(np.moveaxis(response, 0, -1)),
        2.0 * np.pi * frequency[kept],
        coherence=np.ascontiguousarray(coherence.T),
        std=np.ascontiguousarray(np.moveaxis(np.sqrt(0.5 * variance), 0, -1)),
        n_averages=averages,
        segment_length=length,
        n_omitted=int(inside.sum() - kept.sum()),
        dt=data.dt,
        hold=data.hold,
        input_labels=data.input_labels,
        output_labels=data.output_labels,
        input_units=data.input_units,
        output_units=data.output_units,
        name=data.name,
    )


def effective_averages(n_samples: int, taper: Array, shared: int) -> float:
    """Effective number of independent segments (Welch 1967).

    Parameters
    ----------
    n_samples : int
        Length of the record.
    taper : ndarray of shape (L,)
        Window.
    shared : int
        Samples that neighbouring segments share.

    Returns
    -------
    float
        K / (1 + 2 sum_j (1 - j/K) rho_j), rho_j the squared correlation of
        the window with itself, j hops apart.

    Examples
    --------
    >>> effective_averages(800, np.ones(100), 0)
    8.0
    """
    length = taper.size
    hop = length - shared
    count = (n_samples - shared) // hop
    total = 1.0
    for j in range(1, count):
        lag = j * hop
        if lag >= length:
            break
        rho = (taper[:-lag] @ taper[lag:] / (taper @ taper)) ** 2
        total += 2.0 * (1.0 - j / count) * float(rho)
    return count / total


def _check_varied(data: Measurement) -> None:
    """Refuse inputs that never change."""
    for label, row in zip(data.input_labels, data.inputs, strict=True):
        if np.ptp(row) == 0.0:
            raise DataError(
                f"input {label!r} is constant ({row[0]:g}) over all {data.n_samples} samples: no frequency "
                "response can be estimated from it; use a record in which it varies, or leave the channel out"
            )


def _taper(window: str | tuple[Any, ...], length: int) -> Array:
    """Weights of a segment's samples."""
    if not isinstance(window, str | tuple):
        raise ct.ControlArgument(f"window must be a name or a tuple (name, parameters), not {shown(window)}")
    try:
        return np.asarray(signal.get_window(window, length))
    except (ValueError, TypeError, AttributeError, IndexError) as error:
        raise ct.ControlArgument(
            f"window must be one that scipy.signal.get_window knows, not {shown(window)}: {error}"
        ) from error


def _segment_length(given: int | None, n_samples: int) -> int:
    if given is None:
        if n_samples < 32:
            raise DataError(f"{n_samples} samples are too few for a frequency response; record at least 32")
        return max(8, 1 << round(math.log2(n_samples / 8)))
    if isinstance(given, (bool, np.bool_)) or not isinstance(given, (int, np.integer)):
        raise ct.ControlArgument(f"segment_length must be a whole number of samples, not {given!r}")
    if not 4 <= given <= n_samples:
        raise DataError(f"segment_length = {given} must lie between 4 and the record's {n_samples} samples")
    return int(given)


def _check_distinct(s_ww: NDArray[np.complex128], power: Array, labels: tuple[str, ...]) -> None:
    """Refuse inputs that are filtered copies of one another."""
    n_inputs = len(labels)
    for i in range(n_inputs):
        for j in range(i):
            coherence = np.abs(s_ww[:, i, j]) ** 2 / (power[:, i] * power[:, j])
            if np.median(coherence) > _SAME_INPUT:
                raise DataError(
                    f"inputs {labels[j]!r} and {labels[i]!r} run together (coherence 1): "
                    "only their sum can be seen; excite them independently, or keep one"
                )
    if (
        n_inputs > 2
        and np.median(np.linalg.cond(s_ww / np.sqrt(power[:, :, None] * power[:, None, :]))) > 1e9
    ):
        raise DataError(
            f"the inputs {', '.join(map(repr, labels))} are combinations of one another; "
            "excite them independently"
        )
