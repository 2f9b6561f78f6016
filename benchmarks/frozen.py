"""Answers on fixed seeds, written once, compared later: for changes of structure that must change none.

    python benchmarks/frozen.py --write before.json
    python benchmarks/frozen.py --against before.json          # ends with 1 where a figure moved
    python benchmarks/frozen.py --write before.json --only refiner map

The records come from ``tests/hidden`` and from scipy; the figures are verdicts, effects, coefficients,
standard deviations, probabilities, p-values and refined matrices, to 1e-6. Compare on one machine only:
another processor rounds differently, and a search can end elsewhere.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import rcorefine as rco

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parent))
from failure_map import structure
from hidden.generator import SECOND_ORDER, several_hidden
from hidden_effects import ROWS, record_of
from monitor import changing_record

RELATIVE = 1e-6
SEEDS = (910, 911)


def of_effect(effect: rco.Effect) -> str:
    """Name of an effect."""
    return f"{effect.kind} at {effect.place}"


def of_tests(tests: Any) -> dict[str, float]:
    """P-value of each test."""
    return {t.name: t.p_value for t in tests}


def of_system(system: Any) -> dict[str, Any]:
    """Matrices of a system."""
    return {name: np.asarray(getattr(system, name)).tolist() for name in "ABCD"}


def of_refinement(found: rco.Refinement) -> dict[str, Any]:
    """Parameters with their standard deviations, and the errors."""
    rows = {f"{row.kind} at {row.place}: {row.name}": [row.value, row.std] for row in found.parameters}
    return {"parameters": rows, "rmse": found.rmse.tolist(), "system": of_system(found.system)}


def of_diagnosis(found: rco.Diagnosis) -> dict[str, Any]:
    """Verdict, every row of the ranking, every test."""
    ranking = [
        {
            "effect": of_effect(row.effect),
            "coefficients": row.coefficients,
            "std": row.std,
            "fit": np.asarray(row.fit_after).tolist(),
            "p": row.p_value,
            "probability": row.probability,
        }
        for row in found.ranking
    ]
    return {
        "verdict": found.verdict,
        "ambiguous": [of_effect(e) for e in found.ambiguous],
        "ranking": ranking,
        "tests": of_tests(found.tests),
        "winner": of_tests(found.winner_tests),
    }


def hidden_effects() -> Iterator[tuple[str, Any]]:
    """`diagnose` on the rows of hidden_effects.py."""
    for rows in ROWS.values():
        for name, record, settings in rows:
            for seed in SEEDS:
                try:
                    hidden = record_of(seed, **{"samples": 2500, **record})
                except FloatingPointError:
                    continue
                found = rco.diagnose(
                    hidden.plant.model, hidden.data, candidates=hidden.candidates, **settings
                )
                yield f"{name}, {seed}", of_diagnosis(found)


def ladders() -> Iterator[tuple[str, Any]]:
    """`improve` on chains with two effects, and `confirm` on what it returns."""
    for seed in SEEDS:
        try:
            plant, data, _ = several_hidden(seed, 2, samples=3000)
        except FloatingPointError:
            continue
        laws = [rco.Effect(kind, place.name) for place in plant.places for kind in SECOND_ORDER]
        ladder = rco.improve(plant.model, data, candidates=laws)
        steps = [
            [step.action, "" if step.effect is None else of_effect(step.effect), step.coefficients, step.std]
            for step in ladder.steps
        ]
        errors = [step.validation_rmse.tolist() for step in ladder.steps]
        yield f"two effects, {seed}", {"verdict": ladder.verdict, "steps": steps, "rmse": errors}


def monitors() -> Iterator[tuple[str, Any]]:
    """`Monitor` on a stiffness that is lost in one step."""
    for seed in SEEDS:
        change = changing_record(seed, lambda periods: float(periods > 0))
        monitor = rco.Monitor(change.plant.model, dt=change.plant.dt, hold="foh", learn=3000)
        for block in np.array_split(np.arange(change.w.shape[1]), 40):
            monitor.update(change.w[:, block], change.y[:, block])
        alarm = monitor.alarm
        yield (
            f"step, {seed}",
            {
                "alarm": None if alarm is None else str(alarm),
                "ranking": [str(row) for row in monitor.ranking],
            },
        )


def failure_maps() -> Iterator[tuple[str, Any]]:
    """Rows of the failure map of structures whose model has a wrong spring, gain or nothing wrong."""
    for seed in SEEDS:
        s = structure(seed)
        y = s.response()
        noise = 0.02 * y.std(axis=1, keepdims=True) * np.random.default_rng(seed).standard_normal(y.shape)
        for name, record in (("exact", y), ("gain", 1.1 * y), ("clipped", np.clip(y, -y.std(), y.std()))):
            compared = rco.compare(s.model, rco.Measurement(s.w, record + noise, dt=0.02))
            rows = [[f.where, f.measure, f.statistic, f.p_value, f.sentence] for f in compared.failures]
            yield f"{name}, {seed}", {"fit": compared.fit.tolist(), "rows": rows}


def localization() -> Iterator[tuple[str, Any]]:
    """`localize_damage` and `refine` on a chain with one weak spring."""
    masses, springs = [1.0, 1.3, 0.8], np.array([200.0, 260.0, 180.0])
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        force = rng.standard_normal(3000)
        sound = rco.mass_spring_damper(masses, [0.4] * 3, springs, sensors="velocity")
        worn = rco.mass_spring_damper(masses, [0.4] * 3, springs * [1.0, 0.85, 1.0], sensors="velocity")
        y = rco.simulate(worn, rco.Measurement(force, np.zeros((3, 3000)), dt=0.02), "zero").outputs
        data = rco.Measurement(
            force, y + 0.03 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape), dt=0.02
        )
        found = rco.localize_damage(sound, data)
        yield f"weak spring, {seed}", {"text": str(found)}
        effects = [rco.Effect("stiffness", "link2"), rco.Effect("cubic_stiffness", "link1")]
        yield f"refine, {seed}", of_refinement(rco.refine(sound, data, effects))
        refiner = rco.RCORefiner(sound, dt=0.02, effects=effects[:1])
        refiner.update(data.inputs, data.outputs)
        yield f"stream, {seed}", of_system(refiner.system)


def refiners() -> Iterator[tuple[str, Any]]:
    """`RCORefiner` with its defaults and with the paper's settings on the paper's three examples."""
    for name in ("rlc", "one_dof", "two_dof"):
        example = getattr(rco.examples, name)()
        data = example.record(3000, noise=0.02, rng=2)
        for how, settings in (("defaults", {}), ("paper", example.settings)):
            refiner = rco.RCORefiner(example.initial, dt=example.dt, **settings)
            try:
                refiner.run(data)
            except rco.DivergenceError as error:
                yield f"{name}, {how}", str(error)
            else:
                yield f"{name}, {how}", of_system(refiner.discrete_system)


CASES: dict[str, Callable[[], Iterator[tuple[str, Any]]]] = {
    "effects": hidden_effects,
    "ladders": ladders,
    "monitor": monitors,
    "map": failure_maps,
    "localization": localization,
    "refiner": refiners,
}


def plain(value: Any) -> Any:
    """What JSON can hold, to the last bit."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (bool, str)) or value is None:
        return value
    return float(value)


