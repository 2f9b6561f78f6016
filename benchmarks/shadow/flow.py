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
    offsets = {e.kind for e, role in zip(base.effects, base.roles) if role == "offset"}
    if offsets and not integrates(base.physical_model.linear, ordered[0]):
        everywhere = offsets_everywhere(base.physical_model, ordered)
        base = refit(
            base, records, offsets=everywhere, elsewhere=False, tolerance=0.0, noise=None, horizon=None
        )
    return Case.prepare(base, records, candidates, options | {"candidates": None}, 0.01, Progress(), True)


def words(s, trial):
    names = "+".join(f"{e.kind}@{e.place}" for e in trial.effects) or "nothing"
    return names + (" | numbers" if trial.base is not s.fitted else "")


def one(seed, show=5):
    c, truth, p, records = made(seed)
    if records is None:
        return None
    t = time.process_time()
    with warnings.catch_warnings(), own_arithmetic():
        warnings.simplefilter("ignore")
        model = handed(p, c["handed"])
        case = case_of(model, records, controller=controller(p) if p.loop else None)
        s = Search(case).run()
        word, named, P, pv = verdict(s)
    cpu = time.process_time() - t
    rows = s.table()
    top = rows[0][0]
    truths = [bool(truth) and is_truth(e, c, truth, p, model) for e in named]
    if word in ("effect", "ambiguous"):
        right = len(named) == 1 and truths[0]
    elif word == "unexplained":
        right = False
    else:
        right = c["type"] == "none" if word == "adequate" else "P" in truth
    best = rows[0][1]
    print(
        f"{seed} {c['plant']} {c['handed']} {c['type']}/{c['missing']}@{c['site']} {c['nuisance']} {c['input']} noise {c['noise']}"
        f" loss {c['loss']} CPU {cpu:.1f} { {k: round(v, 1) for k, v in s.log.items()} } fit0 {s.trials[0].fit.min():.0f}"
        f" -> {word} {'+'.join(e.label for e in named)} P {P:.3f} p {pv:.3g} {'RIGHT' if right else 'wrong'}"
    )
    for value, trial in rows[:show]:
        good = [is_truth(e, c, truth, p, model) for e in trial.effects] if truth else []
        print(
            f"    {value - top:8.1f} {words(s, trial)} {'TRUE' if good and all(good) else ''} fit {trial.fit.min():.1f} {trial.noise.names} {[round(float(x), 1) for x in trial.surest()]}"
        )
    sys.stdout.flush()
    return {
        "seed": seed,
        "plant": c["plant"],
        "type": c["type"],
        "missing": c["missing"],
        "nuisance": c["nuisance"],
        "noise": c["noise"],
        "loss": c["loss"],
        "verdict": word,
        "named": "+".join(e.label for e in named),
        "P": round(P, 4),
        "p": pv,
        "right": right,
        "cpu": round(cpu, 1),
    }


if __name__ == "__main__":
    first, count = int(sys.argv[1]), int(sys.argv[2])
    out = sys.argv[3] if len(sys.argv) > 3 else None
    rows = []
    for seed in range(first, first + count):
        try:
            row = one(seed)
        except Exception:
            traceback.print_exc()
            print(seed, "ERROR", flush=True)
            continue
        if row and out:
            new = not Path(out).exists()
            with open(out, "a", newline="") as f:
                w = csv.DictWriter(f, row.keys())
                if new:
                    w.writeheader()
                w.writerow(row)
