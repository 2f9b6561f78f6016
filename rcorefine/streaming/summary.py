"""A refiner in words and figures, and its history put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..systems.linear import Array, LinearModel
from .rcmr.arrays import Record
from .rcmr.history import History
from .rcmr.memory import Memory, Settings

if TYPE_CHECKING:
    from .coefficients.estimator import CoefficientFilter
    from .filter_bank import FilterBank

__all__ = [
    "Summary",
    "assemble_history",
    "summarize",
    "summarize_coefficients",
    "summarize_race",
]


@dataclass(frozen=True, slots=True)
class Summary:
    """Cells of the table and the sentences around it."""

    title: str
    headers: list[str]
    rows: list[list[str]]
    notes: list[str]


def assemble_history(
    records: Sequence[tuple[Record, Array]],
    model: LinearModel,
    step: float | None,
    shapes: tuple[tuple[int, int], tuple[int, int]],
) -> History:
    """Join the blocks, time last."""

    def joined(blocks: list[Array], shape: tuple[int, ...]) -> Array:
        if not blocks:
            return np.zeros((*shape, 0))
        return np.ascontiguousarray(np.moveaxis(np.concatenate(blocks), 0, -1))

    outputs = joined([y for _, y in records], (model.n_outputs,))
    return History(
        timepts=np.arange(outputs.shape[1], dtype=np.float64) * (1.0 if step is None else step),
        z1=joined([r.z1 for r, _ in records], (model.n_outputs,)),
        z2=joined([r.z2 for r, _ in records], (model.n_outputs,)),
        theta1=joined([r.theta1 for r, _ in records], shapes[0]),
        theta2=joined([r.theta2 for r, _ in records], shapes[1]),
        x=joined([r.x for r, _ in records], (model.n_states,)),
        y=outputs,
        input_labels=model.input_labels,
        output_labels=model.output_labels,
        state_labels=model.state_labels,
    )


def summarize(
    model: LinearModel,
    step: float | None,
    settings: tuple[Settings, Settings],
    delay: int,
    shapes: tuple[tuple[int, int], tuple[int, int]],
    memory: Memory,
    learned: int,
    estimated: bool,
) -> Summary:
    """Collect what `str(refiner)` shows."""
    rows = [
        ["order n_c", *(f"{s.order}" for s in settings)],
        ["window p [samples]", *(f"{s.window}" for s in settings)],
        [f"Markov parameters mu, from H_{delay}", *(f"{s.markov}" for s in settings)],
        ["learning rate alpha [scaled units]", *(f"{s.learning_rate:g}" for s in settings)],
        ["coefficients", *(f"{rows * columns}" for rows, columns in shapes)],
    ]
    if learned:
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.sqrt(memory.levels[1:] / memory.levels[0])
        for index, label in enumerate(model.output_labels[:3]):
            rows.append([f"performance at {label} / its rms", *(f"{value:.3g}" for value in share[:, index])])
    channels = f"{model.n_states} states, {model.n_inputs} in, {model.n_outputs} out"
    timing = "" if step is None else f", dt = {step:g} s"
    title = f"RCORefiner of {model.name!r}: {channels}, {shapes[0][0]} correction(s){timing}"
    return Summary(
        title, ["setting", "stage 1", "stage 2"], rows, _notes(model, settings, memory, learned, estimated)
    )


def _notes(
    model: LinearModel, settings: tuple[Settings, Settings], memory: Memory, learned: int, estimated: bool
) -> list[str]:
    if memory.tuned is None:
        held = memory.inputs.shape[0]
        return [
            f"{memory.n_samples} samples taken, {held} held back until the size of the signals is known. "
            "The refined model is still the initial one."
        ]
    notes = [f"{learned} samples learned."]
    if learned:
        notes.append(
            f"Performance: rms of simulated minus measured output over about the last {settings[0].window} "
            "samples (0 is perfect). "
            + (
                "Stage 1 follows the output with a dynamic correction and so estimates the states. Stage 2 "
                "predicts the output from these states with the refined model."
                if estimated
                else "Stage 1 does not run: its column shows the initial model. Stage 2 uses its own states."
            )
        )
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
            f"Caution: an output has reached {memory.peak[0]:.3g} times its scale, so alpha has less weight "
            "than intended. Declare scale={...} if this is not an outlier."
        )
    return notes


def summarize_coefficients(model: LinearModel, part: CoefficientFilter, stopped: str) -> Summary:
    """Collect what `str(refiner)` shows of one filter for coefficients."""
    setup = part.setup
    title = f"RCORefiner of {model.name!r}: {len(setup.labels)} coefficients, dt = {setup.settings.dt:g} s"
    notes = [
        f"{part.memory.n_samples} samples taken; the model was discretized {part.memory.discretized} times.",
        *_of_coefficients(model, part),
    ]
    if stopped:
        notes.append(stopped.split(";")[0] + "; the static stage does not need it.")
    return Summary(title, _PARAMETERS, part.rows(), notes)


def summarize_race(model: LinearModel, race: FilterBank, stopped: str) -> Summary:
    """Collect what `str(refiner)` shows of several competing forms."""
    (form, grows), memory = race.chosen, race.memory
    part = race.filters[form]
    dt = part.setup.settings.dt
    title = f"RCORefiner of {model.name!r}: form {form!r} of the static stage, dt = {dt:g} s"
    notes = [f"{memory.n_samples} samples taken."]
    if memory.scores:
        shown = ", ".join(
            f"{name.rstrip('!')}{' (unstable)' if name.endswith('!') else ''} {100 - 100 * score**0.5:.4g} %"
            for name, score in memory.scores.items()
        )
        notes.append(
            f"Chosen by the fit of each form's simulation (free run) over {memory.length} held-out "
            f"samples: {shown}."
        )
    else:
        notes.append("No form has been compared yet: the refined model is the initial one.")
    if grows:
        notes.append("The refined model is unstable, and the data clearly support this.")
    notes += [f"{name} {why}; it is no longer compared." for name, why in memory.stopped.items()]
    if form != "initial":
        notes += _of_coefficients(model, part)
    if stopped:
        notes.append(stopped.split(";")[0] + "; the static stage does not need it.")
    return Summary(title, _PARAMETERS, part.rows(), notes)


_PARAMETERS = ["parameter", "effect", "place", "initial", "value", "std", "unit"]


def _of_coefficients(model: LinearModel, part: CoefficientFilter) -> list[str]:
    if part.memory.rounds == 0:
        return ["The first samples are held back until the size of the signals is known."]
    levels = ", ".join(
        f"{label} {level:.3g}" for label, level in zip(model.output_labels, part.noise, strict=True)
    )
    return [
        "std is the standard deviation of the value at this sample, for white innovations. "
        f"Prediction error one sample ahead (rms): {levels}.",
        *part.cautions(),
    ]
