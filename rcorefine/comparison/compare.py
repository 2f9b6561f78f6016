"""Free-run comparison of models with a measured record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, overload

import control as ct
import numpy as np

from ..arguments import as_state
from ..data.channels import Channels, aligned, match_channels, record_for, resting_inputs, with_outputs
from ..data.frequency_response import FrequencyResponse
from ..data.measurement import Measurement
from ..data.records import FreeRun, as_data
from ..effects.given import Table, share_beyond
from ..engine.controlled import as_it_runs, checked_horizon, free_runs, runs_away
from ..engine.observer import leading_ratio
from ..engine.simulation import simulated, structure_of, unjudged_samples
from ..exceptions import DataError, DivergenceError
from ..models.controller import Controller, completed
from ..models.conversion import known_physical, under_control
from ..models.operating_point import ordered_record
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array, LinearModel
from .failure_map.record import given_places
from .responses import FrequencyComparison, LevelComparison, compare_responses
from .result import Comparison


@overload
def compare(
    model: Any,
    data: Measurement,
    *,
    x0: str | Array | Sequence[float] = "estimate",
    horizon: float | None = None,
    controller: Controller | ct.StateSpace | None = None,
) -> Comparison: ...


@overload
def compare(model: Any, data: FrequencyResponse) -> FrequencyComparison: ...


@overload
def compare(model: Any, data: Sequence[FrequencyResponse]) -> LevelComparison: ...


def compare(
    model: Any,
    data: Any,
    *,
    x0: str | Array | Sequence[float] = "estimate",
    horizon: float | None = None,
    controller: Controller | ct.StateSpace | None = None,
) -> Comparison | FrequencyComparison | LevelComparison:
    """Simulate one or several models on a record and compare the outputs.

    Parameters
    ----------
    model : StateSpace, PhysicalModel, Refinement, or list of them
        Continuous, or discrete with the record's sampling time. Channels are matched by name where
        model and record have names, in any order; by position otherwise. Outputs that were not
        measured are left out. A model with a `hold` of its own (`improve` found it) keeps to it.
    data : Measurement, FrequencyResponseData or FrequencyResponse
        Record; its hold decides how continuous models see the inputs. A measured frequency response
        (`control.frd`) is compared directly, a list of them (several amplitudes) one by one.
    x0 : {"estimate", "zero"} or array_like of shape (n,)
        Initial state: the one that fits this record best, rest, or given.
    horizon : float, optional
        Length in s of windows that start anew, each from its own estimated initial state (so it
        excludes a given `x0`). For models with slow or unstable modes, whose free run drifts away
        however good they are. The record is cut in the whole number of equal windows that comes
        nearest. Default: the whole record; one tenth of it where a model integrates. A continuous
        model that is unstable has no free run: it is judged by what it predicts one sample ahead,
        with process noise (Kalman predictor). The same in `refine`, `diagnose` and `improve`.
    controller : Controller, StateSpace or TransferFunction, optional
        As in `refine`: the loop of this controller is simulated.

    Returns
    -------
    Comparison
        `fit`, `rmse`, `residual`, `simulated`, and in `failures` where the model fails; ``print`` it,
        ``.plot()`` it. A `FrequencyComparison` for a measured frequency response, a `LevelComparison`
        of them for a list.

    Raises
    ------
    control.ControlArgument
        If a model or the record is something else; the message says what to convert.
    control.ControlDimension
        If channels do not fit or a name is missing.
    DataError
        If the record or a window has too few samples to estimate the state.
    DivergenceError
        If a simulation leaves all bounds; the message names the model.

    Warns
    -----
    ExcitationWarning
        If an input is constant over the record.

    Examples
    --------
    >>> t = 0.1 * np.arange(200)
    >>> w = np.sign(np.sin(t))
    >>> true = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], name="true")
    >>> wrong = ct.ss([[-2.0]], [[1.0]], [[1.0]], [[0.0]], name="wrong")
    >>> y = ct.forced_response(true.sample(0.1), t, w).outputs
    >>> result = compare([wrong, true], rco.Measurement(w, y, dt=0.1))
    >>> bool(result.fit[1, 0] > 99.999), bool(result.fit[0, 0] < 60)
    (True, True)
    """
    # one model or several; a controller closes the loop around each
    given = as_data(data, x0=x0, horizon=horizon, controller=controller, several=False)
    several = isinstance(model, (list, tuple))
    models = [under_control(each, controller, data) for each in (model if several else [model])]
    if not models:
        raise ct.ControlArgument("no model to compare; give one StateSpace or a list of them")
    linear = [LinearModel.from_statespace(getattr(each, "system", each)) for each in models]
    names = _unique([each.name for each in linear])
    if given[0].in_time:
        horizon = checked_horizon(horizon, known_start=as_state(x0) is not None)
        return _on_record(models, linear, names, given[0], x0, horizon, several)
    named = [each.with_arrays(name=name) for each, name in zip(linear, names, strict=True)]
    return compare_responses(models, named, data, several=several)


class _Entrant(NamedTuple):
    """A model of the comparison, and its channels in the record."""

    model: Any
    linear: LinearModel
    name: str
    channels: Channels
    hold: str


class _Course(NamedTuple):
    """The record in windows, over which every model runs."""

    data: Measurement
    outputs: list[int]  #: outputs of the record that are compared
    x0: Any
    windows: list[slice]
    hidden: int = 0  #: first samples that a delay hides from one of the models


def _on_record(
    models: Sequence[Any],
    linear: Sequence[LinearModel],
    names: Sequence[str],
    data: Measurement,
    x0: Any,
    horizon: float | None,
    several: bool,
) -> Comparison:
    """The models run freely on one record."""
    # models in a loop read their controller's signals from the record
    known = list(filter(None, map(known_physical, models)))
    looped = [model for model in known if model.controller is not None]
    given = completed(looped[0], data) if looped else data
    # a free decay without inputs: those of the model are zero
    data = resting_inputs(given, list(dict.fromkeys(label for each in linear for label in each.input_labels)))
    entrants = _enter(models, linear, names, data)
    course, notes = _lay_out(entrants, known, data, x0, horizon)
    # inputs that do not vary cannot show the dynamics
    given.check_excitation("compare")
    # a delay makes the first outputs depend on inputs before the record
    if as_state(x0) is None:
        seen = [record_for(course.data, each.channels) for each in entrants]
        hidden = max(map(unjudged_samples, models, seen))
        course = course._replace(hidden=min(hidden, course.windows[0].stop // 2))
    # simulate each model, with the initial state of each window
    runs, initial, states = zip(*(_simulate(each, course) for each in entrants), strict=True)
    for each, motion in zip(entrants, states, strict=True):
        notes += _beyond_tables(each, motion, course)
    if course.hidden:
        notes.append(
            f"the first {course.hidden} sample(s) are not compared: because of a delay in the model they "
            "depend on values before the record"
        )
    return Comparison(
        **_as_compared(entrants, course),
        runs=np.array(runs),
        states=states,
        initial_states=initial,
        horizon=horizon,
        x0=x0 if isinstance(x0, str) else "given",
        notes=tuple(dict.fromkeys(notes)),
        several=several,
        looped=bool(looped),
        led=len(course.windows) == 1 and not looped and _follows_record(known, linear, course.data),
    )


def _enter(
    models: Sequence[Any], linear: Sequence[LinearModel], names: Sequence[str], data: Measurement
) -> list[_Entrant]:
    """Find the channels of each model by label, otherwise by position."""
    channels = [match_channels(each, data) for each in linear]
    holds = [getattr(known_physical(each), "hold", None) or data.hold for each in models]
    return list(map(_Entrant, models, linear, names, channels, holds))


def _lay_out(
    entrants: Sequence[_Entrant],
    known: Sequence[PhysicalModel],
    data: Measurement,
    x0: Any,
    horizon: float | None,
) -> tuple[_Course, list[str]]:
    """Return the outputs and windows in which all models run, and notes."""
    # compare the outputs that all models have
    common = set.intersection(*(set(each.channels.outputs) for each in entrants))
    outputs = sorted(common - {-1})
    if not outputs:
        raise ct.ControlDimension("the models have no output of the record in common; compare them alone")
    looped = [as_it_runs(model, data) for model in known if model.controller is not None]
    # for a refinement this includes its initial model, by which `refine` decided whether it integrates
    runs_as = looped or [*(each.linear for each in entrants), *(model.linear for model in known)]
    # divide the record where a model cannot run over all of it
    (windows,), note = free_runs(runs_as, [data], horizon, known_start=as_state(x0) is not None)
    # a window must determine its initial states and leave samples to judge by
    n_states = max(each.n_states for each in runs_as)
    if as_state(x0) is None and data.n_samples * len(outputs) <= n_states:
        raise DataError(
            f"the record holds {data.n_samples} samples of {len(outputs)} output(s), too few to estimate "
            f"{n_states} initial states from and to judge by; give a longer one, or x0='zero'"
        )
    course = _Course(data if horizon is None else data._changed(FreeRun), outputs, x0, windows)
    return course, _notes(entrants, data, note)


def _notes(entrants: Sequence[_Entrant], data: Measurement, note: str) -> list[str]:
    """Return notes on channels, on windows, and on holds of the models."""
    notes = [note for each in entrants for note in each.channels.notes] + [note] * bool(note)
    return notes + [
        f"{each.name!r} uses hold={each.hold!r}, as it was fitted; the record declares {data.hold!r}"
        for each in entrants
        if each.hold != data.hold
    ]


def _as_compared(entrants: Sequence[_Entrant], course: _Course) -> dict[str, Any]:
    """Return fields of the comparison: models with the channels of the record."""
    data, outputs = course.data, course.outputs
    # leave out the samples that a delay hides
    if course.hidden:
        data = data.segment(float(data.timepts[course.hidden]))
    straight = tuple(
        aligned(each.linear, each.channels, data, outputs).with_arrays(name=each.name) for each in entrants
    )
    places = tuple(
        given_places(each.model, flat, each.channels, data.n_inputs, outputs)
        for each, flat in zip(entrants, straight, strict=True)
    )
    return {
        "names": tuple(each.name for each in entrants),
        "models": straight,
        "data": with_outputs(data, outputs),
        "places": places,
        "holds": tuple(each.hold for each in entrants),
        "starts": tuple(max(0, int(window.start) - course.hidden) for window in course.windows),
    }


def _follows_record(known: Sequence[PhysicalModel], linear: Sequence[LinearModel], data: Measurement) -> bool:
    """Return whether a model has no free run and follows the record instead."""
    # an unstable model or an integrator that drifts is corrected by the record
    away = any(each.is_continuous and runs_away(each, data) for each in linear)
    return away or any(
        leading_ratio(physical, ordered_record(physical, data)) is not None for physical in known
    )


def _simulate(entrant: _Entrant, course: _Course) -> tuple[Array, Array, Array]:
    """Return simulated outputs, the initial state per window, and states.

    The outputs are the compared ones, in the record's order. Each window begins early by the samples that a
    delay hides, and these are left out.
    """
    data, x0, windows, hidden = course.data, course.x0, course.windows, course.hidden
    record, n_states = record_for(data, entrant.channels), entrant.linear.n_states
    model = _on_measured_outputs(entrant)
    # outputs in the order of the record
    measured = [place for place in entrant.channels.outputs if place >= 0]
    order = [measured.index(place) for place in course.outputs]
    run = np.empty((len(order), data.n_samples))
    states, motion = np.empty((len(windows), n_states)), np.empty((n_states, data.n_samples))
    # each window begins with an initial state of its own
    for index, window in enumerate(windows):
        early = min(hidden, window.start)
        part = record
        if len(windows) > 1:  # the last one runs to the end
            after = record.timepts[window.stop] if window.stop < record.n_samples else None
            part = record.segment(record.timepts[window.start - early], after)
        try:
            simulation = simulated(model, part, x0, led=True)
        except DivergenceError as error:
            raise DivergenceError(_DIVERGED.format(name=entrant.name, why=error)) from error
        run[:, window] = simulation.outputs[order][:, early:]
        motion[:, window] = simulation.states[:n_states, early:]
        states[index] = motion[:, max(window.start, hidden)]
    # a free run that overflows is reported with its time
    if not np.isfinite(run).all():
        k = int(np.argmin(np.isfinite(run).all(axis=0)))
        why = f"its output is not finite from t = {data.timepts[k]:g} s on"
        raise DivergenceError(_DIVERGED.format(name=entrant.name, why=why))
    return run[:, hidden:], states, motion[:, hidden:]


def _on_measured_outputs(entrant: _Entrant) -> Any:
    """Return the model with the outputs that were measured.

    Only a plain state-space model may have others.
    """
    model, linear, places = entrant.model, entrant.linear, entrant.channels.outputs
    rows = [i for i, place in enumerate(places) if place >= 0]
    if len(rows) == len(places):
        return model
    if model is not getattr(model, "system", model):
        unmeasured = ", ".join(linear.output_labels[i] for i, place in enumerate(places) if place < 0)
        raise ct.ControlDimension(
            f"{entrant.name!r} has outputs that the record does not hold ({unmeasured}); only a plain "
            "StateSpace can be compared on part of its outputs: measure them, build the model without "
            "them, or pass .system"
        )
    return linear.with_arrays(
        C=linear.C[rows], D=linear.D[rows], output_labels=tuple(linear.output_labels[i] for i in rows)
    ).to_statespace()


def _beyond_tables(entrant: _Entrant, states: Array, course: _Course) -> list[str]:
    """A sentence on each table that the motion of a model leaves."""
    inputs, sentences = record_for(course.data, entrant.channels).inputs[:, course.hidden :], []
    for effect in getattr(entrant.model, "effects", ()):
        if not isinstance(effect.law, Table):
            continue
        physical = structure_of(entrant.model)[0].model
        # share of the samples outside the table
        share = share_beyond(effect.law, *_felt_at(physical, effect.place, states, inputs))
        if share > 0.0:
            sentences.append(
                f"the motion of {entrant.name!r} leaves the table of {effect.label} in {100 * share:.2g} % "
                "of the samples; the table is extrapolated linearly there"
            )
    return sentences


def _felt_at(physical: PhysicalModel, place: str, states: Array, inputs: Array) -> tuple[Array, Array]:
    """Return displacement and velocity at a place, or its signal twice."""
    linear = physical.linear
    states = states[: linear.n_states]  # without those of the effects
    if place in linear.input_labels:
        signal = inputs[linear.input_labels.index(place)]
        return signal, signal
    if place in linear.output_labels:
        j = linear.output_labels.index(place)
        signal = linear.C[j] @ states + linear.D[j] @ inputs
        return signal, signal
    port = physical.port(place)
    d = port.position @ states + port.position_input @ inputs
    return d, port.velocity @ states + port.velocity_input @ inputs


_DIVERGED = (
    "the free run of model {name!r} diverges: {why}. Look at its poles (control.poles); "
    "horizon=... starts it anew every so many seconds"
)


def _unique(names: Sequence[str]) -> list[str]:
    """Names that differ: the second "plant" becomes "plant (2)"."""
    result: list[str] = []
    for name in names:
        candidate, count = name, 1
        while candidate in result:
            count += 1
            candidate = f"{name} ({count})"
        result.append(candidate)
    return result
