"""Every kind of effect at every place it can have: is the coefficient found, and is its error bar right?

    python benchmarks/effects.py [--seeds 40] [--kinds coulomb_friction,mass]

One hidden effect, 1 % noise, 2000 samples. The truth is simulated with 32 times finer steps than the
fit begins with (tests/test_refine.py takes scipy.integrate.solve_ivp for a part of the same cases).
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import control as ct
import numpy as np
from scipy.stats import beta

from rcorefine import Effect, Measurement, ports, refine
from rcorefine.effects.law import KINDS
from rcorefine.engine.engine import Engine
from rcorefine.engine.structure import Structure
from rcorefine.views.tables import TextTable

SAMPLES, FINE, NOISE = 2000, 32, 0.01
M1, M2, C1, K1, K2 = 1.0, 0.7, 0.3, 40.0, 25.0
JUMPS = ("coulomb_friction", "asymmetric_friction", "stribeck_friction")


@dataclass(frozen=True)
class Case:
    """One effect in one model."""

    kind: str
    place: str
    values: tuple[float, ...]
    model: ct.StateSpace
    dt: float
    steps: bool  # input: steps between 0 and 1.2 rather than white noise of size 10


def chain(output: int, name: str) -> ct.StateSpace:
    """Two masses between two walls, force on the first, one sensor: 0 is x1, 2 is v1."""
    A = [
        [0, 0, 1, 0],
        [0, 0, 0, 1],
        [-(K1 + K2) / M1, K2 / M1, -2 * C1 / M1, C1 / M1],
        [K2 / M2, -K2 / M2, C1 / M2, -C1 / M2],
    ]
    C = np.zeros((1, 4))
    C[0, output] = 1.0
    return ct.ss(
        A, [[0], [0], [1 / M1], [0]], C, 0, inputs="f", outputs=name, states=["x1", "x2", "v1", "v2"]
    )


MECHANICAL: dict[str, tuple[float, ...]] = {
    "stiffness": (2.0,),
    "damping": (0.1,),
    "mass": (0.1,),
    "cubic_stiffness": (8.0,),
    "quadratic_stiffness": (3.0,),
    "bilinear_stiffness": (4.0,),
    "clearance": (10.0, 0.25),
    "coulomb_friction": (1.0,),
    "asymmetric_friction": (1.0, 1.6),
    "asymmetric_damping": (0.2, 0.4),
    "stribeck_friction": (0.8, 1.6, 0.3),
    "quadratic_damping": (0.2,),
    "cubic_damping": (0.1,),
    "hysteresis": (1.5, 0.1),
    "hidden_mode": (0.1, 0.1, 6.0),
    "constant_force": (2.0,),
}
FIRST_ORDER: dict[str, tuple[float, ...]] = {
    "damping": (0.03,),
    "coulomb_friction": (0.3,),
    "quadratic_damping": (0.05,),
    "cubic_damping": (0.02,),
    "sqrt_flow": (0.3,),
    "threshold_flow": (0.5, 3.0),
    "mass": (0.1,),
    "constant_force": (0.2,),
}
INPUT: dict[str, tuple[float, ...]] = {
    "input_gain": (0.05,),
    "input_offset": (1.0,),
    "input_delay": (0.03,),
    "input_lag": (0.02,),
    "input_deadzone": (2.0,),
    "input_saturation": (15.0,),
}
OUTPUT: dict[str, tuple[float, ...]] = {
    "output_gain": (0.05,),
    "output_offset": (0.2,),
    "output_delay": (0.02,),
    "output_lag": (0.02,),
    "output_saturation": (1.5,),
    "output_rectification": (0.8,),
}


def cases() -> list[Case]:
    """All of them; a kind that is missing here stops the benchmark."""
    velocity, position = chain(2, "v1"), chain(0, "q1")
    tank = ct.ss([[-0.1]], [[1.0]], [[1.0]], 0, inputs="q", outputs="y", states=["level"])
    found = []
    for kind, values in MECHANICAL.items():
        for place in ("x1", "x2", "x1-x2"):
            if kind == "mass" and place == "x1-x2":
                continue  # a mass moves with one point; relative ones are inerters, with another start
            model = position if kind == "constant_force" else velocity
            if (kind, place) == ("constant_force", "x1-x2"):
                continue  # two opposite constants: at rest only a static stretch, which the offset also makes
            found.append(Case(kind, place, values, model, 0.05, False))
    found += [Case(kind, "level", values, tank, 0.2, True) for kind, values in FIRST_ORDER.items()]
    for kind, values in INPUT.items():
        model = position if kind == "input_offset" else velocity
        found.append(Case(kind, "f", values, model, 0.05, False))
    found += [Case(kind, "v1", values, velocity, 0.05, False) for kind, values in OUTPUT.items()]
    found.append(Case("coefficient", "A[v2,x1]", (2.0,), velocity, 0.05, False))
    missing = set(KINDS) - {case.kind for case in found} - {"custom"}
    if missing:
        raise SystemExit(f"no case for {', '.join(sorted(missing))}")
    return found


def record(case: Case, seed: int) -> Measurement:
    """Fine simulation with the effect, 1 % noise on the output."""
    rng = np.random.default_rng(seed)
    if case.steps:
        w = np.repeat(rng.uniform(0, 1.2, SAMPLES // 20), 20)
    else:
        w = 10 * rng.standard_normal(SAMPLES)
    blank = Measurement(w, np.zeros(SAMPLES), dt=case.dt)
    constants: dict[int, float] = {}
    if case.kind in JUMPS:
        bare = Engine(Structure(case.model), blank).run(np.zeros(0), sensitivity=False, histories=True)
        port = next(p for p in ports(case.model) if p.name == case.place)
        # sgn(v) a little sharper than the width that the fit will take
        constants = {0: 0.003 * float(np.sqrt(np.mean((port.velocity @ bare.states) ** 2)))}
    elif case.kind == "sqrt_flow":
        constants = {0: 1e-3}
    truth = Structure(case.model, [Effect(case.kind, case.place)], constants=constants)
    y = Engine(truth, blank, substeps=FINE).run(np.array(case.values), sensitivity=False).outputs[0]
    return Measurement(w, y + NOISE * y.std() * rng.standard_normal(SAMPLES), dt=case.dt)


def interval(hits: int, runs: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper and Pearson)."""
    low = 0.0 if hits == 0 else float(beta.ppf(0.025, hits, runs - hits + 1))
    high = 1.0 if hits == runs else float(beta.ppf(0.975, hits + 1, runs - hits))
    return low, high


