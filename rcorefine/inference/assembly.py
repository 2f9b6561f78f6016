"""Setup of an estimation: effects, parameters, offsets and windows.

The linear parameters are those that are estimated together with the effects; offsets are nuisance parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_flag, as_list, as_noise, as_number, shown
from ..data.frequency_response import FrequencyResponse
from ..data.measurement import Measurement
from ..data.records import FreeRun
from ..data.response_record import some_lines
from ..data.signals import over_time
from ..effects.channels import InputOffset, OutputOffset
from ..effects.effect import Effect, as_effects
from ..effects.law import KINDS
from ..engine.controlled import as_it_runs, checked_horizon, free_runs, integrates
from ..engine.observer import leading_ratio
from ..exceptions import ModelError
from ..models.controller import HELD, held_effects
from ..models.conversion import as_physical
from ..models.operating_point import ordered_record
from ..models.parameters import independent_parameters
from ..models.physical_model import PhysicalModel
from ..systems.linear import LinearModel
from .refinement import Refinement

_OFF = {"inputs": 1.0, "outputs": 10.0}  # prior standard deviation of an offset over the rms of the signal


def unfold(model: Any) -> tuple[PhysicalModel, list[tuple[Effect, str]]]:
    """Return the initial model and the effects of a Refinement.

    The effects start at their estimated values. Any other model has no effects yet.
    """
    if not isinstance(model, Refinement):
        physical = as_physical(model)
        return physical, [(effect, HELD) for effect in held_effects(physical)]
    kept = []
    structure, theta, _ = model.simulation_structure()
    # estimates become starting values; each effect keeps its role
    for index, (effect, role) in enumerate(zip(model.effects, model.roles, strict=True)):
        start = dict(effect.start)
        for name in effect.coefficients:
            if structure.position(index, name) >= 0:
                start[name] = float(theta[structure.position(index, name)])
        kept.append((effect.replace(start=start), role))
    return model.physical_model, kept


def check_settings(
    physical: PhysicalModel,
    *,
    free: Any = (),
    tolerance: Any = 0.0,
    offset: Any = True,
    noise: Any = None,
    horizon: Any = None,
    known_start: bool = False,
) -> None:
    """Check the settings that all fits share, before the fit begins.

    Raises
    ------
    control.ControlArgument, control.ControlDimension
        If a setting is of the wrong kind, size or out of range.
    """
    as_number(tolerance, "tolerance", least=0.0)
    as_flag(offset, "offset")
    as_noise(noise, physical.linear.n_outputs)
    checked_horizon(horizon, known_start)
    _linear_effects(physical, free, tolerance)


def assemble(
    physical: PhysicalModel,
    kept: list[tuple[Effect, str]],
    effects: Sequence[Effect],
    free: str | Sequence[Any],
    tolerance: float,
    offsets: Sequence[Effect],
) -> list[tuple[Effect, str]]:
    """Effects with their roles: asked for, linear parameters, offsets."""
    # in this order: effects of the given refinement, requested ones, linear parameters, offsets
    chosen = list(kept)
    for effect in as_effects(effects, "effects"):
        if any(same.kind == effect.kind and same.place == effect.place for same, _ in chosen):
            raise ModelError(f"{effect.label} is named twice; give each effect once")
        chosen.append((effect, "effect"))
    for effect in _linear_effects(physical, free, tolerance):
        if not any(_covers(same, effect) for same, _ in chosen):
            chosen.append((effect, "linear"))
    # offsets, unless another effect can hold a constant
    if not any(role == "offset" for _, role in chosen):
        if not any(same.spec.holds_constant for same, _ in chosen):
            chosen += [(effect, "offset") for effect in offsets]
    return chosen


def _covers(chosen: Effect, linear: Effect) -> bool:
    """Return whether an effect makes a linear parameter redundant.

    It does if it already contains everything that the linear parameter could change.
    """
    if chosen.place != linear.place:
        return False
    return chosen.kind == linear.kind or linear.kind in chosen.spec.covers


def _linear_effects(physical: PhysicalModel, free: Any, tolerance: float) -> list[Effect]:
    numbers = independent_parameters(physical)
    # a free mass and a free input gain would rescale each other: only the gain is free
    gains = any(KINDS[q.kind].relative for q in physical.parameters)
    everything = [Effect(q.kind, q.place) for q in numbers if not (gains and KINDS[q.kind].inertial)]
    if isinstance(free, str):
        if free != "linear":
            raise ct.ControlArgument(f"free must be 'linear' or a list, not {shown(free)}")
        return everything
    # a list of names or effects; a tolerance alone frees all linear parameters
    entries = [free] if isinstance(free, Effect) else as_list(free, "free", "names or effects")
    if not entries:
        return everything if tolerance > 0 else []
    found = []
    by_name = {q.name: Effect(q.kind, q.place) for q in physical.parameters}
    for entry in entries:
        effect = by_name.get(entry) if isinstance(entry, str) else entry
        if not isinstance(effect, Effect):
            raise ct.ControlArgument(
                f"free names {shown(entry)}; the model has the parameters {', '.join(by_name) or 'none'}"
            )
        found.append(effect)
    return found


def offset_variants(physical: PhysicalModel, record: Measurement, offset: bool) -> list[list[Effect]]:
    """Return the possible places of constant offsets, likeliest first.

    In a linear model the data cannot distinguish actuator from sensor offsets as long as the
    inputs reach the outputs at rest; in a nonlinear one they can, and both are tried.
    Where the model integrates, an offset of the sensors that read what is integrated is an initial state.
    """
    if not as_flag(offset, "offset") or not record.in_time:
        return [[]]
    linear, controller = physical.linear, physical.controller
    if controller is not None and not controller.recorded and integrates(controller.linear, record):
        return [[]]  # the initial state of its integrator acts as an offset
    # candidates: an offset at each input and output
    at_inputs = [Effect(InputOffset.name, label) for label in linear.input_labels]
    at_outputs = [Effect(OutputOffset.name, label) for label in linear.output_labels]
    if integrates(linear, record):
        return [at_inputs + [at_outputs[i] for i in _own_levels(linear)]]
    # static gain D - C A^-1 B: which outputs does a constant input reach?
    reach = linear.D - linear.C @ np.linalg.pinv(linear.A) @ linear.B
    level = np.abs(reach) @ np.sqrt(np.mean(record.inputs**2, axis=1))
    seen = np.flatnonzero(level > 1e-3 * over_time(np.std, record.outputs))
    if seen.size < linear.n_inputs:
        return [at_outputs]
    # those outputs determine the offsets of the actuators; the other outputs need their own
    taken = set(seen[: linear.n_inputs])
    rest = [effect for i, effect in enumerate(at_outputs) if i not in taken]
    return [at_inputs + rest, at_outputs]


def offsets_everywhere(physical: PhysicalModel, records: Sequence[Measurement]) -> list[Effect]:
    """Return a constant offset at every input and output.

    Priors decide between offsets that the data of a linear model cannot distinguish.
    """
    linear = physical.linear
    found = []
    for law, labels, signals, wide in (
        (InputOffset, linear.input_labels, [r.inputs for r in records], _OFF["inputs"]),
        (OutputOffset, linear.output_labels, [r.outputs for r in records], _OFF["outputs"]),
    ):
        for label, signal in zip(labels, np.concatenate(signals, axis=1), strict=True):
            # prior standard deviation in units of the rms value of the signal
            size = float(np.sqrt(np.nanmean(signal**2)))
            found.append(Effect(law.name, label, prior={"offset": wide * (size or 1.0)}))
    return found


def _own_levels(linear: LinearModel) -> list[int]:
    """Return the outputs of an integrating model that need their own offset.

    Neither an initial state nor a constant input sets the level of these outputs.
    """
    if not linear.is_continuous:
        return []
    U, s, Vt = np.linalg.svd(linear.A)
    # null space of A: the integrators; `away`: inputs that drive one
    free = s <= 1e-9 * s.max(initial=0.0)
    inverse = np.linalg.pinv(linear.A, rcond=1e-9)
    away = np.linalg.norm(U[:, free].T @ linear.B, axis=0) > 1e-9 * np.linalg.norm(linear.B, axis=0)
    # levels of the outputs that an initial state or a constant input can set
    levels = [linear.C @ Vt[free].T, (linear.C @ inverse @ linear.B)[:, ~away]]
    span, own = np.hstack(levels), []
    span = span / np.maximum(np.linalg.norm(span, axis=0), 1e-300)
    # an output needs an offset of its own if its unit vector lies outside of that span
    for i, unit in enumerate(np.eye(linear.n_outputs)):
        more = np.column_stack([span, unit])
        if np.linalg.matrix_rank(more, tol=1e-6) > np.linalg.matrix_rank(span, tol=1e-6):
            span = more
            own.append(i)
    return own


_LOOPED = "The model was fitted to predictions one sample ahead; compare and simulate run the closed loop."
_PREDICTED = (
    "The motion is chaotic and cannot be simulated from the initial state (no free run). It is judged "
    "by predictions one sample ahead, with process noise (horizon= gives short simulations)."
)

_MOST_LINES, _FEWEST_LINES = 200, 40  # frequencies for nonlinear effects: all responses, each one


def check_validation(model: Any, record: Any) -> None:
    """Check that a record can validate the model, before the fit begins."""
    if not isinstance(record, (Measurement, FrequencyResponse)):
        raise ct.ControlArgument(
            f"validation must be a Measurement that the fit does not use, not {type(record).__name__}"
        )
    ordered_record(as_physical(model), record)


def spread_lines(data: list[Any]) -> list[Any]:
    """Limit the number of frequencies of responses at known amplitudes.

    Harmonic balance would take too long at all of them, so evenly spread ones are kept.
    """
    balances = [one.n_balances for one in data]
    total = sum(balances)
    if total <= _MOST_LINES or not all(balances):
        return data
    # frequencies of each response in proportion to their number, evenly spread
    kept = [min(n, max(_FEWEST_LINES, n * _MOST_LINES // total)) for n in balances]
    numbers = [np.linspace(0, n - 1, few) for n, few in zip(balances, kept, strict=True)]
    return [some_lines(one, np.unique(k.astype(int))) for one, k in zip(data, numbers, strict=True)]


def about_noise(physical: PhysicalModel, data: list[Any], given: list[Any]) -> list[str]:
    """Return notes on the noise and the used points of frequency responses."""
    about = _notes([ordered_record(physical, one) for one in data])
    taken, of = (sum(one.n_points for one in some) for some in (data, given))
    fewer = f"The search for nonlinear effects used {taken} of {of} frequencies; refine() uses all of them."
    return [sentence for sentence in (about, fewer if taken < of else "") if sentence]


def _notes(records: Sequence[Any]) -> str:
    """Return what is to be said of the noise of the records."""
    return " ".join(dict.fromkeys(record.note for record in records if record.note))


def windows(
    physical: PhysicalModel, records: list[Any], horizon: float | None, known_start: bool = False
) -> tuple[list[Any], str]:
    """Cut the records into windows, and return a note with the reason.

    The windows are those of `engine.free_runs`. Responses stay whole, and the note is about their noise.
    """
    # a given horizon asks for free runs
    if not records[0].in_time:
        return records, _notes(records)
    if horizon is not None:
        records = [r._changed(FreeRun) for r in records]
    cuts, note = free_runs([as_it_runs(physical, r) for r in records], records, horizon, known_start)
    # no windows by default: is the model judged by predictions?
    if len(cuts[0]) == 1 and not note and any(leading_ratio(physical, r) is not None for r in records):
        note = _PREDICTED if physical.controller is None else _LOOPED
    pieces = []
    # each window is a record with an initial state of its own
    for record, parts in zip(records, cuts, strict=True):
        pieces += [record] if len(parts) == 1 else [record._part(part) for part in parts]
    return pieces, note
