"""Run the shadow on calibration seeds: a block per record, and a row in a CSV file."""

from __future__ import annotations

import csv
import sys
import time
import traceback
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from calibration import is_truth
from calibration_plants import controller, handed, made
from search import Search
from verdict import verdict

from rcorefine.arithmetic import own_arithmetic
from rcorefine.diagnosis.case import Case
from rcorefine.engine.free_runs import integrates
from rcorefine.inference.assembly import offsets_everywhere
from rcorefine.inference.windows import as_data, spread_lines
from rcorefine.models.conversion import under_control
from rcorefine.models.operating_point import ordered_record
from rcorefine.progress import Progress
from rcorefine.refinement.base_fit import base_fit
from rcorefine.refinement.refine import refit


def case_of(model, data, candidates=None, controller=None):
    options = {"free": (), "tolerance": 0.0, "offset": True, "noise": None, "horizon": None}
    given = as_data(data, controller=controller)
    model = under_control(model, controller, data)
    records = spread_lines(given)
    base = base_fit(model, records, **options)
    ordered = [ordered_record(base.physical_model, r) for r in records]
    offsets = {e.kind for e, role in zip(base.effects, base.roles, strict=True) if role == "offset"}
    if offsets and not integrates(base.physical_model.linear, ordered[0]):
        everywhere = offsets_everywhere(base.physical_model, ordered)
        base = refit(
            base, records, offsets=everywhere, elsewhere=False, tolerance=0.0, noise=None, horizon=None
        )
    return Case.prepare(base, records, candidates, options | {"candidates": None}, 0.01, Progress(), True)


def words(s, trial):
    names = "+".join(f"{e.kind}@{e.place}" for e in trial.effects) or "nothing"
    force = f" | force {s.ratio(trial.base):g}" if s.ratio(trial.base) else ""
    return names + (" | numbers" if s.is_floated(trial) else "") + force


def one(seed, show=5):
    """One record: what was said as a row, and the table printed."""
    c, truth, p, records = made(seed)
    if records is None:
        return None
    start = time.process_time()
    with warnings.catch_warnings(), own_arithmetic():
        warnings.simplefilter("ignore")
        model = handed(p, c["handed"])
        search = Search(case_of(model, records, controller=controller(p) if p.loop else None)).run()
        word, named, probability, trial, _ = verdict(search)
        p_value = search.tested(trial)[0]
    cpu = time.process_time() - start
    true = [bool(truth) and is_truth(e, c, truth, p, model) for e in named]
    right = {
        "adequate": c["type"] == "none",
        "parameters": "P" in truth,
        "unexplained": False,
    }.get(word, len(named) == 1 and true[0])
    row = {key: c[key] for key in ("seed", "plant", "handed", "type", "missing", "site", "nuisance", "input")}
    row |= {
        "noise": c["noise"],
        "loss": c["loss"],
        "verdict": word,
        "named": "+".join(e.label for e in named),
    }
    row |= {"P": round(probability, 4), "p": float(f"{p_value:.3g}"), "right": right, "cpu": round(cpu, 1)}
    print(*row.values(), {key: round(value, 1) for key, value in search.log.items()})
    rows = search.table()
    for value, trial in rows[:show]:
        sure = [round(float(x), 1) for x in trial.surest()]
        told = f"{value - rows[0][0]:10.1f} {words(search, trial)} fit {trial.fit.min():.1f}"
        print(told, trial.noise.names, sure)
    sys.stdout.flush()
    return row


def append(name, row):
    """A row at the end of a CSV file: a run can be stopped and continued."""
    new = not Path(name).exists()
    with open(name, "a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, row.keys())
        if new:
            writer.writeheader()
        writer.writerow(row)


if __name__ == "__main__":
    first, count = int(sys.argv[1]), int(sys.argv[2])
    for number in range(first, first + count):
        try:
            found = one(number)
        except Exception:  # the others go on
            traceback.print_exc()
            continue
        if found and len(sys.argv) > 3:
            append(sys.argv[3], found)
