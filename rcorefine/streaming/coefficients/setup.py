"""Filter for coefficients: setup, memory, and the loop over samples."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import control as ct
import numpy as np

from ...arguments import as_noise, as_number, as_text
from ...exceptions import DivergenceError, ModelError
from ...inference.covariance import standard_deviations
from ...systems.conversion import to_discrete
from ...systems.linear import Array, LinearModel
from ..history import PARAMETERS, Summary, rates
from ..persistence import check_course, check_like, check_range, storable
from ..samples import Block, Complex, Flags, Integers
from .kernel import DIVERGED, DONE, MOVED, SURPRISED, CoefficientRecord, Kernel, Layout


@dataclass(frozen=True, eq=False)
class CoefficientMemory:
    """State of the physical stage between two calls.

    Parameters
    ----------
    packed : ndarray
        As `Layout` says.
    counters : ndarray of int64, shape (3,)
        Samples taken; samples for which the initial state still matters; whether unknown forces act.
    centre : ndarray, shape (p,)
        Coefficients that the model was discretized for.
    origin : ndarray, shape (p,)
        Coefficients that the search starts from, the mean of their prior.
    spread : ndarray, shape (p,)
        Standard deviation of their prior; empty until the first samples tell the sizes.
    widths : ndarray
        Smoothing width of each law that has one, by effect; NaN for others.
    sizes : ndarray, shape (n_w + n_y,)
        Rms of inputs and outputs over the first samples.
    states : ndarray, shape (n,)
        Rms of the states over the first samples; empty until they tell it.
    inputs, outputs : ndarray, shape (K, n_w), (K, n_y)
        First samples, gone over again as the model improves; empty later.
    known, use : ndarray of uint8, shape (K,), (K, n_y)
        Which of them were measured.
    rivals : ndarray, shape (r, p)
        Coefficients of other valleys, not yet discarded.
    rounds : int
        Times that the first samples were gone over.
    discretized : int
        Times that the model was discretized.
    renewed : int
        Times that the filter began anew, its innovations far beyond what it was sure of.
    doubted : int
        Sample at which it last began anew with the state alone, 0 for never.
    kernel : Kernel
        The model discretized at `centre`, made from the other fields.
    """

    packed: Array
    counters: Integers
    centre: Array
    origin: Array
    spread: Array
    widths: Array
    sizes: Array
    states: Array
    inputs: Array
    outputs: Array
    known: Flags
    use: Flags
    rivals: Array
    rounds: int
    discretized: int
    renewed: int
    doubted: int
    kernel: Any = None

    @property
    def first(self) -> Block:
        """The first samples, as far as they are kept."""
        return Block(self.inputs, self.outputs, self.known, self.use)

    @property
    def n_samples(self) -> int:
        """Samples taken."""
        return int(self.counters[0])

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "kernel": None}  # compiled code stays in its process

    def copied(self) -> CoefficientMemory:
        """Independent copy of what changes in place."""
        twin = object.__new__(CoefficientMemory)  # dataclasses.replace takes longer than the sample itself
        twin.__dict__.update(self.__dict__)
        twin.__dict__["packed"], twin.__dict__["counters"] = self.packed.copy(), self.counters.copy()
        return twin


SHARE = 1.0  # of its standard deviation that a coefficient may move before the model is discretized anew
_SOON = 500  # samples within which a second surprise means that not the state alone was wrong
DOUBT = 50.0  # samples that the first guess of the noise, the size of the outputs, counts for
_LIMIT = 1e12  # state over its size, beyond which the filter has diverged
NEVER = 1e300  # a threshold that nothing reaches, and still a finite number
_CHANGING = 0.03  # unknown force over the input where coefficients may change


storable(CoefficientMemory, CoefficientRecord)


@dataclass(frozen=True, slots=True, eq=False)
class FilterSettings:
    """Settings that every coefficient filter has.

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
    def loose(self) -> bool:
        """Return whether the state always stays uncertain.

        This is so if unknown forces act or coefficients may change.
        """
        return self.disturbance > 0 or self.forgetting < 1


