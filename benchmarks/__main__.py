"""How fast, against what, and how exact: one table of 80 columns, and JSON.

    python -m benchmarks [--samples 2000] [--repeats 5] [--json speed.json]

Every line runs ours and its peer in turn in one process, and takes the median of the ratios: they hardly
move with the load of the machine, times do. Beside each stands how far the two answers are from the truth,
or from each other. Then how the cost grows, and what this processor can do at all.
The scripts beside this one measure each part more closely, and rates of right answers.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

import control as ct
import numpy as np
from scipy.optimize import least_squares

import rcorefine as rco
from rcorefine.effects import Coefficient, PortLaw
from rcorefine.engine.engine import Engine
from rcorefine.engine.nonlinear import nonlinear_system
from rcorefine.engine.structure import Structure
from rcorefine.jit import NUMBA

from .stage_one import compare as both_stages


@dataclass
class Row:
    """Seconds of processor time of both, the median of their ratios, and the error of both answers."""

    what: str
    peer: str
    ours: float
    theirs: float
    ratio: float
    error: float
    error_of_peer: float | None = None

    def __str__(self) -> str:
        behind = "" if self.error_of_peer is None else f"{self.error_of_peer:7.0e}"
        return (
            f"{self.what:22}{self.peer:17}{_time(self.ours):>9}{_time(self.theirs):>9}{self.ratio:7.3g}x"
            f"{self.error:7.0e}{behind}"
        )


def _time(seconds: float) -> str:
    units = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
    unit = next((name for name, size in units.items() if seconds >= size), "us")
    return f"{seconds / units[unit]:.3g} {unit}"


def seconds(run: Callable[[], Any]) -> float:
    """Processor time of a run."""
    begin = time.process_time()
    run()
    return time.process_time() - begin


def in_turn(ours: Callable[[], Any], theirs: Callable[[], Any], repeats: int) -> tuple[float, float, float]:
    """Medians of both, and of the ratios of neighbors."""
    ours()  # compiles
    times = np.array([(seconds(ours), seconds(theirs)) for _ in range(repeats)])
    mine, other = np.median(times, axis=0)
    return float(mine), float(other), float(np.median(times[:, 1] / times[:, 0]))


def stages(samples: int, repeats: int) -> list[Row]:
    """Both stages of the paper against its equations as they are printed."""
    rows = []
    for example in (rco.examples.one_dof(), rco.examples.two_dof(), rco.examples.rlc()):
        literal, ours, ratio, gap = both_stages(example, samples // 2, repeats)
        rows.append(Row(f"stage 1+2, {example.name}"[:21], "equations 23-42", ours, literal, ratio, gap))
    return rows


def two_masses(k2: float, k3: float) -> rco.PhysicalModel:
    return rco.mass_spring_damper([1.0, 1.2], [0.4, 0.4, 0.4], [300.0, k2, k3], sensors=("velocity", 1))


def grey_box(samples: int, repeats: int) -> list[Row]:
    """Two stiffnesses from a record, 1 % noise, against least squares around `control.forced_response`."""
    rng, truth = np.random.default_rng(0), np.array([230.0, 190.0])
    w = 20 * rng.standard_normal(samples)
    y = rco.simulate(two_masses(*truth), rco.Measurement(w, np.zeros(samples), dt=0.01), "zero").outputs[0]
    data = rco.Measurement(w, y + 0.01 * y.std() * rng.standard_normal(samples), dt=0.01)
    start = np.array([250.0, 200.0])
    effects = [rco.Effect("stiffness", "link2"), rco.Effect("stiffness", "link3")]
    found: dict[str, np.ndarray] = {}

    def ours() -> None:
        fitted = rco.refine(two_masses(*start), data, effects, x0="zero", offset=False)
        found["ours"] = np.array([row.value for row in fitted.parameters])

    def residual(k: np.ndarray) -> np.ndarray:
        sampled = ct.sample_system(two_masses(*k).system, data.dt, "zoh")
        return ct.forced_response(sampled, data.timepts, w).outputs.ravel() - data.outputs[0]

    def theirs() -> None:
        found["theirs"] = least_squares(residual, start, x_scale=start).x

    mine, other, ratio = in_turn(ours, theirs, repeats)
    errors = [float(np.abs(found[who] / truth - 1).max()) for who in ("ours", "theirs")]
    return [Row(f"refine, {samples} samples", "forced_response", mine, other, ratio, *errors)]


def free_run(samples: int, repeats: int) -> list[Row]:
    """A chain with a quadratic damper against python-control's integrator, both against a tight one."""
    model = rco.mass_spring_damper([1.0] * 3, [0.2, 0.16, 0.12], [10.0, 8.0, 6.0], force=3)
    structure, theta = Structure(model, [rco.Effect("quadratic_damping", "link2")]), np.array([0.5])
    w = np.random.default_rng(0).standard_normal((1, samples))
    data = rco.Measurement(w, np.zeros((3, samples)), dt=0.02, hold="foh")
    peer, engine, few = nonlinear_system(structure, theta), Engine(structure, data), min(samples, 400)
    found: dict[str, np.ndarray] = {}

    def ours() -> None:
        found["ours"] = engine.run(theta, sensitivity=False).outputs

    def theirs(**options: Any) -> None:
        found["theirs"] = np.asarray(ct.input_output_response(peer, data.timepts, w, **options).outputs)

    mine, other, ratio = in_turn(ours, theirs, min(repeats, 3))
    last = dict(found)
    theirs(solve_ivp_kwargs={"rtol": 1e-9, "atol": 1e-12}, t_eval=data.timepts[:few])
    tight = found["theirs"]
    errors = [float(np.abs(last[who][:, :few] - tight).max() / np.abs(tight).max()) for who in last]
    return [Row("free run, nonlinear", "input_output", mine, other, ratio, *errors)]


