"""Checked settings, scaled model and memory of the paper's stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ...arguments import as_array, as_number
from ...engine.linear import state_power
from ...exceptions import DataError, ModelError
from ...systems.discretization import discretize
from ...systems.linear import Array, LinearModel
from ..persistence import check_like, check_range, storable
from ..samples import Complex, Sampled, as_matrix, as_size
from .kernels import PADDING, Design, Plant, Record, Stage

# A Markov parameter counts as zero below this share of the largest |C| |A^(i-1) B_u| of its entry
# over the first n + 1 samples: what is left of an exact cancellation after rounding.
TOLERANCE = 1e-10


def markov_parameters(plant: Plant, count: int) -> Array:
    """H_0 = D_u and H_i = C A^(i-1) B_u, shape (count, n_y, l_u)."""
    values = np.empty((count, *plant.Du.shape))
    # H_i = C A^(i-1) B_u
    values[0] = plant.Du
    power = plant.Bu
    for i in range(1, count):
        values[i] = plant.C @ power
        power = plant.A @ power
    return values


def _nonzero(plant: Plant) -> tuple[Array, NDArray[np.bool_]]:
    """Return n + 1 Markov parameters after H_0, and the nonzero entries.

    An entry counts as nonzero if it exceeds the rounding error.
    """
    # by Cayley and Hamilton's theorem: if these are zero, all are
    count = plant.A.shape[0] + 2
    values = markov_parameters(plant, count)
    # bound of each entry without cancellation
    bound = np.abs(plant.Du)
    power = plant.Bu
    for _ in range(1, count):
        bound = np.maximum(bound, np.abs(plant.C) @ np.abs(power))
        power = plant.A @ power
    return values, np.abs(values) > TOLERANCE * bound


def relative_degree(plant: Plant) -> int:
    """Return the index d of the first nonzero Markov parameter.

    With feedthrough, d = 0.

    Raises
    ------
    ModelError
        If the correction reaches no output at all.
    """
    _, nonzero = _nonzero(plant)
    # (n_y, l_u) entries: one that is not zero is enough
    reached = nonzero.any(axis=(1, 2))
    if not reached.any():
        raise ModelError(
            "the correction reaches no output: every Markov parameter D_u, C A^i B_u is zero; "
            "choose correction_input (B_u) so that it drives a state that the outputs see"
        )
    return int(np.argmax(reached))


def column_delays(plant: Plant) -> Array:
    """Return the first nonzero Markov parameter of each correction.

    The shape is (n_y, l_u).

    Raises
    ------
    ModelError
        If a correction reaches no output.
    """
    values, nonzero = _nonzero(plant)
    reached = nonzero.any(axis=1)
    dead = ~reached.any(axis=0)
    if dead.any():
        raise ModelError(
            f"correction {int(np.argmax(dead))} (column of B_u, D_u) reaches no output; "
            "leave the column out, or measure where it acts"
        )
    # column c of the first H_i that is not zero for correction c, (n_y, l_u)
    first = np.argmax(reached, axis=0)
    return np.stack([values[first[c], :, c] for c in range(first.size)], axis=1)


def path_zeros(plant: Plant) -> Complex:
    """Return the finite zeros of the path u -> y.

    They are invariant zeros if the path is square, otherwise the zeros of every single path.
    """
    n_y, l_u = plant.Du.shape
    # square path: invariant zeros; otherwise those of each pair of output and correction
    if n_y == l_u:
        pairs = [(slice(None), slice(None))]
    else:
        pairs = [(slice(r, r + 1), slice(c, c + 1)) for r in range(n_y) for c in range(l_u)]
    found = [_invariant_zeros(plant.A, plant.Bu[:, c], plant.C[r], plant.Du[r, c]) for r, c in pairs]
    return np.concatenate([*found, np.zeros(0, dtype=complex)])


def _invariant_zeros(a: Array, b: Array, c: Array, d: Array) -> Complex:
    n = a.shape[0]
    # Rosenbrock's pencil [A - zI, B; C, D]: its generalized eigenvalues are the zeros
    pencil = np.block([[a, b], [c, d]])
    mass = np.zeros_like(pencil)
    mass[:n, :n] = np.eye(n)
    alpha, beta = linalg.eig(pencil, mass, right=False, homogeneous_eigvals=True)
    # infinite eigenvalues belong to the relative degree
    finite = np.abs(beta) > 1e-10 * np.maximum(np.abs(alpha), 1e-300)
    zeros = np.asarray(alpha[finite] / beta[finite], dtype=complex)
    return np.asarray(zeros[np.isfinite(zeros)])


# Signals count as settled when the second half of a stretch is at most this much larger than the first.
GROWTH = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Scales:
    """Size of each signal in its own unit.

    A signal divided by it has unit size.

    Parameters
    ----------
    inputs, outputs, states, corrections : ndarray
        Shapes (n_w,), (n_y,), (n,), (l_u,).
    """

    inputs: Array
    outputs: Array
    states: Array
    corrections: Array


def scaled_plant(plant: Plant, scales: Scales) -> Plant:
    """Same system in scaled signals."""
    # A, B, C, D of signals divided by their scales: S_x^-1 A S_x and so on
    x, y = scales.states[:, None], scales.outputs[:, None]
    return Plant(
        A=np.ascontiguousarray(plant.A * scales.states / x),
        B=np.ascontiguousarray(plant.B * scales.inputs / x),
        Bu=np.ascontiguousarray(plant.Bu * scales.corrections / x),
        C=np.ascontiguousarray(plant.C * scales.states / y),
        D=np.ascontiguousarray(plant.D * scales.inputs / y),
        Du=np.ascontiguousarray(plant.Du * scales.corrections / y),
    )


def is_settled(signals: Array) -> bool:
    """Return whether every signal varies and no longer grows.

    `signals` is a stretch of shape (n, N).
    """
    if (np.ptp(signals, axis=1) == 0.0).any():
        return False
    # stationary: rms of the second half at most three times that of the first
    half = signals.shape[1] // 2
    first = np.sqrt(np.mean(signals[:, :half] ** 2, axis=1))
    second = np.sqrt(np.mean(signals[:, half:] ** 2, axis=1))
    return bool((second <= GROWTH * first).all())


def measured_scales(
    plant: Plant, w: Array, y: Array, labels: tuple[tuple[str, ...], tuple[str, ...]]
) -> Scales:
    """Return the scales from the first samples, (n_w, N) and (n_y, N).

    They are the rms of inputs, outputs and model states.

    Raises
    ------
    DataError
        If an input is constant or an output is zero throughout.
    ModelError
        If the initial model grows beyond floating point on these inputs.
    """
    n_samples = w.shape[1]
    for signal, label in zip(w, labels[0], strict=True):
        if np.ptp(signal) == 0.0:
            raise DataError(
                f"input {label!r} is constant ({signal[0]:g}) from sample 0 to {n_samples - 1}: nothing can "
                "be learned from it. Excite it, leave it out of the model, or declare scale={...}"
            )
    for signal, label in zip(y, labels[1], strict=True):
        if not signal.any():
            raise DataError(
                f"output {label!r} is zero from sample 0 to {n_samples - 1}: check the sensor, "
                "or declare scale={...}"
            )
    # rms of the measured signals
    inputs = np.sqrt(np.mean(w**2, axis=1))
    outputs = np.sqrt(np.mean(y**2, axis=1))
    corrections = _correction_scales(plant, outputs)
    # rms of the model states in a simulation from rest
    with np.errstate(over="ignore", invalid="ignore"):
        power = state_power(plant.A, plant.B, np.ascontiguousarray(w[:, :-1].T))
    power = _finite(power, n_samples) * ((n_samples - 1) / n_samples)
    states = _fill_scales(np.sqrt(power), plant, corrections, n_samples)
    return Scales(inputs, outputs, states, corrections)


def declared_scales(plant: Plant, scale: Any, n_samples: int) -> Scales | None:
    """Return the scales that the user declares, None for those to be measured.

    Those of states and corrections may be left out.

    Raises
    ------
    control.ControlArgument
        If a name is unknown, or inputs or outputs are missing.
    control.ControlDimension
        If a scale has the wrong length.
    ModelError
        If a scale is not positive and finite.
    """
    if isinstance(scale, str) and scale == "auto":
        return None
    if not isinstance(scale, Mapping):
        raise ct.ControlArgument(
            f"scale must be 'auto' or a mapping such as {{'inputs': 1.0, 'outputs': 0.1}}, not {scale!r}"
        )
    sizes = {
        "inputs": plant.B.shape[1],
        "outputs": plant.C.shape[0],
        "states": plant.A.shape[0],
        "corrections": plant.Bu.shape[1],
    }
    # check names and signs
    if unknown := set(scale) - set(sizes):
        raise ct.ControlArgument(
            f"scale: {sorted(unknown)[0]!r} is unknown; give {', '.join(map(repr, sizes))}"
        )
    for name in ("inputs", "outputs"):
        if name not in scale:
            raise ct.ControlArgument(f"scale: {name!r} is missing; give the typical size of {name}")
    given = {name: _positive(name, value, sizes[name]) for name, value in scale.items()}
    corrections = given.get("corrections")
    if corrections is None:
        corrections = _correction_scales(plant, given["outputs"])
    states = given.get("states")
    if states is None:
        # rms response to white inputs of the declared size over the first samples, from rest
        states = np.sqrt(_power(plant.A, plant.B * given["inputs"], n_samples))
        states = _fill_scales(states, plant, corrections, n_samples)
    return Scales(given["inputs"], given["outputs"], states, corrections)


def _positive(name: str, value: Any, size: int) -> Array:
    array = as_array(value, f"scale: {name}", error=ModelError)
    if array.ndim > 1 or (array.ndim == 1 and array.size != size):
        raise ct.ControlDimension(f"scale: {name} has shape {array.shape}; give one number, or {size}")
    if not (array > 0).all():
        raise ModelError(f"scale: {name} must be positive and finite, not {value!r}")
    return np.full(size, array, dtype=float) if array.ndim == 0 else array.astype(float)


def _correction_scales(plant: Plant, outputs: Array) -> Array:
    """Return the scales of the corrections.

    A correction of unit size moves the outputs by their unit size at its first response.

    So alpha means the same whatever the unit of the correction and however
    fast the sampling.
    """
    return np.asarray(1.0 / np.linalg.norm(column_delays(plant) / outputs[:, None], axis=0))


def _power(a: Array, b: Array, n_samples: int) -> Array:
    """Return the mean square of the states under white inputs.

    The states start from rest. Inputs of unit size act through b.
    """
    # sum over k of |A^(k-1) B|^2, weighted by the samples that an input had time to act
    total = np.zeros(a.shape[0])
    step = b
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, n_samples):
            total += (step**2).sum(axis=1) * ((n_samples - k) / n_samples)
            step = a @ step
    return _finite(total, n_samples)


def _finite(total: Array, n_samples: int) -> Array:
    if not np.isfinite(total).all():
        raise ModelError(
            f"the initial model grows beyond floating point within {n_samples} samples: it is unstable. "
            "Declare scale={...} with states, or start from a stable model"
        )
    return total


def _fill_scales(states: Array, plant: Plant, corrections: Array, n_samples: int) -> Array:
    """Return the scales of the states with missing ones filled in.

    States that the inputs do not move get their scale from the correction.
    """
    # states that no input excites: as large as a unit correction makes them
    still = states == 0.0
    if still.any():
        moved = np.sqrt(_power(plant.A, plant.Bu * corrections, n_samples))
        states = np.where(still, moved, states)
    return np.where(states == 0.0, 1.0, states)


storable(Design, Plant, Record, Stage, Scales)
_GROWN = {"inputs": "samples", "outputs": "samples"}


@dataclass(frozen=True, slots=True)
class Settings:
    """Numbers that shape one stage: n_c, p, mu and alpha."""

    order: int
    window: int
    markov: int
    learning_rate: float


@dataclass(frozen=True, slots=True, eq=False)
class Tuned:
    """Scaled model and designs of both stages for given scales."""

    scales: Scales
    plant: Plant
    designs: tuple[Design, Design]


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """State of a refiner between two calls.

    Parameters
    ----------
    stages : tuple of two Stage
        Both stages.
    peak, levels : ndarray of shape (1,), (3, n_y)
        Largest scaled output; mean squares of y, z1 and z2.
    recent_theta : ndarray of shape (average, m)
        Latest coefficients of stage 2, as a ring.
    inputs, outputs : ndarray of shape (K, n_w), (K, n_y)
        First samples, held back until they tell the scales; then empty.
    n_samples : int
        Samples taken, those held back included.
    tuned : Tuned or None
        None while samples are held back.
    """

    stages: tuple[Stage, Stage]
    peak: Array
    levels: Array
    recent_theta: Array
    inputs: Array
    outputs: Array
    n_samples: int
    tuned: Tuned | None

    def static_theta(self) -> Array:
        """Return the coefficients of stage 2, averaged over the latest samples.

        They include padding and are in scaled units.
        """
        # average over the samples learned, at most `static_average`
        learned = int(self.stages[1].counters[4])
        count = min(max(learned, 1), self.recent_theta.shape[0])
        return np.asarray(self.recent_theta[:count].mean(axis=0))

    def copied(self, n_samples: int) -> Memory:
        """Independent copy of what changes in place, for so many samples."""
        # dataclasses.replace takes as long as a stage
        rings = self.peak.copy(), self.levels.copy(), self.recent_theta.copy()
        stages = copied(self.stages[0]), copied(self.stages[1])
        return Memory(stages, *rings, self.inputs, self.outputs, n_samples, self.tuned)


def regressor_length(n: int, n_w: int, l_u: int, order: int) -> int:
    """Length of psi: (n_c + 1) (n + n_w) + n_c l_u."""
    return (order + 1) * (n + n_w) + order * l_u


def start(design: Design, n: int, n_w: int, window: int, memory: int) -> Stage:
    """Memory of a stage before the first sample: theta = 0, an empty window.

    Parameters
    ----------
    design : Design
        Settings of the stage.
    n, n_w : int
        Number of states and inputs.
    window : int
        Samples in the sliding window.
    memory : int
        Past samples that Markov parameters reach back to.
    """
    _, n_y, l_u = design.H.shape
    q = regressor_length(n, n_w, l_u, design.order)
    # length of vec(theta), padded
    m = -(-l_u * q // PADDING) * PADDING
    # theta = 0 and gain = (alpha I)^-1: only the regularization is known
    return Stage(
        theta=np.zeros(m),
        gain=np.eye(m) / design.alpha,
        pending=np.zeros((2, m)),
        rows=np.zeros((window * n_y, m)),
        offsets=np.zeros(window * n_y),
        psi=np.zeros(q),
        past_psi=np.zeros((memory, q)),
        past_u=np.zeros((memory, l_u)),
        x=np.zeros(n),
        energy=np.zeros(1),
        counters=np.zeros(5, dtype=np.int64),
    )


def copied(stage: Stage) -> Stage:
    """Independent copy, on which a block can fail without harm."""
    return Stage._make(map(np.ndarray.copy, stage))


def regressor_scale(states: Array, inputs: Array, corrections: Array, order: int) -> Array:
    """Units of psi from those of x, w and u."""
    return np.concatenate(
        [np.tile(states, order + 1), np.tile(inputs, order + 1), np.tile(corrections, order)]
    )


def in_units(theta: Array, scales: Scales, order: int) -> Array:
    """Return coefficients in the units of the signals.

    `theta` has shape (..., m) with padding, the result (..., l_u, l_psi).
    """
    # psi = [x(k) ... x(k - n_c); w(k) ... w(k - n_c); u(k - 1) ... u(k - n_c)]
    units = regressor_scale(scales.states, scales.inputs, scales.corrections, order)
    l_u, q = scales.corrections.size, units.size
    # u = theta psi in scaled units: multiply rows by the unit of u, divide columns by that of psi
    plain = theta[..., : l_u * q].reshape(*theta.shape[:-1], l_u, q)
    return plain * scales.corrections[:, None] / units


# Samples that tell the scales: a window, but no fewer and no more than this.
LEAST_WARM_UP, MOST_WARM_UP = 50, 100
# Signals that still grow are held back until there are this many times as many samples.
LONGEST_WARM_UP = 16


storable(Memory, Tuned)


@dataclass(frozen=True, slots=True, eq=False)
class Setup(Sampled):
    """Setup of the paper's stages before the first sample.

    Parameters
    ----------
    plant : Plant
        Discrete arrays with B_u and D_u, in the units of the signals.
    delay : int
        First Markov parameter that is not zero, d.
    settings : tuple of two Settings
        n_c, p, mu, alpha of both stages.
    estimated : bool
        Whether stage 2 sees the states of stage 1.
    average : int
        Samples that the static coefficients are averaged over.
    scales : Scales or None
        Declared scales.
    """

    plant: Plant
    delay: int
    settings: tuple[Settings, Settings]
    estimated: bool
    average: int
    scales: Scales | None

    @property
    def theta_shapes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Shapes (l_u, l_psi) of the coefficients of both stages."""
        n, n_w = self.plant.B.shape
        l_u = self.plant.Bu.shape[1]
        first, second = ((l_u, regressor_length(n, n_w, l_u, s.order)) for s in self.settings)
        return first, second

    def begin(self) -> Memory:
        """Memory before the first sample."""
        delay, n_w = self.delay, self.plant.B.shape[1]
        n_y, l_u = self.plant.Du.shape
        # past regressors as far back as the Markov parameters and the delay reach
        reach = delay + max(s.markov for s in self.settings)

        def empty(s: Settings) -> Stage:
            design = Design(np.zeros((s.markov, n_y, l_u)), delay, s.order, s.learning_rate)
            return start(design, self.plant.A.shape[0], n_w, s.window, reach)

        first, second = map(empty, self.settings)
        return Memory(
            stages=(first, second),
            # largest output so far over its scale
            peak=np.ones(1),
            levels=np.zeros((3, n_y)),
            recent_theta=np.zeros((self.average, second.theta.size)),
            inputs=np.zeros((0, n_w)),
            outputs=np.zeros((0, n_y)),
            n_samples=0,
            tuned=None if self.scales is None else self.tuned(self.scales),
        )

    def tuned(self, scales: Scales) -> Tuned:
        """Scale the model and cut the Markov parameters that each stage uses."""
        # Markov parameters of the scaled model from H_d on, mu of each stage
        scaled, delay = scaled_plant(self.plant, scales), self.delay
        values = markov_parameters(scaled, delay + max(s.markov for s in self.settings))
        first, second = (
            Design(np.ascontiguousarray(values[delay : delay + s.markov]), delay, s.order, s.learning_rate)
            for s in self.settings
        )
        return Tuned(scales, scaled, (first, second))

    def restored(self, found: Memory) -> Memory:
        """Return the memory from a file after checking it.

        It is checked against a fresh memory. What follows from the scales is computed again.

        Raises
        ------
        DataError
            If a refiner with these settings cannot have left it.
        """
        # shapes and types as before the first sample
        fresh = replace(self, scales=None).begin()
        check_like(replace(found, tuned=None), fresh, "memory", _GROWN)
        plant, n_y = self.plant, self.plant.C.shape[0]
        # samples wait only while the scales are unknown
        held = 0 if found.tuned else found.n_samples
        check_range(len(found.inputs), held, held, "inputs")
        check_range(found.peak, 1.0, np.inf, "peak")
        # counters stay within the window and the past that are kept
        for stage in found.stages:
            slots, recent = stage.rows.shape[0] // n_y, stage.past_u.shape[0]
            check_range(
                stage.counters, 0, [slots - 1, found.n_samples, 1, recent - 1, found.n_samples], "counters"
            )
        if found.tuned is None:
            return found
        scales = found.tuned.scales
        check_like(
            scales,
            Scales(*(np.ones(size) for size in (plant.B.shape[1], n_y, plant.A.shape[0], plant.Bu.shape[1]))),
            "scales",
        )
        for name in ("inputs", "outputs", "states", "corrections"):
            check_range(getattr(scales, name), np.finfo(float).tiny, np.finfo(float).max, f"scales.{name}")
        # the scaled model follows from the scales
        return replace(found, tuned=self.tuned(scales))

    def found_scales(self, inputs: Array, outputs: Array, before: int, last: bool) -> Scales | None:
        """Return the scales as soon as the samples determine them.

        They do not depend on how the stream is cut into blocks.
        """
        labels = (self.initial.input_labels, self.initial.output_labels)
        # the length doubles until the signals no longer grow
        count = warm_up(self.settings)
        longest = count * LONGEST_WARM_UP
        while count <= longest and count <= inputs.shape[0]:
            if count > before:
                w, y = inputs[:count].T, outputs[:count].T
                if count == longest or (is_settled(w) and is_settled(y)):
                    return measured_scales(self.plant, w, y, labels)
            count *= 2
        return measured_scales(self.plant, inputs.T, outputs.T, labels) if last else None


