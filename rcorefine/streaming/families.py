"""Models with coefficients: physical effects, or entries of matrices."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import control as ct
import numpy as np

from ..arguments import as_noise, as_number, as_text
from ..data.measurement import Measurement, block_of_stream
from ..effects.bodies import Entry
from ..effects.channels import OutputOffset
from ..effects.effect import Effect, as_effects
from ..effects.formula import InputLaw, OutputLaw
from ..engine.engine import Engine
from ..engine.linear import Substep, state_power
from ..engine.structure import Parameter, Structure
from ..exceptions import (
    ConversionWarning,
    IdentifiabilityWarning,
    ModelError,
    RCOError,
    RCOWarning,
    unheard,
    warn,
)
from ..inference.covariance import standard_deviations
from ..inference.parameters import EstimatedParameter, estimated, nominal_size, parameter_table
from ..inference.starts import estimated_motion, law_widths
from ..inference.whitening import autoregression
from ..models.conversion import as_physical
from ..models.operating_point import check_stream_hold, refuse_discrete
from ..models.physical_model import PhysicalModel
from ..systems.conversion import growth, nearest_continuous, to_discrete
from ..systems.discretization import exponential
from ..systems.linear import Array, LinearModel
from .samples import Block

MILESTONES = (32, 64, 128, 256, 512, 1024, 2048)  # samples since the start at which all of them are fitted
BLOCK = 64  # samples of a block
_CHANGING = 0.03  # unknown force over the input where coefficients may change
_LAG = 64  # samples that input delays look back on
_MARGIN = 1e-3  # share of a bound that an estimate keeps off it
_LOOSE = 2.0  # prior standard deviation over the nominal value
_WIDE = 30.0  # ... over the size whose effect on the outputs is that of the signals
_FAR, _FLAT = (
    6.0,
    1e-3,
)  # standard errors of a mean that is no chance; share of an output that distorts nothing


@dataclass(frozen=True, slots=True, eq=False)
class FilterSettings:
    """Settings that every filter has.

    Parameters
    ----------
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
    """

    dt: float
    hold: str
    noise: Array
    disturbance: float
    forgetting: float

    @property
    def block(self) -> int:
        """Samples of a block: an eighth of the memory, a power of two."""
        memory = 1.0 / max(1.0 - self.forgetting, 1e-9)
        return 1 << int(np.log2(min(max(memory / 8, 1), BLOCK)))


def checked_settings(
    n_outputs: int, dt: float, hold: str, noise: Any, disturbance: float | None, forgetting: float
) -> FilterSettings:
    """Settings of a filter, checked."""
    if as_text(hold, "hold") not in ("zoh", "foh"):
        raise ct.ControlArgument(
            f"hold must be 'zoh' or 'foh' on a stream, not {hold!r}; a band-limited input needs the future: "
            "use refine() on the record"
        )
    declared = as_noise(noise, n_outputs)
    forgetting = as_number(
        forgetting, "forgetting (1 forgets nothing)", least=0.5, most=1.0, error=ModelError
    )
    if disturbance is None:
        # a state that is certain cannot follow a model that changes
        disturbance = 0.0 if forgetting == 1.0 else _CHANGING
    disturbance = as_number(disturbance, "disturbance", least=0.0, error=ModelError)
    levels = np.zeros(n_outputs) if declared is None else declared.copy()
    return FilterSettings(dt, hold, levels, disturbance, forgetting)


class Prior(NamedTuple):
    """Prior knowledge of the coefficients, and a start of the search."""

    theta: Array  #: (p,), mean of the coefficients
    root: Array  #: (p, q), square root of their covariance; what it does not span is held
    spread: Array  #: (p,), standard deviations, those of held directions included
    start: Array  #: (p,), coefficients to begin the search with


class Family(ABC):
    """A model that depends on coefficients theta.

    Attributes
    ----------
    model : LinearModel
        Initial model, as it was given.
    physical : PhysicalModel
        Its continuous form.
    settings : FilterSettings
        Sampling, noise, memory.
    labels : tuple of str
        Names of the coefficients.
    bounds : tuple of ndarray
        Their lower and upper bounds.
    least : int
        Samples that the first fit needs.
    substeps : int
        Substeps per sample.
    lag : int
        Samples that delays and laws at the inputs look back on.
    """

    model: LinearModel
    physical: PhysicalModel
    settings: FilterSettings
    labels: tuple[str, ...]
    bounds: tuple[Array, Array]
    least: int
    substeps: int
    lag = 0
    one_to_one = False  #: whether directions that no sample determines are held
    remembers = False  #: whether laws have a memory, so that no block begins within another
    translates = False  #: whether coefficients are of another time domain than the model that was given

    @abstractmethod
    def structure(self, widths: Array) -> Structure:
        """Model for the engine, with these widths of laws."""

    @abstractmethod
    def start(self) -> Array:
        """Coefficients of the initial model."""

    @abstractmethod
    def prior(self, first: Block, theta: Array | None) -> tuple[Prior, Array]:
        """Return the prior for the first samples, and widths of laws.

        `theta` are the present coefficients, None before the first fit.
        """

    @abstractmethod
    def system(self, theta: Array, name: str) -> LinearModel:
        """Model at these coefficients, in the timebase that it is estimated in."""

    @abstractmethod
    def rows(self, theta: Array, spread: Array) -> tuple[Any, ...]:
        """Estimated parameters, one row each."""

    def translated(self, theta: Array, covariance: Array) -> tuple[Array, Array]:
        """Return coefficients and covariance in the given time domain."""
        return theta, covariance

    def check(self, first: Block, left: Array) -> None:  # noqa: B027
        """Warn of what the residual (N, n_y) of the first samples shows."""


class Effects(Family):
    """Physical effects as coefficients.

    Parameters
    ----------
    model : StateSpace or PhysicalModel
        Initial model.
    effects : sequence of Effect
        What is estimated.
    settings : FilterSettings
        Sampling, noise, memory.
    substeps : int or None
        Substeps per sample.
    """

    def __init__(
        self, model: Any, effects: Sequence[Effect], settings: FilterSettings, substeps: int | None
    ) -> None:
        effects = _checked_effects(effects)
        refuse_discrete(model)
        physical = as_physical(model)
        check_stream_hold(physical, settings.hold)
        self.physical, self.model, self.effects, self.settings = physical, physical.linear, effects, settings
        bare = self.bare = Structure(physical, effects)
        if bare.n_parameters == 0:
            raise ModelError("every coefficient of the effects is fixed; leave at least one free")
        steps = 3 - bare.stages if substeps is None else substeps
        self.substeps = 1 if bare.is_linear else steps
        self.labels = tuple(q.label for q in bare.parameters)
        self.lag = _LAG if bare.input_statics else 0
        inner = [bare.effects[i].spec.inner_states for i in (*bare.port_effects, *dict(bare.input_statics))]
        self.remembers = bare.remembers or any(inner)
        self.least = 3 * (bare.n_states + bare.n_parameters) // max(1, bare.n_outputs) + bare.n_states

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

    def start(self) -> Array:
        """Coefficients at which the effects are absent, or the user's."""
        return np.clip(self.bare.start(), *self.bounds)

    def structure(self, widths: Array) -> Structure:
        """Model with its effects and the widths of their laws."""
        return _structure(self, tuple(widths.tolist()))

    def prior(self, first: Block, theta: Array | None) -> tuple[Prior, Array]:
        """Prior: declared, of nominal values, or of what moves the outputs."""
        from ..refinement.refine import refine

        data = _bridged(first, self.settings)
        widths = np.zeros(0)
        if any(effect.spec.width_share is not None for effect in self.effects):
            found = law_widths(self.bare, estimated_motion(Structure(self.physical), np.zeros(0), data))
            widths = np.array([found.get(i, np.nan) for i in range(len(self.effects))])
        start, origin = self.start() if theta is None else theta, self.start()
        # the starts that `refine` tries; a stretch that tells nothing leaves the start
        if theta is None or len(first.inputs) == 256:
            try:
                with unheard(RCOWarning):
                    start = refine(self.physical, data, self.effects, offset=False).theta
            except RCOError:
                pass
        start = np.clip(start, *self.bounds)
        structure = self.structure(widths)
        shaped = [structure.effects[q.effect].start_of(q.name) is None for q in structure.parameters]
        origin = np.where(shaped, start, origin)
        # rms sensitivity of all outputs to each coefficient, over their size
        size = np.sqrt(np.mean(data.outputs**2, axis=1))
        run = Engine(structure, data, substeps=self.substeps).run(start, check=False)
        weighed = run.sensitivity / np.where(size > 0, size, 1.0)[:, None, None]
        trace = np.sqrt(np.mean(np.minimum(np.abs(np.nan_to_num(weighed)), 1e100) ** 2, axis=(0, 1)))
        spread = np.zeros(start.size)
        for i, q in enumerate(structure.parameters):
            effect = structure.effects[q.effect]
            nominal = _LOOSE * np.nan_to_num(nominal_size(structure, effect), posinf=0.0)
            by_outputs = _WIDE / trace[i] if trace[i] > 0 else max(10.0 * abs(origin[i]), 1.0)
            if q.name in effect.prior:
                spread[i] = effect.prior[q.name]
            elif shaped[i] and origin[i] != 0:
                spread[i] = _WIDE * abs(origin[i])
            else:
                spread[i] = max(nominal, 2 * abs(start[i])) if nominal else by_outputs
        return Prior(origin, np.diag(spread), spread, start), widths

    def system(self, theta: Array, name: str) -> LinearModel:
        """Linear part at these coefficients, in continuous time."""
        return LinearModel.from_statespace(self.bare.system(theta, name))

    def rows(self, theta: Array, spread: Array) -> tuple[Any, ...]:
        """Estimated parameters, one row each."""
        return estimated(parameter_table(self.bare, ["effect"] * len(self.effects)), theta, spread)

    def check(self, first: Block, left: Array) -> None:
        """Warn if the first samples have a constant part that no effect takes.

        Seen in the mean of the residual, or, where the fit turned it into a slow motion, in that of the
        initial model; then a fit beside an offset must be decisively better.
        """
        from ..comparison.compare import compare
        from ..refinement.refine import refine

        data, labels = _bridged(first, self.settings), self.model.output_labels
        taken = [effect.place for effect in self.effects if effect.spec.holds_constant]
        size = np.where(np.isin(labels, taken), np.inf, np.sqrt(np.mean(data.outputs**2, axis=1)))
        mean, error, _ = _means(left.T)
        suspect = np.abs(mean) > np.maximum(_FAR * error, _FLAT * size)
        with unheard(RCOWarning):
            mean, _, spread = _means(compare(self.physical, data).residual)
            large = ~suspect & (np.abs(mean) > np.maximum(spread, _FLAT * size))
            if large.any():
                offsets = [Effect(OutputOffset.name, labels[i]) for i in np.flatnonzero(large)]
                beside = compare(
                    refine(self.physical, data, [*self.effects, *offsets], offset=False), data
                ).residual
                _, error, spread = _means(beside)
                gain = len(left) * np.log(
                    np.nanmean(left.T**2, axis=1) / np.maximum(np.mean(beside**2, axis=1), 1e-300)
                )
                # colored noise: fewer independent samples than samples
                wide = np.maximum(1.0, len(left) * (error / np.maximum(spread, 1e-300)) ** 2)
                suspect |= large & (gain > _FAR**2 * wide)
        for i in np.flatnonzero(suspect):
            warn(
                f"output {labels[i]!r}: the first samples have an offset that is not in the model and "
                "distorts the coefficients; estimate it together with them: "
                f"rco.Effect({OutputOffset.name!r}, {labels[i]!r})",
                IdentifiabilityWarning,
            )


