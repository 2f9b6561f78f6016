"""The loop on one example, told as it runs: what `rcorefine demo` does."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from rcorefine import (
    Comparison,
    Diagnosis,
    Effect,
    Improvement,
    Measurement,
    PhysicalModel,
    compare,
    diagnose,
    improve,
    mass_spring_damper,
    simulate,
)

from ..jit import NUMBA
from ..writing import replacing

N_SAMPLES, DT = 2000, 0.01
NOISE = 0.03
TRAINING = 0.7
FRICTION, LOSS = 0.5, -20.0  # what the model lacks at link2 [N], and later at link3 [N/m]
LAWS = ("stiffness", "damping", "cubic_stiffness", "coulomb_friction")
STRETCH = 3.0  # s of the held-out record that are drawn: short enough to see the curves
WIDTH = 78
_SHARP = 1e-3  # of the simulated truth: a sharper sign(v) than the estimator's


def demo(*, output: Path = Path("rcorefine-demo"), seed: int = 1, quiet: bool = False) -> int:
    """Run the workflow on an example, and draw it.

    A structure whose model lacks friction: compare the model with a noisy record, diagnose, refine, and
    compare again on held-out data. Then do the same with two effects, step by step. Takes up to a minute.

    Parameters
    ----------
    output : Path
        Folder for the pictures and the report, created if absent.
    seed : int
        Seed of the excitation and the noise, 0 or larger.
    quiet : bool
        No progress bar.

    Returns
    -------
    int
        0.

    Raises
    ------
    OSError
        If the folder or a picture cannot be written.
    FileExistsError
        If ``report.html`` is there and is no report.
    """
    progress, folder = not quiet, output
    folder.mkdir(parents=True, exist_ok=True)  # before the work, not after it

    if progress and NUMBA:
        sys.stderr.write(
            "(numba compiles on first use, which takes part of a minute; later runs take seconds)\n"
        )
    rng = np.random.default_rng(seed)
    model = mass_spring_damper(
        [1.0, 1.2], [0.4, 0.4, 0.4], [300.0, 250.0, 200.0], sensors=("velocity", 1), name="model"
    )
    friction = Effect("coulomb_friction", "link2", fixed={"force": FRICTION, "width": _SHARP})
    loss = Effect("stiffness", "link3", fixed={"stiffness": LOSS})
    candidates = [Effect(law, f"link{i}") for i in (1, 2, 3) for law in LAWS]
    data = _record(model, [friction], rng, "first test")
    train, test = data.split(TRAINING)
    _title("A structure, its record, and a model in which an effect is missing")
    _say(
        "Two masses hang between two walls on three springs and dampers. A random force drives the first "
        f"mass, and one sensor reads its velocity: {N_SAMPLES} samples, {1e3 * DT:g}~ms apart, with "
        f"{100 * NOISE:g}~% of noise. Masses, springs and dampers of the model are right, but one effect of "
        f"the structure is missing. The first {100 * TRAINING:g}~% of the record are for fitting, the rest "
        "for validation."
    )

    _title("1. Compare the model with the measurement")
    before = compare(model, test)
    _write(str(before))
    rows = before.failures.rows
    _say(f"Where does it fail? {rows[0].sentence if rows else 'The record shows no significant failure.'}")

    _title("2. What is missing?")
    _say(
        f"{len(LAWS)} effects at 3 links give {len(candidates)} candidates. Which one explains the record?\n"
    )
    found = diagnose(model, train, candidates=candidates, progress=progress)
    _write(str(found))

    _title("3. Refine: add it, and fit it to convergence")
    better = found.refine()
    _write(str(better))

    _title("4. Compare again, on the data that was held out")
    after = compare([model, better], test)
    _write(str(after))
    first, last = (float(fit) for fit in np.ravel(after.fit))
    _say(
        f"The fit rises from {first:.1f}~% to {last:.1f}~%. With {100 * NOISE:g}~% of noise even the true "
        f"model would reach only about {100 * (1 - NOISE):.0f}~%. The true effect is {FRICTION:g}~N of dry "
        "friction at link2, between the two masses, where there is no sensor."
    )

    _title("5. Two things at once: improve, step by step")
    _say(
        "A later record of the same structure: the friction is still there, and the spring at link3 has "
        f"lost {-LOSS:g} of its 200~N/m. The same model, one effect after the other:\n"
    )
    later = _record(model, [friction, loss], rng, "later test")
    improvement = improve(model, later, candidates=candidates, progress=progress)
    _write(str(improvement))

    _title("6. Use the refined model")
    _say(
        "The linear part of each refined model is a control.StateSpace with the signal names and the "
        "timebase of the first one. Use it with control.bode_plot, control.feedback and the rest of "
        "python-control:"
    )
    _write(f"\n{better.system}\n")
    for name, words in _draw([model, better], test, before, found, improvement, folder).items():
        _write(f"{folder / name}\n{textwrap.indent(textwrap.fill(words, WIDTH - 4), '    ')}")
    return 0


def _record(model: PhysicalModel, hidden: list[Effect], rng: np.random.Generator, name: str) -> Measurement:
    """Return a noisy record of a model with the `hidden` effects."""
    force = 20 * np.convolve(rng.standard_normal(N_SAMPLES + 4), np.ones(5) / 5, "valid")
    blank = Measurement(force, np.zeros(N_SAMPLES), dt=DT)
    y = simulate(model, blank, "zero", effects=hidden).outputs
    y = y + NOISE * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    return Measurement(
        force,
        y,
        dt=DT,
        input_labels=model.linear.input_labels,
        output_labels=model.linear.output_labels,
        input_units=model.input_units,
        output_units=model.output_units,
        name=name,
    )


def _draw(
    models: list[Any],
    test: Measurement,
    before: Comparison,
    found: Diagnosis,
    improvement: Improvement,
    folder: Path,
) -> dict[str, str]:
    """Draw the pictures and write the report; return what each one shows."""
    overview = plt.figure(figsize=(12, 5), layout="constrained")
    [[left, right]] = overview.subfigures(1, 2, squeeze=False)
    axes = left.subplots(2, 1, sharex=True, squeeze=False, height_ratios=(2, 1))
    stretch = test.segment(test.timepts[0], test.timepts[0] + STRETCH)
    compare(models, stretch).plot(ax=axes)
    left.suptitle("One effect missing: held-out record, both models, residuals")
    right.suptitle("Two changes at once: error after each step")
    improvement.plot(ax=right.subplots())
    pictures = {
        "overview.png": (overview, 100),
        "map.png": (before.plot("map").figure, 100),
        "diagnosis.png": (found.plot().figure, 100),
        "staircase.png": (improvement.plot().figure, 120),
    }
    for name, (figure, dpi) in pictures.items():
        with replacing(folder / name) as stream:
            figure.savefig(stream, format="png", dpi=dpi)
    found.report(folder / "report.html")
    plt.close("all")
    return {
        "overview.png": f"{STRETCH:g} s of the held-out record, both models and their residuals; beside "
        "them the error after each step",
        "map.png": "where the model fails, over time, frequency, state and place",
        "diagnosis.png": "the candidates; the hidden force against the motion, estimated without any "
        "formula; the residuals",
        "report.html": "the diagnosis on one page",
        "staircase.png": "the error on held-out data after each added effect",
    }


def _title(text: str) -> None:
    _write(f"\n{text}\n{'-' * len(text)}")


def _say(text: str) -> None:
    # ~ ties a number to its unit
    _write(textwrap.fill(text, WIDTH).replace("~", " ") + "\n" * text.endswith("\n"))


def _write(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
