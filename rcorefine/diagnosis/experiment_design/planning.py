"""Plans of possible next records.

A plan repeats the record, or changes its amplitude, band, length or sensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...data.measurement import Measurement
from ...models.physical_model import PhysicalModel
from ...systems.linear import Array
from ...words import frequency_text
from .sensors import sensor_rows

__all__ = ["Proposal", "default_bands", "factor_in_words", "proposals"]

_MODES = 2  # bands about the lowest modes
_ABOUT = 0.2  # half width of such a band over its frequency
_LINES = 8  # frequency lines that a band must hold
_WORDS = {2.0: "twice", 3.0: "three times", 4.0: "four times", 5.0: "five times"}


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """An experiment: its inputs, what it asks for, its cost.

    Attributes
    ----------
    kind : str
        "repeat", "amplitude", "band", "longer" or "sensor".
    name : str
        In words.
    record : Measurement
        Inputs; the outputs are zero.
    cost : float
        In lengths of the present record.
    sensor : tuple of (str, ndarray), or None
        Label and row of the new output.
    """

    kind: str
    name: str
    record: Measurement
    cost: float
    sensor: tuple[str, Array] | None = None


def factor_in_words(factor: float) -> str:
    """A factor as one says it: twice, three times, 2.5 times."""
    return _WORDS.get(float(factor), f"{factor:g} times")


def proposals(
    model: PhysicalModel,
    record: Measurement,
    *,
    repeat: bool,
    amplitudes: Sequence[float],
    lengths: Sequence[float],
    bands: Sequence[tuple[float, float]],
    sensors: Sequence[str] | None,
    costs: dict[str, float],
) -> list[Proposal]:
    """All experiments to be judged, the cheapest first.

    Parameters
    ----------
    model : PhysicalModel
        Model.
    record : Measurement
        Present record.
    repeat, amplitudes, lengths, sensors, costs
        As in `Diagnosis.suggest_experiment`.
    bands : sequence of (float, float)
        Bands in rad/s.

    Returns
    -------
    list of Proposal
    """
    w = record.inputs
    found = []
    if repeat:
        found.append(Proposal("repeat", "repeat the record", _record(record, w), costs["repeat"]))
    for factor in amplitudes:
        hard = "as hard" if factor > 1 else "the amplitude"
        name = f"drive {factor_in_words(factor)} {hard}" if factor > 1 else f"drive at {factor:g} of {hard}"
        cost = costs["amplitude"] + 0.1 * abs(np.log2(factor))  # the nearer to the record, the safer
        found.append(Proposal("amplitude", name, _record(record, factor * w), cost))
    for low, high in bands:
        text = f"{frequency_text(low)} to {frequency_text(high)}"
        shaped = in_band(w, record.dt, low, high)
        found.append(Proposal("band", f"excite {text}, same rms", _record(record, shaped), costs["band"]))
    for factor in lengths:
        name = f"record {factor_in_words(factor)} as long"
        cost = costs["longer"] * factor
        n = round(factor * w.shape[1])  # the same kind of input, repeated from its beginning
        found.append(Proposal("longer", name, _record(record, np.tile(w, -(-n // w.shape[1]))[:, :n]), cost))
    for place, label, row in sensor_rows(model, sensors):
        name = f"repeat with a sensor at {place}"
        found.append(Proposal("sensor", name, _record(record, w), costs["sensor"], (label, row)))
    return sorted(found, key=lambda p: p.cost)


def _record(like: Measurement, inputs: Array) -> Measurement:
    return Measurement(
        inputs, np.zeros((like.n_outputs, inputs.shape[1])), dt=like.dt, hold=like.hold,
        input_labels=like.input_labels, output_labels=like.output_labels,
    )  # fmt: skip


def in_band(w: Array, dt: float, low: float, high: float) -> Array:
    """Return a random-phase multisine between two frequencies (rad/s).

    Mean and rms of the input are kept.
    """
    n = w.shape[1]
    omega = 2 * np.pi * np.fft.rfftfreq(n, dt)
    lines = np.flatnonzero((omega >= low) & (omega <= high) & (omega > 0))
    rng = np.random.default_rng(0)
    spectrum = np.zeros((w.shape[0], omega.size), dtype=complex)
    spectrum[:, lines] = np.exp(2j * np.pi * rng.random((w.shape[0], lines.size)))
    signal = np.fft.irfft(spectrum, n, axis=1)
    size = signal.std(axis=1, keepdims=True)
    size[size == 0] = 1.0
    return np.asarray(w.mean(axis=1, keepdims=True) + signal * (w.std(axis=1, keepdims=True) / size))


def default_bands(model: PhysicalModel, record: Measurement) -> list[tuple[float, float]]:
    """Return frequency bands (rad/s) for the modes of the model.

    They are the lower and the upper half of the band of the model, and bands around its lowest modes.
    """
    poles = np.linalg.eigvals(model.linear.A)
    nyquist, line = np.pi / record.dt, 2 * np.pi / record.duration
    modes = np.unique(np.round(np.abs(poles[np.imag(poles) > 0.3 * np.abs(poles)]), 12))
    speeds = np.abs(poles[np.abs(poles) > line])
    if speeds.size == 0:
        return []
    low = max(0.3 * float(speeds.min()), line)
    high = min(2.0 * float(speeds.max()), 0.5 * nyquist)
    middle = float(np.sqrt(low * high))
    found = [(low, middle), (middle, high)]
    found += [((1 - _ABOUT) * m, (1 + _ABOUT) * m) for m in modes[:_MODES] if modes.size > 1]
    return [(a, b) for a, b in found if (b - a) / line >= _LINES and b <= nyquist]
