"""Outputs that show nothing of the motion.

The verdict then rests on the other outputs, and a note names the dead ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from ..arguments import as_noise
from ..data.channels import match_channels, record_for, with_outputs
from ..data.measurement import Measurement
from ..data.records import runs
from ..data.signals import over_time
from ..effects.effect import Effect
from ..engine.simulation import simulate
from ..exceptions import DataError, DivergenceError
from ..inference.whitening import autoregression, innovations
from ..models.conversion import as_physical
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array

_LONG = 0.05  # of the record, from which one value that repeats is a sensor that has stopped
_NOISY = 0.01  # repeated samples elsewhere, up to which the sensor has noise that never repeats
_LAGS = 100
_ALIKE = 0.2  # correlation with the model from which a sensor shows something
_SPREAD = 4.0  # standard deviations of a sum of so many squared correlations


class Watched(NamedTuple):
    """Model without the outputs that show nothing.

    It also selects the kept outputs in the records and settings of the user.

    Attributes
    ----------
    whole : PhysicalModel
        With every output.
    kept : tuple of int
        Outputs that show something.
    said : tuple of str
        Which are left out, and why.
    """

    whole: PhysicalModel
    kept: tuple[int, ...]
    said: tuple[str, ...]

    @property
    def model(self) -> PhysicalModel:
        """The model with the outputs that are kept."""
        return _with_outputs(self.whole, list(self.kept))

    def record(self, data: Measurement) -> Measurement:
        """Return a record with the kept outputs in the model's order.

        Its channels may come in any order.
        """
        return with_outputs(record_for(data, match_channels(self.whole.linear, data)), self.kept)

    def noise(self, noise: Any) -> Any:
        """Declared noise of the outputs that are kept; one for all of them stays."""
        given = as_noise(noise, self.whole.linear.n_outputs)
        return noise if given is None or np.ndim(noise) == 0 else given[list(self.kept)]

    def effects(self, given: Any) -> Any:
        """Entries without the laws of sensors that are left out; None stays."""
        if given is None:
            return None
        labels = self.whole.linear.output_labels
        lost = {label for i, label in enumerate(labels) if i not in self.kept}
        return [
            one
            for one in ([given] if isinstance(given, Effect) else given)
            if not isinstance(one, Effect) or "output" not in one.spec.where or one.place not in lost
        ]


def without_dead_sensors(model: Any, records: Sequence[Measurement]) -> Watched | None:
    """Return the model without its dead outputs, or None.

    A dead output shows nothing in any record. None is returned where nothing is left out. Leaving a signal
    out can cost power, but makes no claim about the others. A sensor in a control loop, or of a nonlinear or
    refined model, is left in, because more depends on it than its record. So is one that is at fault in some
    of the records only.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Model.
    records : sequence of Measurement
        Records.

    Returns
    -------
    Watched or None
        None, too, where no output shows anything.

    Raises
    ------
    DataError
        If no output ever changes.
    """
    physical = _watchable(model, records)
    if physical is None:
        return None
    ordered = [record_for(record, match_channels(physical.linear, record)) for record in records]
    labels = physical.linear.output_labels
    if any(record.n_outputs < len(labels) for record in ordered):
        return None
    check_moving(ordered, labels)
    # left out if the sensor shows nothing in every record
    dead = _dead(physical, ordered)
    kept = tuple(i for i in range(len(labels)) if i not in dead)
    if not kept or not dead:
        return None
    rest = ", ".join(labels[i] for i in kept)
    said = tuple(f"{labels[i]} is left out: {why}. The verdict rests on {rest}." for i, why in dead.items())
    return Watched(physical, kept, said)


def check_moving(records: Sequence[Any], where: Sequence[str]) -> None:
    """Refuse records in which no output ever changes.

    The message names `where`: outputs, or a record.
    """
    if all(record.in_time and not over_time(np.ptp, record.outputs).any() for record in records):
        raise DataError(f"no output ever changes ({', '.join(where)}); check sensors and cables")


def _watchable(model: Any, records: Sequence[Measurement]) -> PhysicalModel | None:
    """Return the model if only its record depends on a sensor, else None.

    Frequency responses, and models that are refined, nonlinear or in a loop, keep all outputs.
    """
    if not records[0].in_time or hasattr(model, "physical_model"):
        return None
    physical = as_physical(model)
    point = physical.operating_point
    straight = point is None or point.field is None
    return physical if straight and physical.controller is None else None


def _dead(model: PhysicalModel, records: Sequence[Measurement]) -> dict[int, str]:
    """Return the outputs that show nothing in any record, with the reasons."""
    dead = {}
    for i in range(model.linear.n_outputs):
        faults = [_fault(model, record, i) for record in records]
        if all(faults):
            dead[i] = " and ".join(dict.fromkeys(faults))
    return dead


def _fault(model: PhysicalModel, data: Measurement, index: int) -> str:
    """Return the reason why an output shows nothing, or an empty string."""
    y = data.outputs[index]
    known = ~np.isnan(y)
    if not np.any(np.ptp(y[known]) if known.any() else 0):
        return "it never changes"
    said = _stuck(y[known], np.flatnonzero(known))
    if said or y.size <= 5 * _LAGS:
        return said
    # correlated neither with an input nor with the simulation, while other outputs are
    driving = [w for w in data.inputs if np.ptp(w) > 0]
    spans = over_time(np.ptp, data.outputs)
    others = [row for i, row in enumerate(data.outputs) if i != index and spans[i] > 0]

    def moves(row: Array) -> bool:
        return not all(_unrelated(row, w) for w in driving)

    if not moves(y) and any(map(moves, others)) and not _foreseen(model, data, index):
        return "it moves with none of the inputs, as noise alone does, and other outputs do"
    return ""


def _stuck(y: Array, samples: NDArray[np.intp]) -> str:
    """Return since when a noisy output repeats one value, or an empty string.

    `samples` are the numbers of the samples in the record.
    """
    # runs of equal samples
    first, end = runs(np.append(np.diff(y) == 0, False))
    if not first.size:
        return ""
    longest = int(np.argmax(end - first))
    length = int(end[longest] - first[longest]) + 1
    elsewhere = int(np.sum(end - first)) + 1 - length
    inside = y.min() < y[first[longest]] < y.max()
    if not inside or elsewhere >= _NOISY * y.size or length <= max(_LONG * y.size, 20):
        return ""
    return (
        f"from sample {samples[first[longest]]} on it repeats one value {length} times, to the last digit, "
        "where its noise never did: the sensor has stopped"
    )


def _unrelated(y: Array, w: Array) -> bool:
    """Return whether the innovations of output and input are uncorrelated.

    The input is compared at up to 100 samples before the output.
    """
    # whiten both, then correlate
    one, other = (innovations(autoregression(row)[0], row - row.mean()) for row in (y, w))
    n, whole = y.size, np.count_nonzero(~np.isnan(y))
    if whole < n:  # over gaps the white input alone gives the correlation its variance
        one = np.nan_to_num(y - np.nanmean(y))
    r = correlate(one, other, mode="full", method="fft")[n - 1 : n - 1 + _LAGS]
    r = r / float(np.linalg.norm(one) * np.linalg.norm(other) or 1.0)
    # portmanteau test: sum of squared correlations against chi-square
    return bool(whole * float(r @ r) < _LAGS + _SPREAD * np.sqrt(2 * _LAGS))


def _foreseen(model: PhysicalModel, data: Measurement, index: int) -> bool:
    """Return whether the output is correlated with the simulation.

    A diverging simulation counts as correlated.
    """
    # correlation with the simulation from rest
    try:
        run = simulate(model, data, "zero").outputs[index]
    except DivergenceError:
        return True
    y = data.outputs[index]
    known = ~np.isnan(y)
    return np.ptp(run) == 0 or abs(float(np.corrcoef(run[known], y[known])[0, 1])) > _ALIKE


def _with_outputs(model: PhysicalModel, rows: list[int]) -> PhysicalModel:
    """The model with some of its outputs."""
    linear, point = model.linear, model.operating_point
    labels = tuple(linear.output_labels[i] for i in rows)
    return replace(
        model,
        linear=linear.with_arrays(C=linear.C[rows], D=linear.D[rows], output_labels=labels),
        output_state=model.output_state[rows],
        output_rate=model.output_rate[rows],
        output_input=model.output_input[rows],
        output_units=tuple(model.output_units[i] for i in rows) if model.output_units else (),
        ports=tuple(replace(p, output=p.output[rows]) if p.output.size else p for p in model.ports),
        operating_point=None if point is None else replace(point, outputs=point.outputs[rows]),
    )
