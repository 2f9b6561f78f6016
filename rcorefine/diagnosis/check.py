"""`check`: one table before everything else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import control as ct
import numpy as np

from ..arguments import as_flag
from ..comparison.compare import compare
from ..comparison.result import Comparison
from ..data.channels import match_channels
from ..data.measurement import Measurement
from ..data.records import as_record
from ..effects.effect import Effect, as_effects
from ..engine.controlled import integrates
from ..exceptions import DataError, DivergenceError, own_arithmetic, unheard
from ..inference.levels import levels
from ..inference.sensitivities import candidate_columns
from ..models.controller import Controller, JoinedController
from ..models.conversion import as_physical, known_physical, under_control
from ..models.library import zero_entries
from ..models.operating_point import OperatingPoint, ordered_record
from ..models.physical_model import PhysicalModel
from ..progress import Progress
from ..refinement.refine import base_fit
from ..results import counted
from ..systems.linear import LinearModel
from .case import Case, with_recorded_inputs
from .check_outputs import gain_rows, level_rows
from .check_rows import (
    LOOK,
    OK,
    STOP,
    Check,
    CheckRow,
    Detectable,
    controller_rows,
    feedback_rows,
    sampling_rows,
    signal_rows,
)
from .residual_tests import TestedResidual
from .verdict import detectable

_SHORTEST = 20  # samples
_LONGER = 100.0  # times its value: of what only as much shows, no length is named
_TESTS = 6  # among which one would have to show an effect
_DIVERGES = CheckRow(
    STOP, "free run", "", "diverges",
    "The simulation diverges, so the model cannot be compared with the record. Give compare a short "
    "horizon=, or correct the poles.",
)  # fmt: skip
_SETTINGS: dict[str, Any] = {"free": (), "tolerance": 0.0, "offset": True, "noise": None, "horizon": None}


def check(
    model: Any,
    data: Measurement,
    *,
    information: bool = True,
    controller: Controller | ct.StateSpace | None = None,
    effects: Sequence[Effect] | None = None,
) -> Check:
    """Check a record and a model before anything is concluded from them.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Model.
    data : Measurement
        Record; its channels are matched as in `compare`.
    information : bool
        Whether to work out the smallest effects that the record could show.
    controller : Controller, StateSpace or TransferFunction, optional
        As in `refine`: the controller under which the record was taken.
    effects : sequence of Effect, optional
        Effects of your own model. A row for each compares its size, given by ``start`` or ``fixed``, with the
        smallest that this record would show. All other coefficients must be fixed.

    Returns
    -------
    Check
        A row for each thing that was looked at, *ok*, *look* or *stop*; ``print`` it.

    Raises
    ------
    control.ControlArgument
        If model or data are something else, or an effect has more than one coefficient that is not fixed.
    control.ControlDimension
        If channels do not fit.
    DataError
        If the record is too short.

    Notes
    -----
    Looked at: constant, repeated, clipped, coarse and spiky signals, dropouts; sampling and length against
    the model's modes; of each output beside the free run its sign, gain and unit (known where record and
    model declare it; else a gain that is 9.549 within a small error, while the rest of the record fits, is
    rpm for rad/s, and one near that may be), delay, offset, drift; inputs that follow the outputs. The gain's
    standard deviation comes from the spread over blocks of the record, so the noise may have any color.

    Examples
    --------
    >>> motor = rco.dc_motor(gain=2.0, time_constant=0.5, inputs="voltage", outputs="speed")
    >>> volts = np.random.default_rng(0).standard_normal(1000)
    >>> y = rco.simulate(motor, rco.Measurement(volts, np.zeros(1000), dt=0.05), "zero").outputs[0]
    >>> found = rco.check(motor, rco.Measurement(volts, y * 60 / (2 * np.pi), dt=0.05))
    >>> found.stops, found.looks[0].what
    (True, 'units')
    """
    as_flag(information, "information")
    if as_record(data).n_samples < _SHORTEST:
        raise DataError(f"a record of {data.n_samples} samples is too short to look over; give {_SHORTEST}")
    model = under_control(model, controller, data)
    with own_arithmetic(), unheard():
        # signals, sampling, gains and levels; stop before the long part if something must be corrected
        record, rows = _looked_over(model, data, None)
        stopped = any(row.status == STOP for row in rows)
        # smallest effects that the record would show
        shown = _shown(model, record) if information and not stopped else ()
        own = () if effects is None or stopped else _own(model, record, as_effects(effects, "effects"))
        rows += _idle_rows(model, data)
    rows += _information_rows(shown, as_physical(model), record) if shown else []
    if information and record.n_samples < record.shortest:
        said = f"{record.n_samples} samples are too few to test for effects; {record.shortest} are needed."
        rows.append(CheckRow(LOOK, "information", "", f"{record.n_samples} samples", said))
    rows += [_against(effect, found) for effect, found in own]
    return Check(tuple(rows), data, shown)


def looks(model: Any, records: Sequence[Measurement], horizon: float | None) -> tuple[CheckRow, ...]:
    """Return the check rows that need attention for these records.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Model.
    records : sequence of Measurement
        Records; of several, each row says which it is about.
    horizon : float, optional
        Length of the free runs (s).

    Returns
    -------
    tuple of CheckRow
        Those that say stop first.
    """
    rows = []
    with unheard():
        for i, data in enumerate(records):
            about = f"record {i + 1}"
            for row in _looked_over(model, data, horizon)[1] if data.n_samples >= _SHORTEST else ():
                where, sentence = f"{row.where}, {about}".removeprefix(", "), f"{about}: {row.sentence}"
                rows.append(row if len(records) == 1 else replace(row, where=where, sentence=sentence))
    return Check(tuple(rows), records[0]).looks


class _Beside(NamedTuple):
    """A record beside the free run of a model.

    Attributes
    ----------
    physical : PhysicalModel or None
        The model, where its places are known.
    point : OperatingPoint or None
        Its operating point, with the outputs of the record.
    record : Measurement
        The record, in the model's channel order where that is known.
    compared : Comparison or None
        The free run on the record; None if it diverges.
    """

    physical: PhysicalModel | None
    point: OperatingPoint | None
    record: Measurement
    compared: Comparison | None

    @property
    def controller(self) -> JoinedController | None:
        """Controller of the loop, if there is one."""
        return None if self.physical is None else self.physical.controller

    @property
    def straight(self) -> bool:
        """True if the model is linear: else a gain says little."""
        return self.point is None or self.point.field is None


def _beside(model: Any, data: Measurement, horizon: float | None) -> _Beside:
    """Simulate a model on a record; about a point, in deviations from it."""
    physical = known_physical(model)
    found = _Beside(physical, None if physical is None else physical.operating_point, data, None)
    if physical is None or found.point is None or not found.straight or found.controller is not None:
        compared = _compared(model, data, horizon)
        return found._replace(record=data if compared is None else compared.data, compared=compared)
    # about an operating point: deviations of the record and of the model, beside what the record has above it
    compared = _compared(physical.system, ordered_record(physical, data), horizon)
    known = dict(zip(match_channels(physical.linear, data).outputs, found.point.outputs, strict=True))
    outputs = np.array([known.get(i, 0.0) for i in range(data.n_outputs)])
    return found._replace(point=replace(found.point, outputs=outputs), compared=compared)


def _looked_over(model: Any, data: Measurement, horizon: float | None) -> tuple[Measurement, list[CheckRow]]:
    """Return the record in the model's channel order, and its check rows.

    The rows on information are not included.
    """
    beside = _beside(model, data, horizon)
    record, compared, controller = beside.record, beside.compared, beside.controller
    linear = LinearModel.from_statespace(getattr(model, "system", model))
    # signals alone first, then levels, then the simulation
    rows = list(signal_rows(record if data.n_inputs else data))
    rows += level_rows(data, beside.point, compared) if beside.straight else []
    sampling = sampling_rows(linear, record, controller is not None)
    if compared is None:  # an unstable model has no free run to compare
        return record, [*rows, *sampling, _DIVERGES]
    if controller is not None:
        return record, [*rows, *sampling, *controller_rows(controller, linear, data)]
    # gains need a free run of a linear model; they say what a level and a limit there come from
    units = _units(beside.physical, data, compared)
    gains = list(gain_rows(compared, units)) if beside.straight and not compared.led else []
    bent = {row.where for row in gains if row.what in ("rectified", "stops")}
    rows = [row for row in rows if row.where not in bent or row.what not in ("level", "clipping")]
    return record, [*rows, *sampling, *gains, *feedback_rows(compared)]


def _compared(model: Any, data: Measurement, horizon: float | None) -> Comparison | None:
    """Return the model on the record, None if its simulation diverges."""
    try:
        compared = compare(model, data, horizon=horizon)
    except DivergenceError:
        return None
    return compared if np.isfinite(compared.runs).all() else None


def _units(physical: PhysicalModel | None, data: Measurement, compared: Comparison) -> tuple[str, ...]:
    """Units that the model declares for the outputs that were compared."""
    if physical is None or not any(physical.output_units):
        return ()
    outputs = match_channels(physical.linear, data).outputs
    labels = [data.output_labels[place] if place >= 0 else "" for place in outputs]
    return tuple(physical.output_units[labels.index(label)] for label in compared.data.output_labels)


def _own(model: Any, data: Measurement, effects: Sequence[Effect]) -> list[tuple[Effect, Detectable | None]]:
    """Return effects, each with the smallest size that the record shows.

    The size is None if the record shows none.
    """
    # effects without their values: only one size each is free
    bare = []
    for effect in effects:
        sizes = [name for name in effect.coefficients if name not in effect.spec.shaping]
        if len(sizes) != 1 or set(effect.free) - set(sizes):
            others = ", ".join(name for name in effect.free if name not in sizes[:1])
            raise ct.ControlArgument(
                f"{effect.label} has more coefficients than its size: fix the others ({others}) by "
                "fixed={...}"
            )
        fixed = {name: value for name, value in effect.fixed.items() if name not in sizes}
        bare.append(effect.replace(start={}, prior={}, fixed=fixed))
    shown = {found.effect: found for found in _shown(model, data, bare)}
    return [(effect, shown.get(one)) for effect, one in zip(effects, bare, strict=True)]


def _against(effect: Effect, found: Detectable | None) -> CheckRow:
    """Return the row of an effect of the user's own model."""
    if found is None:
        said = f"This record cannot show {effect.label}."
        return CheckRow(LOOK, "information", effect.place, f"{effect.kind}: not seen", said)
    # the size in the user's model against the smallest that the record shows
    value = {**effect.start, **effect.fixed}.get(found.coefficient)
    least = f"{found.smallest:.3g} {found.unit}".strip()
    status, word = OK, f"from {least}"
    said = f"{effect.label}: this record cannot show less than {least} (95 % probability)."
    if value is not None:
        said = f"{said} Your model has {value:.3g} {found.unit}".strip() + "."
        status, word = (OK, "shows") if abs(value) >= found.smallest else (LOOK, "too small to show")
    return CheckRow(status, "information", effect.place, f"{effect.kind}: {word}", said)


