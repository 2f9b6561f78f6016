"""Both stages by the paper's equations, as an estimator of the refiner.

Samples are held back until the scales are known.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...exceptions import DataError, DivergenceError, ModelError, RCOError
from ...systems.conversion import nearest_continuous
from ...systems.linear import Array, LinearModel
from ..history import History, Summary, joined, pole_samples, poles_of
from ..persistence import check_course
from ..samples import Block
from .kernels import Plant, Record, advance
from .setup import Memory, Scales, Setup, explain, in_units, regressor_scale, warm_up


class Diverged(DivergenceError):
    """Divergence.

    `sound` holds the memory before these samples, and the inputs and outputs before the divergence.
    """

    def __init__(self, message: str, sound: Any = None) -> None:  # None: unpickled
        super().__init__(message)
        self.sound = sound


Taken = tuple[Memory, list[tuple[Record, Array]]]  # memory after some samples, and their course


def _unavailable(what: str) -> Any:
    """Property that the paper's coefficients do not have."""

    def refuse(self: Any) -> None:
        raise RCOError(
            f"{what} belong to the joint filter; leave out window, markov and static_..., or name "
            "effects=[...] (static_theta has the paper's coefficients)"
        )

    return property(refuse)


class PaperStages:
    """Retrospective cost optimization in two stages, equations (23) to (46).

    Parameters
    ----------
    setup : Setup
        Model and settings.
    keep : bool
        Whether to keep the course of every sample.
    """

    def __init__(self, setup: Setup, keep: bool) -> None:
        self.setup, self.keep = setup, keep
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        s = self.setup
        try:
            self.memory: Memory = s.begin()
        except MemoryError as error:
            raise ModelError(
                f"order, window, markov and static_average need more memory than there is: {error}; "
                "choose smaller ones"
            ) from error
        self.records: list[tuple[Record, Array]] = []

    @property
    def n_samples(self) -> int:
        """Samples taken."""
        return self.memory.n_samples

    @property
    def n_learned(self) -> int:
        """Samples learned from."""
        return self.memory.n_samples - len(self.memory.inputs)

    def take(self, block: Block, *, keep_sound: bool = False) -> None:
        """Learn from a block completely or not at all.

        With `keep_sound`, keep what came before a divergence.
        """
        # gaps: stretch by stretch, with the simulated output in the place of the missing one
        if block.whole:
            self._take(block.inputs, block.outputs, keep_sound)
        else:
            self._commit(self._over_gaps(block))

    def finish(self) -> None:
        """Learn from what is still held back for the scales, however short."""
        memory = self.memory
        if memory.tuned is None:
            self._take(memory.inputs[:0], memory.outputs[:0], True, last=True)

    def _take(self, inputs: Array, outputs: Array, keep_sound: bool, last: bool = False) -> None:
        try:
            self._commit(self._after(self.memory, inputs, outputs, last))
        # a record keeps what came before a divergence, a stream takes all of a block or nothing
        except Diverged as error:
            if keep_sound:
                memory, inputs, outputs = error.sound
                self._commit(self._run_stages(memory, inputs, outputs, self.keep))
            raise

    def _commit(self, taken: Taken) -> None:
        self.memory, records = taken
        self.records += records

    def _after(self, memory: Memory, inputs: Array, outputs: Array, last: bool = False) -> Taken:
        """Return the memory after some samples, and their course.

        The memory given stays as it is. Samples are held back until their rms gives the scales,
        or until the record ends (`last`).
        """
        if memory.tuned is None:
            held, n_samples = len(memory.inputs), memory.n_samples + len(inputs)
            inputs = np.concatenate([memory.inputs, inputs])
            outputs = np.concatenate([memory.outputs, outputs])
            scales = self.setup.found_scales(inputs, outputs, held, last)
            if scales is None:
                return replace(memory, inputs=inputs, outputs=outputs, n_samples=n_samples), []
            # scales known: design both stages; the waiting samples are learned now
            memory = replace(
                memory, inputs=inputs[:0].copy(), outputs=outputs[:0].copy(), tuned=self.setup.tuned(scales),
                n_samples=n_samples - len(inputs),
            )  # fmt: skip
        return self._run_stages(memory, inputs, outputs, self.keep)

    def _run_stages(self, before: Memory, inputs: Array, outputs: Array, keep: bool) -> Taken:
        """Run both stages over samples.

        They change a copy: an error leaves the memory as it was.
        """
        setup, count, n_y = self.setup, len(inputs), outputs.shape[1]
        memory = before.copied(before.n_samples + count)
        assert memory.tuned is not None
        scales, plant, stages = memory.tuned.scales, memory.tuned.plant, memory.stages
        # record only where a history is kept
        widths = n_y, n_y, *(stage.theta.size for stage in stages), len(plant.A)
        record = Record(*(np.empty((count if keep else 0, width)) for width in widths))
        # both stages on scaled signals, in compiled code
        with np.errstate(all="ignore"):  # a divergence is reported below, in words
            done, stage = advance(
                plant, *memory.tuned.designs, *stages, memory.peak, memory.levels, memory.recent_theta,
                inputs / scales.inputs, outputs / scales.outputs, setup.estimated, record,
            )  # fmt: skip
        # a stage diverged: say where and why
        if stage:
            sample, settings = before.n_samples + done, setup.settings[stage - 1]
            time = "" if setup.step is None else f" (t = {sample * setup.step:.6g} s)"
            message = explain(
                plant, setup.delay, settings.markov, settings.learning_rate, stage, f"sample {sample}{time}",
                float(memory.peak[0]),
            )  # fmt: skip
            raise Diverged(message, (before, inputs[:done], outputs[:done]))
        if not keep:
            return memory, []
        # back to the units of the signals
        z1, z2 = record.z1 * scales.outputs, record.z2 * scales.outputs
        theta1, theta2 = (
            in_units(theta, scales, stage.order)
            for theta, stage in zip((record.theta1, record.theta2), setup.settings, strict=True)
        )
        return memory, [(Record(z1, z2, theta1, theta2, record.x * scales.states), outputs.copy())]

    def _over_gaps(self, block: Block) -> Taken:
        """Take one stretch of samples after another, gaps included.

        In a gap the output of stage 1 replaces the measured one. So its performance is zero there
        and nothing changes.
        """
        memory, records = self.memory, []
        # stretches between gaps
        complete = np.asarray(block.use.all(axis=1))
        position, total = 0, complete.size
        while position < total:
            ahead = np.flatnonzero(complete[position:] != complete[position])
            stop = position + (int(ahead[0]) if ahead.size else total - position)
            # samples with a gap go one by one: each needs the simulated output of its own time
            if not complete[position]:
                stop = position + 1
            inputs, outputs = block.inputs[position:stop], block.outputs[position:stop].copy()
            if not complete[position]:
                gap = block.use[position] == 0
                outputs[0, gap] = self._simulated_output(memory, inputs, outputs)[gap]
            memory, more = self._after(memory, inputs, outputs)
            records += more
            position = stop
        return memory, records

    def _simulated_output(self, memory: Memory, inputs: Array, outputs: Array) -> Array:
        """Output of stage 1 at the next sample, before it has learned from it."""
        # simulated output of stage 1: performance plus what was given as the output
        if memory.tuned is not None:
            ((record, _),) = self._run_stages(memory, inputs, outputs, True)[1]
            return np.asarray(record.z1[0] + outputs[0])
        # before the scales are known: hold the last output
        if memory.outputs.shape[0] == 0:
            raise DataError(
                "an output is missing at the first sample, before anything can stand in for it; "
                "start at a sample that is whole"
            )
        return np.asarray(memory.outputs[-1])

    # -- results -------------------------------------------------------------------------------------

    @property
    def scales(self) -> Scales | None:
        """Sizes that signals are divided by, None while they are not known yet."""
        return None if self.memory.tuned is None else self.memory.tuned.scales

    def theta(self, stage: int) -> Array:
        """Return the coefficients of a stage in the units of the signals.

        Stage 0 is dynamic, stage 1 is static.
        """
        memory = self.memory
        if memory.tuned is None:
            return np.zeros(self.setup.theta_shapes[stage])
        # dynamic coefficients of this sample; static ones averaged
        theta = memory.stages[0].theta if stage == 0 else memory.static_theta()
        return in_units(theta, memory.tuned.scales, self.setup.settings[stage].order)

    form = "paper"

    @property
    def static(self) -> PaperStages:
        """The static stage."""
        return self

    filter = static

    scores, parameters, covariance = map(_unavailable, ("scores", "parameters", "covariance"))

    def dynamic_theta(self) -> Array:
        """Coefficients of stage 1."""
        return self.theta(0)

    def static_theta(self) -> Array:
        """Static coefficients."""
        return self.theta(1)

    def standard_deviations(self) -> Array:
        """Return the standard deviations of the static coefficients.

        They are the scatter over the samples that the coefficients are averaged over.
        """
        memory = self.memory
        # scatter needs two samples
        learned = min(int(memory.stages[1].counters[4]), memory.recent_theta.shape[0])
        if memory.tuned is None or learned < 2:
            return np.full(self.setup.theta_shapes[1], np.inf)
        scatter = memory.recent_theta[:learned].std(axis=0, ddof=1)
        return np.abs(in_units(scatter, memory.tuned.scales, self.setup.settings[1].order))

    def deviation(self) -> None:
        """The paper's coefficients have no covariance."""
        return None

    def discrete_system(self, name: str) -> LinearModel:
        """Refined model in discrete time."""
        # A + B_u theta_x, B + B_u theta_w, C + D_u theta_x, D + D_u theta_w
        s = self.setup
        return refined(s.discrete, s.plant, self.theta(1), s.settings[1].order, name)

    def system(self, name: str) -> LinearModel:
        """Refined model, continuous where the initial one is."""
        initial = self.setup.initial
        if not initial.is_continuous:
            return self.discrete_system(name)
        # theta = 0: the initial model, without a conversion
        if not self.theta(1).any():
            return initial.with_arrays(name=name)
        return nearest_continuous(self.discrete_system(name))

    def predict(self, inputs: Array) -> Array:
        """Free run on further inputs of shape (N, n_w); outputs of shape (n_y, N)."""
        model, x = self.discrete_system(""), self._present_state()
        outputs = np.empty((model.n_outputs, len(inputs)))
        # free run of the refined model
        with np.errstate(over="ignore", invalid="ignore"):
            for k, w in enumerate(inputs):
                outputs[:, k] = model.C @ x + model.D @ w
                x = model.A @ x + model.B @ w
        return outputs

    def history(self) -> History:
        """Course of both stages."""
        s = self.setup
        # join the blocks, samples last
        z1, z2, theta1, theta2, x = (
            joined([record[i] for record, _ in self.records], shape) for i, shape in enumerate(self._shapes)
        )
        timepts = np.arange(z1.shape[1], dtype=np.float64) * (1.0 if s.step is None else s.step)
        # poles of the refined model, where the correction is static
        at = pole_samples(timepts.size if s.settings[1].order == 0 else 0)
        systems = [refined(s.discrete, s.plant, theta2[:, :, k], 0, "") for k in at]
        return History(
            timepts=timepts,
            z1=z1,
            z2=z2,
            theta1=theta1,
            theta2=theta2,
            x=x,
            y=joined([y for _, y in self.records], (s.initial.n_outputs,)),
            input_labels=s.initial.input_labels,
            output_labels=s.initial.output_labels,
            state_labels=s.initial.state_labels,
            pole_timepts=timepts[at],
            poles=poles_of(systems, s.step),
        )

    @property
    def _shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shape of one sample of each part of a `Record`."""
        outputs = (self.setup.initial.n_outputs,)
        return outputs, outputs, *self.setup.theta_shapes, (self.setup.initial.n_states,)

    def summary(self) -> Summary:
        """Cells and sentences of `str`."""
        s, model = self.setup, self.setup.initial
        # settings of both stages, then their performance
        rows = [
            ["order n_c", *(f"{stage.order}" for stage in s.settings)],
            ["window p [samples]", *(f"{stage.window}" for stage in s.settings)],
            [f"Markov parameters mu, from H_{s.delay}", *(f"{stage.markov}" for stage in s.settings)],
            ["learning rate alpha [scaled units]", *(f"{stage.learning_rate:g}" for stage in s.settings)],
            ["coefficients", *(f"{rows * columns}" for rows, columns in s.theta_shapes)],
        ]
        if self.n_learned:
            # performance over the rms of the measured output
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.sqrt(self.memory.levels[1:] / self.memory.levels[0])
            for label, column in zip(model.output_labels[:3], share.T, strict=False):
                rows.append([f"performance at {label} / its rms", *(f"{value:.3g}" for value in column)])
        channels = f"{model.n_states} states, {model.n_inputs} in, {model.n_outputs} out"
        timing = "" if s.step is None else f", dt = {s.step:g} s"
        title = f"RCORefiner of {model.name!r}: {channels}, {s.theta_shapes[0][0]} correction(s){timing}"
        return Summary(title, ["setting", "stage 1", "stage 2"], rows, self._notes())

    def _notes(self) -> list[str]:
        memory, model = self.memory, self.setup.initial
        if memory.tuned is None:
            held = memory.inputs.shape[0]
            return [
                f"{memory.n_samples} samples taken, {held} held back until the size of the signals is known. "
                "The refined model is still the initial one."
            ]
        notes = [f"{self.n_learned} samples learned."]
        if self.n_learned:
            notes.append(
                "Performance: rms of simulated minus measured output over about the last "
                f"{self.setup.settings[0].window} samples (0 is perfect). "
                + (
                    "Stage 1 follows the output with a dynamic correction and so estimates the states. "
                    "Stage 2 predicts the output from these states with the refined model."
                    if self.setup.estimated
                    else "Stage 1 does not run: its column shows the initial model. "
                    "Stage 2 uses its own states."
                )
            )
        # scale of each signal
        scales = memory.tuned.scales
        sizes = [
            f"{label} {size:.3g}"
            for label, size in zip(
                (*model.input_labels, *model.output_labels), (*scales.inputs, *scales.outputs), strict=True
            )
        ]
        shown = ", ".join(sizes[:6]) + (", ..." if len(sizes) > 6 else "")
        notes.append(f"Scaled units: signals are divided by their size ({shown}), so alpha has no unit.")
        if memory.peak[0] > 30.0:
            notes.append(
                f"Caution: an output has reached {memory.peak[0]:.3g} times its scale, so alpha has less "
                "weight than intended. Declare scale={...} if this is not an outlier."
            )
        return notes

    def state(self) -> dict[str, Any]:
        """All that is remembered, for a file."""
        return {"memory": self.memory, "records": self.records}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave, once it was held against a fresh memory."""
        s = self.setup
        # an empty record with the shapes of this model
        rows = Record(*(np.zeros((0, *shape)) for shape in self._shapes))
        check_course(state["records"], rows, s.initial.n_outputs)
        self.memory = s.restored(state["memory"])
        self.records = state["records"]

    def _present_state(self) -> Array:
        """Return the state of the refined model after the last sample.

        It is in the units of the states.
        """
        memory, s = self.memory, self.setup
        order = s.settings[1].order
        n, n_w, l_u = s.initial.n_states, s.initial.n_inputs, s.plant.Bu.shape[1]
        # nothing learned: simulate the initial model over the samples that wait
        if memory.tuned is None:
            if order > 0:
                raise ModelError(
                    "predict with static_order > 0 needs the scales: it works once the first "
                    f"{warm_up(s.settings)} samples are learned, or with scale={{...}} declared"
                )
            x = np.zeros(n)
            for w in memory.inputs:
                x = s.plant.A @ x + s.plant.B @ w
            return x
        scales, stage = memory.tuned.scales, memory.stages[1]
        # static correction: the state of the model is all
        x = memory.stages[0 if s.estimated else 1].x * scales.states
        if order == 0:
            return x
        # correction with memory: past x, w and u from the regressor, in units
        psi = stage.psi * regressor_scale(scales.states, scales.inputs, scales.corrections, order)
        first_w, first_u = (order + 1) * n, (order + 1) * (n + n_w)
        latest = stage.past_u[stage.counters[3]] * scales.corrections
        past_u = np.concatenate([latest, psi[first_u : first_u + (order - 1) * l_u]])
        return np.concatenate([x, psi[: order * n], psi[first_w : first_w + order * n_w], past_u])


