"""The first samples, gone over again about the model as it improves.

Errors of phase grow with time, so a short stretch has one valley where a long one has many:
the stretch doubles, each time started where the shorter one ended (Gauss-Newton, damped).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...effects.output_path import OutputOffset
from ...engine.engine import Engine
from ...engine.structure import Structure
from ...exceptions import IdentifiabilityWarning, warn
from ...inference.autoregression import autoregression
from ...systems.linear import Array
from .memory import CoefficientMemory
from .setup import floor_at

if TYPE_CHECKING:
    from .effects import EffectsSetup

__all__ = ["engine_on", "go_over"]

_PASSES = 15
_LOOSE = 2.0  # prior standard deviation over the nominal value
_WIDE = 30.0  # ... over the size whose effect on the outputs is that of the signals
_MOST_STARTS = 8
_FEW = 6  # passes that a rival gets
_RIVALS = 4
_SCENARIOS = 3  # times that the loss of each single parameter is tried
_LOSSES = (0.35, 0.7)
_ENOUGH = 90  # samples of which a mean is judged
_FAR = 6.0  # standard errors of a mean that is no chance
_FLAT = 1e-3  # of the rms of an output: a constant part that distorts nothing


@dataclass(frozen=True, slots=True, eq=False)
class _Pass:
    """One run over the stretch about fixed coefficients."""

    memory: CoefficientMemory
    step: Array
    power: Array
    cost: float
    left: Array


def go_over(setup: EffectsSetup, memory: CoefficientMemory) -> CoefficientMemory:
    """Return the memory after filtering again with the best coefficients.

    It is as if the best coefficients had been known from the first sample of the stretch.
    """
    memory = _sized(setup, memory)
    initial = _initial_state(setup, memory)
    memory = replace(memory, states=np.sqrt(np.diag(initial[1])))
    found: list[_Pass] = []
    main, far = _starts(setup, memory)
    for start in main + _promising(setup, memory, initial, far):
        descent = _descend(setup, memory, initial, start, _PASSES if not found else _FEW)
        if descent is not None and not any(_same(setup, descent, other) for other in found):
            found.append(descent)
    if not found:  # not even the initial model stays bounded: leave it to the guard
        return replace(memory, rounds=memory.rounds + 1, kernel=None)
    found.sort(key=lambda one: one.cost)
    best = _descend(setup, memory, initial, found[0].memory.centre, _PASSES) or found[0]
    _judge_means(setup, memory, initial, best)
    rivals = np.array([one.memory.centre for one in found[1 : 1 + _RIVALS]]).reshape(-1, setup.layout.p)
    return replace(_adopted(setup, best, memory), rivals=rivals)


def _judge_means(
    setup: EffectsSetup, memory: CoefficientMemory, initial: tuple[Array, Array], best: _Pass
) -> None:
    """Warn if the first samples have a constant part that no effect takes.

    Such a constant part distorts the coefficients.

    Seen in what the best fit leaves, by the standard error of a mean of colored noise. But a fit that ran
    away turns the constant into a slow motion: where it is the larger part of what the initial model
    leaves, a fit without it must not be decisively better.
    """
    taken = {effect.place for effect in setup.effects if effect.spec.holds_constant}
    labels = setup.model.output_labels
    least = np.array([np.inf if label in taken else _FLAT for label in labels]) * memory.sizes[-len(labels) :]
    mean, error, _ = _means(best.left)
    suspect = np.abs(mean) > np.maximum(_FAR * error, least)
    other = _over(setup, memory, initial, memory.origin, best.power)
    if other is not None:
        mean, _, sd = _means(other.left)
        large = ~suspect & (np.abs(mean) > np.maximum(sd, least))
        for _ in range(2 * bool(large.any())):
            mean = np.where(large, _means(other.left)[0], 0.0)
            memory = _sized(setup, replace(memory, outputs=memory.outputs - mean))
            initial = _initial_state(setup, memory)
            other = _descend(setup, memory, initial, other.memory.centre, _FEW) or other
        _, error, sd = _means(other.left)
        wide = max(1.0, float(np.max(len(best.left) * (error / np.maximum(sd, 1e-300)) ** 2)))
        suspect |= large & (best.cost - other.cost > _FAR**2 * wide)
    for i in np.flatnonzero(suspect & (len(best.left) >= _ENOUGH)):
        warn(
            f"output {labels[i]!r}: the first samples have an offset that is not in the model and "
            "distorts the coefficients; estimate it together with them: "
            f"rco.Effect({OutputOffset.name!r}, {labels[i]!r})",
            IdentifiabilityWarning,
        )


def _means(left: Array) -> tuple[Array, Array, Array]:
    """Return the residual's mean, standard error and deviation per output.

    The standard error is that of a mean of colored noise.
    """
    found = np.array([[0.0], [np.inf], [0.0]]) * np.ones(left.shape[1])
    for i, row in enumerate(left.T):
        row = row[np.isfinite(row)]
        if row.size:
            a, variance = autoregression(row)
            error = np.sqrt(variance / row.size) / max(abs(a.sum()), 1e-300)
            found[:, i] = row.mean(), error, row.std()
    return found[0], found[1], found[2]


def _promising(
    setup: EffectsSetup, memory: CoefficientMemory, initial: tuple[Array, Array], starts: list[Array]
) -> list[Array]:
    """The few of many starts that are best one step further."""
    lower, upper = setup.bounds_about(memory.origin)
    R = np.maximum(memory.sizes[-setup.layout.ny :] ** 2, 1e-300)
    found: list[tuple[float, int, Array]] = []
    for i, start in enumerate(starts):
        one = _over(setup, memory, initial, np.clip(start, lower, upper), R)
        if one is None:
            continue
        aim = np.clip(one.memory.centre + one.step, lower, upper)
        further = _over(setup, memory, initial, aim, one.power)
        if further is not None and further.cost < one.cost:
            found.append((further.cost, i, aim))
        else:
            found.append((one.cost, i, one.memory.centre))
    return [point for _, _, point in sorted(found, key=lambda entry: entry[:2])[:_RIVALS]]


def _same(setup: EffectsSetup, one: _Pass, other: _Pass) -> bool:
    """Return whether two descents ended in the same minimum."""
    spread = np.sqrt(np.diag(setup.layout.view(other.memory.packed, "Pt")))
    return bool(np.all(np.abs(one.memory.centre - other.memory.centre) < 3.0 * spread))


def _descend(
    setup: EffectsSetup, memory: CoefficientMemory, initial: tuple[Array, Array], start: Array, passes: int
) -> _Pass | None:
    lower, upper = setup.bounds_about(memory.origin)
    ny = setup.layout.ny
    R = np.maximum(memory.sizes[-ny:] ** 2, 1e-300)
    best = _over(setup, memory, initial, np.clip(start, lower, upper), R)
    if best is None:
        return None
    best = _over(setup, memory, initial, best.memory.centre, best.power) or best
    damping = 1.0
    for _ in range(passes):
        aim = np.clip(best.memory.centre + damping * best.step, lower, upper)
        trial = _over(setup, memory, initial, aim, best.power)
        if trial is None or trial.cost >= best.cost:
            spread = np.sqrt(np.diag(setup.layout.view(best.memory.packed, "Pt")))
            if damping < 0.02 or np.all(np.abs(damping * best.step) < 1e-2 * spread):
                break
            damping *= 0.3
            continue
        gained = best.cost - trial.cost
        best, damping = trial, min(1.0, 2.0 * damping)
        if gained < 1e-3:
            break
    return best


def _over(
    setup: EffectsSetup, memory: CoefficientMemory, initial: tuple[Array, Array], theta: Array, R: Array
) -> _Pass | None:
    """Run over the stretch about `theta`; None where that leaves all bounds."""
    lay = setup.layout
    packed = np.zeros(lay.size)
    lay.view(packed, "theta")[:] = theta
    lay.view(packed, "delta")[:] = memory.origin - theta
    lay.view(packed, "x")[:], lay.view(packed, "Pb")[:] = initial
    lay.view(packed, "Pt")[:] = np.diag(memory.spread**2)
    counters = setup.counters()
    about = replace(memory, packed=packed, counters=counters, centre=theta.copy())
    kernel = setup.compile(about)
    if not np.isfinite(kernel.fixed).all() and not np.isfinite(kernel.fixed[4 * lay.p :]).all():
        return None
    fixed = kernel.fixed.copy()
    floor = np.maximum(kernel.floor, R)
    fixed[floor_at(lay)] = floor
    course = lay.record(len(memory.inputs))
    done, _ = replace(kernel, fixed=fixed).over(packed, counters, memory.first, course, frozen=True)
    if done < len(memory.inputs) or not np.isfinite(packed).all():
        return None
    cost, count = lay.view(packed, "cost")
    power = np.where(count > 0, cost / np.maximum(count, 1.0), R)
    total = float(np.sum(count * np.log(np.maximum(power, kernel.floor) + 1e-300)))
    away = (theta - memory.origin) / memory.spread
    step = lay.view(packed, "delta").copy()
    about = replace(about, discretized=memory.discretized + 1, kernel=kernel)
    left = np.where(memory.use, memory.outputs - course.predicted, np.nan)
    return _Pass(about, step, power, total + float(away @ away), left)


def _adopted(setup: EffectsSetup, best: _Pass, memory: CoefficientMemory) -> CoefficientMemory:
    """Memory after the best pass, its last step taken."""
    lay = setup.layout
    lower, upper = setup.bounds_about(memory.origin)
    found = best.memory
    packed = found.packed
    theta = lay.view(packed, "theta")
    step = np.clip(theta + best.step, lower, upper) - theta
    if np.all(np.abs(step) < 3.0 * np.sqrt(np.diag(lay.view(packed, "Pt"))) + 1e-300):
        theta += step
        lay.view(packed, "x")[:] += step @ lay.view(packed, "S")
    lay.view(packed, "delta")[:] = 0.0
    lay.view(packed, "level")[:] = best.power
    lay.view(packed, "count")[:] = lay.view(packed, "cost")[1]
    found = replace(found, centre=theta.copy(), rounds=memory.rounds + 1)
    return replace(found, kernel=setup.compile(found), discretized=found.discretized + 1)


def _sized(setup: EffectsSetup, memory: CoefficientMemory) -> CoefficientMemory:
    """Sizes of signals, widths of laws and priors, from the samples so far."""
    inputs, outputs = memory.inputs, np.where(memory.use, memory.outputs, np.nan)
    with np.errstate(invalid="ignore"):
        count = np.maximum(memory.use.sum(axis=0), 1)
        y_size = np.sqrt(np.nansum(outputs**2, axis=0) / count)
    w_size = np.sqrt(np.mean(inputs**2, axis=0))
    sizes = np.concatenate([w_size, np.where(y_size > 0, y_size, 1.0)])
    memory = replace(memory, sizes=sizes)
    memory = replace(memory, widths=_widths(setup, memory))
    if memory.spread.size:
        return memory
    memory = _shaped(setup, memory)
    return replace(memory, spread=_prior(setup, memory))


def _shaped(setup: EffectsSetup, memory: CoefficientMemory) -> CoefficientMemory:
    """Memory whose first coefficients shape their laws as the motion suggests."""
    from ...inference.starts import shape_starts

    shapes = [i for i in range(setup.layout.p) if setup.is_shape(i)]
    if not shapes:
        return memory
    start = shape_starts(setup.structure(memory.widths), memory.origin.copy(), _motion(setup, memory))[0]
    # a level that goes with a shape (friction) starts with it, or the shape has no gradient
    packed = memory.packed.copy()
    setup.layout.view(packed, "theta")[:] = start
    return replace(memory, origin=start, packed=packed)


def _motion(setup: EffectsSetup, memory: CoefficientMemory) -> Any:
    from ...data.measurement import Measurement
    from ...engine.structure import Structure
    from ...inference.starts import estimated_motion

    data = Measurement(memory.inputs.T, _filled(memory).T, dt=setup.settings.dt, hold=setup.settings.hold)
    return estimated_motion(Structure(setup.physical), np.zeros(0), data)


def _filled(memory: CoefficientMemory) -> Array:
    """Outputs with gaps bridged by straight lines, for sizes only."""
    outputs = memory.outputs.copy()
    grid = np.arange(len(outputs))
    for i in range(outputs.shape[1]):
        there = memory.use[:, i] > 0
        outputs[:, i] = np.interp(grid, grid[there], outputs[there, i]) if there.any() else 0.0
    return outputs


def _widths(setup: EffectsSetup, memory: CoefficientMemory) -> Array:
    from ...inference.starts import law_widths

    widths = np.full(len(setup.effects), np.nan)
    if any(effect.spec.width_share is not None for effect in setup.effects):
        for index, width in law_widths(setup.bare, _motion(setup, memory)).items():
            widths[index] = width
    return widths


def _prior(setup: EffectsSetup, memory: CoefficientMemory) -> Array:
    """Return the prior standard deviation of every coefficient.

    It is declared, or follows from the nominal value, or from the sensitivity of the outputs.
    """
    structure = setup.structure(memory.widths)
    spread = _LOOSE * setup.nominal
    engine = engine_on(setup, structure, memory.inputs, memory.outputs)
    run = engine.run(memory.origin, check=False)
    with np.errstate(all="ignore"):
        weights = 1.0 / memory.sizes[-setup.layout.ny :]
        trace = np.sqrt(np.mean((weights[:, None, None] * run.sensitivity) ** 2, axis=(0, 1)))
    for i, q in enumerate(structure.parameters):
        effect = structure.effects[q.effect]
        if q.name in effect.prior:
            spread[i] = effect.prior[q.name]
        elif setup.is_shape(i) and memory.origin[i] != 0:
            spread[i] = _WIDE * abs(memory.origin[i])
        elif spread[i] == 0.0:
            seen = np.isfinite(trace[i]) and trace[i] > 0
            spread[i] = _WIDE / trace[i] if seen else max(10.0 * abs(memory.origin[i]), 1.0)
    return spread


def _initial_state(setup: EffectsSetup, memory: CoefficientMemory) -> tuple[Array, Array]:
    """Mean and covariance of the state at the first sample."""
    lay = setup.layout
    structure = setup.structure(memory.widths)
    engine = engine_on(setup, structure, memory.inputs, memory.outputs)
    calm = memory.origin.copy()
    if structure.port_columns.size:
        calm[structure.port_columns] = 0.0
    run = engine.run(calm, sensitivity=False, initial_state=True, histories=True, check=False)
    y_size = memory.sizes[-lay.ny :]
    with np.errstate(all="ignore"):
        moving = np.sqrt(np.mean(np.nan_to_num(run.states) ** 2, axis=1))
        C = structure.matrices(calm).C
        read = np.abs(np.linalg.pinv(C)) @ y_size
        shown = np.sqrt(np.mean((run.sensitivity / y_size[:, None, None]) ** 2, axis=(0, 1)))
    size = np.hypot(np.where(np.isfinite(moving), moving, 0.0), read)
    reach = np.where(np.isfinite(shown) & (shown > 0), 1.0 / np.where(shown > 0, shown, 1.0), 0.0)
    size = np.where(size > 0, 3.0 * size, 3.0 * reach)
    return np.zeros(lay.n), np.diag(size**2)


def _starts(setup: EffectsSetup, memory: CoefficientMemory) -> tuple[list[Array], list[Array]]:
    """Return the starting values of the descent: near ones and far ones.

    The near ones are the present coefficients and the alternatives in memory. Of the far ones only
    the best are used.
    """
    from ...inference.starts import shape_starts

    starts = [setup.layout.view(memory.packed, "theta").copy(), *memory.rivals]
    if memory.rounds:
        starts.append(memory.origin.copy())
    far: list[Array] = []
    if memory.rounds < _SCENARIOS:
        for i in np.flatnonzero(setup.nominal):
            for loss in _LOSSES:
                start = memory.origin.copy()
                start[i] -= loss * setup.nominal[i]
                far.append(start)
    if any(setup.is_shape(i) for i in range(setup.layout.p)):
        far.append(setup.bare.start())  # where gap or threshold is zero the law is smooth
        motion = _motion(setup, memory)
        far += shape_starts(setup.structure(memory.widths), memory.origin, motion)[:_MOST_STARTS]
    return starts, far


def engine_on(setup: EffectsSetup, structure: Structure, inputs: Array, outputs: Array) -> Engine:
    """Engine of the structure on some samples of shape (N, n_w), (N, n_y)."""
    from ...data.measurement import Measurement

    data = Measurement(inputs.T, np.nan_to_num(outputs.T), dt=setup.settings.dt, hold=setup.settings.hold)
    return Engine(structure, data, substeps=setup.substeps)