class CoefficientSetup(ABC):
    """A model that depends on coefficients, and how they are estimated.

    Attributes
    ----------
    settings : FilterSettings
        Sampling, noise, memory.
    model : LinearModel
        Initial model.
    layout : Layout
        Sizes of the packed memory.
    labels, bounds : tuple of str, tuple of two ndarray
        Names of the coefficients; their lower and upper bounds.
    milestones : tuple of int
        Numbers of samples at which the first ones are gone over.
    n_laws : int
        Laws that may have a width of their own.
    share : float
        Standard deviations a coefficient may move before rediscretization.
    watch : float
        Mean square of normalized innovations at which the filter restarts.
    """

    settings: FilterSettings
    model: LinearModel
    layout: Layout
    labels: tuple[str, ...]
    bounds: tuple[Array, Array]
    milestones: tuple[int, ...]
    n_laws = 0
    share = SHARE
    watch = NEVER

    @abstractmethod
    def start(self) -> Array:
        """Coefficients of the initial model."""

    @abstractmethod
    def compile(self, memory: CoefficientMemory) -> Kernel:
        """Discretize at `memory.centre` and pack what the loop needs."""

    @abstractmethod
    def go_over(self, memory: CoefficientMemory) -> CoefficientMemory:
        """Memory after the first samples, gone over again about a better model."""

    @abstractmethod
    def system(self, theta: Array, widths: Array, name: str) -> LinearModel:
        """Model at these coefficients, in the timebase that it is estimated in."""

    @abstractmethod
    def rows(self, theta: Array, spread: Array) -> tuple[Any, ...]:
        """Estimated parameters, one row each."""

    translates = False  #: whether the coefficients are of another time domain than the model that was given

    def translated(self, theta: Array, covariance: Array) -> tuple[Array, Array]:
        """Return coefficients and covariance in the given time domain."""
        return theta, covariance

    def milestone(self, rounds: int) -> int:
        """Return after how many samples the first ones are filtered again.

        It is -1 if that never happens again.
        """
        lengths = self.milestones
        return lengths[rounds] if rounds < len(lengths) else -1

    def begin(self) -> CoefficientMemory:
        """Memory before the first sample."""
        lay = self.layout
        n_w = lay.nu - 1
        lower, upper = self.bounds
        origin = np.clip(self.start(), lower, upper)
        # all zero but the coefficients: sizes and priors follow from the first samples
        packed = np.zeros(lay.size)
        lay.parts(packed).theta[:] = origin
        return CoefficientMemory(
            packed=packed,
            counters=self.counters(),
            centre=origin.copy(),
            origin=origin,
            spread=np.zeros(0),
            widths=np.full(self.n_laws, np.nan),
            sizes=np.zeros(n_w + lay.ny),
            states=np.zeros(0),
            inputs=np.zeros((0, n_w)),
            outputs=np.zeros((0, lay.ny)),
            known=np.zeros(0, dtype=np.uint8),
            use=np.zeros((0, lay.ny), dtype=np.uint8),
            rivals=np.zeros((0, lay.p)),
            rounds=0,
            discretized=0,
            renewed=0,
            doubted=0,
        )

    def counters(self) -> Integers:
        """Counters of a filter before its first sample."""
        return np.array([0, 10 * self.layout.n + 10, int(self.settings.loose)], dtype=np.int64)

    def head(
        self,
        memory: CoefficientMemory,
        bounds: tuple[Array, Array],
        acting: Array,
        inputs: Array,
    ) -> tuple[list[Array], Array]:
        """First numbers that the loop needs, and the floor of the noise.

        Parameters
        ----------
        memory : CoefficientMemory
            Where to linearize.
        bounds : tuple of ndarray
            Bounds of the coefficients.
        acting, inputs : ndarray of shape (n, .)
            What unknown forces, and inputs that were not measured, move in a sample.
        """
        lay, settings = self.layout, self.settings
        # divergence: 1e12 times the size of the states
        limit = _LIMIT * (float(memory.states.max(initial=0.0)) or 1.0)
        y_size = memory.sizes[lay.nu - 1 :]
        # noise floor: as declared, or the rounding of the outputs
        floor = np.maximum(settings.noise**2, 1e-16 * y_size**2)
        scale = np.where(memory.spread > 0, memory.spread, 1.0) if memory.spread.size else np.ones(lay.p)
        numbers = np.array([self.share, settings.forgetting, limit, self.watch])
        head = [memory.centre, *bounds, 1e-6 * scale, floor, numbers]
        # covariances of unknown forces and of missing inputs: B B'
        return [*head, (acting @ acting.T).ravel(), (inputs @ inputs.T).ravel()], floor

    def prior_covariance(self, spread: Array) -> Array:
        """Covariance of the coefficients before the first sample, shape (p, p)."""
        return np.diag(spread**2)

    def held_covariance(self, spread: Array) -> Array:
        """Return the part of the prior along which the coefficients are held.

        It is no part of `prior_covariance`: no sample changes it.
        """
        return np.diag(spread**2) - self.prior_covariance(spread)

    def renewed(self, memory: CoefficientMemory) -> CoefficientMemory:
        """Return a memory that no longer trusts its state.

        It does not trust its coefficients either if the last restart did not help for long.

        A bump moves the state alone. Where the coefficients were learned from something that is
        over, they begin anew as the initial ones: they may be far off.
        """
        packed, counters = memory.packed.copy(), self.counters()
        parts = self.layout.parts(packed)
        counters[0] = memory.n_samples
        # covariance reset: the state is as uncertain as at the start
        parts.Pb[:] = np.diag(memory.states**2)
        parts.surprise[:] = 0.0
        # first surprise in a long time: trust the coefficients, renew the state only
        if memory.doubted == 0 or memory.n_samples - memory.doubted > _SOON:
            return replace(memory, packed=packed, counters=counters, doubted=memory.n_samples)
        # second one soon after: reset the coefficients to the initial model, too
        parts.theta[:] = memory.origin
        parts.S[:] = 0.0
        parts.Pt[:] = self.prior_covariance(memory.spread)
        # the quick level of the innovations holds now
        parts.level[1] = parts.level.max(axis=0)
        parts.count[:] = DOUBT
        return replace(
            memory, packed=packed, counters=counters, centre=memory.origin.copy(), kernel=None, doubted=0,
            renewed=memory.renewed + 1,
        )  # fmt: skip

    def about(self, memory: CoefficientMemory, theta: Array) -> CoefficientMemory:
        """Memory before the first sample, about these coefficients."""
        packed = np.zeros(self.layout.size)
        parts = self.layout.parts(packed)
        parts.theta[:] = theta
        parts.Pb[:] = np.diag(memory.states**2)
        parts.Pt[:] = self.prior_covariance(memory.spread)
        return replace(memory, packed=packed, counters=self.counters(), centre=theta.copy(), kernel=None)