def _means(left: Array) -> tuple[Array, Array, Array]:
    """Mean of each row, its standard error, and the deviation.

    The standard error is that in colored noise.
    """
    found = []
    for row in left:
        row = row[np.isfinite(row)]
        # standard error of a mean: sqrt(S(0) / N), the spectrum at zero from the autoregressive model
        a, variance = autoregression(row)
        found.append((row.mean(), np.sqrt(variance / row.size) / max(abs(a.sum()), 1e-300), row.std()))
    mean, error, spread = np.array(found).T
    return mean, error, spread


@lru_cache(maxsize=64)
def _structure(family: Effects, widths: tuple[float, ...]) -> Structure:
    constants = {index: width for index, width in enumerate(widths) if np.isfinite(width)}
    return Structure(family.physical, family.effects, constants=constants)


def _checked_effects(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Refuse what no stream can estimate."""
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
    return tuple(effects)


def _bridged(first: Block, settings: FilterSettings) -> Measurement:
    """Samples as a record, gaps bridged by straight lines.

    It serves for starts and sizes only.
    """
    outputs, grid = first.outputs.copy(), np.arange(len(first.outputs))
    for i in range(outputs.shape[1]):
        there = first.use[:, i] > 0
        outputs[:, i] = np.interp(grid, grid[there], outputs[there, i]) if there.any() else 0.0
    return block_of_stream(first.inputs.T, outputs.T, settings.dt, settings.hold)


# -- entries ---------------------------------------------------------------------------------------


_ENTRY = re.compile(r"\s*([ABCD])\s*\[\s*(\d+)\s*,\s*(\d+)\s*\]\s*")
_TINY = 1e-30  # complex step
_SMALL = 1e-4  # of a standard deviation, for derivatives of the continuous entries
_RATE = 0.1  # of what moves a row that an entry which is zero may do, one standard deviation
_UNSEEN = 1e-7  # of the largest change of the response: a direction that changes it less changes nothing


class Entries(Family):
    """Linear model [A B; C D] plus patterns times coefficients.

    Parameters
    ----------
    initial : LinearModel
        Initial model, as it was given.
    base : LinearModel
        The model whose entries change: the initial one, or the same discretized.
    names : sequence of str
        Entries, such as "A[1,0]".
    settings : FilterSettings
        Sampling, noise, memory.
    rate : float
        Prior standard deviation of a coefficient over what would move its row as much as all else does.
    one_to_one : bool
        Hold the coefficients along directions that change no response of the initial model.
    """

    substeps = 1

    def __init__(
        self, initial: LinearModel, base: LinearModel, names: Sequence[str], settings: FilterSettings,
        rate: float, one_to_one: bool = False,
    ) -> None:  # fmt: skip
        self.model, self.base, self.settings, self._rate = initial, base, settings, rate
        self.labels, n, self.one_to_one = tuple(names), base.n_states, one_to_one
        self._places = [_place(name, n) for name in names]
        self.patterns = np.zeros((len(names), n + base.n_outputs, n + base.n_inputs))
        for a, (i, j) in enumerate(self._places):
            self.patterns[a, i, j] = 1.0
        self._whole = _stacked(base)
        self.value = np.array([_stacked(initial)[place] for place in self._places], dtype=float)
        self.bounds = np.full(len(names), -np.inf), np.full(len(names), np.inf)
        self.least = MILESTONES[0]
        # no place but the entries; the continuous form serves an observer
        with unheard(ConversionWarning):
            timed = initial if initial.is_continuous else initial.with_arrays(dt=settings.dt)
            linear = timed if timed.is_continuous else nearest_continuous(timed)
        none = np.zeros((linear.n_outputs, linear.n_states))
        self.physical = PhysicalModel(linear, linear.C, none, linear.D, ())
        self._structure = _Matrices(self)

    def start(self) -> Array:
        """Zero, the initial model."""
        return np.zeros(len(self.labels))

    def structure(self, widths: Array) -> Structure:
        """Model for the engine; it has no laws."""
        return self._structure

    def stacked(self, theta: Array) -> Array:
        """[A B; C D] at these coefficients."""
        return self._whole + np.tensordot(theta, self.patterns, axes=1)

    def system(self, theta: Array, name: str) -> LinearModel:
        """Model at these coefficients, in the timebase that it is estimated in."""
        n, whole = self.base.n_states, self.stacked(theta)
        return self.base.with_arrays(
            A=whole[:n, :n], B=whole[:n, n:], C=whole[n:, :n], D=whole[n:, n:], name=name
        )

    @property
    def translates(self) -> bool:  # type: ignore[override]
        """True where discrete entries stand for a continuous model."""
        return self.model.is_continuous and not self.base.is_continuous

    def translated(self, theta: Array, covariance: Array) -> tuple[Array, Array]:
        """Return coefficients and covariance in the time domain of the model.

        What is not learned stays as it is.
        """
        if not (self.translates and np.isfinite(covariance).all()):
            return theta, covariance
        steps = np.diag(_SMALL * standard_deviations(covariance))
        with unheard(ConversionWarning):
            found, *moved = (self._continuous(theta + step) for step in (0.0 * theta, *steps))
        sizes = np.where(np.diag(steps) > 0, np.diag(steps), 1.0)
        slope = (np.array(moved) - found).T / sizes
        return found - self.value, slope @ covariance @ slope.T

    def _continuous(self, theta: Array) -> Array:
        near = _stacked(nearest_continuous(self.system(theta, "")))
        return np.array([near[place] for place in self._places])

    def rows(self, theta: Array, spread: Array) -> tuple[Any, ...]:
        """Estimated parameters, one row each."""
        return tuple(
            EstimatedParameter(
                name=name, kind=Entry.name, place=name, initial=float(value), value=float(value + change),
                coefficient=float(change), std=float(std), unit="", role=Entry.name,
            )
            for name, value, change, std in zip(self.labels, self.value, theta, spread, strict=True)
        )  # fmt: skip

    def discretized(self, theta: Array) -> tuple[Array, Array]:
        """Return the state equation over one sample, and its derivatives.

        Behind the state stand the inputs before and after the sample.
        """
        base, dt = self.base, self.settings.dt
        n, nw = base.n_states, base.n_inputs
        whole = self.stacked(theta)[:n]
        if not base.is_continuous:  # the patterns are the derivatives
            late = (0, 0), (0, nw)
            return np.pad(whole, late), np.pad(self.patterns[:, :n], ((0, 0), *late))
        # exponential of [A B 0; 0 0 I; 0 0 0] dt: transition, response to a step and to a ramp (Van Loan)
        blocks = np.zeros((1 + len(theta), n + 2 * nw, n + 2 * nw), complex)
        blocks[:, :n, : n + nw] = whole
        blocks[1:, :n, : n + nw] += 1j * _TINY * self.patterns[:, :n]
        blocks *= dt
        blocks[:, n : n + nw, n + nw :] = np.eye(nw)
        with np.errstate(over="ignore", invalid="ignore"):  # the engine says where the model blows up
            E = exponential(blocks)[:, :n]
        step, ramp = E[:, :, n : n + nw], E[:, :, n + nw :]
        found = np.concatenate([E[:, :, :n], step - ramp, ramp], axis=2)
        slopes = found[1:].imag / _TINY
        return found[0].real, np.where(np.isfinite(slopes), slopes, 0.0)

    # -- prior ---------------------------------------------------------------------------------------

    def prior(self, first: Block, theta: Array | None) -> tuple[Prior, Array]:
        """Half of each entry, or the share of its row that it may contribute.

        Along a change of coordinates of the states no sample tells anything: what linearization at different
        points seems to tell there would let the coefficients wander, so they are held along it.
        """
        power = np.sum(np.where(first.use, first.outputs, 0.0) ** 2, axis=0)
        outputs = np.sqrt(power / np.maximum(first.use.sum(axis=0), 1))
        inputs, outputs = np.sqrt(np.mean(first.inputs**2, axis=0)), np.where(outputs > 0, outputs, 1.0)
        base, n = self.base, self.base.n_states
        # an unstable model is followed no longer than it takes to grow twentyfold
        discrete = to_discrete(base, self.settings.dt, self.settings.hold)
        span = max(int(min(3.0 / max(growth(discrete), 1e-9), len(first.inputs))), 1)
        shown = np.abs(np.linalg.pinv(discrete.C)) @ outputs
        states = np.hypot(np.sqrt(state_power(discrete.A, discrete.B, first.inputs[:span])), shown)
        sources = np.concatenate([np.where(states > 0, states, 1.0), inputs])
        # size of each row of [A B; C D] [x; w]; of a discrete A without its identity part
        rest = np.abs(self._whole - np.eye(*self._whole.shape) * (not base.is_continuous))
        rows = np.concatenate([(rest * sources)[:n].max(axis=1, initial=0.0), outputs])
        still = sources[:n] / self.settings.dt if base.is_continuous else sources[:n]
        rows[:n] = np.where(rows[:n] > 0, rows[:n], still)
        spread = np.zeros(len(self.labels))
        for a, (i, j) in enumerate(self._places):
            by_row = rows[i] / sources[j] if sources[j] > 0 else 1.0
            spread[a] = max(0.5 * rest[i, j], self._rate * by_row) or _RATE * by_row
        root = np.diag(spread)
        if spread.size and self.one_to_one:
            _, sizes, directions = np.linalg.svd(self._response_change * spread)
            seen = directions[: np.count_nonzero(sizes > _UNSEEN * sizes[0])]
            root = (seen * spread).T
        start = self.start()
        return Prior(start, root, spread, start), np.zeros(0)

    @cached_property
    def _response_change(self) -> Array:
        """Change of the initial frequency response by each coefficient."""
        n, nw, p = self.base.n_states, self.base.n_inputs, len(self.labels)
        M, dM = self.discretized(self.start())
        # both input columns act as one in a steady sine
        A, B, C = M[:, :n], M[:, n : n + nw] + M[:, n + nw :], self.base.C
        dA, dB = dM[:, :, :n], dM[:, :, n : n + nw] + dM[:, :, n + nw :]
        rows = []
        # frequencies below the Nyquist frequency, relative to the largest gain at each
        for omega in np.geomspace(1e-3, 0.9, 60) * np.pi:
            resolvent = np.linalg.inv(np.exp(1j * omega) * np.eye(n) - A)
            left, right = C @ resolvent, resolvent @ B
            size = max(float(np.abs(left @ B + self.base.D).max(initial=0.0)), 1e-300)
            # dG = C (zI - A)^-1 (dA (zI - A)^-1 B + dB) + dC (zI - A)^-1 B + dD
            change = left @ (dA @ right + dB) + self.patterns[:, n:, :n] @ right + self.patterns[:, n:, n:]
            rows.append(change.reshape(p, -1).T / size)
        found = np.concatenate(rows)
        return np.concatenate([found.real, found.imag])


class _Matrices(Structure):
    """Structure of a linear model whose matrices `Entries` discretizes."""

    def __init__(self, family: Entries) -> None:
        super().__init__(family.physical)
        self._family = family
        self.parameters = [Parameter(0, name, name, -np.inf, np.inf) for name in family.labels]

    def start(self) -> Array:
        """Zero, the initial model."""
        return self._family.start()

    @property
    def absorbed(self) -> Any:
        """All coefficients enter the matrices."""
        return np.arange(len(self.parameters))

    def discretize(
        self, theta: Array, step: float, *, derivatives: bool = True, pieces: bool = False
    ) -> Substep:
        """Return a sample, with its derivatives by the coefficients."""
        return self.kept(("sample", theta.tobytes(), derivatives), lambda: self._sample(theta, derivatives))

    def _sample(self, theta: Array, derivatives: bool) -> Substep:
        n, nw, ny, p = self.n_states, self.n_inputs, self.n_outputs, len(self.parameters) * derivatives
        M, dM = self._family.discretized(theta)
        # behind the inputs stands the constant one, which enters nothing
        columns = np.r_[: n + nw, n + nw + 1 : n + 2 * nw + 1]
        wide, dwide = np.zeros((1, n, n + 2 * nw + 2)), np.zeros((1, p, n, n + 2 * nw + 2))
        wide[..., columns], dwide[..., columns] = M, dM[:p]
        O, dO = np.zeros((ny, n + nw + 1)), np.zeros((p, ny, n + nw + 1))
        O[:, : n + nw] = self._family.stacked(theta)[n:]
        dO[:, :, : n + nw] = self._family.patterns[:p, n:]
        none = np.zeros((0, n + nw + 1))
        return Substep(wide, dwide, np.arange(p), O, dO, none, np.zeros((0, *none.shape)))


def _stacked(model: LinearModel) -> Array:
    return np.block([[model.A, model.B], [model.C, model.D]])


def _place(name: str, n: int) -> tuple[int, int]:
    """Row and column of an entry in [A B; C D]."""
    match = _ENTRY.fullmatch(name)
    assert match is not None
    matrix, row, column = match[1], int(match[2]), int(match[3])
    return row + n * (matrix in "CD"), column + n * (matrix in "BD")


def checked_entries(model: LinearModel, names: Sequence[str]) -> list[str]:
    """Entries by their names, such as "A[1,0]".

    Raises
    ------
    control.ControlArgument
        If a name is none of an entry.
    ModelError
        If the model has no such entry, or it is named twice.
    """
    found: list[str] = []
    for name in names:
        match = _ENTRY.fullmatch(name)
        if match is None:
            raise ct.ControlArgument(
                f"effects: {name!r} is no entry; write it as 'A[1,0]' (rows and columns from 0); physical "
                "effects are Effect objects"
            )
        matrix, row, column = match[1], int(match[2]), int(match[3])
        entry, shape = f"{matrix}[{row},{column}]", getattr(model, matrix).shape
        if row >= shape[0] or column >= shape[1]:
            raise ModelError(f"effects: the model has no entry {entry}; {matrix} has shape {shape}")
        if entry in found:
            raise ModelError(f"effects: {entry} is named twice; give each entry once")
        found.append(entry)
    return found


def nonzero_entries(model: LinearModel) -> list[str]:
    """Entries that are not zero, where physics may have put them.

    Rows x1' = x2 are kinematics, and an output that shows one state is a sensor: both are no parameters.
    """
    found = []
    for row in range(model.n_states):
        columns = np.flatnonzero(model.A[row])
        kinematic = columns.size == 1 and columns[0] != row and model.A[row, columns[0]] == 1.0
        if not kinematic or model.B[row].any():
            found += [f"A[{row},{j}]" for j in columns]
            found += [f"B[{row},{j}]" for j in np.flatnonzero(model.B[row])]
    return found + _mixed_outputs(model)


def all_entries(model: LinearModel) -> list[str]:
    """All entries of A and B, and those of outputs that mix signals."""
    rows = range(model.n_states)
    found = [f"A[{i},{j}]" for i in rows for j in rows]
    return found + [f"B[{i},{j}]" for i in rows for j in range(model.n_inputs)] + _mixed_outputs(model)


def _mixed_outputs(model: LinearModel) -> list[str]:
    found = []
    for row in range(model.n_outputs):
        # a single state is a sensor; sums of several signals carry parameters
        states, inputs = np.flatnonzero(model.C[row]), np.flatnonzero(model.D[row])
        if states.size + inputs.size > 1 or (not states.size and inputs.size):
            found += [f"C[{row},{j}]" for j in states] + [f"D[{row},{j}]" for j in inputs]
    return found
