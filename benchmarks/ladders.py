"""How often `improve` adds exactly what is hidden: none, two or three effects at different links.

python benchmarks/ladders.py --effects 0 2 3 --seeds 40 --first 1000
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from scipy.stats import beta

import rcorefine as rco

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from hidden.generator import SECOND_ORDER, hidden_record, several_hidden


def one(seed: int, count: int) -> tuple[str, float]:
    """What the ladder did, and its processor time in s."""
    if count:
        plant, data, hidden = several_hidden(seed, count)
    else:
        record = hidden_record(seed, effect=None, samples=4000)
        plant, data, hidden = record.plant, record.data, set()
    laws = [rco.Effect(kind, place.name) for place in plant.places for kind in SECOND_ORDER]
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ladder = rco.improve(plant.model, data, candidates=laws)
    found = {(e.kind, e.place) for e in ladder.effects}
    seconds = time.process_time() - began
    if found == hidden:
        return "exact", seconds
    return f"{plant.name}: hidden {sorted(hidden)}, found {sorted(found)}, {ladder.verdict}", seconds


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--effects", type=int, nargs="+", default=[0, 2, 3])
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--misses", action="store_true", help="say what was found instead")
    given = parser.parse_args()
    print(f"{'effects':>8} {'n':>4} {'exact set':>10}  95 % interval   median time [s]")
    for count in given.effects:
        words, times = [], []
        for seed in range(given.first, given.first + given.seeds):
            try:
                word, seconds = one(seed, count)
            except FloatingPointError:
                continue  # the plant with these effects runs away
            words.append(word)
            times.append(seconds)
            if given.misses and word != "exact":
                print(f"    {seed} {word}", flush=True)
        n, hits = len(words), words.count("exact")
        low = 100 * beta.ppf(0.025, hits, n - hits + 1) if hits else 0.0
        high = 100 * beta.ppf(0.975, hits + 1, n - hits) if hits < n else 100.0
        share = f"{hits}/{n}"
        print(
            f"{count:8d} {n:4d} {share:>10}  {low:.0f}-{high:.0f} %        {np.median(times):.1f}", flush=True
        )


if __name__ == "__main__":
    main()