def signal_sizes(memory: CoefficientMemory) -> Array:
    """Rms of inputs and outputs over the first samples, gaps left out.

    It is 1 for an output that is zero.
    """
    outputs = np.where(memory.use, memory.outputs, 0.0)
    y = np.sqrt(np.sum(outputs**2, axis=0) / np.maximum(memory.use.sum(axis=0), 1))
    w = np.sqrt(np.mean(memory.inputs**2, axis=0))
    return np.concatenate([w, np.where(y > 0, y, 1.0)])


def floor_at(lay: Layout) -> slice:
    """Return the position of the noise floor in the packed array."""
    return slice(4 * lay.p, 4 * lay.p + lay.ny)


def held_columns(M: Array, n: int, nu: int, hold: str) -> Array:
    """Return the columns of the linear part for the given hold.

    With a zero-order hold an input acts with its value at the start.
    """
    M = np.ascontiguousarray(M[:, :, : n + 2 * nu])
    # zero-order hold: the input of the sample before acts alone
    if hold == "zoh":
        M[:, :, n : n + nu] += M[:, :, n + nu :]
        M[:, :, n + nu :] = 0.0
    return M


def checked_settings(
    n_outputs: int, dt: float, hold: str, noise: Any, disturbance: float | None, forgetting: float
) -> FilterSettings:
    """Settings of a coefficient filter, checked."""
    if as_text(hold, "hold") not in ("zoh", "foh"):
        raise ct.ControlArgument(
            f"hold must be 'zoh' or 'foh' on a stream, not {hold!r}; a band-limited input needs the future: "
            "use refine() on the record"
        )
    declared = as_noise(noise, n_outputs)
    levels = np.zeros(n_outputs) if declared is None else declared.copy()
    forgetting = as_number(
        forgetting, "forgetting (1 forgets nothing)", least=0.5, most=1.0, error=ModelError
    )
    if disturbance is None:
        # a state that is certain cannot follow a model that changes
        disturbance = 0.0 if forgetting == 1.0 else _CHANGING
    disturbance = as_number(disturbance, "disturbance", least=0.0, error=ModelError)
    return FilterSettings(dt, hold, levels, disturbance, forgetting)


