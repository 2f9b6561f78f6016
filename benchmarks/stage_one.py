"""Speed of both stages against equations (23)-(42) transcribed literally, in one process.

    python benchmarks/stage_one.py [--samples 1000] [--repeats 5]

Each line: the paper's settings of one example, time per sample of the literal
loop (both stages, normal equations solved anew) and of `RCORefiner`, and the
median of the ratios of interleaved runs. Times move with the machine's load,
ratios hardly. The last column is the largest difference of theta, relative.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from literal_rco import Plant, literal

import rcorefine as rco
from rcorefine.jit import NUMBA


def prepare(example: Any, n_samples: int) -> tuple[Any, Plant, np.ndarray, np.ndarray]:
    """Refiner with declared unit scales on scaled signals, so that both do the same arithmetic."""
    record = example.record(n_samples)
    scout = rco.RCORefiner.paper(example.initial, dt=example.dt, **example.settings)
    scout.update(record.inputs, record.outputs)
    tuned = scout._estimator.memory.tuned
    assert tuned is not None
    scales = {name: getattr(tuned.scales, name) for name in ("inputs", "outputs", "states", "corrections")}
    refiner = rco.RCORefiner.paper(example.initial, dt=example.dt, scale=scales, **example.settings)
    w, y = record.inputs / scales["inputs"][:, None], record.outputs / scales["outputs"][:, None]
    return (refiner, record), Plant(*tuned.plant), w, y


def compare(example: Any, n_samples: int, repeats: int) -> tuple[float, float, float, float]:
    """Seconds per sample of both, median ratio, and difference of theta."""
    (refiner, record), plant, w, y = prepare(example, n_samples)
    s = example.settings
    ours, theirs = [], []
    for _ in range(repeats):
        begin = time.process_time()
        first = literal(plant, w, y, 1, s["order"], s["window"], s["markov"], s["learning_rate"])
        literal(plant, w, y, 1, 0, s["window"], s["markov"], s["static_learning_rate"], states=first.x)
        theirs.append((time.process_time() - begin) / n_samples)
        refiner.reset()
        begin = time.process_time()
        refiner.update(record.inputs, record.outputs)
        ours.append((time.process_time() - begin) / n_samples)
    theta = refiner._estimator.memory.stages[0].theta[: first.theta[-1].size]
    difference = np.abs(theta - first.theta[-1].ravel()).max() / np.abs(theta).max()
    ratio = float(np.median(np.array(theirs) / np.array(ours)))
    return float(np.median(theirs)), float(np.median(ours)), ratio, float(difference)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    print(f"numba {'on' if NUMBA else 'off'}, {options.samples} samples, median of {options.repeats} runs")
    print(f"{'example':22}{'n_c':>4}{'coef.':>7}{'literal us':>12}{'ours us':>10}{'ratio':>8}{'diff.':>10}")
    for example in (rco.examples.one_dof(), rco.examples.two_dof(), rco.examples.rlc()):
        literal_s, ours_s, ratio, difference = compare(example, options.samples, options.repeats)
        order, n = example.settings["order"], example.initial.nstates
        size = (order + 1) * (n + 1) + order
        print(
            f"{example.name:22}{order:4d}{size:7d}{1e6 * literal_s:12.1f}{1e6 * ours_s:10.2f}{ratio:8.1f}"
            f"{difference:10.1e}"
        )


if __name__ == "__main__":
    main()