def warm_up(settings: tuple[Settings, Settings]) -> int:
    """Return the number of samples that determine the scales.

    It is the length of a window, within a lower and an upper limit.
    """
    return min(max(settings[0].window, LEAST_WARM_UP), MOST_WARM_UP)


def make_setup(
    model: Sampled,
    given: Mapping[str, Any],
    settings: tuple[Settings, Settings],
    estimated: bool,
    average: int,
) -> Setup:
    """Check the arguments of the paper's stages and prepare the model.

    `given` are the arguments of `RCORefiner`.
    """
    initial, discrete, step = model.initial, model.discrete, model.step
    # B_u and D_u, by default those of the inputs
    b_u, d_u = correction_path(initial, given)
    # the correction acts as a held input, too
    if initial.is_continuous and step is not None:
        b_u = discretize(initial.A, b_u, step)[1]
    arrays = (discrete.A, discrete.B, b_u, discrete.C, discrete.D, d_u)
    plant = Plant(*(np.ascontiguousarray(array) for array in arrays))
    # relative degree of the path u -> y, and each correction must act on an output
    delay = relative_degree(plant)
    column_delays(plant)
    scales = declared_scales(plant, given["scale"], warm_up(settings))
    return Setup(initial, discrete, step, plant, delay, settings, estimated, average, scales)