_UNLEARNED = 0.5  # of its prior deviation: a coefficient that is no better known has not been seen
_UNEXPLAINED = 0.3  # of the rms of an output left in the innovations: the effects do not explain it
_ALIKE = 0.995  # correlation of two estimates that the sensors can hardly tell apart


def explain_divergence(setup: CoefficientSetup, memory: CoefficientMemory, sample: int) -> DivergenceError:
    """Error that says when the state left all bounds, and why."""
    sentences = [
        f"the static stage diverged at sample {sample} (t = {sample * setup.settings.dt:.6g} s); "
        "the state before is readable.",
        *_pole_caution(setup, memory),
        *_bound_caution(setup, memory),
        "Place: choose other effects, give them a start or a prior, or declare the noise of the sensors.",
    ]
    return DivergenceError(" ".join(sentences))


def cautions(setup: CoefficientSetup, memory: CoefficientMemory) -> list[str]:
    """Return the reasons not to trust the coefficients."""
    if memory.rounds == 0 or not memory.spread.size:
        return []
    of = _pole_caution, _bound_caution, _doubt_cautions, _error_cautions, _decay_caution
    return [sentence for caution in of for sentence in caution(setup, memory)]


def _doubt_cautions(setup: CoefficientSetup, memory: CoefficientMemory) -> list[str]:
    """Coefficients that the samples do not determine, or not one by one."""
    found, names = [], np.array(setup.labels, dtype=object)
    # standard deviations from the covariance of the filter
    P = setup.layout.parts(memory.packed).Pt
    std = standard_deviations(P)
    # held: the prior fixes more than the data determine
    together = names[np.diag(setup.held_covariance(memory.spread)) > std**2]
    if together.size:
        found.append(
            f"Determined only together: {', '.join(together)}. What no sample changes is held "
            "at the initial model, and std is that of its prior."
        )
    # not excited: the posterior deviation is close to the prior
    blind = names[std > _UNLEARNED * memory.spread]
    if blind.size:
        found.append(f"Not excited: the samples hardly determine {', '.join(blind)}; excite or omit it.")
    # nearly collinear estimates
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = np.argwhere(np.tril(np.abs(P) / np.outer(std, std) > _ALIKE, -1))
    if alike.size:
        pairs = "; ".join(f"{names[i]} and {names[j]}" for i, j in alike[:3])
        found.append(f"Hardly distinguished by these sensors: {pairs}.")
    return found


def _error_cautions(setup: CoefficientSetup, memory: CoefficientMemory) -> list[str]:
    """Innovations above the declared noise, or above a share of the signal."""
    found = []
    level = np.sqrt(setup.layout.parts(memory.packed).level[1])
    rows = zip(
        setup.model.output_labels, level, memory.sizes[-level.size :], setup.settings.noise, strict=True
    )
    for label, left, whole, declared in rows:
        error = f"Not explained: the prediction error of {label} is"
        if declared > 0 and left > 2.0 * declared:
            found.append(
                f"{error} {left:.3g}, the declared noise {declared:.3g}. An effect is missing or at another "
                "place."
            )
        elif declared == 0 and left > _UNEXPLAINED * whole:
            found.append(
                f"{error} {100 * left / whole:.3g} % of its rms. Unless this is noise, an effect is missing "
                "or at another place (rcorefine.diagnose ranks the candidates)."
            )
    return found


