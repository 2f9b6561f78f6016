"""Inputs of a diagnosis: fitted model, records and candidate effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import control as ct
import numpy as np

from ..data.measurement import Measurement
from ..data.records import at_rest
from ..data.response_record import ResponseRecord, some_lines
from ..data.signals import over_time
from ..effects.effect import Effect
from ..effects.law import KINDS
from ..engine.amplitude_response import is_linear
from ..engine.harmonic_balance import remembering
from ..engine.structure import Structure
from ..exceptions import DataError, ModelError
from ..inference.assembly import spread_lines, windows
from ..inference.doubts import explains_nothing
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel, fitted_from
from ..inference.levels import levels
from ..inference.refinement import Refinement
from ..inference.starts import estimated_motion
from ..inference.whitening import RESOLUTION
from ..models.conversion import as_physical
from ..models.library import candidates_of, effect_library, reads_rate
from ..models.operating_point import ordered_record
from ..models.physical_model import PhysicalModel
from ..progress import Progress
from .residual_tests import passes

_FEW_LEVELS = 3  # distinct values of an output that does not move but for its last digit
_SOLVED = 1e-7  # of a response: its balance of harmonics is solved to 1e-8, which grows near a resonance
_SURE = 1e-3  # of the sample interval: its standard deviation where an output holds differences of samples
_BOTH = 0.05  # of the largest state: it takes both signs


class Case:
    """A fitted model that is asked what it lacks.

    Parameters
    ----------
    asked : sequence of Effect or None
        Candidates; None for the library.

    Attributes
    ----------
    base : Refinement
        The model at its minimum.
    records : tuple of Measurement
        What it was fitted to.
    settings : dict
        Options of fitting, as in `diagnose`.
    significance : float
        Level of the tests.
    progress : Progress
        What does the steps and counts them.
    effort : float
        Refits that the search may take, times the usual number.
    fitted : FittedModel
        The model on the free runs that are tested.
    motions : list of Motion or ResponseMotion
        Estimated motion on each of them.
    library : list of Effect
        Candidates that the model does not hold.
    levels : Levels
        Of the decisions.
    cut : bool
        Whether the free runs are windows of the records.

    Raises
    ------
    DataError
        If a record is too short to test.
    ControlArgument
        If no candidate is left that the model does not hold.
    """

    def __init__(
        self,
        base: Refinement,
        records: Sequence[Measurement],
        asked: Sequence[Effect] | None,
        settings: dict[str, Any],
        significance: float,
        progress: Progress,
        effort: float = 1.0,
    ) -> None:
        self.effort = effort
        self.base, self.records = base, tuple(records)
        self.significance, self.progress = significance, progress
        known = levels()
        self.settings = {"matters": known.matters} | settings
        self.levels = replace(known, matters=self.settings["matters"])
        physical = base.physical_model
        # records with the channels in the order of the model
        self.ordered = ordered = [ordered_record(physical, r) for r in records]
        for record in ordered:
            if record.n_samples < record.shortest:
                parts = "" if record.in_time else " (real and imaginary parts count)"
                raise DataError(
                    f"record {record.name!r} of {record.n_samples} samples is too short to test; "
                    f"give at least {record.shortest}{parts}"
                )
        # free runs: whole records, or windows where the model cannot run freely
        segments, _ = windows(physical, ordered, settings["horizon"])
        self.cut = len(segments) > len(ordered)
        # the fit as it is, with its residual and sensitivities
        tolerance, noise = settings["tolerance"], settings["noise"]
        self.fitted = fitted = fitted_from(base, segments, tolerance=tolerance, noise=noise)
        # motion of each record, by the model corrected with the measured outputs
        self.motions = [estimated_motion(fitted.structure, fitted.theta, record) for record in segments]
        if len(records) > 1:
            self.motions[0].companions = self.motions[1:]
        # candidates that the records can show and the model does not hold
        library = candidates_of(physical) if asked is None else asked
        library = list(dict.fromkeys(side for effect in library for side in effect.sides))
        library = seen_in(physical, library, ordered, asked is not None)
        self.library = not_held(self._distinct(library) if asked is None else library, base.effects)
        if not self.library:
            raise ct.ControlArgument("no candidate is left that the model does not hold already; give others")

    def _distinct(self, candidates: Sequence[Effect]) -> list[Effect]:
        """Leave out laws that are another one where the state keeps its sign."""
        found = []
        for effect in candidates:
            if effect.spec.two_signed and self.in_time:
                v = np.concatenate([motion.port(effect.place)[1] for motion in self.motions])
                if min(v.max(), -v.min()) < _BOTH * np.abs(v).max():
                    continue
            found.append(effect)
        return found

    @property
    def about(self) -> dict[str, Any]:
        """Return the fields of a diagnosis without tests and ranking."""
        nothing = dict.fromkeys(("ranking", "ambiguous", "tests", "winner_tests", "detectable"), ())
        own = {name: getattr(self, name) for name in ("base", "records", "significance", "settings")}
        return {"force_ratio": 0.0, **nothing, **own}

    @property
    def in_time(self) -> bool:
        """Return whether the records are time series.

        If not, they are frequency responses.
        """
        return self.fitted.problem.in_time

    @property
    def options(self) -> dict[str, Any]:
        """Options of fitting other than what floats."""
        return {name: self.settings[name] for name in ("tolerance", "offset", "noise", "horizon")}

    def excess(self, fitted: FittedModel) -> float:
        """Residual over the declared noise, 0 where none was declared."""
        if self.settings["noise"] is None and not all(record.known for record in self.ordered):
            return 0.0
        residual = np.hstack(fitted.residuals())
        return float(np.sqrt(over_time(np.mean, residual**2)).max())

    def passes(self, tests: Sequence[FTest], fitted: FittedModel) -> bool:
        """Return whether the residual of a model is noise.

        A residual passes, too, if it is no larger than the numerical error.
        """
        # residual in weighted units against the numerical error of the simulation
        left, records = np.hstack(fitted.residuals()), fitted.problem.records
        whole = fitted.problem.weights[:, None] * np.hstack([r.outputs for r in records])
        whole = whole - self.in_time * over_time(np.mean, whole)[:, None]
        least = RESOLUTION if self.in_time else _SOLVED
        if (np.nansum(left**2, axis=1) <= least**2 * np.nansum(whole**2, axis=1)).all():
            return True
        return passes(tests, self.excess(fitted), self.significance, self.levels)


def differenced(physical: PhysicalModel, records: Sequence[Measurement]) -> list[Effect]:
    """Return the candidates of outputs that may be differences of samples.

    A speed from an encoder is the mean over a sample. The interval is that of the record, and known.
    """
    steps = {record.dt for record in records}
    return [
        Effect(law.name, label, start={name: dt}, prior={name: _SURE * dt})
        for law in KINDS.values()
        if (name := law.of_differences)
        for label, rate in zip(physical.linear.output_labels, reads_rate(physical), strict=True)
        for dt in steps
        if rate and len(steps) == 1
    ]


def with_recorded_inputs(model: Any, records: Sequence[Any]) -> tuple[Any, tuple[str, ...]]:
    """Return a model with the recorded inputs that it lacks, and a note.

    They act on nothing yet; the zero entries of B and D are candidates.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Model.
    records : sequence of Measurement
        Records. An input counts if all of them hold it, and all inputs of the model, by name.

    Returns
    -------
    model : StateSpace, PhysicalModel or Refinement
        The model as it was if no input is left over.
    notes : tuple of str
    """
    physical = as_physical(model)
    linear = physical.linear
    if not records[0].in_time or physical.controller is not None or physical.operating_point is not None:
        return model, ()
    # inputs that all records have and the model lacks
    shared = [label for label in records[0].input_labels if all(label in r.input_labels for r in records)]
    extra = [label for label in shared if label not in linear.input_labels]
    if not extra or not set(linear.input_labels) <= set(shared):
        return model, ()
    # zero columns of B and D for them
    wider = np.zeros((linear.n_states + linear.n_outputs, len(extra)))
    units = dict(zip(records[0].input_labels, records[0].input_units, strict=True))
    physical = replace(
        physical,
        linear=linear.with_arrays(
            B=np.hstack([linear.B, wider[: linear.n_states]]),
            D=np.hstack([linear.D, wider[linear.n_states :]]),
            input_labels=(*linear.input_labels, *extra),
        ),
        output_input=np.hstack([physical.output_input, wider[linear.n_states :]]),
        input_units=(*physical.input_units, *(units[label] for label in extra))
        if physical.input_units
        else (),
    )
    names = ", ".join(f"{label} (column {linear.n_inputs + k} of B)" for k, label in enumerate(extra))
    said = f"The model lacks an input of the records: {names}. Its entries are candidates."
    return (replace(model, physical_model=physical) if isinstance(model, Refinement) else physical), (said,)


def not_held(candidates: Sequence[Effect], held: Sequence[Effect]) -> list[Effect]:
    """Return the candidates that the model does not contain.

    Candidates are the same if kind and place agree.
    """
    names = {(effect.kind, effect.place) for effect in held}
    return [effect for effect in candidates if (effect.kind, effect.place) not in names]


def not_tried(physical: PhysicalModel, library: Sequence[Effect], records: Sequence[Any]) -> str:
    """Name the effects that fit the model and are tried only on request.

    Other parameters are no effects that it lacks.
    """
    kinds = [name for name, law in KINDS.items() if not law.needs_law and not law.is_parameter]
    fitting = seen_in(physical, effect_library(physical, kinds=kinds), records, asked=False)
    names = sorted({effect.kind for effect in fitting} - {effect.kind for effect in library})
    if not names:
        return ""
    return f"Not tried: {', '.join(names)}. Name them with candidates=effect_library(model, kinds=[...])."


def seen_in(
    physical: PhysicalModel, candidates: Sequence[Effect], records: Sequence[Any], asked: bool
) -> list[Effect]:
    """Return the candidates that records of this kind show.

    Raises
    ------
    ModelError
        If one was asked for that they cannot show.
    """
    if not records[0].in_time:
        return _seen_in_responses(physical, candidates, records, asked)
    if at_rest(records):
        return _seen_at_rest(physical, candidates, asked)
    if asked:
        return list(candidates)
    candidates = [*candidates, *differenced(physical, records)]
    # a power of a command that changes its sign is a saturation or a dead zone by another name
    inputs = np.hstack([record.inputs for record in records])
    turns = (inputs.min(axis=1) < 0) & (inputs.max(axis=1) > 0)
    turning = {label for label, turn in zip(physical.linear.input_labels, turns, strict=True) if turn}
    return [e for e in candidates if not (e.spec.one_signed and e.place in turning)]


def _seen_in_responses(
    physical: PhysicalModel, candidates: Sequence[Effect], records: Sequence[ResponseRecord], asked: bool
) -> list[Effect]:
    """Return the candidates that a frequency response can show.

    Constants are not among them, and nonlinear effects only if the amplitude is known.

    Raises
    ------
    ModelError
        If one was asked for that it cannot.
    """
    amplitudes = all(record.measured.amplitude is not None for record in records)
    seen = []
    for effect in candidates:
        law = effect.spec
        structure = Structure(physical, [effect])
        linear = is_linear(structure)
        fits = linear or (amplitudes and not remembering(structure))
        if fits and not law.of_record and not (law.holds_constant and linear):
            seen.append(effect)
        elif asked:
            why = "needs the amplitude of the sines (amplitude=)"
            if fits or amplitudes:
                why = "is not seen in a response" if fits else "has memory, and takes records in time"
            raise ModelError(f"{effect.label} {why}; leave it out of candidates")
    return seen


def _seen_at_rest(physical: PhysicalModel, candidates: Sequence[Effect], asked: bool) -> list[Effect]:
    """Return the candidates that a free decay shows.

    Effects of an input need an input that moves. A gain, a lag or a delay of an output cannot be told from
    another initial state.

    Raises
    ------
    ModelError
        If one was asked for that it cannot show.
    """
    inputs = set(physical.linear.input_labels)
    # with the input at rest, an effect on the input or a linear one at an output is hidden
    hidden = [
        e
        for e in candidates
        if e.place in inputs or (e.spec.at_channel and (e.spec.linear or e.spec.inner_states))
    ]
    if asked and hidden:
        raise ModelError(
            f"{hidden[0].label} cannot be seen while no input moves; leave it out of candidates, or give a "
            "record in which the inputs move"
        )
    return not_held(candidates, hidden)


def no_motion(records: Sequence[Measurement]) -> str:
    """Return the reason why records without motion allow no diagnosis.

    The string is empty where they show motion.

    Parameters
    ----------
    records : sequence of Measurement
        Records.

    Returns
    -------
    str
    """
    labels = records[0].output_labels
    still = []
    # an output that hardly takes more than one value does not move
    for i, label in enumerate(labels):
        y = np.concatenate([record.outputs[i] for record in records])
        y = y[~np.isnan(y)]
        least = 1e-9 * max(float(np.abs(y).max()), 1e-300)
        moving = np.abs(np.diff(y)) > least
        if not moving.any() or (np.unique(np.round(y / least)).size <= _FEW_LEVELS and moving.mean() < 0.05):
            still.append(label)
    if len(still) < len(labels):
        return ""
    return (
        f"Cannot tell: {', '.join(still)} does not move in this record, so every effect that holds it still "
        "explains it alike. Give a record with motion."
    )


def not_excited(base: Refinement, records: Sequence[Measurement]) -> str:
    """Return a message if nothing was excited, or an empty string.

    It is empty where an input moves, the outputs settle as the model does, or the record is a free decay:
    the simulation of a wrong model gets out of step with an oscillation and explains nothing of it.

    Parameters
    ----------
    base : Refinement
        The model fitted to the records.
    records : sequence of Measurement
        Records.

    Returns
    -------
    str
    """
    if not at_rest(records) or all(record.n_inputs == 0 for record in records):
        return ""
    samples = sum(record.n_samples for record in records)
    if not explains_nothing(base.fit, samples, base.theta.size + base.initial_states.size):
        return ""
    return (
        f"Cannot tell: nothing was excited. {', '.join(records[0].input_labels)} is constant, and the "
        "outputs show no free motion of the model. Give a record in which the inputs move."
    )


_TURNS = {"fit": (0, 2, 3), "choose": (1,), "judge": (4,), "learn": (0, 1, 2, 3)}  # of five in turn
_BY_RECORD = 5  # least number of records that are split as wholes
_FIT, _CHOOSE = 0.6, 0.2  # shares of the record; the rest judges, so 60 samples leave 36, 12 and 12
_FEWEST_POINTS = 50  # points of a response that can be split
_DEAD = 8.0  # standard deviations of the noise below which nothing moves
_EXCERPT, _PIECES = 8000, 4  # samples of a long record on which effects are sought
_SHORTEST_PIECE, _MOST_RECORDS = 1000, 16  # samples of such a piece, records that it is made of


class Parts(NamedTuple):
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
    """

    fit: list[Measurement]
    choose: list[Measurement]
    judge: list[Measurement]
    learn: list[Measurement]
    remarks: tuple[str, ...] = ()


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
    # the windows of the longest part hold for all parts
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
    if not records[0].in_time:
        return _lines_in_parts(records, validation)
    # a single record with a constant input shows a gain where it has settled
    kept = [moving(record) for record in records] if at_rest(records) else list(records)
    remarks = tuple(
        f"The motion of record {given.name!r} has died at {record.timepts[-1]:.4g} s: the rest of it is left "
        "out."
        for record, given in zip(kept, records, strict=True)
        if record is not given
    )
    # many records are split as wholes, few in time
    many = len(kept) >= _BY_RECORD and all(record.n_samples >= record.shortest for record in kept)
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
    return Parts(climbed, parts["choose"], judge, parts["learn"], remarks)


