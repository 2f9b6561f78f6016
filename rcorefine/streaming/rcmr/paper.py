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
from .setup import Memory, Scales, Setup, Tuned, explain, in_units, regressor_scale


class Diverged(DivergenceError):
    """Divergence after `done` sound samples.

    Samples that were held back are included. `found` holds the scales.
    """

    def __init__(self, message: str, done: int = 0, found: Tuned | None = None) -> None:
        super().__init__(message)
        self.done = done
        self.found = found


def take(
    setup: Setup, memory: Memory, inputs: Array, outputs: Array, *, keep: bool = False, last: bool = False
) -> tuple[Memory, Record | None, Array]:
    """Memory after some samples, and what they leave behind for a history.

    Parameters
    ----------
    setup, memory
        The refiner; `memory` stays as it is.
    inputs, outputs : ndarray of shape (N, n_w), (N, n_y)
        Samples.
    keep : bool
        Whether to record every sample.
    last : bool
        Whether the record ends here, so that no sample is held back.

    Raises
    ------
    Diverged
        If a correction diverges.
    """
    n_samples = memory.n_samples + inputs.shape[0]
    # hold samples back until their rms gives the scales
    if memory.tuned is None:
        inputs = np.concatenate([memory.inputs, inputs])
        outputs = np.concatenate([memory.outputs, outputs])
        scales = setup.found_scales(inputs, outputs, memory.inputs.shape[0], last)
        if scales is None:
            waiting = replace(memory, inputs=inputs, outputs=outputs, n_samples=n_samples)
            return waiting, None, outputs[:0]
        # scales known: design both stages; the waiting samples are learned now
        memory = replace(
            memory,
            inputs=inputs[:0].copy(),
            outputs=outputs[:0].copy(),
            tuned=setup.tuned(scales),
        )
    # work on a copy: an error leaves the memory as it was
    memory = memory.copied(n_samples)
    record = _run_stages(setup, memory, inputs, outputs, n_samples - inputs.shape[0], keep)
    return memory, record, outputs


def take_until(
    setup: Setup, memory: Memory, inputs: Array, outputs: Array, error: Diverged, *, keep: bool = False
) -> tuple[Memory, Record | None, Array]:
    """Take the samples that were sound before these diverged."""
    # the block again, up to the sample before the divergence
    inputs = np.concatenate([memory.inputs, inputs])[: error.done]
    outputs = np.concatenate([memory.outputs, outputs])[: error.done]
    memory = replace(
        memory,
        inputs=inputs[:0].copy(),
        outputs=outputs[:0].copy(),
        n_samples=memory.n_samples - len(memory.inputs),
        tuned=error.found,
    )
    return take(setup, memory, inputs, outputs, keep=keep)


def _run_stages(
    setup: Setup, memory: Memory, inputs: Array, outputs: Array, first: int, keep: bool
) -> Record | None:
    """Run both stages over the block in place.

    With `keep`, return the history of every sample.
    """
    assert memory.tuned is not None
    scales, plant, designs = memory.tuned.scales, memory.tuned.plant, memory.tuned.designs
    stages = memory.stages
    # record only where a history is kept
    kept = inputs.shape[0] if keep else 0
    record = Record(
        z1=np.empty((kept, outputs.shape[1])),
        z2=np.empty((kept, outputs.shape[1])),
        theta1=np.empty((kept, stages[0].theta.size)),
        theta2=np.empty((kept, stages[1].theta.size)),
        x=np.empty((kept, plant.A.shape[0])),
    )
    # both stages on scaled signals, in compiled code
    with np.errstate(all="ignore"):  # a divergence is reported below, in words
        done, stage = advance(
            plant,
            *designs,
            *stages,
            memory.peak,
            memory.levels,
            memory.recent_theta,
            inputs / scales.inputs,
            outputs / scales.outputs,
            setup.estimated,
            record,
        )
    # a stage diverged: say where and why
    if stage:
        raise Diverged(_divergence_message(setup, memory, first + done, stage), done, memory.tuned)
    if not keep:
        return None
    # back to the units of the signals
    return Record(
        record.z1 * scales.outputs,
        record.z2 * scales.outputs,
        in_units(record.theta1, scales, setup.settings[0].order),
        in_units(record.theta2, scales, setup.settings[1].order),
        record.x * scales.states,
    )