def _decay_caution(setup: CoefficientSetup, memory: CoefficientMemory) -> list[str]:
    """Caution where the initial state still matters.

    The time constant of the slowest pole is compared with the length of the stream.
    """
    slowest = -float(np.max(_poles(setup, memory).real, initial=-np.inf))
    length = memory.n_samples * setup.settings.dt
    if slowest <= 0 or length * slowest >= 1.0 or memory.counters[1] == 0:
        return []
    return [
        f"Not decayed: the slowest mode has a time constant of {1 / slowest:.3g} s and the stream is "
        f"{length:.3g} s long. The unknown initial state still affects the coefficients."
    ]


def _poles(setup: CoefficientSetup, memory: CoefficientMemory) -> Complex:
    """Poles of the present model in rad/s."""
    theta = setup.layout.parts(memory.packed).theta
    if not np.isfinite(theta).all():
        return np.zeros(0, dtype=complex)
    return rates(setup.system(theta, memory.widths, "refined"), setup.settings.dt)


def _pole_caution(setup: CoefficientSetup, memory: CoefficientMemory) -> list[str]:
    # compare with the initial model: it may be unstable itself
    before = rates(setup.model, setup.settings.dt).real.max(initial=-np.inf)
    poles = _poles(setup, memory)
    if not poles.size:
        return []
    worst = poles[np.argmax(poles.real)]
    size = np.abs(poles[np.isfinite(poles)]).max(initial=0.0)
    if worst.real <= max(before, 0.0) + 1e-9 * size:
        return []
    return [
        f"Unstable: the refined model has a pole at {worst:.4g} rad/s. A wrong place or a missing effect "
        "can cause it."
    ]


def _bound_caution(setup: CoefficientSetup, memory: CoefficientMemory) -> list[str]:
    theta, (lower, upper) = setup.layout.parts(memory.packed).theta, setup.bounds
    held = np.array(setup.labels, dtype=object)[((theta <= lower) | (theta >= upper)) & (theta != 0)]
    return [f"At its bound: {', '.join(held)}."] if held.size else []


def take(
    setup: CoefficientSetup, memory: CoefficientMemory, block: Block, *, keep: bool = False
) -> tuple[CoefficientMemory, CoefficientRecord]:
    """Memory after some samples; the one given stays as it is.

    Parameters
    ----------
    setup, memory
        The stage.
    block : Block
        Samples.
    keep : bool
        Whether to record every sample.

    Raises
    ------
    DivergenceError
        If the state leaves all bounds.
    """
    memory = memory.copied()
    total = len(block.inputs)
    record = setup.layout.record(total if keep else 0)
    # up to the next milestone the samples are kept, to filter them again
    position = 0
    while position < total:
        target = setup.milestone(memory.rounds)
        stop = total if target < 0 else min(total, position + target - memory.n_samples)
        part = block.part(position, stop)
        if target >= 0:
            memory = replace(memory, **Block.joined([memory.first, part])._asdict())
        # before the first milestone sizes and priors are unknown: only count
        if memory.rounds == 0:
            memory.counters[0] += stop - position
            if keep:
                record.theta[position:stop] = memory.origin
        else:
            memory, done = advanced(setup, memory, part, record.part(position, stop))
            if done < stop - position:
                raise explain_divergence(setup, memory, memory.n_samples)
        position = stop
        # at a milestone: filter the samples kept so far about the best coefficients
        if target >= 0 and memory.n_samples == target:
            memory = setup.go_over(memory)
            # after the last one: drop the samples and run as a pure filter
            if target == setup.milestones[-1]:
                nothing = {name: part.copy() for name, part in memory.first.part(0, 0)._asdict().items()}
                memory = replace(memory, rivals=memory.rivals[:0].copy(), **nothing)
    return memory, record