def refined(model: LinearModel, plant: Plant, theta: Array, order: int, name: str) -> LinearModel:
    """Close the loop u = theta psi around the discrete model.

    Parameters
    ----------
    model : LinearModel
        Discrete initial model, for labels and timebase.
    plant : Plant
        Its arrays with B_u and D_u.
    theta : ndarray
        Coefficients in physical units, shape (l_u, l_psi).
    order : int
        n_c of the static stage; with 0 the model keeps its n states (the
        paper's (44): A + B_u theta_x, B + B_u theta_w).
    name : str
        Name of the refined system.
    """
    # static feedback u = theta_x x + theta_w w
    n, n_w = plant.B.shape
    if order > 0:
        return with_lags(model, plant, theta, order, name)
    on_x, on_w = theta[:, :n], theta[:, n : n + n_w]
    # B_u feeds it into the states, D_u into the outputs
    return model.with_arrays(
        A=plant.A + plant.Bu @ on_x,
        B=plant.B + plant.Bu @ on_w,
        C=plant.C + plant.Du @ on_x,
        D=plant.D + plant.Du @ on_w,
        name=name,
    )


def with_lags(model: LinearModel, plant: Plant, theta: Array, order: int, name: str) -> LinearModel:
    """Close the loop with a correction that has memory.

    The states are x and the past n_c samples of x, w and u.
    """
    n, n_w = plant.B.shape
    l_u = plant.Bu.shape[1]
    first_w, first_u = (order + 1) * n, (order + 1) * (n + n_w)
    on_x, on_w, on_u = theta[:, :first_w], theta[:, first_w:first_u], theta[:, first_u:]
    # u = K [x; past x; past w; past u] + L w
    gain = np.hstack([on_x, on_w[:, n_w:], on_u])
    feed = on_w[:, :n_w]
    size = gain.shape[1]
    # augmented state [x; past x; past w; past u]
    a, b = np.zeros((size, size)), np.zeros((size, n_w))
    a[:n, :n], b[:n] = plant.A, plant.B
    a[:n] += plant.Bu @ gain
    b[:n] += plant.Bu @ feed
    # shift registers for the past
    _shift(a, n, 0, n, order)  # x(k) enters its own past
    past_w, past_u = first_w, first_w + order * n_w
    b[past_w : past_w + n_w] = np.eye(n_w)
    _shift(a, past_w + n_w, past_w, n_w, order - 1)
    a[past_u : past_u + l_u], b[past_u : past_u + l_u] = gain, feed
    _shift(a, past_u + l_u, past_u, l_u, order - 1)
    # outputs: C x + D_u u
    c = np.hstack([plant.C, np.zeros((plant.C.shape[0], size - n))]) + plant.Du @ gain
    labels = list(model.state_labels)
    for names, count in ((model.state_labels, n), (model.input_labels, n_w), (("correction",), l_u)):
        for lag in range(1, order + 1):
            labels += [f"{names[i % len(names)]}[{i}](k-{lag})" for i in range(count)]
    return model.with_arrays(
        A=a, B=b, C=c, D=plant.D + plant.Du @ feed, state_labels=tuple(labels), name=name
    )


def _shift(a: Array, to: int, source: int, width: int, times: int) -> None:
    """Copy `times` blocks of `width` states one place on."""
    count = width * times
    a[to : to + count, source : source + count] += np.eye(count)