def _divergence_message(setup: Setup, memory: Memory, sample: int, stage: int) -> str:
    assert memory.tuned is not None
    settings = setup.settings[stage - 1]
    # sample number and time
    time = "" if setup.step is None else f" (t = {sample * setup.step:.6g} s)"
    return explain(
        memory.tuned.plant,
        setup.delay,
        settings.markov,
        settings.learning_rate,
        stage,
        f"sample {sample}{time}",
        float(memory.peak[0]),
    )


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
        if not block.whole:
            self.memory, records = take_over_gaps(self.setup, self.memory, block, keep=self.keep)
            self.records += records
            return
        self._take(block.inputs, block.outputs, keep_sound, last=False)

    def finish(self) -> None:
        """Learn from what is still held back for the scales, however short."""
        if self.memory.tuned is None:
            s = self.setup
            self._take(np.zeros((0, s.initial.n_inputs)), np.zeros((0, s.initial.n_outputs)), True, last=True)

    def _take(self, inputs: Array, outputs: Array, keep_sound: bool, last: bool) -> None:
        try:
            self._commit(take(self.setup, self.memory, inputs, outputs, keep=self.keep, last=last))
        # a record keeps what came before a divergence, a stream takes all of a block or nothing
        except Diverged as error:
            if keep_sound:
                self._commit(take_until(self.setup, self.memory, inputs, outputs, error, keep=self.keep))
            raise

    def take_sound(self, inputs: Array, outputs: Array) -> None:
        """Learn from samples of shape (N, .) without gaps.

        Samples before a divergence are kept.
        """
        self._take(inputs, outputs, True, last=False)

    def _commit(self, taken: tuple[Memory, Record | None, Array]) -> None:
        self.memory, record, outputs = taken
        if self.keep and record is not None:
            self.records.append((record, outputs.copy()))

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

    @property
    def scores(self) -> dict[str, float]:
        """No forms compete."""
        raise _unavailable("scores")

    @property
    def parameters(self) -> tuple[Any, ...]:
        """The paper's coefficients are no parameters."""
        raise _unavailable("parameters")

    @property
    def covariance(self) -> Array:
        """The paper's coefficients have none."""
        raise _unavailable("covariance")

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
                    f"{s.warm_up} samples are learned, or with scale={{...}} declared"
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


def _unavailable(what: str) -> RCOError:
    return RCOError(
        f"{what} belong to the joint filter; leave out window, markov and static_..., or name "
        "effects=[...] (static_theta has the paper's coefficients)"
    )


def take_over_gaps(
    setup: Setup, memory: Memory, block: Block, *, keep: bool = False
) -> tuple[Memory, list[tuple[Record, Array]]]:
    """Take one stretch of samples after another, gaps included.

    In a gap the output of stage 1 replaces the measured one. So its performance is zero there
    and nothing changes.
    """
    records: list[tuple[Record, Array]] = []
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
            outputs[0, gap] = _simulated_output(setup, memory, inputs, outputs)[gap]
        memory, record, learned = take(setup, memory, inputs, outputs, keep=keep)
        if keep and record is not None:
            records.append((record, learned.copy()))
        position = stop
    return memory, records


def _simulated_output(setup: Setup, memory: Memory, inputs: Array, outputs: Array) -> Array:
    """Output of stage 1 at the next sample, before it has learned from it."""
    # before the scales are known: hold the last output
    if memory.tuned is None:
        if memory.outputs.shape[0] == 0:
            raise DataError(
                "an output is missing at the first sample, before anything can stand in for it; "
                "start at a sample that is whole"
            )
        return np.asarray(memory.outputs[-1])
    # simulated output of stage 1: performance plus what was given as the output
    _, record, _ = take(setup, memory, inputs, outputs, keep=True)
    assert record is not None
    return np.asarray(record.z1[0] + outputs[0])


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