def differences(before: Any, now: Any, where: str) -> Iterator[str]:
    """Each place where two answers differ by more than the tolerance."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in before.keys() | now.keys():
            if key not in before or key not in now:
                yield f"{where} / {key}: {'new' if key in now else 'gone'}"
            else:
                yield from differences(before[key], now[key], f"{where} / {key}")
    elif isinstance(before, list) and isinstance(now, list):
        if len(before) != len(now):
            yield f"{where}: {len(before)} entries before, {len(now)} now"
        for i, (one, two) in enumerate(zip(before, now, strict=False)):
            yield from differences(one, two, f"{where} [{i}]")
    elif isinstance(before, float) and isinstance(now, float):
        # p-values far below any level carry rounding in their exponent
        tiny = max(abs(before), abs(now)) < 1e-30
        if not (tiny or math.isclose(before, now, rel_tol=RELATIVE) or (before != before and now != now)):
            yield f"{where}: {before!r} before, {now!r} now"
    elif before != now:
        yield f"{where}: {before!r} before, {now!r} now"


def main() -> int:
    """Write the answers, or hold them against older ones."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    given = parser.parse_args()
    answers: dict[str, Any] = {}
    for name in given.only:
        began = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            answers[name] = {case: plain(answer) for case, answer in CASES[name]()}
        print(f"{name:14} {len(answers[name]):4d} answers {time.process_time() - began:7.1f} s", flush=True)
    if given.write:
        given.write.write_text(json.dumps(answers, indent=1))
    if given.against:
        before = {k: v for k, v in json.loads(given.against.read_text()).items() if k in answers}
        found = list(differences(before, answers, ""))
        print("\n".join(found) if found else "nothing moved")
        return int(bool(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
