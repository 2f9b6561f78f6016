"""A page for each effect, from its own words and a small simulation: python docs/gallery.py FOLDER"""

import os
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_all_start_methods, get_context
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import rcorefine as rco
from rcorefine.effects.law import KINDS
from rcorefine.exceptions import DivergenceError
from rcorefine.exercises.plants import record_of

SAMPLES, NOISE, LOSS = 2000, 0.01, 0.25
WITHOUT = {  # need what only you know: where that is told
    "custom": "a function of yours: [a law of your own](../laws.md)",
    "tabulated": "an unknown force, from `found.law()`: [what a verdict promises](../verdicts.md)",
    "input_curve": "a static curve of an actuator, as a `Table`: [listed only on request](../laws.md)",
    "output_curve": "a static curve of a sensor, as a `Table`: [listed only on request](../laws.md)",
    "coefficient": "an entry of A or B, where states mean nothing: [how to](../howto.md)",
    "state_dependent_gain": "an entry of B that depends on the state: [listed at stores](../laws.md)",
    "product_of_states": "an entry of A that depends on the state: [listed at stores](../laws.md)",
    "model_parameter": "a number of a right-hand side: [a nonlinear model](../nonlinear_models.md)",
}
CONSTANTS = {"radiation": {"temperature": 300.0}, "magnetic_force": {"gap": 3.0, "current": 1.0}}
FAMILIES = {
    "mechanical": "Springs, dampers and friction",
    "first_order": "Losses and flows of stores",
    "input": "What happens to an input",
    "output": "What happens to an output",
}
RED, BLUE, GRAY = "tab:red", "tab:blue", "0.55"


@cache
def plant(sort):
    """Model, place, blank record and typical sizes of the motion there."""
    rng = np.random.default_rng(0)
    if sort == "first_order":
        model = rco.thermal_network([10.0], {(1, 0): 2.0}, ambient_input=False, name="one heat capacity")
        place, u, dt = "T1-ambient", 4 + 3 * np.repeat(rng.uniform(-1, 1, 50), 40), 0.25
    else:
        model = rco.mass_spring_damper([1.0], [0.8], [100.0], name="one mass")
        place, u, dt = "link1", 20 * np.repeat(rng.standard_normal(250), 8), 0.02
    linear = model.linear
    place = {"input": linear.input_labels[0], "output": linear.output_labels[0]}.get(sort, place)
    blank = record_of(model, u[None, :], dt=dt)
    run = rco.simulate(model, blank, "zero")
    plain, states = run.outputs, run.states
    port = next(p for p in model.ports if p.name == ("T1-ambient" if sort == "first_order" else "link1"))
    d = port.position @ states + port.position_input @ blank.inputs
    v = port.velocity @ states + port.velocity_input @ blank.inputs
    signal = plain if sort == "output" else u
    return model, place, blank, plain, d, v, float(np.std(signal))


def with_it(model, effect, found, blank, width=None):
    """Outputs of the plant that has the effect, from rest."""
    fixed = dict(zip(effect.coefficients, found, strict=True)) | ({"width": width} if width else {})
    held = effect.replace(start={}, prior={}, fixed=fixed)
    return rco.simulate(model, blank, "zero", effects=[held]).outputs


def noisy(outputs, rng):
    """Outputs with white noise."""
    return outputs + NOISE * outputs.std(axis=1, keepdims=True) * rng.standard_normal(outputs.shape)


