"""What the physical stage knows before the first sample, and its model as arrays for the kernel."""

from __future__ import annotations

import types
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..exceptions import ModelError
from ..physics.consistency import check_stream_hold
from ..physics.effects import Effect
from ..physics.engine import Engine, _kernel
from ..physics.physical_model import PhysicalModel, as_physical
from ..physics.structure import Structure
from ..systems.discretization import check_sampling_time
from ..systems.linear import Array, LinearModel
from . import effects_kernel
from .effects_memory import EffectsMemory, Layout

__all__ = ["EffectsSetup", "Kernel", "make_effects_setup"]

SHARE = 1.0  # of its standard deviation that a coefficient may move before the model is discretized anew
_LAG = 64  # samples that input delays look back on
_CHANGING = 0.03  # unknown force over the input where coefficients may change
_MARGIN = 1e-3  # of a bound that an estimate keeps off it
_STATIC_CODES = {
    "input_deadzone": (0, "threshold"),
    "input_saturation": (1, "limit"),
    "input_delay": (2, "delay"),
}


@dataclass(frozen=True, eq=False)
class EffectsSetup:
    """Settings of the physical stage.

    Parameters
    ----------
    physical : PhysicalModel
        Initial model.
    effects : tuple of Effect
        What is estimated.
    dt : float
        Sampling time in s.
    hold : {"zoh", "foh"}
        The input between samples.
    noise : ndarray of shape (n_y,)
        Declared sensor noise, zero where it is estimated.
    disturbance : float
        Unknown force over the measured input, rms.
    forgetting : float
        Share of the information along the excited direction that a sample keeps.
    substeps : int
        Substeps per sample.
    start_samples : int
        Samples that are gone over again while the model improves.
    """

    physical: PhysicalModel
    effects: tuple[Effect, ...]
    dt: float
    hold: str
    noise: Array
    disturbance: float
    forgetting: float
    substeps: int
    start_samples: int

    @cached_property
    def bare(self) -> Structure:
        """Model with its effects, laws of unit width."""
        return Structure(self.physical, self.effects)

    @cached_property
    def layout(self) -> Layout:
        """Sizes of the packed memory."""
        s = self.bare
        delays = any(effect.kind == "input_delay" for effect in self.effects)
        lag = 0 if self.fast else (_LAG if delays else 3)
        return Layout(s.n_states, s.n_parameters, s.n_inputs + 1, s.n_outputs, s.n_ports, lag)

    @cached_property
    def fast(self) -> bool:
        """Whether all effects are absorbed into the matrices."""
        return self.bare.is_linear

    @property
    def loose(self) -> bool:
        """Whether the state never becomes certain: unknown forces act, or coefficients may change."""
        return self.disturbance > 0 or self.forgetting < 1

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
            if s.effects[q.effect].kind == "input_delay":
                upper[i] = min(upper[i], (_LAG - 4) * self.dt)
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
        """Whether a coefficient has no value at which its effect is absent, so that data tell a start."""
        q = self.bare.parameters[column]
        effect = self.effects[q.effect]
        return effect.kind != "custom" and effect.start_of(q.name) is None

    @cached_property
    def nominal(self) -> Array:
        """Size of the physical parameter that each coefficient changes, 0 where there is none."""
        s = self.bare
        known = {(q.kind, q.place): abs(q.value) for q in s.model.parameters}
        found = []
        for q in s.parameters:
            effect = s.effects[q.effect]
            size = known.get((effect.kind, effect.place), 0.0)
            if effect.kind == "mass":
                size = s.inertia(effect.place)
            if effect.kind in ("input_gain", "output_gain"):
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


@dataclass(frozen=True, slots=True, eq=False)
class Kernel:
    """A discretized model, ready for the loop over samples."""

    run: Callable[..., tuple[int, int]]
    sizes: NDArray[np.int64]
    fixed: Array
    rest: tuple[Any, ...]
    floor: Array


