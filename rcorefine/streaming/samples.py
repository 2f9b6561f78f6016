"""Checks of samples and records against the model, and blocks with gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..arguments import as_array, as_choice, as_whole
from ..data.records import as_record
from ..data.signals import LARGEST, SMALLEST, check_sizes
from ..exceptions import DataError, ModelError
from ..systems.conversion import to_discrete
from ..systems.discretization import check_sampling_time
from ..systems.linear import Array, LinearModel

Flags = NDArray[np.uint8]
Integers = NDArray[np.int64]
Complex = NDArray[np.complex128]


def as_size(value: Any, name: str, least: int, meaning: str) -> int:
    """Whole number that is not below `least`."""
    return as_whole(value, f"{name} ({meaning})", least=least, error=ModelError)


def as_matrix(value: Any, name: str, rows: int, columns: int | None, rows_are: str) -> Array:
    """Finite matrix with these rows; a vector is one column."""
    array = as_array(value, name, error=ModelError)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[0] != rows or array.shape[1] == 0:
        raise ct.ControlDimension(
            f"{name} has shape {np.shape(value)}; give ({rows}, l_u), one row per {rows_are}"
        )
    if columns is not None and array.shape[1] != columns:
        raise ct.ControlDimension(f"{name} has {array.shape[1]} column(s) for {columns} correction(s)")
    return array


def as_samples(values: Any, what: str, n_signals: int) -> Array:
    """One sample or a block of `n_signals` signals as (n_signals, N).

    Raises
    ------
    control.ControlArgument
        If the values are complex, text or objects.
    control.ControlDimension
        If the number of signals does not fit, or the array is transposed.
    DataError
        If there is no sample, or a value is masked.
    """
    array = as_array(values, what, finite=False, flags=True)
    # a vector is one sample of several signals, or a block of one signal
    if array.size == 0:
        raise DataError(f"{what} is empty (shape {array.shape}); give at least one sample")
    if array.ndim == 1:
        array = array[None, :] if n_signals == 1 else array[:, None]
    elif array.ndim == 0:
        array = array[None, None]
    if array.ndim != 2:
        raise ct.ControlDimension(f"{what} has shape {array.shape}; give one sample (n,) or a block (n, N)")
    if array.shape[0] != n_signals:
        # python-control's order: signals first, time last
        if array.shape[1] == n_signals and np.ndim(values) == 2:
            raise ct.ControlDimension(
                f"{what} has shape {array.shape}: it looks transposed. Signals come first and time last; "
                f"pass {what}.T"
            )
        raise ct.ControlDimension(
            f"{what} has shape {np.shape(values)}, but the model has {n_signals} {what}; "
            f"give one sample ({n_signals},) or a block ({n_signals}, N)"
        )
    return array


def as_block(model: LinearModel, w: Any, y: Any) -> tuple[Array, Array]:
    """Return inputs (n_w, N) and outputs (n_y, N) at the same samples.

    Errors are raised as in `as_samples`.
    """
    inputs, outputs = as_samples(w, "inputs", model.n_inputs), as_samples(y, "outputs", model.n_outputs)
    if inputs.shape[1] != outputs.shape[1]:
        raise ct.ControlDimension(
            f"inputs have {inputs.shape[1]} sample(s) and outputs {outputs.shape[1]}; "
            "give both at the same samples"
        )
    # what is too small to have a square counts as nothing
    inputs, outputs = (np.where(np.abs(one) < SMALLEST, 0.0, one) for one in (inputs, outputs))
    return inputs, outputs


def check_samples(signals: Array, labels: Sequence[str], what: str, first: int, dt: float | None) -> None:
    """Refuse NaN, Inf and values whose square overflows.

    Samples are counted from the start of the stream.
    """
    bad = ~np.isfinite(signals)
    if not bad.any():
        check_sizes(signals, labels, what, smallest=0.0)  # a sample may be as small as it likes
        return
    # report the first sample and the first signal that is not finite
    sample = int(np.argmax(bad.any(axis=0)))
    row = int(np.argmax(bad[:, sample]))
    value = "NaN" if np.isnan(signals[row, sample]) else "Inf"
    when = "" if dt is None else f" (t = {(first + sample) * dt:.6g} s)"
    raise DataError(
        f"{what} {labels[row]!r} is {value} at sample {first + sample}{when}, {sample} in this call; "
        "nothing of the call was used. Repair the sample or leave it out"
    )


class Block(NamedTuple):
    """Samples with gaps bridged, and flags for what was measured.

    The arrays are in the form that the kernels take.

    Parameters
    ----------
    inputs, outputs : ndarray of shape (N, n_w), (N, n_y)
        Finite samples; an input that is missing keeps its last value.
    known : ndarray of uint8, shape (N,)
        Whether all inputs of the sample were measured.
    use : ndarray of uint8, shape (N, n_y)
        Which outputs were measured.
    """

    inputs: Array
    outputs: Array
    known: Flags
    use: Flags

    @property
    def whole(self) -> bool:
        """Return whether nothing is missing."""
        # of a single sample ten times as fast as .all()
        return b"\0" not in self.use.tobytes() and b"\0" not in self.known.tobytes()

    def part(self, start: int, stop: int) -> Block:
        """Samples from `start` up to `stop`."""
        rows = slice(start, stop)
        return Block(self.inputs[rows], self.outputs[rows], self.known[rows], self.use[rows])

    @staticmethod
    def joined(blocks: Sequence[Block]) -> Block:
        """Blocks one after the other."""
        return Block(*map(np.concatenate, zip(*blocks, strict=True)))


@lru_cache(maxsize=16)
def _all_there(n_samples: int, n_outputs: int) -> tuple[Flags, Flags]:
    known, use = np.ones(n_samples, dtype=np.uint8), np.ones((n_samples, n_outputs), dtype=np.uint8)
    return known, use


def whole_block(inputs: Array, outputs: Array) -> Block:
    """Samples without a gap."""
    return Block(inputs, outputs, *_all_there(*outputs.shape))


def as_missing(value: Any) -> str:
    """Return the checked choice of what to do about missing samples."""
    return as_choice(value, "missing", ("raise", "hold-out"))


@dataclass(frozen=True, slots=True, eq=False)
class Sampled:
    """The initial model and the samples that it meets.

    Parameters
    ----------
    initial, discrete : LinearModel
        Model as given, and in discrete time.
    step : float or None
        Sampling time in s, None where nobody told it.
    """

    initial: LinearModel
    discrete: LinearModel
    step: float | None


def sampled_model(model: Any, dt: float | None) -> Sampled:
    """Check the initial model and discretize it."""
    # a physical model brings its linear part
    model = LinearModel.from_statespace(getattr(model, "system", model))
    if model.is_continuous and dt is None:
        raise ModelError(
            f"model {model.name!r} is continuous: give dt, the sampling time of the record in seconds"
        )
    # a sampling time must agree with a discrete model
    if dt is not None:
        fixed = not model.is_continuous and model.dt is not None and model.dt is not True
        if fixed and abs(model.dt - check_sampling_time(dt)) > 1e-6 * model.dt:
            raise ModelError(
                f"dt = {dt!r} s contradicts model {model.name!r}, which has dt = {model.dt:g} s; "
                "leave dt out, or give the continuous model (rcorefine.d2c converts one)"
            )
        # zero-order hold equivalent
        discrete = to_discrete(model, dt)
        return Sampled(model, discrete, float(discrete.dt))
    return Sampled(model, model, None if model.dt is None or model.dt is True else float(model.dt))


def _is_plain(one: Any, n_signals: int) -> bool:
    """Return whether one sample, as it comes from a loop, needs no check.

    The checks would take longer than to learn from it.
    """
    if type(one) is not np.ndarray or one.shape != (n_signals,) or one.dtype != np.float64:
        return False
    sizes = [abs(value) for value in one.tolist()]
    return (
        sum(sizes) < LARGEST and min([size or 1.0 for size in sizes], default=1.0) >= SMALLEST
    )  # and no NaN


def checked_block(
    model: LinearModel, step: float | None, w: Any, y: Any, first: int, latest: Array | None
) -> Block:
    """Check one sample or a block.

    Parameters
    ----------
    model : LinearModel
        Model with its labels.
    step : float or None
        Sampling time in s, for the messages.
    w, y : array_like
        As in `RCORefiner.update`.
    first : int
        Number of samples taken before, for the messages.
    latest : ndarray of shape (n_w,), or None
        Inputs of the sample before, to go on with where one is missing: NaN and masked samples are gaps.
        None: they are refused.
    """
    # fast path for single samples
    if _is_plain(w, model.n_inputs) and _is_plain(y, model.n_outputs):
        return whole_block(w[None].copy(), y[None].copy())
    # masked values are missing values
    if latest is not None:
        w, y = (
            np.ma.filled(np.ma.asarray(one, dtype=float), np.nan) if np.ma.isMaskedArray(one) else one
            for one in (w, y)
        )
    # shapes, then values; a NaN is allowed only where gaps are
    inputs, outputs = as_block(model, w, y)
    for signal, labels, what in (
        (inputs, model.input_labels, "input"),
        (outputs, model.output_labels, "output"),
    ):
        there = signal if latest is None else np.where(np.isnan(signal), 0.0, signal)
        check_samples(there, labels, what, first, step)
    inputs, outputs = np.ascontiguousarray(inputs.T), np.ascontiguousarray(outputs.T)
    if latest is None:
        return whole_block(inputs, outputs)
    # an input counts as known at a sample if all its channels are; outputs one by one
    known, use = np.asarray(~np.isnan(inputs).any(axis=1)), ~np.isnan(outputs)
    # hold the last input over a gap
    for row in inputs:
        row[np.isnan(row)] = latest[np.isnan(row)]
        latest = row
    # a missing output is not used; zero keeps the arrays finite
    outputs[~use] = 0.0
    return Block(inputs, outputs, known.astype(np.uint8), use.astype(np.uint8))


def checked_record(setup: Sampled, data: Any, hold: str, *, whole: bool = True) -> tuple[Array, Array]:
    """Return inputs and outputs of a record as (N, signals).

    They are in the order of the model's channels. Part of a record (not `whole`) may be short or at rest.
    """
    model = setup.initial
    data = as_record(data)
    from ..data.channels import match_channels

    # the record must have the sampling time of the refiner
    if setup.step is not None:
        to_discrete(setup.discrete, data.dt)
    if model.is_continuous and data.hold != hold:
        raise DataError(
            f"record {data.name!r} has hold={data.hold!r}, but the refiner takes hold={hold!r}; pass "
            f"RCORefiner(..., hold=...) or Measurement(..., hold={hold!r})"
        )
    if not data.n_inputs:
        raise DataError(
            f"record {data.name!r} has no input: retrospective cost optimization learns from what an input "
            "drives; use refine or improve for a free decay"
        )
    # channels by label, in the order of the model
    channels = match_channels(model, data)
    if -1 in channels.outputs:
        missing = model.output_labels[channels.outputs.index(-1)]
        raise ct.ControlDimension(
            f"output {missing!r} of the model is not in record {data.name!r}; measure it, or give a model "
            "without it"
        )
    # too short for the states, or an input that excites nothing
    if whole and data.n_samples < model.n_states:
        raise DataError(
            f"record {data.name!r} has {data.n_samples} sample(s) for a model of {model.n_states} "
            "states; give a longer record, or a smaller model"
        )
    inputs, outputs = data.inputs[list(channels.inputs)], data.outputs[list(channels.outputs)]
    for signal, label in zip(inputs, model.input_labels, strict=True):
        if whole and np.ptp(signal) == 0.0:
            raise DataError(
                f"input {label!r} is constant ({signal[0]:g}) from sample 0 to {data.n_samples - 1}: nothing "
                "can be learned from it. Give a stretch where it varies, or leave it out of the model"
            )
    return np.ascontiguousarray(inputs.T), np.ascontiguousarray(outputs.T)