def judge(case: Case, seeds: int) -> tuple[tuple[str, ...], int, np.ndarray]:
    """Row of the table, hits, and the deviations of all coefficients in standard deviations."""
    z, seconds = [], []
    for seed in range(seeds):
        data = record(case, seed)
        began = time.perf_counter()
        result = refine(case.model, data, [Effect(case.kind, case.place)])
        seconds.append(time.perf_counter() - began)
        n = len(case.values)
        z.append((result.theta[:n] - case.values) / np.sqrt(np.diag(result.covariance)[:n]))
    deviations = np.array(z)
    inside = np.all(np.abs(deviations) < 3, axis=1)
    hits = int(inside.sum())
    low, high = interval(hits, seeds)
    # error bar ratio over the runs that found the valley; a lost run counts in the share
    rms = np.sqrt(np.mean(deviations[np.all(np.abs(deviations) < 6, axis=1)] ** 2, axis=0))
    row = (
        case.kind,
        case.place,
        f"{hits}/{seeds}",
        f"{100 * low:.0f}-{100 * high:.0f}",
        " ".join(f"{value:.2f}" for value in rms),
        f"{np.median(seconds):.2f}",
    )
    return row, hits, deviations


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=40, help="records per case")
    parser.add_argument("--kinds", default="", help="only these, separated by commas")
    options = parser.parse_args(arguments)
    chosen = [case for case in cases() if not options.kinds or case.kind in options.kinds.split(",")]
    rows, hits, ratios = [], 0, []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        refine(chosen[0].model, record(chosen[0], 0), [Effect(chosen[0].kind, chosen[0].place)])  # compile
        for case in chosen:
            row, found, deviations = judge(case, options.seeds)
            rows.append(row)
            hits += found
            kept = deviations[np.all(np.abs(deviations) < 6, axis=1)]
            ratios.append(np.sqrt(np.mean(kept**2, axis=0)))
            sys.stderr.write(" ".join(row) + "\n")
    total = options.seeds * len(chosen)
    low, high = interval(hits, total)
    overall = float(np.sqrt(np.mean(np.concatenate(ratios) ** 2)))
    # rms of n normal numbers scatters by 1/sqrt(2 n)
    margin = 3.0 / np.sqrt(2 * options.seeds)
    off = [
        f"{row[0]} at {row[1]}"
        for row, ratio in zip(rows, ratios, strict=True)
        if np.any(ratio > 1.25 * (1 + margin)) or np.any(ratio < 0.8 * (1 - margin))
    ]
    notes = (
        "within 3 sd: records in which every coefficient is within 3 standard deviations of the truth, with "
        "the 95 % interval of that share in percent. rms z: how much the estimates scatter over what the "
        "error bar says (1 = right), for each coefficient, runs beyond 6 sd left out. time: median.",
        f"All: {hits}/{total} within 3 sd ({100 * low:.1f}-{100 * high:.1f} %), rms z {overall:.2f}.",
    )
    headers = ("effect", "place", "within 3 sd", "interval [%]", "rms z", "time [s]")
    table = TextTable(headers, rows, title=f"{options.seeds} records per case", notes=notes)
    sys.stdout.write(table.text() + "\n")
    demands = (
        ("coefficient within 3 standard deviations in >= 95 % of all runs", hits >= 0.95 * total),
        ("error bar right within a factor of 1.25 over all cases", 0.8 <= overall <= 1.25),
        (
            f"... and in each case, as far as {options.seeds} records tell{': ' * bool(off)}{', '.join(off)}",
            not off,
        ),
    )
    for demand, met in demands:
        sys.stdout.write(f"{'met    ' if met else 'NOT MET'}  {demand}\n")
    return 0 if all(met for _, met in demands) else 1


if __name__ == "__main__":
    raise SystemExit(main())