class Drag(PortLaw):
    """Quadratic drag, written again."""

    formula, explanation = "f = c v |v|", "Drag at {place}."
    coefficients = (Coefficient("drag", "force/velocity^2", explanation="drag"),)

    @staticmethod
    def law(v: float, drag: float) -> float:
        return drag * v * abs(v)


def own_law(samples: int, repeats: int) -> list[Row]:
    """A law of a user against the same one of the library, with all derivatives."""
    model = rco.mass_spring_damper([1.0] * 3, [0.2, 0.16, 0.12], [10.0, 8.0, 6.0], force=3)
    w = np.random.default_rng(0).standard_normal((1, samples))
    data = rco.Measurement(w, np.zeros((3, samples)), dt=0.02, hold="foh")
    effects = rco.Effect("custom", "link1", law=Drag), rco.Effect("quadratic_damping", "link1")
    mine, built_in = (Engine(Structure(model, [effect]), data) for effect in effects)
    theta = np.array([2.0])
    ours, theirs, ratio = in_turn(lambda: mine.run(theta), lambda: built_in.run(theta), 3 * repeats)
    gap = float(np.abs(mine.run(theta).outputs - built_in.run(theta).outputs).max())
    return [Row("free run, own law", "library's law", ours, theirs, ratio, gap)]


def reading(samples: int, repeats: int) -> list[Row]:
    """A CSV file of 25 lines per sample, against NumPy's reader."""
    table = np.random.default_rng(0).standard_normal((25 * samples, 3))
    table[:, 0] = np.arange(len(table)) * 1e-3
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.csv"
        np.savetxt(path, table, delimiter=",", header="t,u,y", comments="", fmt="%.6g")
        read: dict[str, np.ndarray] = {}

        def ours() -> None:
            read["ours"] = rco.Measurement.from_csv(path, "u", "y", time="t").outputs[0]

        def theirs() -> None:
            read["theirs"] = np.loadtxt(path, delimiter=",", skiprows=1)[:, 2]

        mine, other, ratio = in_turn(ours, theirs, repeats)
    return [
        Row(
            "read a CSV file",
            "numpy.loadtxt",
            mine,
            other,
            ratio,
            float(np.ptp(read["ours"] - read["theirs"])),
        )
    ]


def growth() -> dict[str, float]:
    """Exponents of the processor time by what grows."""
    found = {}
    effect = rco.Effect("stiffness", "link2")

    def engine(masses: int, samples: int) -> Engine:
        links = [0.1] * masses, [10.0] * masses
        model = rco.mass_spring_damper([1.0] * masses, *links, sensors=("velocity", 1))
        return Engine(
            Structure(model, [effect]), rco.Measurement(np.ones(samples), np.zeros(samples), dt=0.02)
        )

    engines = [engine(2, n) for n in (4000, 16000, 64000)]
    chains = [engine(masses, 1000) for masses in (4, 12, 36)]
    for name, several, sizes in (("samples", engines, (1, 4, 16)), ("states", chains, (1, 3, 9))):
        times = []
        for one in several:
            one.run(np.zeros(1), initial_state=True)
            times.append(min(seconds(lambda e=one: e.run(np.ones(1), initial_state=True)) for _ in "123"))
        found[name] = float(np.polyfit(np.log(sizes), np.log(times), 1)[0])
    return found


def limits() -> dict[str, float]:
    """What this processor does in the same minute: multiplications and additions, bytes."""
    a, b, long = np.ones((800, 800)), np.ones((800, 800)), np.ones(4_000_000)
    out = np.empty_like(long)
    product = min(seconds(lambda: a @ b) for _ in range(5))
    copy = min(seconds(lambda: np.add(long, 1.0, out)) for _ in range(5))
    return {"GF/s": 2 * 800**3 / product / 1e9, "GB/s": 16 * long.size / copy / 1e9}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path, help="file for the same as JSON")
    options = parser.parse_args()
    sys.stdout.write(
        f"{date.today()}, {platform.machine()}, Python {platform.python_version()}, numba "
        f"{'on' if NUMBA else 'off'}\n{'':39}{'ours':>9}{'peer':>9}{'ratio':>8}  error of peer\n"
    )
    rows: list[Row] = []
    for part in (stages, grey_box, free_run, own_law, reading):
        rows += (new := part(options.samples, options.repeats))
        sys.stdout.write("".join(f"{row}\n" for row in new))
        sys.stdout.flush()
    exponents, limit = growth(), limits()
    sys.stdout.write("cost grows as " + ", ".join(f"{k}^{v:.2f}" for k, v in exponents.items()))
    sys.stdout.write("; this processor: " + ", ".join(f"{v:.3g} {k}" for k, v in limit.items()) + "\n")
    if options.json:
        found = {"rows": [asdict(row) for row in rows], "growth": exponents, "limits": limit}
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