def values(effect, size, sort):
    """Coefficients: those that shape the law about the motion, the others of this size."""
    _, _, blank, _, d, v, signal = plant(sort)
    if effect.kind in ("input_range", "output_range"):
        return [-0.6 * size, size]
    if effect.kind == "input_power":
        return [1.0 + size, 0.6 * signal]
    if effect.kind == "hidden_mode":
        return [0.3 * size, 0.3 * size * 0.5, 0.3 * size * 64.0]
    typical = {
        "position": (3.0 if effect.kind == "cogging" else 0.5) * np.std(d),
        "velocity": 0.3 * np.std(v) or 1.0,
        "signal": 0.6 * signal,
        "s": 3 * blank.dt,
    }
    names = {coefficient.name for coefficient in effect.spec.coefficients}
    if {"static_ratio", "displacement"} <= names:
        # bristles give over D while the motion turns through the static part, in vs/a: vs^2 > a D
        typical["velocity"] = 2 * np.sqrt(typical["position"] * np.std(np.gradient(v, blank.dt)))
    found, scale = [], size
    for coefficient in effect.spec.coefficients:
        if coefficient.shapes and len(effect.coefficients) > 1:
            middle = {"power": 1.5, "softness": 0.5, "static_ratio": 1.6, "threshold": float(np.mean(v))}
            found.append(middle.get(coefficient.name, typical.get(coefficient.unit_rule, 1.0)))
        else:
            found.append(scale)
            scale *= 1.6 if coefficient.name == "coulomb_force" else 0.4
    return found


def sized(effect, sort):
    """Outputs where the model misses about a quarter of them, and the coefficients; None without."""
    model, _, blank, plain, _, v, _ = plant(sort)
    size, width = 0.137, 1e-3 * float(np.std(v)) if effect.spec.jumps else None
    for _ in range(25):
        try:
            found = values(effect, size, sort)
            outputs = with_it(model, effect, found, blank, width)
        except (DivergenceError, rco.ModelError):
            size /= 3.0
            continue
        missed = float(np.sqrt(np.mean((outputs - plain) ** 2)) / np.std(plain))
        if abs(missed / LOSS - 1) < 0.25:
            return found, outputs
        ratio = LOSS / max(missed, 1e-12)
        shrinks = effect.kind.endswith(("saturation", "rate_limit", "_range"))
        size *= float(np.clip(ratio ** (-0.5 if shrinks else 0.8), 0.05, 20))
    return None


@cache
def shown(sort):
    """All laws that can be simulated at the place: effect, coefficients, outputs."""
    place = plant(sort)[1]
    found = {}
    for kind, law in KINDS.items():
        if sort in law.where and kind not in WITHOUT:
            effect = rco.Effect(kind, place, fixed=CONSTANTS.get(kind))
            made = sized(effect, sort)
            if made is None:
                raise RuntimeError(f"no size of {kind} costs the model a quarter of the output")
            found[kind] = (effect, *made)
    return found


def confused(kind, sort):
    """The three laws at the same place whose change of the output is most alike, with the likeness."""
    plain = plant(sort)[3]
    change = {k: (y - plain).ravel() for k, (_, _, y) in shown(sort).items()}
    own = change[kind]
    alike = {
        k: abs(own @ other) / np.linalg.norm(own) / np.linalg.norm(other)
        for k, other in change.items()
        if k != kind
    }
    return sorted(alike.items(), key=lambda item: -item[1])[:3]


