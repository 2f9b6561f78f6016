"""Physical effects as coefficients: their model as arrays for the kernel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from ...arguments import as_whole
from ...effects.effect import Effect
from ...effects.formula import InputLaw, OutputLaw
from ...effects.several import as_effects
from ...engine.kernels import address_of_march
from ...engine.structure import Structure
from ...exceptions import ModelError
from ...models.conversion import as_physical
from ...models.operating_point import check_stream_hold, refuse_discrete
from ...models.physical_model import PhysicalModel
from ...systems.linear import Array, LinearModel
from .kernel import Kernel
from .memory import CoefficientMemory
from .packed import Layout
from .setup import FilterSettings, Setup, checked_settings, held_columns
from .with_laws import Laws

__all__ = ["EffectsSetup", "make_effects_setup"]

_LAG = 64  # samples that input delays look back on
_FIRST = 50  # samples of the first stretch, at least
_MARGIN = 1e-3  # of a bound that an estimate keeps off it


@dataclass(frozen=True, eq=False)
class EffectsSetup(Setup):
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
    def layout(self) -> Layout:
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

    @property
    def n_laws(self) -> int:
        """Laws that may have a width of their own."""
        return len(self.effects)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the coefficients."""
        return tuple(q.label for q in self.bare.parameters)

    @cached_property
    def milestones(self) -> tuple[int, ...]:
        """Numbers of samples at which the first ones are gone over."""
        lay, last = self.layout, self.settings.start_samples
        lengths = [min(max(_FIRST, 3 * (lay.n + lay.p) // max(1, lay.ny) + lay.n), last)]
        while lengths[-1] < last:
            lengths.append(min(2 * lengths[-1], last))
        return tuple(lengths)

    def start(self) -> Array:
        """Coefficients at which the effects are absent, or the user's."""
        return self.bare.start()

    def compile(self, memory: CoefficientMemory) -> Kernel:
        """Discretize at `memory.centre` and pack what the loop needs."""
        return compile_kernel(self, memory)

    def go_over(self, memory: CoefficientMemory) -> CoefficientMemory:
        """Return the memory after filtering again with the best coefficients.

        It is as if the best coefficients had been known from the first sample.
        """
        from .descent import go_over

        return go_over(self, memory)

    def system(self, theta: Array, widths: Array, name: str) -> LinearModel:
        """Linear part at these coefficients, in continuous time."""
        return LinearModel.from_statespace(self.structure(widths).system(theta, name))

    def rows(self, theta: Array, spread: Array) -> tuple[Any, ...]:
        """Estimated parameters, one row each."""
        from ...inference.outcome import _rows

        return _rows(self.bare, ["effect"] * len(self.effects), theta, spread)

    @property
    def model(self) -> LinearModel:
        """Linear part of the initial model."""
        return self.physical.linear

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Bounds of the coefficients, a little inside those of physics."""
        s = self.bare
        lower = np.array([q.lower for q in s.parameters])
        upper = np.array([q.upper for q in s.parameters])
        for i, q in enumerate(s.parameters):
            if s.effects[q.effect].spec.delays:
                upper[i] = min(upper[i], (_LAG - 4) * self.settings.dt)
        with np.errstate(invalid="ignore"):
            lower = np.where(np.isfinite(lower), lower + _MARGIN * np.abs(lower), lower)
            upper = np.where(np.isfinite(upper), upper - _MARGIN * np.abs(upper), upper)
        return lower, upper

    def bounds_about(self, origin: Array) -> tuple[Array, Array]:
        """Bounds of the coefficients; those that shape a law stay positive."""
        lower, upper = self.bounds
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

        It is 0 where there is no such parameter.
        """
        s = self.bare
        known = {(q.kind, q.place): abs(q.value) for q in s.model.parameters}
        found = []
        for q in s.parameters:
            effect = s.effects[q.effect]
            size = known.get((effect.kind, effect.place), 0.0)
            if effect.spec.inertial:
                size = s.inertia(effect.place)
            if effect.spec.relative:
                size = 1.0
            found.append(size if np.isfinite(size) else 0.0)
        return np.array(found)

    def structure(self, widths: Array) -> Structure:
        """Model with its effects and the widths of their laws."""
        return _structure(self, tuple(widths.tolist()))


@lru_cache(maxsize=64)
def _structure(setup: EffectsSetup, widths: tuple[float, ...]) -> Structure:
    constants = {i: width for i, width in enumerate(widths) if np.isfinite(width)}
    return Structure(setup.physical, setup.effects, constants=constants)


def compile_kernel(setup: EffectsSetup, memory: CoefficientMemory) -> Kernel:
    """Discretize at `memory.centre` and pack what the loop needs."""
    lay, s = setup.layout, setup.structure(memory.widths)
    dt, hold = setup.settings.dt, setup.settings.hold
    step = dt / setup.substeps
    disc = s.discretize(memory.centre, step)
    n, nu = lay.n, lay.nu
    forces = _forces(setup, tuple(memory.sizes.tolist()))
    head, floor = setup.head(memory, setup.bounds_about(memory.origin), *forces)
    q = disc.linear.size
    sizes = np.array([n, lay.p, nu, lay.ny, q, lay.lag, lay.m, lay.kept], dtype=np.int64)
    if setup.fast:
        M, dM = held_columns(disc.M[None], n, nu, hold)[0], held_columns(disc.dM, n, nu, hold)
        fixed = np.concatenate([*head, M.ravel(), disc.O.ravel(), dM.ravel(), disc.dO.ravel(), disc.linear])
        return Kernel(sizes, fixed, None, floor)
    pieces = 16 if s.jumps else 1
    fine = s.discretize(memory.centre, step / pieces) if pieces > 1 else disc
    codes, values, columns, widths = s.laws(memory.centre)
    outcodes, outvalues, outcolumns = s.output_laws(memory.centre)
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
        address_of_march(), np.stack([disc.M, fine.M]), np.stack([disc.dM, fine.dM]), pieces, disc.linear,
        disc.O, disc.dO, disc.P, disc.dP, codes, values, columns, widths,
        statics, levels, outcodes, outvalues, outcolumns, setup.substeps, hold == "foh", dt,
    )  # fmt: skip
    return Kernel(sizes, np.concatenate(head), laws, floor)


@lru_cache(maxsize=64)
def _forces(setup: EffectsSetup, sizes: tuple[float, ...]) -> tuple[Array, Array]:
    """Return how unknown forces and missing inputs move the state per sample."""
    s, n, n_w = setup.bare, setup.layout.n, setup.layout.nu - 1
    level = np.array([size if size > 0 else 1.0 for size in sizes[:n_w]])
    lower, upper = setup.bounds
    calm = np.clip(np.where([setup.is_shape(i) for i in range(setup.layout.p)], 1.0, 0.0), lower, upper)
    m = s.matrices(calm)
    inputs = m.B[:, :n_w] * level * setup.settings.dt
    top = max((float(np.linalg.norm(column)) for column in inputs.T), default=0.0) or setup.settings.dt
    acts = []
    for port in s.model.ports:
        size = float(np.linalg.norm(port.act))
        if size > 0:
            acts.append(np.concatenate([port.act, np.zeros(n - port.act.size)]) * (top / size))
    return np.column_stack([inputs, *acts]) * setup.settings.disturbance, inputs


def make_effects_setup(
    model: Any,
    effects: Sequence[Effect],
    dt: float,
    *,
    hold: str = "zoh",
    noise: Any = None,
    disturbance: float | None = None,
    forgetting: float = 1.0,
    substeps: int | None = None,
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
    check_stream_hold(physical, hold)
    settings = checked_settings(physical.linear.n_outputs, dt, hold, noise, disturbance, forgetting)
    bare = Structure(physical, effects)
    if bare.n_parameters == 0:
        raise ModelError("every coefficient of the effects is fixed; leave at least one free")
    steps = 4 if substeps is None else as_whole(substeps, "substeps", least=1, error=ModelError)
    return EffectsSetup(physical, tuple(effects), settings, 1 if bare.is_linear else steps)