def as_settings(given: Mapping[str, Any], defaults: Mapping[str, Any]) -> tuple[Settings, Settings]:
    """Return the checked settings n_c, p, mu and alpha of both stages.

    Those of stage 2 default to those of stage 1.
    """

    def stage(prefix: str) -> Settings:
        # stage 2 takes the settings of stage 1 where it has none
        def first(name: str) -> Any:
            own = (one for n in (prefix + name, name) for one in (given[n], defaults.get(n)))
            return next((one for one in own if one is not None), None)

        return Settings(
            as_size(first("order"), f"{prefix}order", 0, "n_c"),
            as_size(first("window"), f"{prefix}window", 1, "p"),
            as_size(first("markov"), f"{prefix}markov", 1, "mu"),
            as_number(first("learning_rate"), f"{prefix}learning_rate (alpha)", above=0.0, error=ModelError),
        )

    return stage(""), stage("static_")


def correction_path(model: LinearModel, given: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return B_u and D_u in the timebase of the model.

    By default they are those of its inputs.
    """
    b_u, d_u, n_y = given["correction_input"], given["correction_feedthrough"], model.n_outputs
    acts = model.B if b_u is None else as_matrix(b_u, "correction_input (B_u)", model.n_states, None, "state")
    l_u = acts.shape[1]
    if d_u is not None:
        return acts, as_matrix(d_u, "correction_feedthrough (D_u)", n_y, l_u, "output")
    return acts, model.D if b_u is None else np.zeros((n_y, l_u))


# Samples of the impulse response that the first Markov parameter is compared with.
_SPAN = 50


def explain(
    plant: Plant, delay: int, markov: int, learning_rate: float, stage: int, where: str, largest: float
) -> str:
    """Message of a `DivergenceError`.

    Parameters
    ----------
    plant : Plant
        Scaled model.
    delay : int
        First Markov parameter that is not zero, d.
    markov, learning_rate : int, float
        mu and alpha of the stage.
    stage : {1, 2}
        Which stage.
    where : str
        Sample and time.
    largest : float
        Largest scaled measured output so far.
    """
    # the causes of divergence in the order of their frequency
    prefix = "" if stage == 1 else "static_"
    radius = float(np.abs(np.linalg.eigvals(plant.A)).max()) if plant.A.size else 0.0
    sentences = [
        f"stage {stage} diverged at {where}; the state before is readable.",
        _zeros(plant, f"{prefix}markov", markov),
        _place(plant, delay),
        f"Model: the initial model is unstable (largest |pole| = {radius:.6g}); start from a stable one."
        if radius > 1.0 + 1e-9
        else "",
        f"Scaling: {prefix}learning_rate is {learning_rate:g} in scaled units; raise it tenfold to learn "
        "more slowly.",
    ]
    if largest > 10.0:
        sentences.append(
            f"Outputs have grown to {largest:.3g} times their scale; declare scale={{...}} with the size "
            "that signals reach."
        )
    return " ".join(sentence for sentence in sentences if sentence)


def _zeros(plant: Plant, markov_name: str, markov: int) -> str:
    try:
        zeros = path_zeros(plant)
    except np.linalg.LinAlgError:  # numbers hundreds of decades apart
        return "Zeros: those of the path from the correction to the outputs cannot be computed."
    # retrospective cost inverts the path: zeros outside the unit circle become unstable poles
    outside = zeros[np.abs(zeros) >= 1.0 - 1e-9]
    if not outside.size:
        largest = float(np.abs(zeros).max()) if zeros.size else 0.0
        return (
            "Zeros: those of the path from the correction to the outputs lie inside the unit circle "
            f"(largest |z| = {largest:.4g}), so they are not the cause by themselves."
        )
    worst = outside[np.argmax(np.abs(outside))]
    value = f"{worst.real:.4g}" if abs(worst.imag) < 1e-9 * abs(worst) else f"{worst:.4g}"
    return (
        f"Zeros: the path from the correction to the outputs has {outside.size} zero(s) on or outside the "
        f"unit circle (largest at {value}, |z| = {abs(worst):.4g}), which the method tries to invert unless "
        f"the Markov parameters show them. Raise {markov_name} (now {markov}, up to the length of the "
        "impulse response), or bring correction_input and sensor closer together."
    )


def _place(plant: Plant, delay: int) -> str:
    # first Markov parameter against the largest one
    values = np.abs(markov_parameters(plant, delay + _SPAN)).max(axis=(1, 2))
    share = float(values[delay] / values.max())
    if delay <= 1 and share >= 0.1:
        return (
            "Place: the correction shows in the outputs at once; if it acts elsewhere in the true system, "
            "choose another correction_input."
        )
    return (
        f"Place: a correction shows first after {delay} sample(s), with {share:.2g} of its largest effect; "
        "let correction_input act closer to a sensor, or sample more slowly."
    )
