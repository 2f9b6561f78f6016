"""The loop on one example, told as it runs: what `rcorefine demo` does."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import control as ct
import matplotlib.pyplot as plt
import numpy as np
from tqdm import tqdm

from . import examples
from .comparison import Comparison, compare
from .jit import NUMBA
from .measurement import Measurement
from .rco import RCORefiner

__all__ = ["run_demo"]

N_SAMPLES = 6000
NOISE = 0.02
TRAINING = 0.7
BLOCK = 50
# Samples after which the model of the moment is judged on the held-out data.
CHECKPOINTS = (100, 200, 500, 1000, 2000, 4200)
# Stretch of the held-out record that is drawn in time, in s: short enough to see the curves.
STRETCH = 0.012
WIDTH = 78


def run_demo(output: Path | str, *, seed: int = 1, progress: bool = True) -> None:
    """Compare, refine, compare again; tell the story and draw it.

    Parameters
    ----------
    output : path-like
        Folder for the pictures ``time.png``, ``bode.png`` and
        ``overview.png``, made if absent.
    seed : int, optional
        Seed of the excitation and the noise.
    progress : bool, optional
        Whether to show a progress bar on standard error.

    Raises
    ------
    OSError
        If the folder or a picture cannot be written.
    """
    folder = Path(output)
    folder.mkdir(parents=True, exist_ok=True)  # before the work, not after it

    if progress and NUMBA:
        sys.stderr.write(
            "(numba compiles on first use, which takes part of a minute; later runs take seconds)\n"
        )

    example = examples.rlc()
    data = example.record(N_SAMPLES, noise=NOISE, rng=seed)
    train, test = data.split(TRAINING)
    model = example.initial

    _title("A circuit, a record of it, and a model that is wrong")
    _say(
        "A voltage drives a resistor, an inductor and a capacitor in series; the voltage across the "
        f"resistor is recorded: {data.n_samples} samples, {1e3 * data.dt:g}~ms apart, with {NOISE:.0%} of "
        "noise. The resistor is known, 250~ohm. The model takes L~=~2~uH and C~=~1~F; the circuit has 55~mH "
        f"and 23.5~uF. The first {TRAINING:.0%} of the record is to learn from, the rest to judge by."
    )

    _title("1. Compare the model with the measurement")
    _write(str(compare(model, test)))
    _say(_where_it_fails(model, test))

    _title("2. Refine it, sample by sample")
    _say(
        "Two estimators run side by side. Stage 1 puts a dynamic correction in feedback with the model until "
        "both have the same output, and so makes the hidden charge and current of the real circuit visible. "
        "Stage 2 looks for the constant correction of the model that explains them. The model of the moment, "
        "judged on the held-out data:"
    )
    refiner = _refine(model, train, test, example.settings, progress)
    better = refiner.system.copy(name="refined")
    _say(
        "Both stages see each sample once, and their memory does not grow: this could run beside the "
        "circuit for as long as you like."
    )

    _title("3. What was learned")
    _write(_parts(example, better))

    _title("4. Compare again, on the data that was held out")
    after = compare([model, better], test)
    _write(str(after))
    first, last = (float(fit) for fit in np.ravel(after.fit))
    _say(
        f"The fit rises from {first:.1f} % to {last:.1f} %. With {NOISE:.0%} of noise on the record even the "
        f"true model would stop at about {100 * (1 - NOISE):.0f} %."
    )

    _title("5. Take it along")
    _say(
        "The refined model is a control.StateSpace with the signal names and the timebase of the first one. "
        "It goes on into control.bode_plot, control.feedback, control.interconnect and the rest:"
    )
    _write(str(better))
    stretch = test.segment(test.timepts[0], test.timepts[0] + STRETCH)
    for name, words in _draw(after, compare([model, better], stretch), folder).items():
        _write(f"{folder / name}\n{textwrap.indent(textwrap.fill(words, WIDTH - 4), '    ')}")


def _where_it_fails(model: ct.StateSpace, data: Measurement) -> str:
    """Name the frequency where model and measured response lie farthest apart."""
    measured = data.frequency_response()
    record = measured.frd.frdata[0, 0]
    simulated = ct.frequency_response(model.sample(data.dt), measured.omega).frdata[0, 0]
    trusted = measured.coherence[0, 0] > 0.9
    worst = int(np.argmax(np.where(trusted, np.abs(simulated / record - 1), 0.0)))
    return (
        "Where does it fail? The measured frequency response tells: the two lie farthest apart near "
        f"{measured.omega[worst] / (2 * np.pi):.0f}~Hz, where the circuit passes {abs(record[worst]):.2f} "
        f"of the voltage and the model {abs(simulated[worst]):.2f}."
    )


def _refine(
    model: ct.StateSpace,
    train: Measurement,
    test: Measurement,
    settings: Mapping[str, Any],
    progress: bool,
) -> RCORefiner:
    """Stream the record through both stages, and judge the model now and then."""
    refiner = RCORefiner(model, dt=train.dt, **settings)
    _write("samples seen    L [mH]    C [uF]    fit on held-out data [%]")
    with tqdm(total=train.n_samples, unit="sample", disable=not progress, file=sys.stderr) as bar:
        for start in range(0, train.n_samples, BLOCK):
            block = slice(start, start + BLOCK)
            refiner.update(train.inputs[:, block], train.outputs[:, block])
            seen = min(start + BLOCK, train.n_samples)
            bar.update(seen - start)
            if seen in CHECKPOINTS:
                found = examples.rlc_parameters(refiner.system)
                fit = float(np.ravel(compare(refiner.system, test).fit)[0])
                henry, farad = found["inductance"], found["capacitance"]
                with bar.external_write_mode(file=sys.stdout):
                    _write(f"{seen:12d}  {1e3 * henry:8.2f}  {1e6 * farad:8.2f}  {fit:26.1f}")
    return refiner


def _parts(example: examples.Example, better: ct.StateSpace) -> str:
    """Inductance and capacitance: believed, found, true."""
    found = examples.rlc_parameters(better)
    rows = [f"   {'in the model':>12}  {'found':>11}  {'in the circuit':>14}"]
    for letter, key, (coarse, far), (fine, near) in (
        ("L", "inductance", (1e6, "uH"), (1e3, "mH")),
        ("C", "capacitance", (1.0, "F"), (1e6, "uF")),
    ):
        believed, true = coarse * example.initial_parameters[key], fine * example.true_parameters[key]
        rows.append(
            f"{letter}  {f'{believed:g} {far}':>12}  {fine * found[key]:8.2f} {near}  {true:11.2f} {near}"
        )
    return "\n".join(rows)


def _draw(whole: Comparison, stretch: Comparison, folder: Path) -> dict[str, str]:
    """Draw the pictures; return what each one shows."""
    title = "Held-out record: circuit, initial and refined model"
    responses = "Frequency response: circuit, initial and refined model"
    stretch.plot(title=title).figure.savefig(folder / "time.png", dpi=120)
    whole.plot("bode", title=responses).figure.savefig(folder / "bode.png", dpi=120)

    overview = plt.figure(figsize=(12, 5), layout="constrained")
    [[left, right]] = overview.subfigures(1, 2, squeeze=False)
    axes = left.subplots(2, 1, sharex=True, squeeze=False, height_ratios=(2, 1))
    stretch.plot(ax=axes)
    left.suptitle("In time, on data that was held out")
    axes = right.subplots(3, 1, sharex=True, squeeze=False, height_ratios=(2, 1, 1))
    whole.plot("bode", ax=axes)
    right.suptitle("In frequency")
    overview.savefig(folder / "overview.png", dpi=100)
    plt.close("all")
    return {
        "time.png": f"{1e3 * STRETCH:g} ms of the held-out record, both models, and below what is left over",
        "bode.png": "frequency response, measured (dots) and of both models; below, the relative error and "
        "what the noise alone would cause",
        "overview.png": "both in one",
    }


def _title(text: str) -> None:
    _write(f"\n{text}\n{'-' * len(text)}")


def _say(text: str) -> None:
    # ~ ties a number to its unit
    _write(textwrap.fill(text, WIDTH).replace("~", " "))


def _write(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
