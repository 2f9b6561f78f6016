"""Physical effects as coefficients: model arrays, and the first samples.

The first samples are gone over again about the model as it improves. Errors of phase grow with time, so
a short stretch has one valley where a long one has many: the stretch doubles, each time started where
the shorter one ended (Gauss-Newton, damped).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from ...effects.channels import OutputOffset
from ...effects.effect import Effect, as_effects
from ...effects.formula import InputLaw, OutputLaw
from ...engine.engine import Engine
from ...engine.march import address_of_march
from ...engine.setting import setting
from ...engine.structure import Structure
from ...exceptions import IdentifiabilityWarning, ModelError, warn
from ...inference.whitening import autoregression
from ...models.conversion import as_physical
from ...models.operating_point import check_stream_hold, refuse_discrete
from ...models.physical_model import PhysicalModel
from ...systems.linear import Array, LinearModel
from .kernel import Kernel, Layout
from .laws import Laws
from .setup import (
    CoefficientMemory,
    CoefficientSetup,
    FilterSettings,
    floor_at,
    held_columns,
    signal_sizes,
)

_LAG = 64  # samples that input delays look back on
_FIRST, _LAST = 50, 2048  # samples of the first stretch, at least, and of the last one
_MARGIN = 1e-3  # of a bound that an estimate keeps off it


@dataclass(frozen=True, eq=False)
class EffectsSetup(CoefficientSetup):
    """Physical effects as coefficients.

    Parameters
    ----------
    physical : PhysicalModel
        Initial model.
    effects : tuple of Effect
        What is estimated.
    settings : FilterSettings
        Sampling, noise, memory.
    substeps : int
        Substeps per sample.
    """

    physical: PhysicalModel
    effects: tuple[Effect, ...]
    settings: FilterSettings
    substeps: int

    @cached_property
    def bare(self) -> Structure:
        """Model with its effects, laws of unit width."""
        return Structure(self.physical, self.effects)

    @cached_property
    def layout(self) -> Layout:  # type: ignore[override]
        """Sizes of the packed memory."""
        s = self.bare
        delays = any(effect.spec.delays for effect in self.effects)
        lag = 0 if self.fast else (_LAG if delays else 3)
        turning = any(s.effects[i].spec.inner_states for i, _ in s.input_statics)
        inner = s.n_ports + s.n_outputs * s.remembers
        kept = len(s.input_statics) if turning else 0
        return Layout(s.n_states, s.n_parameters, s.n_inputs + 1, s.n_outputs, inner, lag, kept)

    @cached_property
    def fast(self) -> bool:
        """Return whether all effects are absorbed into the matrices."""
        return self.bare.is_linear

    @cached_property
    def n_laws(self) -> int:  # type: ignore[override]
        """Laws that may have a width of their own."""
        return len(self.effects)

    @cached_property
    def labels(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the coefficients."""
        return tuple(q.label for q in self.bare.parameters)

    @cached_property
    def milestones(self) -> tuple[int, ...]:  # type: ignore[override]
        """Numbers of samples at which the first ones are gone over."""
        lay, last = self.layout, _LAST
        # first stretch: enough outputs for states and coefficients; then twice as long each time
        lengths = [min(max(_FIRST, 3 * (lay.n + lay.p) // max(1, lay.ny) + lay.n), last)]
        while lengths[-1] < last:
            lengths.append(min(2 * lengths[-1], last))
        return tuple(lengths)

    def start(self) -> Array:
        """Coefficients at which the effects are absent, or the user's."""
        return self.bare.start()

    def compile(self, memory: CoefficientMemory) -> Kernel:
        """Discretize at `memory.centre` and pack what the loop needs."""
        lay, s = self.layout, self.structure(memory.widths)
        dt, hold = self.settings.dt, self.settings.hold
        step = dt / self.substeps
        # discretize model and derivatives at the substep
        disc = s.discretize(memory.centre, step, pieces=s.jumps)
        n, nu = lay.n, lay.nu
        forces = _forces(self, tuple(memory.sizes.tolist()))
        head, floor = self.head(memory, self.bounds_about(memory.origin), *forces)
        q = disc.linear.size
        sizes = np.array([n, lay.p, nu, lay.ny, q, lay.lag, lay.m, lay.kept], dtype=np.int64)
        # linear effects: the matrices hold all of them, one step per sample
        if self.fast:
            M, dM = held_columns(disc.M, n, nu, hold)[0], held_columns(disc.dM[0], n, nu, hold)
            fixed = np.concatenate(
                [*head, M.ravel(), disc.O.ravel(), dM.ravel(), disc.dO.ravel(), disc.linear]
            )
            return Kernel(sizes, fixed, None, floor)
        # nonlinear effects: march over substeps, with forces by their ports
        model = setting(s, memory.centre, step, True).model
        # the filter fills in its coefficients
        model = model._replace(
            ports=model.ports._replace(values=model.ports.values.copy()),
            sensors=model.sensors._replace(values=model.sensors.values.copy()),
        )
        # effects and delays at the inputs, one row each: law, channel, columns in theta
        r = len(s.input_statics)
        statics, levels = np.zeros((r, 6), dtype=np.int64), np.zeros((r, 4))
        statics[:, 2:] = -1
        for i, (index, channel) in enumerate(s.input_statics):
            law, found = s.effects[index].spec, s.law_values(memory.centre, index)
            assert isinstance(law, InputLaw)
            statics[i, :2] = 0 if law.delays else law.code, channel
            statics[i, 2 : 2 + len(law.coefficients)] = s.law_columns(index)
            levels[i, : len(found)] = found
        laws = Laws(
            address_of_march(), model, statics, levels, self.substeps, hold == "foh", dt,
        )  # fmt: skip
        return Kernel(sizes, np.concatenate(head), laws, floor)

    def go_over(self, memory: CoefficientMemory) -> CoefficientMemory:
        """Return the memory after filtering again with the best coefficients.

        It is as if the best coefficients had been known from the first sample.
        """
        stretch = _Stretch(self, memory)
        found: list[_Pass] = []
        # descents from several starts; equal minima count once
        main, far = _starts(self, stretch.memory)
        for start in main + stretch.best_starts(far):
            descent = stretch.descend(start, _PASSES if not found else _FEW)
            if descent is not None and not any(descent.alike(other) for other in found):
                found.append(descent)
        if not found:  # not even the initial model stays bounded: leave it to the guard
            return replace(stretch.memory, rounds=memory.rounds + 1, kernel=None)
        # the best minimum is refined; the next ones serve as starts of the longer stretch
        found.sort(key=lambda descent: descent.cost)
        best = stretch.descend(found[0].memory.centre, _PASSES) or found[0]
        stretch.warn_of_offsets(best)
        rivals = np.array([run.memory.centre for run in found[1 : 1 + _RIVALS]]).reshape(-1, self.layout.p)
        return replace(stretch.last_step(best), rivals=rivals)

    def system(self, theta: Array, widths: Array, name: str) -> LinearModel:
        """Linear part at these coefficients, in continuous time."""
        return LinearModel.from_statespace(self.structure(widths).system(theta, name))

    def rows(self, theta: Array, spread: Array) -> tuple[Any, ...]:
        """Estimated parameters, one row each."""
        from ...inference.parameters import estimated, parameter_table

        return estimated(parameter_table(self.bare, ["effect"] * len(self.effects)), theta, spread)

    @cached_property
    def model(self) -> LinearModel:  # type: ignore[override]
        """Linear part of the initial model."""
        return self.physical.linear

    @cached_property
    def bounds(self) -> tuple[Array, Array]:  # type: ignore[override]
        """Bounds of the coefficients, a little inside those of physics."""
        s = self.bare
        lower = np.array([q.lower for q in s.parameters])
        upper = np.array([q.upper for q in s.parameters])
        for i, q in enumerate(s.parameters):
            # a delay stays within the samples that are kept
            if s.effects[q.effect].spec.delays:
                upper[i] = min(upper[i], (_LAG - 4) * self.settings.dt)
        with np.errstate(invalid="ignore"):
            lower = np.where(np.isfinite(lower), lower + _MARGIN * np.abs(lower), lower)
            upper = np.where(np.isfinite(upper), upper - _MARGIN * np.abs(upper), upper)
        return lower, upper

    def bounds_about(self, origin: Array) -> tuple[Array, Array]:
        """Bounds of the coefficients; those that shape a law stay positive."""
        lower, upper = self.bounds
        # widths and gaps: no less than a thousandth of their starting value
        shapes = np.array([self.is_shape(i) for i in range(lower.size)], dtype=bool)
        floor = np.where(shapes & (lower >= 0) & (origin > 0), 1e-3 * origin, -np.inf)
        return np.maximum(lower, floor), upper

    def is_shape(self, column: int) -> bool:
        """Return whether a coefficient needs a starting value from the data.

        This is so if it has no value at which its effect is absent.
        """
        q = self.bare.parameters[column]
        effect = self.effects[q.effect]
        return effect.start_of(q.name) is None

    @cached_property
    def nominal(self) -> Array:
        """Size of the physical parameter that each coefficient changes.

        It is 0 where there is no such parameter; one that is zero has the natural size of its place.
        """
        from ...inference.parameters import nominal_size

        s = self.bare
        found = np.array([nominal_size(s, s.effects[q.effect]) for q in s.parameters])
        return np.where(np.isfinite(found), found, 0.0)

    def structure(self, widths: Array) -> Structure:
        """Model with its effects and the widths of their laws."""
        return _structure(self, tuple(widths.tolist()))


@lru_cache(maxsize=64)
def _structure(setup: EffectsSetup, widths: tuple[float, ...]) -> Structure:
    constants = {i: width for i, width in enumerate(widths) if np.isfinite(width)}
    return Structure(setup.physical, setup.effects, constants=constants)


@lru_cache(maxsize=64)
def _forces(setup: EffectsSetup, sizes: tuple[float, ...]) -> tuple[Array, Array]:
    """Return how unknown forces and missing inputs move the state per sample."""
    s, n, n_w = setup.bare, setup.layout.n, setup.layout.nu - 1
    level = np.array([size if size > 0 else 1.0 for size in sizes[:n_w]])
    # matrices without the effects; a shape has no value that removes it and is set to 1
    lower, upper = setup.bounds
    calm = np.clip(np.where([setup.is_shape(i) for i in range(setup.layout.p)], 1.0, 0.0), lower, upper)
    m = s.matrices(calm)
    # missing inputs: what an input of its usual size moves within one sample
    inputs = m.B[:, :n_w] * level * setup.settings.dt
    top = max((float(np.linalg.norm(column)) for column in inputs.T), default=0.0) or setup.settings.dt
    # unknown forces: one at each port, as strong as the strongest input
    acts = []
    for port in s.model.ports:
        size = float(np.linalg.norm(port.act))
        if size > 0:
            acts.append(np.concatenate([port.act, np.zeros(n - port.act.size)]) * (top / size))
    return np.column_stack([inputs, *acts]) * setup.settings.disturbance, inputs


def make_effects_setup(
    model: Any, effects: Sequence[Effect], settings: FilterSettings, substeps: int | None
) -> EffectsSetup:
    """Check what `RCORefiner` was given for the physical stage."""
    effects = as_effects(effects, "effects")
    for effect in effects:
        if effect.spec.delays and isinstance(effect.spec, OutputLaw):
            raise ModelError(
                f"{effect.label}: a delay at an output needs the future and cannot be estimated on a stream; "
                "use an input_delay, an output_lag, or refine() on a record"
            )
        if effect.spec.drifts or (isinstance(effect.spec, InputLaw) and effect.spec.feels_time):
            raise ModelError(
                f"{effect.label}: an effect that depends on the time between samples is not estimated on a "
                "stream; use refine() on a record"
            )
    if not effects:
        raise ModelError("effects is empty: name at least one Effect, or leave effects out")
    seen: set[tuple[str, str]] = set()
    for effect in effects:
        if (effect.kind, effect.place) in seen:
            raise ModelError(f"{effect.label} is named twice; give each effect once")
        seen.add((effect.kind, effect.place))
    refuse_discrete(model)
    physical = as_physical(model)
    check_stream_hold(physical, settings.hold)
    bare = Structure(physical, effects)
    if bare.n_parameters == 0:
        raise ModelError("every coefficient of the effects is fixed; leave at least one free")
    steps = 3 - bare.stages if substeps is None else substeps
    return EffectsSetup(physical, tuple(effects), settings, 1 if bare.is_linear else steps)


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
    """One run over the stretch about fixed coefficients, and their deviations."""

    memory: CoefficientMemory
    step: Array
    power: Array
    cost: float
    left: Array
    std: Array

    def alike(self, other: _Pass) -> bool:
        """Return whether two descents ended in the same minimum."""
        return bool(np.all(np.abs(self.memory.centre - other.memory.centre) < 3.0 * other.std))


class _Stretch:
    """First samples, to be filtered about other coefficients.

    Sizes of signals, widths of laws, priors and the initial state follow from them.
    """

    def __init__(self, setup: EffectsSetup, memory: CoefficientMemory) -> None:
        memory = _with_sizes(setup, memory)
        self.setup = setup
        self.memory = replace(memory, states=_state_sizes(setup, memory))
        self.lower, self.upper = setup.bounds_about(memory.origin)
        # noise variance from the size of the outputs, before there is a residual
        self.R = np.maximum(memory.sizes[-setup.layout.ny :] ** 2, 1e-300)

    def inside(self, theta: Array) -> Array:
        """Coefficients within their bounds."""
        return np.clip(theta, self.lower, self.upper)

    def run_about(self, theta: Array, R: Array) -> _Pass | None:
        """Run over the stretch about `theta`; None where that leaves all bounds."""
        setup, memory, lay = self.setup, self.memory, self.setup.layout
        about = setup.about(memory, theta)
        parts = lay.parts(about.packed)
        # delta: the mean of the prior relative to theta
        parts.delta[:] = memory.origin - theta
        kernel = setup.compile(about)
        if not np.isfinite(kernel.fixed[4 * lay.p :]).all():
            return None
        # the noise is the same in all passes that are compared
        fixed = kernel.fixed.copy()
        fixed[floor_at(lay)] = np.maximum(kernel.floor, R)
        course = lay.record(len(memory.inputs))
        done, _ = replace(kernel, fixed=fixed).over(
            about.packed, about.counters, memory.first, course, frozen=True
        )
        if done < len(memory.inputs) or not np.isfinite(about.packed).all():
            return None
        cost, count = parts.cost
        power = np.where(count > 0, cost / np.maximum(count, 1.0), R)
        # minus twice the log-likelihood, noise variances concentrated out, plus the prior
        total = float(np.sum(count * np.log(np.maximum(power, kernel.floor) + 1e-300)))
        away = (theta - memory.origin) / memory.spread
        about = replace(about, discretized=memory.discretized + 1, kernel=kernel)
        left = np.where(memory.use, memory.outputs - course.predicted, np.nan)
        std = np.sqrt(np.diag(parts.Pt))
        return _Pass(about, parts.delta.copy(), power, total + float(away @ away), left, std)

    def descend(self, start: Array, passes: int) -> _Pass | None:
        """Gauss-Newton with a damped step, inside the bounds."""
        # noise variance first from the size of the outputs, then from the residual of the first pass
        best = self.run_about(self.inside(start), self.R)
        if best is None:
            return None
        best = self.run_about(best.memory.centre, best.power) or best
        damping = 1.0
        for _ in range(passes):
            trial = self.run_about(self.inside(best.memory.centre + damping * best.step), best.power)
            if trial is None or trial.cost >= best.cost:
                # no descent: shorten the step, or stop where it is small against the deviations
                if damping < 0.02 or np.all(np.abs(damping * best.step) < 1e-2 * best.std):
                    break
                damping *= 0.3
                continue
            gained = best.cost - trial.cost
            best, damping = trial, min(1.0, 2.0 * damping)
            if gained < 1e-3:
                break
        return best

    def best_starts(self, starts: list[Array]) -> list[Array]:
        """The few of many starts that are best one step further."""
        found: list[tuple[float, int, Array]] = []
        for i, start in enumerate(starts):
            # cost at the start and one Gauss-Newton step further
            trial = self.run_about(self.inside(start), self.R)
            if trial is None:
                continue
            further = self.run_about(self.inside(trial.memory.centre + trial.step), trial.power)
            if further is None or further.cost >= trial.cost:
                further = trial
            found.append((further.cost, i, further.memory.centre))
        return [point for _, _, point in sorted(found, key=lambda entry: entry[:2])[:_RIVALS]]

    def last_step(self, best: _Pass) -> CoefficientMemory:
        """Memory after the best pass, its last step taken."""
        found, parts = best.memory, self.setup.layout.parts(best.memory.packed)
        # take the last step where the linearization holds: within three standard deviations
        step = self.inside(parts.theta + best.step) - parts.theta
        if np.all(np.abs(step) < 3.0 * best.std + 1e-300):
            parts.theta += step
            parts.x += step @ parts.S
        parts.delta[:] = 0.0
        # noise level and count go on from the pass
        parts.level[:] = best.power
        parts.count[:] = parts.cost[1]
        found = replace(found, centre=parts.theta.copy(), rounds=self.memory.rounds + 1)
        return replace(found, kernel=self.setup.compile(found), discretized=found.discretized + 1)

    def warn_of_offsets(self, best: _Pass) -> None:
        """Warn if the first samples have a constant part that no effect takes.

        Such a constant part distorts the coefficients.

        Seen in what the best fit leaves, by the standard error of a mean of colored noise. But a fit that ran
        away turns the constant into a slow motion: where it is the larger part of what the initial model
        leaves, a fit without it must not be decisively better.
        """
        # an offset that an effect estimates needs no warning
        setup, memory, labels = self.setup, self.memory, self.setup.model.output_labels
        taken = {effect.place for effect in setup.effects if effect.spec.holds_constant}
        flat = np.array([np.inf if label in taken else _FLAT for label in labels])
        least = flat * memory.sizes[-len(labels) :]
        # mean of the residual against its standard error, for colored noise
        mean, error, _ = _means(best.left)
        suspect = np.abs(mean) > np.maximum(_FAR * error, least)
        # compare with the initial coefficients: an offset may hide in a distorted fit
        other = self.run_about(memory.origin, best.power)
        if other is not None:
            mean, _, sd = _means(other.left)
            large = ~suspect & (np.abs(mean) > np.maximum(sd, least))
            # fit again without that mean: does the likelihood say that it was an offset?
            for _ in range(2 * bool(large.any())):
                mean = np.where(large, _means(other.left)[0], 0.0)
                memory = replace(memory, outputs=memory.outputs - mean)
                other = _Stretch(setup, memory).descend(other.memory.centre, _FEW) or other
            _, error, sd = _means(other.left)
            # colored noise: fewer independent samples than samples
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
            # standard error of a mean: sqrt(S(0) / N), the spectrum at zero from the autoregressive model
            a, variance = autoregression(row)
            error = np.sqrt(variance / row.size) / max(abs(a.sum()), 1e-300)
            found[:, i] = row.mean(), error, row.std()
    return found[0], found[1], found[2]


def _with_sizes(setup: EffectsSetup, memory: CoefficientMemory) -> CoefficientMemory:
    """Sizes of signals, widths of laws and priors, from the samples so far."""
    memory = replace(memory, sizes=signal_sizes(memory))
    memory = replace(memory, widths=_widths(setup, memory))
    if memory.spread.size:
        return memory
    memory = _with_shapes(setup, memory)
    return replace(memory, spread=_prior(setup, memory))


def _with_shapes(setup: EffectsSetup, memory: CoefficientMemory) -> CoefficientMemory:
    """Memory whose first coefficients shape their laws as the motion suggests."""
    from ...inference.starts import shape_starts

    shapes = [i for i in range(setup.layout.p) if setup.is_shape(i)]
    if not shapes:
        return memory
    start = shape_starts(setup.structure(memory.widths), memory.origin.copy(), _motion(setup, memory))[0]
    # a level that goes with a shape (friction) starts with it, or the shape has no gradient
    packed = memory.packed.copy()
    setup.layout.parts(packed).theta[:] = start
    return replace(memory, origin=start, packed=packed)


def _motion(setup: EffectsSetup, memory: CoefficientMemory) -> Any:
    from ...data.measurement import Measurement
    from ...inference.starts import estimated_motion

    data = Measurement(
        memory.inputs.T, _bridge_gaps(memory).T, dt=setup.settings.dt, hold=setup.settings.hold
    )
    return estimated_motion(Structure(setup.physical), np.zeros(0), data)


def _bridge_gaps(memory: CoefficientMemory) -> Array:
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
    # prior: twice the nominal parameter; without one, from the effect on the outputs
    structure = setup.structure(memory.widths)
    spread = _LOOSE * setup.nominal
    engine = engine_on(setup, structure, memory.inputs, memory.outputs)
    run = engine.run(memory.origin, check=False)
    with np.errstate(all="ignore"):
        # rms sensitivity of all outputs to each coefficient, relative to their size
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


def _state_sizes(setup: EffectsSetup, memory: CoefficientMemory) -> Array:
    """Standard deviation of the state at the first sample."""
    structure = setup.structure(memory.widths)
    # simulate without the force laws from rest, with the sensitivity to the initial state
    engine = engine_on(setup, structure, memory.inputs, memory.outputs)
    calm = memory.origin.copy()
    if structure.port_columns.size:
        calm[structure.port_columns] = 0.0
    run = engine.run(calm, sensitivity=False, initial_state=True, histories=True, check=False)
    y_size = memory.sizes[-setup.layout.ny :]
    with np.errstate(all="ignore"):
        moving = np.sqrt(np.mean(np.nan_to_num(run.states) ** 2, axis=1))
        C = structure.matrices(calm).C
        # states from the outputs, by the pseudo-inverse of C
        read = np.abs(np.linalg.pinv(C)) @ y_size
        shown = np.sqrt(np.mean((run.sensitivity / y_size[:, None, None]) ** 2, axis=(0, 1)))
    size = np.hypot(np.where(np.isfinite(moving), moving, 0.0), read)
    # a state without a size: as large as would be seen at the outputs
    reach = np.where(np.isfinite(shown) & (shown > 0), 1.0 / np.where(shown > 0, shown, 1.0), 0.0)
    return np.where(size > 0, 3.0 * size, 3.0 * reach)


def _starts(setup: EffectsSetup, memory: CoefficientMemory) -> tuple[list[Array], list[Array]]:
    """Return the starting values of the descent: near ones and far ones.

    The near ones are the present coefficients and the alternatives in memory. Of the far ones only
    the best are used.
    """
    from ...inference.starts import shape_starts

    starts = [setup.layout.parts(memory.packed).theta.copy(), *memory.rivals]
    if memory.rounds:
        starts.append(memory.origin.copy())
    far: list[Array] = []
    if memory.rounds < _SCENARIOS:
        # damage scenarios: each nominal parameter loses 35 or 70 %
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