def _in_time(records: Sequence[Measurement], validated: bool) -> dict[str, list[Measurement]]:
    """Return each record in parts, in the order of time."""
    parts: dict[str, list[Measurement]] = {name: [] for name in _TURNS}
    share = _FIT / (_FIT + _CHOOSE) if validated else _FIT
    # 60 % to fit, 20 % to choose, 20 % to validate
    least = round(Measurement.shortest / share)
    for record in records:
        if record.n_samples < least:
            another = "" if validated else ", or another record as validation="
            raise DataError(
                f"record {record.name!r} of {record.n_samples} samples is too short: {record.shortest} are "
                f"needed to fit, and the others {'choose' if validated else 'choose and judge'}; give at "
                f"least {least}{another}"
            )
        both = record
        if not validated:
            both, last = record.split(_FIT + _CHOOSE)
            parts["judge"].append(last)
        first, second = both.split(_FIT / (_FIT + _CHOOSE))
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
    if record.n_samples < record.shortest:
        return record
    y, length = record.outputs, max(record.n_samples // 50, 4)
    # noise from second differences, robust
    noise = over_time(np.median, np.abs(np.diff(y, 2, axis=1))) / (0.6745 * np.sqrt(6.0))
    pieces = np.array_split(np.arange(record.n_samples), record.n_samples // length)
    # the last piece in which an output moves clearly beyond its noise
    alive = [bool((over_time(np.ptp, y[:, piece]) > _DEAD * noise).any()) for piece in pieces]
    last = int(pieces[max(np.flatnonzero(alive), default=-1)][-1]) + 1
    return record if last == record.n_samples else record._part(slice(0, last))


def _lines_in_parts(responses: Sequence[Any], validation: Any) -> Parts:
    """Return responses in three parts, each over the whole band."""
    parts: dict[str, list[Any]] = {name: [] for name in _TURNS}
    for response in responses:
        size = response.omega.size
        if size < _FEWEST_POINTS:
            raise DataError(
                f"a response of {size} frequencies is too short to be split in three; give {_FEWEST_POINTS}"
            )
        # every fifth frequency to the same part: each covers the band
        for name, which in _in_turn(range(size), validation is not None).items():
            parts[name].append(some_lines(response, np.array(which, dtype=int)))
    judge = parts["judge"] if validation is None else [validation]
    fit = spread_lines(parts["fit"])
    spread = ("Effects were sought on some of the frequencies, spread evenly.",)
    return Parts(fit, parts["choose"], judge, parts["learn"], () if fit is parts["fit"] else spread)


def excerpt(records: list[Measurement]) -> list[Measurement]:
    """Return pieces of records that are too long for the improvement.

    Shorter records are returned as they are.
    """
    if sum(record.n_samples for record in records) <= _EXCERPT:
        return records
    # pieces spread evenly over the records
    spread = np.unique(np.linspace(0, len(records) - 1, min(len(records), _MOST_RECORDS)).astype(int))
    each = _EXCERPT // spread.size
    pieces = []
    for record in (records[int(i)] for i in spread):
        count = min(_PIECES, max(1, each // _SHORTEST_PIECE))
        length = each // count
        if record.n_samples <= each:
            pieces.append(record)
            continue
        for start in np.linspace(0, record.n_samples - length, count).astype(int):
            pieces.append(record._part(slice(int(start), int(start) + length)))
    return pieces
