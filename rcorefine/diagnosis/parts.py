"""Split of records for stepwise improvement: fit, choice, validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..data.measurement import Measurement
from ..data.records import at_rest
from ..data.response_record import in_frequency, some_lines
from ..exceptions import DataError
from ..inference.windows import spread_lines, windows
from ..models.physical_model import PhysicalModel
from .case import SHORTEST

__all__ = ["Parts", "common_horizon", "split_in_parts"]

_TURNS = {"fit": (0, 2, 3), "choose": (1,), "judge": (4,), "learn": (0, 1, 2, 3)}  # of five in turn
_BY_RECORD = 5  # least number of records that are split as wholes
_FIT, _CHOOSE = 0.6, 0.2  # shares of the record; the rest judges
_LEAST, _FEWEST = 30, 50  # samples of a part that chooses or judges, points of a response that can be split
_DEAD = 8.0  # standard deviations of the noise below which nothing moves
_EXCERPT, _PIECES = 8000, 4  # samples of a long record on which effects are sought
_SHORTEST, _MOST_RECORDS = 1000, 16  # samples of such a piece, records that it is made of


@dataclass(frozen=True, slots=True)
class Parts:
    """Parts of the records for a stepwise improvement.

    Attributes
    ----------
    fit : list of Measurement
        To fit on; an excerpt where the records are long.
    choose : list of Measurement
        To choose on.
    judge : list of Measurement
        What takes part in nothing.
    learn : list of Measurement
        All that does not judge.
    remarks : tuple of str
        What was left out, and why.
    whole : bool
        Whether the first part is all of it, and no excerpt.
    """

    fit: list[Measurement]
    choose: list[Measurement]
    judge: list[Measurement]
    learn: list[Measurement]
    remarks: tuple[str, ...] = ()
    whole: bool = True


def common_horizon(
    physical: PhysicalModel, records: Sequence[Any], horizon: float | None
) -> tuple[float | None, list[str]]:
    """Return the length of the free runs of all parts, and what is said of it.

    Parameters
    ----------
    physical : PhysicalModel
        Model.
    records : sequence of Measurement
        Whole records, channels in the order of the model.
    horizon : float or None
        What was asked for.

    Returns
    -------
    horizon : float or None
        Of the windows of the whole record where the model integrates: a part would choose shorter ones.
    notes : list of str
    """
    pieces, note = windows(physical, list(records), horizon)
    if horizon is not None or len(pieces) == len(records):
        return horizon, []
    return max(piece.n_samples * piece.dt for piece in pieces), [note]


def split_in_parts(records: Sequence[Measurement], validation: Measurement | None) -> Parts:
    """Return the records in parts for the fit, the choice and validation.

    Each record is split in time. Five records or more are split as wholes, since the ends of many records
    are alike: settled steps, or decays that have died out. Of five in turn, three are for the fit, one is
    for the choice and one is for validation.

    Parameters
    ----------
    records : sequence of Measurement
        Records of the same system.
    validation : Measurement or None
        Record that judges; the last fifth of each for None.

    Returns
    -------
    Parts

    Raises
    ------
    DataError
        If a record is too short.
    """
    if in_frequency(records):
        return _lines_in_parts(records, validation)
    # a single record with a constant input shows a gain where it has settled
    kept = [moving(record) for record in records] if at_rest(records) else list(records)
    remarks = tuple(
        f"The motion of record {given.name!r} has died at {record.timepts[-1]:.4g} s: the rest of it is left "
        "out."
        for record, given in zip(kept, records, strict=True)
        if record is not given
    )
    many = len(kept) >= _BY_RECORD and min(record.n_samples for record in kept) >= SHORTEST
    parts = _in_turn(kept, validation is not None) if many else _in_time(kept, validation is not None)
    fit = parts["fit"]
    climbed, whole = excerpt(fit), sum(record.n_samples for record in fit)
    if climbed is not fit:
        remarks += (
            f"The record is long: effects were sought on {len(climbed)} pieces spread over it "
            f"({sum(record.n_samples for record in climbed)} of {whole} samples); the last model was fitted "
            "once more on all that does not judge.",
        )
    judge = parts["judge"] if validation is None else [validation]
    return Parts(climbed, parts["choose"], judge, parts["learn"], remarks, climbed is fit)


def _in_time(records: Sequence[Measurement], validated: bool) -> dict[str, list[Measurement]]:
    """Return each record in parts, in the order of time."""
    parts: dict[str, list[Measurement]] = {name: [] for name in _TURNS}
    least = SHORTEST + _LEAST + (0 if validated else _LEAST)
    for record in records:
        if record.n_samples < least:
            another = "" if validated else ", or another record as validation="
            raise DataError(
                f"record {record.name!r} of {record.n_samples} samples is too short: {SHORTEST} are needed "
                f"to fit, {_LEAST} to choose by, {_LEAST} to judge by; give at least {least}{another}"
            )
        both = record
        if not validated:
            both, last = record.split(max(_FIT + _CHOOSE, 0.5 + 0.5 * SHORTEST / record.n_samples))
            parts["judge"].append(last)
        first, second = both.split(max(_FIT / (_FIT + _CHOOSE), SHORTEST / both.n_samples))
        for name, part in (("fit", first), ("choose", second), ("learn", both)):
            parts[name].append(part)
    return parts


def _in_turn(items: Sequence[Any], validated: bool) -> dict[str, list[Any]]:
    """Return three of five records or frequencies, the next, and the last."""
    turns = _TURNS | ({"fit": (0, 2, 3, 4), "judge": (), "learn": tuple(range(5))} if validated else {})
    return {name: [item for k, item in enumerate(items) if k % 5 in which] for name, which in turns.items()}


def moving(record: Measurement) -> Measurement:
    """Return a free decay up to where its motion has died out.

    A part without motion decides nothing. Motion counts as long as an output still moves by `_DEAD` standard
    deviations of its noise (of second differences) within a fiftieth of the record.
    """
    if record.n_samples < SHORTEST:
        return record
    y, length = record.outputs, max(record.n_samples // 50, 4)
    noise = np.median(np.abs(np.diff(y, 2, axis=1)), axis=1) / (0.6745 * np.sqrt(6.0))
    pieces = np.array_split(np.arange(record.n_samples), record.n_samples // length)
    alive = [bool((np.ptp(y[:, piece], axis=1) > _DEAD * noise).any()) for piece in pieces]
    last = int(pieces[max(np.flatnonzero(alive), default=-1)][-1]) + 1
    return record if last == record.n_samples else record._part(slice(0, last))


def _lines_in_parts(responses: Sequence[Any], validation: Any) -> Parts:
    """Return responses in three parts, each over the whole band."""
    parts: dict[str, list[Any]] = {name: [] for name in _TURNS}
    for response in responses:
        size = response.omega.size
        if size < _FEWEST:
            raise DataError(
                f"a response of {size} frequencies is too short to be split in three; give {_FEWEST}"
            )
        for name, which in _in_turn(range(size), validation is not None).items():
            parts[name].append(some_lines(response, np.array(which, dtype=int)))
    judge = parts["judge"] if validation is None else [validation]
    fit = spread_lines(parts["fit"])
    spread = ("Effects were sought on some of the frequencies, spread evenly.",)
    whole = fit is parts["fit"]
    return Parts(fit, parts["choose"], judge, parts["learn"], () if whole else spread, whole)


def excerpt(records: list[Measurement]) -> list[Measurement]:
    """Return pieces of records that are too long for the improvement.

    Shorter records are returned as they are.
    """
    if sum(record.n_samples for record in records) <= _EXCERPT:
        return records
    spread = np.unique(np.linspace(0, len(records) - 1, min(len(records), _MOST_RECORDS)).astype(int))
    each = _EXCERPT // spread.size
    pieces = []
    for record in (records[int(i)] for i in spread):
        count = min(_PIECES, max(1, each // _SHORTEST))
        length = each // count
        if record.n_samples <= each:
            pieces.append(record)
            continue
        for start in np.linspace(0, record.n_samples - length, count).astype(int):
            pieces.append(record._part(slice(int(start), int(start) + length)))
    return pieces
