"""How often the stated standard deviations of a stream's estimates hold the true values.

    python benchmarks/coverage_streams.py                20 records of each noise, length and way, minutes
    python benchmarks/coverage_streams.py --cases 60     goes on from the rows that are in the file

Two masses on springs, both displacements measured, four noises of 5 % of each output. With effects the two
stiffnesses are estimated, by default the entries of the model. A row of the file is one record; the table
counts values within two standard deviations: 90 to 99 % are wanted (95.4 % for normal errors).
"""

from __future__ import annotations

import argparse
import csv
import warnings
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

import rcorefine as rco

DT, LEVEL = 0.05, 0.05
LENGTHS = (100, 1000)
STIFFNESS = (30.0, 20.0)
FIELDS = ("way", "noise", "samples", "seed", "inside", "values", "ratio")


def plant(k1: float, k2: float) -> rco.PhysicalModel:
    return rco.mass_spring_damper([1.0, 0.8], [0.6, 0.4], [k1, k2], sensors="displacement")


def colored(kind: str, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Noise of unit deviation."""
    r = 0.98
    filters = {
        "white": ([1.0], [1.0]),
        "AR(0.95)": ([1.0], [1.0, -0.95]),
        "resonant": ([1.0], [1.0, -2 * r * np.cos(4.0 * DT), r * r]),  # near the first mode
        "MA(4)": ([1.0, 1.0, 1.0, 1.0, 1.0], [1.0]),
    }
    e = lfilter(*filters[kind], rng.standard_normal((shape[0], shape[1] + 2000)))
    scale = lfilter(*filters[kind], np.eye(1, 4000)[0])
    return e[:, 2000:] / np.sqrt(np.sum(scale**2))


NOISES = ("white", "AR(0.95)", "resonant", "MA(4)")


def run(way: str, noise: str, samples: int, seed: int) -> tuple[int, int, float]:
    """Values within two standard deviations, their number, and error over deviation (rms)."""
    rng = np.random.default_rng([seed, samples, NOISES.index(noise)])
    loss = 1.0 - 0.3 * rng.random(2)
    true, start = plant(*(np.array(STIFFNESS) * loss)), plant(*STIFFNESS)
    w = rng.standard_normal((true.linear.n_inputs, samples))
    still = rco.Measurement(w, np.zeros((2, samples)), dt=DT)
    y = rco.simulate(true, still, "zero").outputs
    y = y + LEVEL * y.std(axis=1, keepdims=True) * colored(noise, y.shape, rng)
    effects = [rco.Effect("stiffness", f"link{i}") for i in (1, 2)]
    options = {"effects": effects} if way == "effects" else {"form": "nonzero"}
    refiner = rco.RCORefiner(start, dt=DT, use_estimated_states=False, **options)
    refiner.update(w, y)
    rows = refiner.parameters
    if way == "effects":
        truth = np.array(STIFFNESS) * loss
    else:
        matrices = {name: getattr(true.linear, name) for name in "ABCD"}
        truth = np.array([matrices[r.name[0]][tuple(map(int, r.name[2:-1].split(",")))] for r in rows])
    values, std = np.array([r.value for r in rows]), np.array([r.std for r in rows])
    errors = np.abs(values - truth) / std
    return int(np.sum(errors <= 2.0)), errors.size, float(np.sqrt(np.mean(errors**2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=20, help="records of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first record")
    parser.add_argument("--file", type=Path, default=Path("coverage_streams.csv"), help="rows so far")
    parser.add_argument("--ways", nargs="*", default=["effects", "default"])
    options = parser.parse_args()
    rows = list(csv.DictReader(options.file.open())) if options.file.exists() else []
    done = {(r["way"], r["noise"], int(r["samples"]), int(r["seed"])) for r in rows}
    with options.file.open("a", newline="") as stream:
        writer = csv.DictWriter(stream, FIELDS)
        if not rows:
            writer.writeheader()
        for way in options.ways:
            for noise in NOISES:
                for samples in LENGTHS:
                    for seed in range(options.first, options.first + options.cases):
                        if (way, noise, samples, seed) in done:
                            continue
                        with warnings.catch_warnings():
                            warnings.simplefilter("ignore")
                            found = run(way, noise, samples, seed)
                        row = dict(zip(FIELDS, (way, noise, samples, seed, *found), strict=True))
                        writer.writerow(row)
                        stream.flush()
                        rows.append(row)
                    mine = [
                        r for r in rows if (r["way"], r["noise"], int(r["samples"])) == (way, noise, samples)
                    ]
                    inside, values = (sum(int(r[name]) for r in mine) for name in ("inside", "values"))
                    ratio = np.nanmedian([float(r["ratio"]) for r in mine])
                    print(
                        f"{way:8s} {noise:9s} {samples:5d} samples: {inside:4d} of {values:4d} values"
                        f" within two ({100 * inside / values:5.1f} %), error over deviation {ratio:.2f}",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