def _shown(model: Any, data: Measurement, effects: Sequence[Effect] | None = None) -> tuple[Detectable, ...]:
    """Smallest coefficients that one of the tests of `diagnose` would show."""
    # fit the model as it is, then power of the tests for each candidate
    try:
        base = base_fit(model, [data], **_SETTINGS)
        case = Case(base, [data], effects, _SETTINGS, 0.01, Progress())
    except (DataError, ct.ControlArgument):
        return ()  # too short, or nothing that could be missing: there is no such row then
    scored = candidate_columns(case.fitted, case.library, case.motions[0], (0.0,))
    return detectable(TestedResidual(case.fitted), scored, _TESTS, 0.01, levels())


def _information_rows(
    shown: tuple[Detectable, ...], model: PhysicalModel, record: Measurement
) -> list[CheckRow]:
    """Return check rows on the changes that the record could show.

    A parameter counts as not seen if the record would not even show that it doubles. The smallest size falls
    with the root of the length at least. Windows of a model that integrates show less than the whole record.
    """
    # changes relative to the nominal values
    nominal = {(q.kind, q.place): abs(q.value) for q in model.parameters if q.value}
    shares = {
        d.effect.label: d.smallest / nominal[key]
        for d in shown
        if (key := (d.effect.kind, d.effect.place)) in nominal
    }
    best = ", ".join(f"{d.effect.label} {d.smallest:.3g} {d.unit}".strip() for d in shown[:3])
    said = f"Smallest effects that it would show (95 % probability): {best}, and others (.detectable)."
    known = sorted((share, label) for label, share in shares.items() if share <= 1.0)
    if known:
        ends = " to ".join(
            f"{100 * share:.2g} % ({label})" for share, label in dict.fromkeys((known[0], known[-1]))
        )
        said += f" Changes of parameters: from {ends}."
    seen = CheckRow(OK, "information", "", f"{counted(len(shown), 'effect')} tried", said)
    # not seen: even a doubling would be missed; the size falls with the root of the length
    blind = []
    for label, share in shares.items():
        if share > 1.0:
            enough = f" (about {float(f'{record.n_samples * share**2:.1g}'):.0f} samples are enough)"
            blind.append(label + enough * (share < _LONGER))
    if not blind:
        return [seen]
    cut = integrates(model.linear, record)
    whole = "Free runs of a tenth of the record (the model integrates)" if cut else "The record"
    least = f"{whole} would not show these even if they doubled: {', '.join(blind[:4])}."
    least += " A longer horizon= may." if cut else ""
    return [seen, CheckRow(LOOK, "information", "", f"{len(blind)} not seen", least)]


def _idle_rows(model: Any, data: Measurement) -> Iterator[CheckRow]:
    """Yield a row on each input that acts on nothing in the model.

    An input that only the record has is one of them.
    """
    wider, _ = with_recorded_inputs(model, [data])
    linear = LinearModel.from_statespace(getattr(wider, "system", wider))
    tried = {effect.place for effect in zero_entries(as_physical(wider))}
    for j in np.flatnonzero(~linear.B.any(axis=0) & ~linear.D.any(axis=0)):
        label, open_ = linear.input_labels[j], any(f"B[{i},{j}]" in tried for i in range(linear.n_states))
        said = f"{label} acts on nothing in the model: its column of B and D is zero."
        said += " Its entries are candidates of diagnose." if open_ else " Set the entry where it acts."
        yield CheckRow(LOOK, "inputs", label, "acts on nothing", said)
