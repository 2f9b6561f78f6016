"""Free-run comparison of models with a measured record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, overload

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
    known = [model for model in map(known_physical, models) if model is not None]
    looped = [model for model in known if model.controller is not None]
    data = given = completed(looped[0], data) if looped else data
    # a free decay without inputs: those of the model are zero
    data = resting_inputs(data, list(dict.fromkeys(label for each in linear for label in each.input_labels)))
    # channels by label, otherwise by position
    channels = [match_channels(each, data) for each in linear]
    holds = [getattr(known_physical(each), "hold", None) or data.hold for each in models]
    # compare the outputs that all models have
    outputs = [i for i in range(data.n_outputs) if all(i in each.outputs for each in channels)]
    if not outputs:
        raise ct.ControlDimension("the models have no output of the record in common; compare them alone")
    notes = [note for each in channels for note in each.notes]
    # for a refinement this includes its initial model, by which `refine` decided whether it integrates
    runs_as = [as_it_runs(model, data) for model in looped] or [*linear, *(model.linear for model in known)]
    # divide the record where a model cannot run over all of it
    estimated = isinstance(x0, str) and x0 == "estimate"
    windows, note = _windows(runs_as, data, horizon, estimated, len(outputs))
    notes += [note] if note else []
    notes += [
        f"{name!r} uses hold={hold!r}, as it was fitted; the record declares {data.hold!r}"
        for name, hold in zip(names, holds, strict=True)
        if hold != data.hold
    ]
    # inputs that do not vary cannot show the dynamics
    given.check_excitation("compare")
    if horizon is not None:
        data = data._changed(FreeRun)
    hidden = 0  # first samples that a delay hides from one of the models
    # a delay makes the first outputs depend on inputs before the record
    if estimated:
        seen = [record_for(data, where) for where in channels]
        hidden = min(max(map(unjudged_samples, models, seen)), windows[0].stop // 2)
    made = []
    for each, flat, places, name in zip(models, linear, channels, names, strict=True):
        # simulate each model, with the initial state of each window
        run, start, motion = _simulate(each, flat, places, data, x0, windows, hidden, name, outputs)
        notes += _beyond_tables(each, name, motion, record_for(data, places).inputs[:, hidden:])
        made.append((run, start, motion))
    runs, starts, states = zip(*made, strict=True)
    # leave these samples out of the comparison
    if hidden:
        notes.append(
            f"the first {hidden} sample(s) are not compared: because of a delay in the model they depend on "
            "values before the record"
        )
        data = data.segment(float(data.timepts[hidden]))
    # models with the channels in the order of the record
    straight = tuple(
        aligned(each, places, data, outputs).with_arrays(name=name)
        for each, places, name in zip(linear, channels, names, strict=True)
    )
    return Comparison(
        names=tuple(names),
        models=straight,
        data=with_outputs(data, outputs),
        runs=np.array(runs),
        states=states,
        places=tuple(
            given_places(each, flat, where, data.n_inputs, outputs)
            for each, flat, where in zip(models, straight, channels, strict=True)
        ),
        initial_states=starts,
        starts=tuple(max(0, int(window.start) - hidden) for window in windows),
        horizon=None if horizon is None else float(horizon),
        x0=x0 if isinstance(x0, str) else "given",
        holds=tuple(holds),
        notes=tuple(dict.fromkeys(notes)),
        several=several,
        looped=bool(looped),
        led=len(windows) == 1 and not looped and _follows_record(known, linear, data),
    )


def _windows(
    models: Sequence[LinearModel], data: Measurement, horizon: float | None, estimated: bool, n_outputs: int
) -> tuple[list[slice], str]:
    """Return windows that cover the record, and the reason for them.

    Each window is long enough to estimate a state in it.
    """
    (windows,), note = free_runs(models, [data], horizon, known_start=not estimated)
    # a window must determine its initial states and leave samples to judge by
    n_states = max(each.n_states for each in models)
    if estimated and data.n_samples * n_outputs <= n_states:
        raise DataError(
            f"the record holds {data.n_samples} samples of {n_outputs} output(s), too few to estimate "
            f"{n_states} initial states from and to judge by; give a longer one, or x0='zero'"
        )
    return windows, note


def _follows_record(known: Sequence[PhysicalModel], linear: Sequence[LinearModel], data: Measurement) -> bool:
    """Return whether a model has no free run and follows the record instead."""
    # an unstable model or an integrator that drifts is corrected by the record
    away = any(each.is_continuous and runs_away(each, data) for each in linear)
    return away or any(
        leading_ratio(physical, ordered_record(physical, data)) is not None for physical in known
    )


def _simulate(
    model: Any,
    linear: LinearModel,
    channels: Channels,
    data: Measurement,
    x0: Any,
    windows: list[slice],
    hidden: int,
    name: str,
    outputs: Sequence[int],
) -> tuple[Array, Array, Array]:
    """Return simulated outputs, the initial state per window, and states.

    The outputs are the compared ones, in the record's order. Each window begins `hidden` samples early, and
    these are left out.
    """
    record = record_for(data, channels)
    # outputs that are measured; a plain state-space model may have others
    rows = [i for i, place in enumerate(channels.outputs) if place >= 0]
    if len(rows) < len(channels.outputs):
        if model is not getattr(model, "system", model):
            unmeasured = ", ".join(linear.output_labels[i] for i, p in enumerate(channels.outputs) if p < 0)
            raise ct.ControlDimension(
                f"{name!r} has outputs that the record does not hold ({unmeasured}); only a plain "
                "StateSpace can be compared on part of its outputs: measure them, build the model without "
                "them, or pass .system"
            )
        model = linear.with_arrays(
            C=linear.C[rows], D=linear.D[rows], output_labels=tuple(linear.output_labels[i] for i in rows)
        ).to_statespace()
    # outputs in the order of the record
    order = [[place for place in channels.outputs if place >= 0].index(place) for place in outputs]
    start = x0 if isinstance(x0, str) else np.asarray(x0, dtype=float)
    run = np.empty((len(outputs), data.n_samples))
    states = np.empty((len(windows), linear.n_states))
    motion = np.empty((linear.n_states, data.n_samples))
    # each window begins with an initial state of its own
    for index, window in enumerate(windows):
        early = min(hidden, window.start)
        part = record
        if len(windows) > 1:  # the last one runs to the end
            after = record.timepts[window.stop] if window.stop < record.n_samples else None
            part = record.segment(record.timepts[window.start - early], after)
        try:
            simulation = simulated(model, part, start, led=True)
        except DivergenceError as error:
            raise DivergenceError(_DIVERGED.format(name=name, why=error)) from error
        run[:, window] = simulation.outputs[order][:, early:]
        motion[:, window] = simulation.states[: linear.n_states, early:]
        states[index] = motion[:, max(window.start, hidden)]
    # a free run that overflows is reported with its time
    if not np.isfinite(run).all():
        k = int(np.argmin(np.isfinite(run).all(axis=0)))
        why = f"its output is not finite from t = {data.timepts[k]:g} s on"
        raise DivergenceError(_DIVERGED.format(name=name, why=why))
    return run[:, hidden:], states, motion[:, hidden:]


def _beyond_tables(model: Any, name: str, states: Array, inputs: Array) -> list[str]:
    """A sentence on each table that the motion of a model leaves."""
    sentences = []
    for effect in getattr(model, "effects", ()):
        if isinstance(effect.law, Table):
            # motion that the table depends on: signal, or displacement and velocity at the place
            physical, place = structure_of(model)[0].model, effect.place
            linear = physical.linear
            if place in linear.input_labels:
                d = v = inputs[linear.input_labels.index(place)]
            elif place in linear.output_labels:
                j = linear.output_labels.index(place)
                d = v = linear.C[j] @ states + linear.D[j] @ inputs
            else:
                port = physical.port(place)
                d = port.position @ states + port.position_input @ inputs
                v = port.velocity @ states + port.velocity_input @ inputs
            # share of the samples outside the table
            share = share_beyond(effect.law, d, v)
            if share > 0.0:
                sentences.append(
                    f"the motion of {name!r} leaves the table of {effect.label} in {100 * share:.2g} % of "
                    "the samples; the table is extrapolated linearly there"
                )
    return sentences


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
