"""Power table of `diagnose`: how often the hidden effect is named, and how often a name is wrong.

Plants, places, laws, strengths and noise are drawn at random by ``tests/hidden``, which
shares no code with the estimator and integrates with `scipy.integrate.solve_ivp`.

    python benchmarks/hidden_effects.py --rows null effects plants outside --seeds 100 --first 5000
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.stats import beta

import rcorefine as rco

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from hidden.generator import OUTSIDE, Hidden, fed_back, hidden_record
from hidden.strong import servo_record, strong_record

ROWS: dict[str, list[tuple[str, dict[str, object], dict[str, object]]]] = {
    "null": [
        ("nothing, white 3 %", {"effect": None}, {}),
        ("nothing, AR 0.9", {"effect": None, "noise_kind": "ar"}, {}),
        ("nothing, resonant + drift", {"effect": None, "noise_kind": "resonant"}, {}),
        ("nothing, heavy tails t3", {"effect": None, "noise_kind": "t3"}, {}),
        ("nothing, unmeasured force 3 %", {"effect": None, "unmeasured": 0.03}, {}),
        ("nothing, parameters 1 % off", {"effect": None, "detuned": 0.01}, {"tolerance": 0.01}),
        ("nothing, 5 % of reading", {"effect": None, "noise": 0.05, "noise_kind": "reading"}, {}),
        (
            "nothing, 5 % of reading, input in bursts",
            {"effect": None, "noise": 0.05, "noise_kind": "reading", "drive": "bursts"},
            {},
        ),
        ("nothing, input in bursts", {"effect": None, "drive": "bursts"}, {}),
        ("nothing, hammer", {"effect": None, "drive": "hammer"}, {}),
        ("nothing, 1 % spikes", {"effect": None, "noise_kind": "spikes"}, {}),
        ("nothing, dropouts", {"effect": None, "noise_kind": "dropouts"}, {}),
        ("nothing, hum", {"effect": None, "noise_kind": "hum"}, {}),
        ("nothing, 500 samples", {"effect": None, "samples": 500}, {}),
        ("nothing, direct feedback, unmeasured force 10 %", {"effect": "fed back"}, {}),
    ],
    "effects": [
        (f"{loss} % at {noise} % noise", {"loss": loss / 100, "noise": noise / 100}, {})
        for loss, noise in ((1, 1), (1, 3), (1, 10), (5, 3), (5, 10), (20, 3), (50, 10))
    ]
    + [
        ("5 % at 3 %, two sensors", {"sensors": 2}, {}),
        ("5 % at 3 %, AR 0.9", {"noise_kind": "ar"}, {}),
        ("20 % at 3 %, unmeasured force 3 %", {"loss": 0.2, "unmeasured": 0.03}, {}),
        ("20 % at 3 %, parameters 1 % off (nonlinear)", {"loss": 0.2, "detuned": 0.01}, {"tolerance": 0.01}),
    ],
    "plants": [
        (f"{plant}, {loss} % at 3 %", {"plant": plant, "loss": loss / 100}, {})
        for plant in ("motor", "quarter car", "RLC", "tanks", "thermal", "ring")
        for loss in (5, 20)
    ],
    "servo": [("servo, dry friction, 2 % noise", {"effect": "servo", "samples": 3500}, {})],
    "strong": [("strong effects, whole library", {"effect": "strong", "samples": 6000}, {})],
    "outside": [(f"outside: {kind}, 15 % at 3 %", {"effect": kind, "loss": 0.15}, {}) for kind in OUTSIDE],
}


def interval(hits: int, n: int) -> tuple[float, float]:
    """95 % Clopper-Pearson interval in percent."""
    low = beta.ppf(0.025, hits, n - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, n - hits) if hits < n else 1.0
    return 100 * low, 100 * high


def outcome(hidden: Hidden, found: rco.Diagnosis) -> str:
    """One word for what the diagnosis did."""
    if found.verdict in ("adequate", "unexplained"):
        return found.verdict
    truth = (hidden.kind, hidden.place)
    names = [(e.kind, e.place) for e in found.ambiguous]
    if found.verdict == "effect":
        return "right" if names[0] == truth else "wrong"
    if hidden.kind is None:
        return "wrong"
    # one mass between two walls: both springs are the same place by two names
    if all(kind == hidden.kind and hidden.plant.alike(place, hidden.place) for kind, place in names):
        return "right"
    return "with truth" if truth in names else "without"


_NAMED = ("any", "servo", "strong")  # records whose effect is in the library


def _wanted(record: dict) -> str:
    """What a perfect diagnosis would say."""
    effect = record.get("effect", "any")
    return {None: "adequate", "fed back": "adequate"}.get(
        effect, "unexplained" if effect in OUTSIDE else "right"
    )


def record_of(seed: int, *, effect: str | None = "any", **settings: object) -> Hidden:
    """The record of a row."""
    made = {"fed back": fed_back, "servo": servo_record, "strong": strong_record}.get(effect)
    if made is not None:
        return made(seed, **settings)
    return hidden_record(seed, effect=effect, **settings)


def run_row(first: int, seeds: int, record: dict, settings: dict, verbose: bool) -> dict[str, object]:
    """Rates of one row, error of the coefficient over its standard deviation, times."""
    counts: Counter[str] = Counter()
    times, deviations, claims, link = [], [], [], []
    for seed in range(first, first + seeds):
        try:
            hidden = record_of(seed, **record)
        except FloatingPointError:
            counts["no record"] += 1
            continue
        if settings.get("tolerance") and hidden.kind in ("stiffness", "damping"):
            continue  # a linear parameter off by its tolerance is no effect
        started = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = rco.diagnose(hidden.plant.model, hidden.data, candidates=hidden.candidates, **settings)
        times.append(time.process_time() - started)
        word = outcome(hidden, found)
        counts[word] += 1
        best = found.best
        if best is not None and hidden.place is not None:
            link.append(hidden.plant.alike(best.effect.place, hidden.place))
        if best is not None and found.verdict == "effect" and best.probability >= 0.95:
            claims.append(word == "right")
        if word in ("right", "with truth") and record.get("effect", "any") in _NAMED:
            for row in found.ranking:
                if (row.effect.kind, row.effect.place) == (hidden.kind, hidden.place):
                    name = next(iter(row.coefficients))
                    deviations.append((row.coefficients[name] - hidden.coefficient) / row.std[name])
        usual = _wanted(record)
        if verbose and word not in (usual, "with truth"):
            tests = found.winner_tests or found.tests
            worst = min(tests, key=lambda t: t.p_value)
            name = best.effect.label if best else ""
            ratio = found.force_ratio
            print(
                f"    {seed} {hidden.plant.name} {hidden.kind} at {hidden.place} "
                f"loss {hidden.loss:.3f}: {word} "
                f"{name} [{worst.name} {worst.p_value:.1e}] {ratio:g}",
                flush=True,
            )
    return {"counts": counts, "times": times, "deviations": deviations, "claims": claims, "link": link}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", nargs="+", default=list(ROWS), help="groups, or parts of the names of rows")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=5000)
    parser.add_argument("--samples", type=int, default=4000)
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    rows = [
        row
        for group, some in ROWS.items()
        for row in some
        if group in given.rows or any(g in row[0] for g in given.rows)
    ]
    print(
        f"{'row':44} {'n':>4} {'adequate':>9} {'right':>6} {'with truth':>10} {'wrong':>6} {'without':>8} "
        f"{'unexplained':>11} {'link':>5} {'s':>5} {'z sd':>5} {'cover':>6}  interval of the figure wanted"
    )
    for name, record, settings in rows:
        record = {"samples": given.samples, **record}
        result = run_row(given.first, given.seeds, record, settings, given.verbose)
        counts = result["counts"]
        n = sum(counts.values()) - counts["no record"]
        wanted = _wanted(record)
        low, high = interval(counts[wanted], n)
        z = np.array(result["deviations"])
        link = result["link"]
        print(
            f"{name:44} {n:4d} {counts['adequate']:9d} {counts['right']:6d} {counts['with truth']:10d} "
            f"{counts['wrong']:6d} {counts['without']:8d} {counts['unexplained']:11d} "
            f"{100 * np.mean(link) if link else np.nan:5.0f} "
            f"{np.median(result['times']):5.2f} {np.std(z) if z.size else np.nan:5.2f} "
            f"{100 * np.mean(np.abs(z) < 1.96) if z.size else np.nan:6.0f}  {wanted} {low:.0f}-{high:.0f} %"
            f"; claims >= .95: {sum(result['claims'])}/{len(result['claims'])}",
            flush=True,
        )


if __name__ == "__main__":
    main()