def draw(kind, sort, path):
    """Time, frequency response at two levels, and what the law does to the motion or the signal."""
    model, _, blank, plain = plant(sort)[:4]
    effect, found, outputs = shown(sort)[kind]
    figure, grid = plt.subplots(2, 2, figsize=(8.6, 5.6), layout="constrained")
    axes = [grid[0, 0], grid[0, 1], grid[1, 0], grid[1, 1]]
    axes[3].sharex(axes[1])
    part = slice(0, 400)
    axes[0].plot(blank.timepts[part], outputs[0, part], color=GRAY, lw=3, label="plant with it")
    axes[0].plot(blank.timepts[part], plain[0, part], color=RED, lw=1, ls="--", label="model")
    output = f"[{model.output_units[0]}]"
    axes[0].set(xlabel="time [s]", ylabel=f"{blank.output_labels[0]} {output}", title="In time")
    axes[0].legend(fontsize="small")
    rng = np.random.default_rng(1)
    for factor, color in ((0.25, BLUE), (1.0, "k")):
        quiet = record_of(model, factor * blank.inputs, dt=blank.dt)
        try:
            y = with_it(model, effect, found, quiet)
        except DivergenceError:
            continue
        record = record_of(model, quiet.inputs, noisy(y, rng), dt=blank.dt)
        frd = record.frequency_response(segment_length=400).frd
        seen = (frd.omega > 0) & (frd.omega < 0.5 * np.pi / blank.dt)
        axes[1].loglog(frd.omega[seen], np.abs(frd.frdata[0, 0][seen]), ".", ms=3, color=color,
                       label=f"record, input x {factor:g}")  # fmt: skip
        axes[3].semilogx(frd.omega[seen], np.angle(frd.frdata[0, 0][seen], deg=True), ".", ms=3, color=color)
    omega = frd.omega[seen]
    response = model.system(1j * omega)
    axes[1].loglog(omega, np.abs(response), color=RED, lw=1, ls="--", label="model")
    axes[1].set(ylabel="magnitude", title="Frequency response")
    axes[3].semilogx(omega, np.angle(response, deg=True), color=RED, lw=1, ls="--")
    axes[3].set(xlabel="frequency [rad/s]", ylabel="phase [deg]", yticks=[-180, -90, 0, 90, 180])
    axes[1].legend(fontsize="small")
    if sort in ("input", "output"):
        axes[2].plot(plain[0], outputs[0], ".", ms=2, color=BLUE)
        axes[2].set(title="One against the other")
        axes[2].set(xlabel=f"output of the model {output}", ylabel=f"output of the plant {output}")
    else:
        fixed = {**effect.fixed, **dict(zip(effect.coefficients, found, strict=True))}
        held = rco.Effect(kind, effect.place, fixed=fixed)
        run = rco.simulate(rco.refine(model, record, [held], offset=False), record, "zero")
        states = run.states[: model.linear.n_states]
        port = next(p for p in model.ports if p.name == effect.place)
        motion = port.position @ states if "position" in effect.spec.needs else port.velocity @ states
        if run.forces.size:
            axes[2].plot(motion, run.forces[0], ".", ms=2, color=BLUE)
            axes[2].set_ylabel(f"its {'flow' if sort == 'first_order' else 'force'} [{port.force_unit}]")
        else:
            axes[2].plot(motion, outputs[0] - plain[0], ".", ms=2, color=BLUE)
            axes[2].set_ylabel(f"change of the output {output}")
        moved = "position" in effect.spec.needs
        what = "state" if sort == "first_order" else "displacement" if moved else "velocity"
        unit = port.position_unit if moved else port.velocity_unit
        axes[2].set(xlabel=f"{what} [{unit}]", title="Against the motion")
    for ax in axes:
        ax.grid(alpha=0.3)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def diagnosed(kind, sort):
    """Sentences of a diagnosis that is offered it and the three most alike."""
    model, _, blank, _, _, _, _ = plant(sort)
    effect, _, outputs = shown(sort)[kind]
    record = record_of(model, blank.inputs, noisy(outputs, np.random.default_rng(2)), dt=blank.dt)
    offered = [effect, *(shown(sort)[other][0] for other, _ in confused(kind, sort))]
    found = rco.diagnose(model, record, candidates=offered)
    said = [s for s in found.sentences() if not s.startswith("LOOK")][:2]
    if found.best is not None and found.best.effect != effect and found.verdict == "effect":
        said.append(
            f"The name is that of {found.best.effect.kind}: on this record it does the work of {kind}; what "
            "is left is too little, or a constant that the nuisance offset takes up. Another amplitude tells."
        )
    if {"static_ratio", "displacement"} <= set(effect.coefficients):
        said.append(
            "The motion here takes longer to turn through the static part (vs/a, a the acceleration) than "
            "the bristles take to give (D/vs). Where it is faster, no record tells the static part from "
            "plain hysteresis: such a force ends as hysteresis, or unexplained."
        )
    if found.verdict == "adequate" and effect.spec.holds_constant:
        said.append("The nuisance offset that every fit has took it up; offset=False leaves it to be found.")
    return found.verdict, said


