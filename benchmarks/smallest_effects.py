"""Is the smallest effect that an adequate record would have shown, shown by such a record?

A record with nothing missing names, for every candidate, the coefficient that it would have
shown in 95 of 100 cases. One of them, at 1/1.5, 1 and 1.5 times that size, is then put into
the plant and a fresh record is diagnosed.

    python benchmarks/smallest_effects.py --seeds 100 --first 25000
"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np
from hidden_effects import interval

import rcorefine as rco

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from hidden.generator import (
    SECOND_ORDER,
    Hidden,
    Law,
    excitation,
    forces,
    hidden_record,
    integrate,
    linear_states,
    outputs,
)

FACTORS = (1 / 1.5, 1.0, 1.5)


def with_effect(
    blank: Hidden, kind: str, at: str, coefficient: float, rng: np.random.Generator
) -> rco.Measurement:
    """Fresh record of the plant with one effect, as noisy as the blank one."""
    plant = blank.plant
    place = next(p for p in plant.places if p.name == at)
    w = excitation(rng, plant, blank.data.n_samples)
    x0 = linear_states(plant, w)
    law = Law(kind, np.array([coefficient, 0.003 * float(np.std(place.v @ x0)), 0.0]))
    x = integrate(plant, w, law, place)
    y = outputs(plant, x, w, forces(plant, x, law, place), place)
    level = blank.noise * outputs(plant, x0, w, None, None).std(axis=1, keepdims=True)
    return rco.Measurement(w, y + level * rng.standard_normal(y.shape), dt=plant.dt, hold="foh")


def one(seed: int, samples: int) -> tuple[str, list[bool]] | None:
    """Kind, and whether each size was noticed; None where the blank record is not adequate."""
    blank = hidden_record(seed, effect=None, samples=samples)
    rng = np.random.default_rng([seed, 80])
    found = rco.diagnose(blank.plant.model, blank.data, candidates=blank.candidates)
    known = [d for d in found.detectable if d.effect.kind in SECOND_ORDER]
    if not known:
        return None
    chosen = known[int(rng.integers(len(known)))]
    seen = []
    for factor in FACTORS:
        data = with_effect(blank, chosen.effect.kind, chosen.effect.place, factor * chosen.smallest, rng)
        verdict = rco.diagnose(blank.plant.model, data, candidates=blank.candidates).verdict
        seen.append(verdict != "adequate")
    return chosen.effect.kind, seen


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=25000)
    parser.add_argument("--samples", type=int, default=4000)
    given = parser.parse_args()
    kinds, rows = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for seed in range(given.first, given.first + given.seeds):
            try:
                result = one(seed, given.samples)
            except FloatingPointError:
                continue  # the plant with this effect runs away
            if result is not None:
                kinds.append(result[0])
                rows.append(result[1])
    table = np.array(rows)
    print(f"{'kind':22} {'n':>4}" + "".join(f" {f'x {factor:.2f}':>12}" for factor in FACTORS))
    for kind in [*sorted(set(kinds)), "all"]:
        mine = table if kind == "all" else table[[k == kind for k in kinds]]
        print(f"{kind:22} {len(mine):4d}" + "".join(f" {100 * share:10.0f} %" for share in mine.mean(axis=0)))
    for factor, share in zip(FACTORS, table.T, strict=True):
        low, high = interval(int(share.sum()), len(share))
        print(f"x {factor:.2f}: noticed in {share.mean():.1%}, 95 % interval {low:.0f}-{high:.0f} %")


if __name__ == "__main__":
    main()
