"""What `diagnose` and `improve` say of coursework: none, one or two effects are hidden, or a strange one.

Plants come from their physics (``tests/hidden/coursework.py``), half of them as a plain `StateSpace`. Of 40
records in a row 8 lack nothing, 18 one effect of the library, 6 two, and 8 one that is outside of it or a
product. Numbers of the model are 10 to 20 % off in half of the first two groups.

    python benchmarks/coursework.py --first 52000 --count 40 --out rows.jsonl
    python benchmarks/coursework.py --table rows.jsonl

*Right*: the set is named; with nothing missing, "adequate" or "parameters"; outside, a right name. *Tied*:
the set is in a tie. Numbers that are off may be named beside the effect. A changed number is right as
"parameters", too. Coefficients are judged where the numbers of the model are exact: else only ratios of force
and mass are known.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

os.environ.setdefault("OMP_NUM_THREADS", "1")
import rcorefine as rco

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from hidden.coursework import (
    LINEAR,
    ROLES,
    Coursework,
    Hidden,
    NoRecordError,
    at_the_input,
    coursework,
    labels,
)

NUMBERS = {"stiffness", "damping", "mass", "input_gain", "output_gain", "coefficient"}
FINE = ("adequate", "parameters")
SURE = 0.95


# ------------------------------------------------------------------ judging
def matches(effects: Iterable[rco.Effect], record: Coursework) -> bool:
    """Whether a set is the hidden one; numbers of the model may stand beside it where they are off."""
    left = list(record.hidden)
    for effect in effects:
        hit = next((one for one in left if one.named_by(effect, record.exact)), None)
        if hit is not None:
            left.remove(hit)
        elif not (record.off and effect.kind in NUMBERS):
            return False
    return not left


def under_all_names(row: Any) -> list[tuple[rco.Effect, ...]]:
    """The sets of a row: its own, and those that are the same change of the model."""
    return [row.effects, *(other.effects for other in row.same)]


def judged(found: rco.Diagnosis, record: Coursework) -> str:
    """Right, tied, wrong or unexplained."""
    verdict = found.verdict
    if verdict in FINE:
        number = [one.kind in LINEAR for one in record.hidden] == [True]
        return "right" if not record.hidden or (number and verdict == "parameters") else "wrong"
    if verdict == "unexplained":
        return "unexplained"
    if verdict == "effect":
        return "right" if any(matches(e, record) for e in under_all_names(found.best)) else "wrong"
    tied = [row for row in found.ranking if row.alike or row is found.best]
    return "tied" if any(matches(e, record) for row in tied for e in under_all_names(row)) else "wrong"


def judged_ladder(ladder: rco.Improvement, record: Coursework) -> str:
    """Right, tied, wrong or unexplained: the set after the last step, and the rivals of its steps."""
    if ladder.verdict == "unexplained":
        return "unexplained"
    if matches(ladder.effects, record):
        return "right"
    if not ladder.effects and [one.kind in LINEAR for one in record.hidden] == [True]:
        return "right" if any(step.action == "parameters" for step in ladder.steps) else "wrong"
    rivals = {s.effect: s.rivals for s in ladder.steps if s.effect is not None}
    for i, effect in enumerate(ladder.effects):
        for other in rivals.get(effect, ()):
            if matches([*ladder.effects[:i], other, *ladder.effects[i + 1 :]], record):
                return "tied"
    return "wrong"


def deviations(found: rco.Diagnosis, record: Coursework) -> list[float]:
    """Errors of the coefficients in standard deviations, where the set is named right."""
    errors = []
    for effect, rows in found.best.estimates:
        one: Hidden | None = next((h for h in record.hidden if h.named_by(effect, record.exact)), None)
        if one is not None:
            truth = one.truth(effect.place, record.exact)
            errors += [
                abs(row.coefficient - truth[name]) / row.std
                for name, row in rows.items()
                if name in truth and row.std > 0
            ]
    return [round(float(error), 2) for error in errors]


def as_set(effects: Iterable[rco.Effect]) -> list[str]:
    """Names of a set, in order."""
    return sorted(f"{effect.kind} at {effect.place}" for effect in effects)


# ------------------------------------------------------------------ one case
def timed(what: Callable[..., Any], *given: Any) -> tuple[Any, str, float]:
    """The answer or the words of the refusal, and the processor time in s."""
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            answer, error = what(*given), ""
        except rco.RCOError as refusal:
            answer, error = None, str(refusal)[:200]
    return answer, error, round(time.process_time() - began, 1)


def case(seed: int, *, improve: bool = True) -> dict[str, Any]:
    """One record through both, in words and figures."""
    record = coursework(seed)
    row: dict[str, Any] = {
        "seed": seed, "plant": record.name, "role": record.role, "plain": record.plain, "off": record.off,
        "drive": record.drive, "samples": record.data.n_samples, "bits": record.bits,
        "noise": round(record.share, 4), "loss": round(record.loss, 3),
        "truth": [described(one, record) for one in record.hidden],
    }  # fmt: skip
    found, error, row["diagnose_s"] = timed(rco.diagnose, record.model, record.data)
    if found is None:
        row |= {"verdict": "refused", "judged": "refused", "error": error}
    else:
        row |= of_diagnosis(found, record)
    if improve:
        ladder, error, row["improve_s"] = timed(rco.improve, record.model, record.data)
        if ladder is None:
            row |= {"improve_verdict": "refused", "improve_judged": "refused", "improve_error": error}
        else:
            row |= of_improvement(ladder, found, record)
    return row


def described(one: Hidden, record: Coursework) -> str:
    """The truth in words: kind, place by its name in the model, numbers."""
    numbers = ", ".join(f"{name} {value:.4g}" for name, (value, _) in one.coefficients.items())
    if isinstance(one.place, str):
        place = one.place
    elif isinstance(one.place, tuple):
        place = labels(record.exact)[one.place[0]][one.place[1]]
    else:
        ports = [port.name for port in rco.ports(record.exact) if one.scales(port.name, record.exact)]
        place = "/".join(ports) or next((at for _, at in one.strange.names), "no port")
    return f"{one.kind} at {place}" + (f" ({numbers})" if numbers else "")


def of_diagnosis(found: rco.Diagnosis, record: Coursework) -> dict[str, Any]:
    """Columns of a diagnosis."""
    best, named = found.best, found.verdict in ("effect", "ambiguous")
    word = judged(found, record)
    ties = [row.label for row in found.ranking if row.alike and row is not best]
    row: dict[str, Any] = {
        "verdict": found.verdict,
        "named": as_set(found.effects),
        "ties": ties if found.verdict == "ambiguous" else [],
        "probability": number(best.probability if named else np.nan),
        "none_of_these": number(found.none_of_these),
        "share": number(max((s.share for s in found.error_shares), default=np.nan)),
        "model_share": number(max((s.model for s in found.error_shares), default=np.nan)),
        "adequate_to": number(found.adequate_to),
        "judged": word,
    }
    if word == "right" and named and record.role != "outside" and not record.off:
        row["deviations"] = deviations(found, record)
    return row


def of_improvement(
    ladder: rco.Improvement, found: rco.Diagnosis | None, record: Coursework
) -> dict[str, Any]:
    """Columns of an improvement; the held-out error is that of another record, over its noise."""
    compared, error, _ = timed(rco.compare, ladder.refinement, record.test)
    row: dict[str, Any] = {
        "improve_verdict": ladder.verdict,
        "improve_set": as_set(ladder.effects),
        "improve_judged": judged_ladder(ladder, record),
        "held_out": number(np.max(np.ravel(compared.rmse) / record.noise)) if compared is not None else None,
    }
    if error:
        row["compare_error"] = error
    if found is not None:
        both = {found.verdict, ladder.verdict} == {"unexplained"}
        one = "unexplained" in (found.verdict, ladder.verdict)
        sets = [{at_the_input(e.kind, e.place, record.exact) for e in f.effects} for f in (found, ladder)]
        row["agree"] = both or (not one and sets[0] == sets[1])
    return row


def number(value: float) -> float | None:
    """Four digits, None where there is none."""
    return float(f"{value:.4g}") if np.isfinite(value) else None


# ------------------------------------------------------------------ the table
def rate(name: str, hits: Sequence[bool]) -> str:
    """A rate with its 95 % interval after Clopper and Pearson."""
    n, k = len(hits), sum(hits)
    if not n:
        return f"{name:48}   none"
    low = beta.ppf(0.025, k, n - k + 1) if k else 0.0
    high = beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return f"{name:48}{k:4d} of {n:3d}  {100 * k / n:4.0f} %  {100 * low:3.0f}-{100 * high:3.0f} %"


def table(rows: list[dict[str, Any]]) -> str:
    """The rates in 80 columns."""
    lines = [f"{'':48}{'':15}{'95 % interval':>14}"]
    for key, verb in (("judged", "diagnose"), ("improve_judged", "improve")):
        done = [r for r in rows if key in r]
        of = {role: [r[key] for r in done if r["role"] == role] for role in ROLES}
        if not done:
            continue
        lines.append(f"{verb}")
        lines.append(rate("  nothing missing: adequate or parameters", [w == "right" for w in of["nothing"]]))
        for role, words in (("one", "one effect"), ("two", "two effects")):
            lines.append(rate(f"  {words}: right", [w == "right" for w in of[role]]))
            lines.append(rate(f"  {words}: right or tied", [w in ("right", "tied") for w in of[role]]))
        plain = [r[key] in ("right", "tied") for r in done if r["role"] == "one" and r["plain"]]
        built = [r[key] in ("right", "tied") for r in done if r["role"] == "one" and not r["plain"]]
        off = [r[key] in ("right", "tied") for r in done if r["role"] == "one" and r["off"]]
        lines.append(rate("  one effect, plain ct.ss: right or tied", plain))
        lines.append(rate("  one effect, builder: right or tied", built))
        lines.append(rate("  one effect, numbers off: right or tied", off))
        good = [w in ("unexplained", "right", "tied") for w in of["outside"]]
        lines.append(rate("  outside: unexplained or named right", good))
    sure = [r for r in rows if r.get("verdict") == "effect" and (r["probability"] or 0) >= SURE]
    lines.append(rate(f"claims at P >= {SURE:.2f} right", [r["judged"] == "right" for r in sure]))
    errors = [z for r in rows for z in r.get("deviations", ())]
    lines.append(rate("coefficients of right names within 2 sd", [z <= 2 for z in errors]))
    lines.append(rate("coefficients of right names within 3 sd", [z <= 3 for z in errors]))
    both = [r for r in rows if "agree" in r]
    lines.append(rate("diagnose and improve agree on word and set", [bool(r["agree"]) for r in both]))
    held = [r for r in rows if r.get("held_out") is not None]
    right = [r["held_out"] <= 1.05 for r in held if r["improve_judged"] == "right"]
    lines.append(rate("held-out error within 5 % of the noise", [r["held_out"] <= 1.05 for r in held]))
    lines.append(rate("  where improve is right", right))
    lines.append(rate("refused", [r["judged"] == "refused" for r in rows]))
    for key in ("diagnose_s", "improve_s"):
        spent = [r[key] for r in rows if key in r]
        if spent:
            lines.append(
                f"CPU of {key[:-2]}: median {np.median(spent):.0f} s, largest {max(spent):.0f} s, over 20 s "
                f"{sum(s > 20 for s in spent)}, over 60 s {sum(s > 60 for s in spent)} of {len(spent)}"
            )
    return "\n".join(lines)


def told(row: dict[str, Any]) -> str:
    """A case in a few lines of 80 columns."""
    head = f"{row['seed']} {row['plant']}, {row['role']}, {'plain' if row['plain'] else 'builder'}"
    head += ", off" if row["off"] else ""
    said = f"  diagnose {row['judged']}: {row['verdict']} {row.get('named', '')} P {row.get('probability')}"
    after = f"  improve {row.get('improve_judged')}: {row.get('improve_verdict')} {row.get('improve_set')}"
    return "\n".join([head, f"  truth {row['truth']}, loss {row['loss']}, noise {row['noise']}", said, after])


def read(path: Path) -> list[dict[str, Any]]:
    """Rows of a file, none where it is not there."""
    return (
        [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
    )


def main() -> None:
    """Run the cases that the file lacks, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=52000)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--out", type=Path, help="a JSON line per case; cases that it has are skipped")
    parser.add_argument("--skip-improve", action="store_true")
    parser.add_argument("--table", type=Path, help="print the rates of a file and the cases that went wrong")
    given = parser.parse_args()
    if given.table:
        rows = read(given.table)
        missed = [
            r for r in rows if r["judged"] in ("wrong", "refused") or r.get("improve_judged") == "wrong"
        ]
        print("\n".join([*map(told, missed), "", table(rows)]))
        return
    rows = read(given.out) if given.out else []
    done = {row["seed"] for row in rows}
    for seed in range(given.first, given.first + given.count):
        if seed in done:
            continue
        try:
            row = case(seed, improve=not given.skip_improve)
        except NoRecordError as reason:
            print(reason, flush=True)
            continue
        rows.append(row)
        print(told(row), flush=True)
        if given.out:
            with given.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