def compile_kernel(setup: EffectsSetup, memory: EffectsMemory) -> Kernel:
    """Discretize at `memory.centre` and pack what the loop needs."""
    lay, s = setup.layout, setup.structure(memory.widths)
    step = setup.dt / setup.substeps
    disc = s.discretize(memory.centre, step)
    n, nu = lay.n, lay.nu
    lower, upper = setup.bounds_about(memory.origin)
    y_size = memory.sizes[nu - 1 :]
    floor = np.maximum(setup.noise**2, 1e-16 * y_size**2)
    scale = np.where(memory.spread > 0, memory.spread, 1.0) if memory.spread.size else np.ones(lay.p)
    limit = 1e12 * (1.0 + float(memory.sizes.max(initial=0.0)))
    q_known, q_unknown = _disturbances(setup, tuple(memory.sizes.tolist()))
    head = [memory.centre, lower, upper, 1e-6 * scale, floor]
    head += [np.array([SHARE, setup.forgetting, limit]), q_known.ravel(), q_unknown.ravel()]
    q = disc.linear.size
    sizes = np.array([n, lay.p, nu, lay.ny, q, lay.lag], dtype=np.int64)
    if setup.fast:
        M, dM = _held(disc.M[None], n, nu, setup.hold)[0], _held(disc.dM, n, nu, setup.hold)
        fixed = np.concatenate([*head, M.ravel(), disc.O.ravel(), dM.ravel(), disc.dO.ravel(), disc.linear])
        return Kernel(effects_kernel.advance, sizes, fixed, (), floor)
    pieces = 16 if s.jumps else 1
    fine = s.discretize(memory.centre, step / pieces) if pieces > 1 else disc
    codes, values, columns, widths = s.laws(memory.centre)
    outcodes, outvalues = np.zeros(lay.ny, dtype=np.int64), np.zeros(lay.ny)
    outcolumns = np.full(lay.ny, -1, dtype=np.int64)
    for index, channel, code in s.output_statics:
        name = "limit" if code == 1 else "fraction"
        outcodes[channel], outvalues[channel] = code, s.value(memory.centre, index, name)
        outcolumns[channel] = s.position(index, name)
    statics, levels = [], []
    for index, channel in s.input_statics:
        code, name = _STATIC_CODES[s.effects[index].kind]
        statics.append((code, channel, s.position(index, name)))
        levels.append(float(s.value(memory.centre, index, name)))
    rest = (
        np.stack([disc.M, fine.M]), np.stack([disc.dM, fine.dM]), pieces, disc.linear, disc.O, disc.dO,
        disc.P, disc.dP, codes, values, columns, widths,
        np.array(statics, dtype=np.int64).reshape(-1, 3), np.array(levels, dtype=float),
        outcodes, outvalues, outcolumns, setup.substeps, setup.hold == "foh", setup.dt,
    )  # fmt: skip
    return Kernel(_general(s), sizes, np.concatenate(head), rest, floor)


def floor_at(kernel: Kernel, lay: Layout) -> slice:
    """Where the noise floor stands among the packed numbers."""
    return slice(4 * lay.p, 4 * lay.p + lay.ny)


def _held(M: Array, n: int, nu: int, hold: str) -> Array:
    """Columns of the linear part; an input that is held acts with its value at the start."""
    M = np.ascontiguousarray(M[:, :, : n + 2 * nu])
    if hold == "zoh":
        M[:, :, n : n + nu] += M[:, :, n + nu :]
        M[:, :, n + nu :] = 0.0
    return M


@lru_cache(maxsize=64)
def _disturbances(setup: EffectsSetup, sizes: tuple[float, ...]) -> tuple[Array, Array]:
    """Covariance per sample of unknown forces, and of an input that was not measured."""
    s, n, n_w = setup.bare, setup.layout.n, setup.layout.nu - 1
    level = np.array([size if size > 0 else 1.0 for size in sizes[:n_w]])
    lower, upper = setup.bounds
    calm = np.clip(np.where([setup.is_shape(i) for i in range(setup.layout.p)], 1.0, 0.0), lower, upper)
    m = s.matrices(calm)
    inputs = m.B[:, :n_w] * level * setup.dt
    top = max((float(np.linalg.norm(column)) for column in inputs.T), default=0.0) or setup.dt
    acts = []
    for port in s.model.ports:
        size = float(np.linalg.norm(port.act))
        if size > 0:
            acts.append(np.concatenate([port.act, np.zeros(n - port.act.size)]) * (top / size))
    everywhere = np.column_stack([inputs, *acts]) * setup.disturbance
    return everywhere @ everywhere.T, inputs @ inputs.T


