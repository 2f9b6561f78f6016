"""What `diagnose` says off the chains: other plants, laws that no library has, records that are odd.

Plants come as a plain `StateSpace`, the whole default library is offered; ``tests/hidden/wider.py`` makes the
records and shares no code with the estimator.

    python benchmarks/verdicts.py --rows nothing outside inside --seeds 60 --first 30000 --out verdicts.csv
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from scipy.stats import beta

import rcorefine as rco

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from hidden.wider import DRIVES, OUTSIDE, PLANTS, STATIC, Wider, wider_record

EVERY = ("chain", "servo", "motor", "half car", "RC ladder", "thermal", "geared drive", "pendulum")
WARM = ("thermal", "RC ladder")
MOVING = ("chain", "half car", "geared drive", "pendulum")
#: Laws of the library that are the one hidden.
NAMES = {
    "smooth friction": "smooth_friction", "v^1.5": "power_damping", "sqrt v": "power_damping",
    "soft dead zone": "soft_clearance", "lugre": "lugre_friction", "backlash": "play",
    "radiation": "radiation",
}  # fmt: skip
FINE = ("adequate", "parameters")

ROWS: dict[str, list[tuple[str, tuple[str, ...], dict[str, object]]]] = {
    "nothing": [
        ("nothing, numbers exact", EVERY, {}),
        ("nothing, numbers 2 % off", EVERY, {"off": 0.02}),
        ("nothing, numbers 5 % off", EVERY, {"off": 0.05}),
        ("nothing, numbers 15 % off", EVERY, {"off": 0.15}),
        ("nothing, numbers 35 % off", EVERY, {"off": 0.35}),
        ("nothing, clock .2 % off", EVERY, {"clock": 0.002}),
        ("nothing, sensor gain 2 % off", EVERY, {"gain": 0.02}),
        ("nothing, 7 bits", EVERY, {"bits": 7, "noise": 0.005}),
        ("nothing, input noise 5 %", EVERY, {"input_noise": 0.05}),
        *((f"nothing, {kind}", EVERY, {"drive_kind": kind}) for kind in DRIVES[1:]),
        ("nothing, starts in motion", EVERY, {"cut": 400}),
        ("nothing, 300 samples", EVERY, {"samples": 300}),
        ("nothing, 800 samples", EVERY, {"samples": 800}),
        ("nothing, 20,000 samples", EVERY, {"samples": 20000}),
    ],
    "outside": [
        (f"{kind}, {loss} %", WARM if kind == "radiation" else MOVING, {"kind": kind, "loss": loss / 100})
        for kind in OUTSIDE
        for loss in (5, 15)
    ],
    "inside": [(f"{plant}, 5 % at 3 %", (plant,), {"kind": "any"}) for plant in PLANTS],
}  # fmt: skip


def interval(hits: int, n: int) -> tuple[float, float]:
    """95 % Clopper-Pearson interval in percent."""
    low = beta.ppf(0.025, hits, n - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, n - hits) if hits < n else 1.0
    return 100 * low, 100 * high


def is_truth(record: Wider, model: object, effect: rco.Effect) -> bool:
    """Whether an effect is what was hidden, where it was hidden."""
    return effect.kind == NAMES.get(record.kind, record.kind) and record.at_truth(effect.place, model)


def run(task: tuple[str, int, str, dict[str, object]]) -> dict[str, object]:
    """One record through `diagnose`, in words and figures."""
    name, seed, plant, settings = task
    row: dict[str, object] = {"row": name, "seed": seed, "plant": plant, "outcome": "no record"}
    try:
        record = wider_record(seed, plant=plant, **{"kind": None, **settings})
    except FloatingPointError:
        return row
    model = record.plant.model
    row |= {"kind": record.kind or "", "site": record.site.name if record.site else ""}
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = rco.diagnose(model, record.data)
        except rco.RCOError as error:
            return row | {"outcome": "refused", "named": str(error)[:60], "seconds": 0.0}
    row["seconds"] = round(time.process_time() - started, 2)
    best = found.best
    named = best.effect.label if best is not None else ""
    probability = best.probability if best is not None and found.verdict == "effect" else float("nan")
    row |= {"verdict": found.verdict, "named": named, "probability": round(float(probability), 4)}
    row["alike"] = "; ".join(e.label for e in found.ambiguous)
    if found.verdict == "effect":
        row["outcome"] = "right" if is_truth(record, model, best.effect) else "wrong"
    elif found.verdict == "ambiguous":
        held = any(is_truth(record, model, e) for e in found.ambiguous)
        row["outcome"] = "with truth" if held else "without"
    else:
        row["outcome"] = found.verdict
    place = getattr(found, "place", None)
    where = getattr(place, "name", place) or (best.effect.place if best is not None else "")
    row["placed"] = bool(where) and record.at_truth(str(where), model)
    if record.kind in STATIC and found.verdict == "unexplained" and hasattr(found, "law"):
        row["tabulated"] = round(_left(record, model, found), 3)
    return row


def _left(record: Wider, model: object, found: rco.Diagnosis) -> float:
    """Error with the tabulated law on another record, over the noise."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            better = rco.refine(model, record.data, effects=[found.law()])
            left = rco.compare(better, record.test).rmse
        except rco.RCOError:
            return float("nan")
    spread = record.test.outputs.std(axis=1) * record.noise / np.sqrt(1 + record.noise**2)
    return float(np.max(np.ravel(left) / spread))