def advanced(
    setup: CoefficientSetup, memory: CoefficientMemory, block: Block, record: CoefficientRecord
) -> tuple[CoefficientMemory, int]:
    """Return the memory after a block, and the number of samples done.

    The memory is changed in place. Fewer samples are done if the filter diverged.

    The model is discretized anew where coefficients have moved.
    """
    position, total = 0, len(block.inputs)
    while position < total:
        # compile at the first use, then run until the kernel stops
        if memory.kernel is None:
            memory = replace(memory, kernel=setup.compile(memory))
        done, why = memory.kernel.over(
            memory.packed, memory.counters, block.part(position, total), record.part(position, total)
        )
        position += done
        if why == DIVERGED:
            break
        # innovations too large for their covariance: restart
        if why == SURPRISED:
            memory = setup.renewed(memory)
        # coefficients moved too far for the linearization: discretize about them
        if why == MOVED:
            centre = setup.layout.parts(memory.packed).theta.copy()
            memory = replace(memory, centre=centre, discretized=memory.discretized + 1, kernel=None)
    return memory, position


# the first samples, and what was found about them
_GROWN = {**dict.fromkeys(("inputs", "outputs", "known", "use"), "samples"), "rivals": "valleys"}


class CoefficientFilter:
    """Joint Kalman filter for the state and coefficients of a model.

    It runs on a stream.

    Parameters
    ----------
    setup : CoefficientSetup
        Model, coefficients, settings.
    keep : bool
        Whether to keep the course of every sample.
    """

    def __init__(self, setup: CoefficientSetup, keep: bool) -> None:
        self.setup, self.keep = setup, keep
        self._unrecorded = setup.layout.record(0)
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self.memory: CoefficientMemory = self.setup.begin()
        self.records: list[tuple[CoefficientRecord, Array]] = []

    @property
    def n_samples(self) -> int:
        """Samples taken."""
        return self.memory.n_samples

    @property
    def filter(self) -> CoefficientFilter:
        """Filter of the coefficients that the refined model has."""
        return self

    @contextmanager
    def all_or_nothing(self) -> Iterator[None]:
        """Undo what was learned where an error follows."""
        memory, count = self.memory, len(self.records)
        try:
            yield
        except BaseException:
            self.memory = memory
            del self.records[count:]
            raise

    def take(self, block: Block, *, predict: bool = False) -> Array:
        """Learn from a block; with `predict` what was expected, one sample ahead."""
        self.memory, record = take(self.setup, self.memory, block, keep=self.keep or predict)
        if self.keep:
            self.records.append((record, np.where(block.use, block.outputs, np.nan)))
        return record.predicted

    def one(self, block: Block) -> bool:
        """Learn from a single sample by the fast path, if that is available.

        Otherwise do nothing and return False.
        """
        memory = self.memory
        kernel = memory.kernel
        # fast path: nothing kept, nothing to filter again, and the model is compiled
        if self.keep or kernel is None or memory.inputs.size or memory.rounds == 0:
            return False
        after = memory.copied()
        if kernel.over(after.packed, after.counters, block, self._unrecorded) != (1, DONE):
            return False
        self.memory = after
        return True

    def finish(self) -> None:
        """Learn from what is still held back, however short."""
        memory = self.memory
        # a stream shorter than the first milestone
        if memory.rounds == 0 and memory.inputs.shape[0] > self.setup.layout.n + 2:
            self.memory = self.setup.go_over(memory)

    # -- results -----------------------------------------------------------------------------------

    @property
    def parts(self) -> SimpleNamespace:
        """Quantities of the memory by name."""
        return self.setup.layout.parts(self.memory.packed)

    @property
    def own(self) -> tuple[Array, Array]:
        """Coefficients (p,) and covariance (p, p) as they are estimated.

        The covariance is infinite before anything is learned. Where coefficients are held, it is that of
        their prior.
        """
        theta, found = np.array(self.parts.theta), np.array(self.parts.Pt)
        # before the first milestone nothing is learned
        if not found.any():
            found[np.diag_indices_from(found)] = np.inf
            return theta, found
        return theta, found + self.setup.held_covariance(self.memory.spread)

    @property
    def theta(self) -> Array:
        """Coefficients, shape (p,), in the time domain of the given model."""
        return self.setup.translated(*self.own)[0]

    @property
    def covariance(self) -> Array:
        """Covariance of `theta`, shape (p, p)."""
        return self.setup.translated(*self.own)[1]

    @property
    def standard_deviations(self) -> Array:
        """Standard deviations of the coefficients, shape (p,).

        They are infinite before anything is learned.
        """
        return standard_deviations(self.covariance)

    @property
    def parameters(self) -> tuple[Any, ...]:
        """Rows: name, kind, place, initial, value, coefficient, std, unit, role."""
        theta, covariance = self.setup.translated(*self.own)
        return self.setup.rows(theta, standard_deviations(covariance))

    form = "coefficients"

    @property
    def scores(self) -> dict[str, float]:
        """Nothing competes."""
        return {}

    def summary(self, name: str) -> Summary:
        """Cells and sentences of `str`."""
        setup, memory = self.setup, self.memory
        title = f"RCORefiner of {name!r}: {len(setup.labels)} coefficients, dt = {setup.settings.dt:g} s"
        taken = f"{memory.n_samples} samples taken; the model was discretized {memory.discretized} times."
        return Summary(title, PARAMETERS, self.rows(), [taken, *self.notes()])

    def system(self, name: str) -> LinearModel:
        """Refined linear model, in the timebase that it is estimated in."""
        if self.memory.rounds == 0:
            return self.setup.model.with_arrays(name=name)
        return self.setup.system(self.own[0], self.memory.widths, name)

    def discrete_system(self, name: str) -> LinearModel:
        """Refined linear model, its input held between samples."""
        return to_discrete(self.system(name), self.setup.settings.dt, self.setup.settings.hold)

    def predict(self, inputs: Array) -> Array:
        """Free run on further inputs of shape (N, n_w); outputs of shape (n_y, N)."""
        setup, memory, total = self.setup, self.memory, inputs.shape[0]
        # before the first milestone the initial model runs on from the first sample
        if memory.rounds == 0:  # still the initial model, from rest
            inputs = np.vstack([memory.inputs, inputs])
            packed = np.zeros(setup.layout.size)
            setup.layout.parts(packed).theta[:] = memory.centre
            memory = replace(memory, packed=packed, counters=np.array([1, 0, 0]), kernel=None)
        memory = replace(
            memory, rounds=1 << 30, inputs=memory.inputs[:0], outputs=memory.outputs[:0], rivals=memory.rivals
        )
        # no output is used: the filter only predicts, so this is a simulation
        use = np.zeros((inputs.shape[0], setup.layout.ny), np.uint8)
        known = np.ones(inputs.shape[0], np.uint8)
        block = Block(inputs, np.zeros(use.shape), known, use)
        _, record = take(setup, memory, block, keep=True)
        return np.ascontiguousarray(record.predicted.T[:, -total:])

    def state(self) -> list[Any]:
        """All that is remembered, for a file."""
        return [self.memory, self.records]

    def restore(self, state: list[Any]) -> None:
        """Go on from what `state` gave, once it was held against a fresh memory."""
        memory, records = state
        lay, setup = self.setup.layout, self.setup
        # compare shapes and ranges with an empty memory
        fresh = setup.begin()
        if memory.spread.size:  # the first samples have told it
            fresh = replace(fresh, spread=np.zeros(lay.p))
        if memory.states.size:
            fresh = replace(fresh, states=np.zeros(lay.n))
        check_like(memory, fresh, "memory", _GROWN)
        target = setup.milestone(memory.rounds)
        check_range(memory.counters, 0, [target - 1 if target > 0 else np.inf, np.inf, 1], "memory.counters")
        check_range(memory.sizes, 0.0, np.inf, "memory.sizes")
        check_course(records, lay.record(0), lay.ny)
        self.memory, self.records = memory, records

    def rows(self) -> list[list[str]]:
        """Cells of the table of parameters."""
        return [row.cells for row in self.parameters]

    def notes(self) -> list[str]:
        """Sentences about the coefficients."""
        if self.memory.rounds == 0:
            return ["The first samples are held back until the size of the signals is known."]
        errors = zip(self.setup.model.output_labels, np.sqrt(self.parts.level[1]), strict=True)
        levels = ", ".join(f"{label} {level:.3g}" for label, level in errors)
        return [
            "std is the standard deviation of the value at this sample, for white innovations. "
            f"Prediction error one sample ahead (rms): {levels}.",
            *cautions(self.setup, self.memory),
        ]