def _general(structure: Structure) -> Callable[..., tuple[int, int]]:
    """The loop for any effects, bound to the user's own laws where there are any."""
    if not structure.custom_laws:
        return effects_kernel.advance_general
    source = {name: getattr(value, "py_func", value) for name, value in vars(effects_kernel).items()}
    source["march"] = _kernel(structure)
    bound: dict[str, Any] = dict(source)
    for name, value in source.items():
        if isinstance(value, types.FunctionType) and value.__module__ == effects_kernel.__name__:
            bound[name] = types.FunctionType(value.__code__, bound)
    run: Callable[..., tuple[int, int]] = bound["advance_general"]
    return run


def make_effects_setup(
    model: Any,
    effects: Sequence[Effect],
    dt: float | None,
    *,
    hold: str = "zoh",
    noise: Any = None,
    disturbance: float | None = None,
    forgetting: float = 1.0,
    substeps: int | None = None,
    start_samples: int = 2048,
) -> EffectsSetup:
    """Check what `RCORefiner` was given for the physical stage."""
    if isinstance(effects, Effect):
        effects = [effects]
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ct.ControlArgument(f"effects must hold Effect objects, not {type(effect).__name__}")
        if effect.kind == "output_delay":
            raise ModelError(
                f"{effect.label}: a delay at an output needs the future and cannot be estimated on a stream; "
                "use an input_delay, an output_lag, or refine() on a record"
            )
    if not effects:
        raise ModelError("effects is empty: name at least one Effect, or leave effects out")
    seen: set[tuple[str, str]] = set()
    for effect in effects:
        if (effect.kind, effect.place) in seen:
            raise ModelError(f"{effect.label} is named twice; give each effect once")
        seen.add((effect.kind, effect.place))
    given = getattr(model, "system", model)
    if isinstance(given, ct.StateSpace) and given.dt != 0:
        raise ModelError(
            f"model {given.name!r} is discrete, and physical effects live in continuous time; "
            "give the continuous model, or convert it with rcorefine.d2c"
        )
    physical = as_physical(model)
    if dt is None:
        raise ModelError(
            f"model {physical.linear.name!r} is continuous: give dt, the sampling time in seconds"
        )
    if hold not in ("zoh", "foh"):
        raise ct.ControlArgument(
            f"hold must be 'zoh' or 'foh' on a stream, not {hold!r}; a band-limited input needs the future: "
            "use refine() on the record"
        )
    check_stream_hold(physical, hold)
    ny = physical.linear.n_outputs
    levels = np.zeros(ny)
    if noise is not None:
        levels = np.array(np.broadcast_to(np.asarray(noise, dtype=float), (ny,)))
        if not (np.isfinite(levels).all() and (levels > 0).all()):
            raise ct.ControlArgument(
                f"noise must be positive standard deviations, one per output, not {noise!r}"
            )
    if disturbance is None:
        # a state that is certain cannot follow a model that changes
        disturbance = 0.0 if forgetting == 1.0 else _CHANGING
    if not (np.isfinite(disturbance) and disturbance >= 0):
        raise ModelError(f"disturbance must be a finite number >= 0, not {disturbance!r}")
    if not 0.5 <= forgetting <= 1.0:
        raise ModelError(f"forgetting must lie in [0.5, 1] (1 forgets nothing), not {forgetting!r}")
    bare = Structure(physical, effects)
    if bare.n_parameters == 0:
        raise ModelError("every coefficient of the effects is fixed; leave at least one free")
    steps = 4 if substeps is None else int(substeps)
    if steps < 1:
        raise ModelError(f"substeps must be at least 1, not {substeps}")
    return EffectsSetup(
        physical=physical,
        effects=tuple(effects),
        dt=check_sampling_time(dt),
        hold=hold,
        noise=levels,
        disturbance=float(disturbance),
        forgetting=float(forgetting),
        substeps=1 if bare.is_linear else steps,
        start_samples=int(start_samples),
    )


def engine_on(setup: EffectsSetup, structure: Structure, inputs: Array, outputs: Array) -> Engine:
    """Engine of the structure on some samples of shape (N, n_w), (N, n_y)."""
    from ..measurement import Measurement

    data = Measurement(inputs.T, np.nan_to_num(outputs.T), dt=setup.dt, hold=setup.hold)
    return Engine(structure, data, substeps=setup.substeps)