def wanted(row: dict[str, object]) -> bool:
    """Whether the outcome is what one would wish for."""
    if not row["kind"]:
        return row["outcome"] in FINE
    good = ("right", "with truth")
    if row["kind"] in OUTSIDE:
        good = (*good, "unexplained")
    return row["outcome"] in good


def line(name: str, rows: list[dict[str, object]]) -> str:
    """A row of the table."""
    rows = [r for r in rows if r["outcome"] != "no record"]
    if not rows:
        return f"{name:30.30} no record"
    counts = Counter(str(r["outcome"]) for r in rows)
    sure = [r for r in rows if r.get("verdict") == "effect" and float(r["probability"]) >= 0.95]
    wrong = sum(r["outcome"] == "wrong" for r in sure)
    low, high = interval(sum(map(wanted, rows)), len(rows))
    placed = [r["placed"] for r in rows if r.get("kind") and "placed" in r]
    left = [r["tabulated"] for r in rows if "tabulated" in r]
    words = ", ".join(f"{word} {count}" for word, count in counts.most_common())
    text = f"{name:30.30} {len(rows):3d} {low:3.0f}-{high:3.0f} % sure {len(sure):3d} wrong {wrong:2d}"
    text += f" place {100 * np.mean(placed):3.0f}" if placed else " " * 10
    text += f" {np.median([float(r['seconds']) for r in rows]):5.1f} s"
    text += f" law {np.nanmedian(left):4.2f}" if left else ""
    return f"{text}  {words}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="+", default=list(ROWS), help="groups, or parts of the names of rows")
    parser.add_argument("--seeds", type=int, default=60)
    parser.add_argument("--first", type=int, default=30000)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", help="a CSV file with a line per record")
    given = parser.parse_args()
    chosen = [
        row
        for group, some in ROWS.items()
        for row in some
        if group in given.rows or any(g in row[0] for g in given.rows)
    ]
    print(f"{'row':30}   n  as wished   P >= .95", flush=True)
    every: list[dict[str, object]] = []
    with ProcessPoolExecutor(given.workers) as pool:
        for name, plants, settings in chosen:
            seeds = range(given.first, given.first + given.seeds)
            tasks = [(name, s, plants[s % len(plants)], settings) for s in seeds]
            rows = list(pool.map(run, tasks))
            every += rows
            print(line(name, rows), flush=True)
            if given.out:
                fields = list(dict.fromkeys(key for r in every for key in r))
                with open(given.out, "w", newline="", encoding="utf-8") as file:
                    writer = csv.DictWriter(file, fields)
                    writer.writeheader()
                    writer.writerows(every)
    sure = [r for r in every if r.get("verdict") == "effect" and float(r["probability"]) >= 0.95]
    right = sum(r["outcome"] == "right" for r in sure)
    print(f"claims at P >= .95: {right} of {len(sure)} right")


if __name__ == "__main__":
    main()