def page(kind, sort, folder):
    """One effect: words, coefficients, picture, how it is found, with what it is confused."""
    law = KINDS[kind]
    model, place = plant(sort)[:2]
    effect, found, _ = shown(sort)[kind]
    fixed = f", fixed={CONSTANTS[kind]}" if kind in CONSTANTS else ""
    draw(kind, sort, folder / f"{kind}.png")
    rows = "".join(
        f"| `{c.name}` | {model.unit(effect, c.name)} | {c.explanation} | {value:.3g} |\n"
        for c, value in zip(law.coefficients, found, strict=True)
    )
    verdict, said = diagnosed(kind, sort)
    near = "".join(f"| [{k}]({k}.md) | {like:.2f} |\n" for k, like in confused(kind, sort))
    sentences = "\n".join(f"> {sentence}\n>" for sentence in said).rstrip(">").rstrip()
    formula = "`" + law.formula.replace("`", "") + "`\n\n" if law.formula else ""
    return f"""# {kind}

{law.__doc__.strip().splitlines()[0]} {effect.explanation}

{formula}| coefficient | unit | what it is | here |
| --- | --- | --- | --- |
{rows}
## What it looks like

![{kind}: in time, in frequency, against the motion]({kind}.png)

{model.name.capitalize()}, {SAMPLES} samples; the effect is so strong that the model misses about a
quarter of the output. The frequency response is measured (Welch) at a quarter of the input and at
all of it: where the two differ, no linear model fits both.

## How it is found

```text
effect = rco.Effect("{kind}", "{place}"{fixed})
found = rco.diagnose(model, data, candidates=[effect, ...])  # verdict: {verdict}
```

{sentences}

Offered were this effect and the three that are most like it, at {100 * NOISE:.0f} % noise.

## With what it is confused

How alike the changes of the output are (1: the same, up to size), on this record, before anything
else of the model moves:

| effect | likeness |
| --- | --- |
{near}
Above 0.95 a record of this length tells them apart only where the noise is small;
`found.suggest_experiment()` says which record would.
"""


@cache
def page_kinds():
    """Kind -> where it is shown, in the order of the catalogue."""
    return {k: sort for sort in FAMILIES for k in shown(sort)} | {
        k: sort for sort in reversed(FAMILIES) for k in shown(sort)
    }


def _written(folder, entry):
    """Write the page and the picture of one effect."""
    kind, sort = entry
    (folder / f"{kind}.md").write_text(page(kind, sort, folder), encoding="utf-8")


def write(folder):
    """Write all pages, unless they are newer than the laws and this file."""
    sources = [Path(__file__), *Path(rco.__file__).parent.joinpath("effects").glob("*.py")]
    index = folder / "index.md"
    if index.exists() and index.stat().st_mtime > max(path.stat().st_mtime for path in sources):
        return
    folder.mkdir(exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first, *others = page_kinds().items()  # with the records of all effects, which the others inherit
        _written(folder, first)  # what numba compiles is then on disk
        if "fork" in get_all_start_methods():  # a diagnosis per page takes the time
            with ProcessPoolExecutor(min(4, os.cpu_count() or 1), get_context("fork")) as pool:
                list(pool.map(partial(_written, folder), others))
        else:
            list(map(partial(_written, folder), others))
    parts = [
        "# Gallery of effects\n\nOne page for each: what it looks like, how it is found, "
        "with what it is confused. "
        "`print(rco.describe_effects(rco.effect_library(model)))` lists what could act in a model; "
        "[a law of your own](../laws.md) is one class.\n"
    ]
    for sort, title in FAMILIES.items():
        kinds = [k for k, s in page_kinds().items() if s == sort]
        lines = "".join(f"| [{k}]({k}.md) | {KINDS[k].__doc__.strip().splitlines()[0]} |\n" for k in kinds)
        names = "\n".join(kinds)
        tree = f"```{{toctree}}\n:hidden:\n\n{names}\n```"
        parts.append(f"\n## {title}\n\n| effect | what it is |\n| --- | --- |\n{lines}\n{tree}\n")
    told = "".join(f"| `{kind}` | {where} |\n" for kind, where in WITHOUT.items())
    parts.append(f"\n## Laws that are yours\n\n| effect | what it is |\n| --- | --- |\n{told}")
    index.write_text("".join(parts), encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
