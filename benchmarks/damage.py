"""Which springs of a chain lost stiffness, from one sensor: names, false names, and their CPU.

Chains of 3 to 6 unequal masses, one or two springs 10 to 60 % softer, 1 to 3 % noise. The records are made by
scipy's zero-order-hold discretization, and not by the package.

    python benchmarks/damage.py --first 0 --records 40 [--out damage.csv]
"""

from __future__ import annotations

import argparse
import csv
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import cont2discrete, dlsim

import rcorefine as rco

SENSORS = ("displacement", "velocity", "acceleration")


def made(seed: int) -> tuple[rco.PhysicalModel, rco.Measurement, dict[int, float]]:
    """Undamaged model, record of the damaged chain, and its losses by link."""
    rng = np.random.default_rng([seed, 311])
    n = int(rng.integers(3, 7))
    masses, dampers = rng.uniform(0.7, 1.4, n), rng.uniform(0.2, 0.5, n)
    springs = rng.uniform(500.0, 1000.0, n)
    push, seen = int(rng.integers(n)), int(rng.integers(n))
    kind = SENSORS[int(rng.integers(3))]
    links = rng.choice(n, 1 + int(rng.integers(2)), replace=False)
    losses = {int(i) + 1: float(rng.uniform(0.1, 0.6)) for i in sorted(links)}
    noise, samples, dt = float(rng.uniform(0.01, 0.03)), 3000, 0.01
    model = rco.mass_spring_damper(
        list(masses), list(dampers), list(springs), force=push + 1, sensors=[(kind, seen + 1)]
    )
    soft = springs.copy()
    for link, loss in losses.items():
        soft[link - 1] *= 1.0 - loss
    ends = np.eye(n) - np.eye(n, k=-1)
    minus = -np.diag(1.0 / masses) @ ends.T
    A = np.block([[np.zeros((n, n)), np.eye(n)], [minus @ np.diag(k) @ ends for k in (soft, dampers)]])
    B = np.eye(2 * n)[:, n + push : n + push + 1] / masses[push]
    at = {"displacement": np.eye(2 * n)[seen], "velocity": np.eye(2 * n)[n + seen]}
    D = B[n + seen : n + seen + 1] if kind == "acceleration" else np.zeros((1, 1))
    w = rng.standard_normal(samples)
    y = dlsim((*cont2discrete((A, B, at.get(kind, A[n + seen])[None], D), dt)[:4], dt), w)[1][:, 0]
    y = y + noise * y.std() * rng.standard_normal(samples)
    return model, rco.Measurement(w, y, dt=dt), losses


def one(seed: int) -> dict[str, Any]:
    model, data, losses = made(seed)
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = rco.localize_damage(model, data)
    seconds = time.process_time() - begin
    truth = {f"stiffness at link{i}": -100.0 * loss for i, loss in losses.items()}
    named = {row.label: row for row in found.named}
    # a set that the record cannot tell from the named one counts as named where it is listed
    alike = all(label in named or any(label in row.rivals for row in found.named) for label in truth) and len(
        named
    ) == len(truth)
    off = [abs(named[k].percent - v) / named[k].percent_std for k, v in truth.items() if k in named]
    return {
        "seed": seed, "masses": len(model.masses) if hasattr(model, "masses") else model.linear.n_states // 2,
        "truth": "; ".join(f"{k} {v:.0f}" for k, v in truth.items()),
        "named": "; ".join(f"{k} {row.percent:.0f}" for k, row in named.items()),
        "exact": set(named) == set(truth), "alike": alike,
        "false": sum(label not in truth and row.p_value < 0.01 for label, row in named.items()),
        "worst": round(max(off, default=np.nan), 1), "explained": found.explained, "cpu": round(seconds, 2),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--records", type=int, default=40)
    parser.add_argument("--out", type=Path, help="a CSV file with a line per record")
    asked = parser.parse_args()
    rows = []
    for seed in range(asked.first, asked.first + asked.records):
        rows.append(one(seed))
        print("{seed:4} {masses} masses  {truth:52} {exact!s:5} {cpu:6.2f} s".format(**rows[-1]), flush=True)
        if not rows[-1]["exact"]:
            print(" " * 15 + "named: " + rows[-1]["named"], flush=True)
        if asked.out:
            with asked.out.open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, rows[0].keys())
                writer.writeheader()
                writer.writerows(rows)
    count = len(rows)
    exact, alike, false = (sum(int(row[key]) for row in rows) for key in ("exact", "alike", "false"))
    print(
        f"exactly the true set {exact}/{count}, or with it listed as an alternative {alike}/{count}; "
        f"false names {false}; CPU median {np.median([row['cpu'] for row in rows]):.2f} s, "
        f"largest {max(row['cpu'] for row in rows):.2f} s"
    )


if __name__ == "__main__":
    main()
