"""Claimed probability against observed right: plants, laws and nuisances that no test has.

Plants are written out from their physics, with a Runge-Kutta method of their own. Each seed draws a plant,
what is missing (or wrong numbers, a fault of the input, nothing), an input, a nuisance, the noise and how the
model is handed over; `diagnose` runs by its default settings.

    python benchmarks/calibration.py --first 1000 --seeds 120 --out benchmarks/calibration.csv
    python benchmarks/calibration.py --draw benchmarks/calibration.csv  # table, picture
"""

from __future__ import annotations

import argparse
import csv
import itertools
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from calibration_plants import controller, handed, made
from scipy.stats import beta

import rcorefine as rco

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "calibration.png"
BINS = (0.0, 0.5, 0.8, 0.95, 1.0)
FIELDS = (
    "seed",
    "plant",
    "handed",
    "type",
    "missing",
    "site",
    "nuisance",
    "input",
    "samples",
    "records",
    "noise",
    "verdict",
    "named",
    "place",
    "probability",
    "none_of_these",
    "outcome",
    "seconds",
)


def along(a, b):
    """Whether two rows are one direction."""
    if not np.any(a) or not np.any(b):
        return not np.any(a) and not np.any(b)
    return abs(a @ b) > 0.999 * np.linalg.norm(a) * np.linalg.norm(b)


def is_truth(effect, c, truth, p, model):
    """Whether an effect is what was hidden, where it was; a single number by the kind of its letter."""
    if "number" in c:
        letter = c["number"][0]
        kinds = {"m": "mass", "J": "mass", "k": "stiffness", "c": "damping", "b": "damping", "G": "damping"}
        return effect.kind in (kinds.get(letter, "damping"), "coefficient")
    if effect.kind not in truth:
        return False
    if c["type"] != "site" or c["handed"] == "tf":
        return True
    _, v, g, _ = p.sites[c["site"]]
    port = next((port for port in rco.ports(model) if port.name == effect.place), None)
    return port is not None and bool(along(port.velocity, v) and along(port.act, g))


def outcome(found, c, truth, p, model):
    """The verdict against the truth, in a word."""
    right = [is_truth(effect, c, truth, p, model) for effect in found.ambiguous]
    if found.verdict == "effect":
        named = [is_truth(effect, c, truth, p, model) for effect in found.effects]
        return "right" if all(named) else "partly" if any(named) else "wrong"
    if found.verdict == "ambiguous":
        return "with truth" if any(right) else "without"
    if found.verdict == "unexplained":
        return "unexplained"
    fine = {"adequate": c["type"] == "none", "parameters": "P" in truth}[found.verdict]
    return "right" if fine else "missed" if found.verdict == "adequate" else "other numbers"


def run(seed):
    """One diagnosis as a row; None where there is no record."""
    c, truth, p, records = made(seed)
    if records is None:
        return None
    model, options = handed(p, c["handed"]), {"controller": controller(p)} if p.loop else {}
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = rco.diagnose(model, records[0] if len(records) == 1 else records, **options)
    best = found.best
    row = {**c, "verdict": found.verdict, "seconds": round(time.process_time() - started, 1)}
    if found.verdict in ("effect", "ambiguous") and best is not None:
        row |= {
            "named": "+".join(effect.kind for effect in best.effects),
            "place": best.effect.place,
            "none_of_these": round(found.none_of_these, 4),
        }
        row["probability"] = round(float(best.probability), 4)
    return row | {"outcome": outcome(found, c, truth, p, model)}


def interval(hits, n):
    """95 % Clopper-Pearson interval in percent."""
    low = beta.ppf(0.025, hits, n - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, n - hits) if hits < n else 1.0
    return 100 * low, 100 * high


def table(rows):
    """What was claimed and what was right, and the words by what was missing."""
    claims = [r for r in rows if r["verdict"] == "effect"]
    points = []
    for low, high in itertools.pairwise(BINS):
        inside = [
            r
            for r in claims
            if low <= float(r["probability"]) < high or (high == 1.0 == float(r["probability"]))
        ]
        if not inside:
            continue
        right = sum(r["outcome"] == "right" for r in inside)
        mean = float(np.mean([float(r["probability"]) for r in inside]))
        bounds = interval(right, len(inside))
        points.append((mean, right / len(inside), *bounds))
        print(
            f"named, P {low:4.2f}-{high:4.2f} (mean {mean:.2f}): right {right} of {len(inside)}"
            f" ({bounds[0]:.0f}-{bounds[1]:.0f} %)"
        )
    for kind in ("none", "numbers", "input", "site"):
        words = Counter(f"{r['verdict']}, {r['outcome']}" for r in rows if r["type"] == kind)
        print(f"{kind:8} {sum(words.values()):3d}: " + "; ".join(f"{w} {k}" for w, k in words.most_common()))
    return points


def draw(points):
    """The picture of the page."""
    import matplotlib.pyplot as plt

    fig, ax = plt.subplots(figsize=(4.6, 4.2))
    mean, right, low, high = np.array(points).T
    spread = 100 * right - low, high - 100 * right
    ax.plot([0, 100], [0, 100], color="0.7", lw=1)
    ax.errorbar(100 * mean, 100 * right, np.maximum(spread, 0), fmt="o", color="tab:blue", capsize=3)
    ax.set(xlabel="claimed probability [%]", ylabel="right [%]", xlim=(0, 103), ylim=(0, 103))
    ax.grid(alpha=0.3)
    fig.tight_layout()
    fig.savefig(PICTURE, dpi=90)


def main():
    """Run seeds, or draw what was run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--out", help="a CSV file with a line per record")
    parser.add_argument("--draw", nargs="+", help="CSV files to draw")
    given = parser.parse_args()
    rows = []
    for name in given.draw or ():
        with open(name, newline="", encoding="utf-8") as file:
            rows += list(csv.DictReader(file))
    for seed in range(given.first, given.first + given.seeds) if not given.draw else ():
        row = run(seed)
        if row is None:
            continue
        rows.append(row)
        print(*(row.get(key, "") for key in FIELDS), flush=True)
        if given.out:
            with open(given.out, "w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, FIELDS, extrasaction="ignore")
                writer.writeheader()
                writer.writerows(rows)
    points = table(rows)
    if given.draw:
        draw(points)


if __name__ == "__main__":
    main()
