"""The search: screen, refit, table, criticism; and the answer beside the old one's words."""

from __future__ import annotations

import time
import warnings

import numpy as np
from sets import SPREADS, Screen, Search, Trial, own_filter

import rcorefine as rco
from rcorefine.arithmetic import own_arithmetic
from rcorefine.diagnosis.case import Case
from rcorefine.diagnosis.floating import is_number
from rcorefine.diagnosis.residual_tests import TestedResidual, run_tests
from rcorefine.diagnosis.case import not_held
from rcorefine.diagnosis.verdict import overall
from rcorefine.inference.fitted import FittedModel
from rcorefine.inference.sensitivities import candidate_columns
from rcorefine.inference.starts import estimated_motion
from rcorefine.inference.whitening import Whitener
from rcorefine.inference.windows import as_data, spread_lines
from rcorefine.models.conversion import under_control
from rcorefine.progress import Progress
from rcorefine.refinement.base_fit import base_fit
from rcorefine.diagnosis.dead_sensors import without_dead_sensors

NONE_PRIOR = {"none": 0.5, "numbers": 0.5}


def case_of(model, data, candidates=None, controller=None):
    options = {"free": (), "tolerance": 0.0, "offset": True, "noise": None, "horizon": None}
    given = as_data(data, controller=controller)
    model = under_control(model, controller, data)
    records = spread_lines(given)
    base = base_fit(model, records, **options)
    return Case.prepare(base, records, candidates, options | {"candidates": None}, 0.01, Progress(), True)


def as_fitted(trial: Trial, search) -> FittedModel:
    from dataclasses import replace

    old = trial.base.refinement
    problem = trial.problem
    theta, starts = problem.unpack(trial.point)
    n = len(problem.structure.effects) - len(old.effects)
    refinement = replace(
        old, effects=problem.structure.effects, roles=(*old.roles, *("effect",) * n),
        constants=dict(problem.structure.constants), theta=theta.copy(), initial_states=starts.copy(),
        substeps=problem.engines[0].substeps, fit=trial.fit,
        rmse=np.sqrt(np.mean(np.concatenate([b / problem.weights[:, None] for b, _ in trial.blocks], axis=1) ** 2, axis=1)),
    )
    found = FittedModel(refinement, problem, trial.point, trial.base.tolerance, trial.base.force_at)
    found._blocks[0.0] = trial.blocks
    return found


def tested(search, trial, library=True):
    case = search.case
    fitted = as_fitted(trial, search)
    rest = not_held(case.library, fitted.structure.effects)
    motions = [estimated_motion(fitted.structure, fitted.theta, m.data) for m in case.motions]
    scored = candidate_columns(fitted, rest, motions[0], (0.0,)) if library else []
    tests = run_tests(TestedResidual(fitted), scored, motions)
    return overall(tests), tests


class Answer:
    pass


def search_case(case, *, most=4, budget=(6, 5), verbose=False):
    s = Search(case)
    started = time.process_time()
    t = time.process_time()
    effects = case.library
    n_effects = len(effects)
    scored = candidate_columns(case.fitted, effects, case.motions[0], (0.0,))
    s.clock("columns", t)
    t = time.process_time()
    numbers = s.numbers
    sd = np.array([e.prior[e.coefficients[0]] for e in numbers]) * (0.2 / case.levels.off)
    prior_effect = -np.log(n_effects)
    white0 = Whitener.fit(s.base_residual, order=0)

    def screen_at(whitener):
        screen = Screen(case.fitted, scored, numbers, sd, whitener, 0.0, case.motions[0])
        screen.number_sd = sd
        return screen

    screen = screen_at(white0)
    own, _ = own_filter(s.base_residual)
    screens = [screen]
    if any(own.orders):
        screens.append(screen_at(own))
    not_number = lambda g: not is_number(g.candidate.effect)  # noqa: E731
    proposals_single, proposals_sets = {}, {}

    def collect(screen):
        singles = screen.beam(1, False, -prior_effect)
        sets = screen.beam(most, True, -prior_effect, usable=not_number) if numbers else screen.beam(most, False, -prior_effect, usable=not_number)
        return singles, sets

    ranked = [collect(x) for x in screens]
    # white under the best set's own residual
    best = max((c for pair in ranked[:1] for kind in pair for c in kind), key=lambda c: c[0])
    shape = [r.shape for r in s.base_residual]
    left = screen.left(best[1], True)
    ends = np.cumsum([a * b for a, b in shape])[:-1]
    blocks = [part.reshape(sh) for part, sh in zip(np.split(left, ends), shape)] if len(left) == sum(a * b for a, b in shape) else s.base_residual
    third, _ = own_filter(blocks)
    if any(third.orders) and third.orders != own.orders:
        screens.append(screen_at(third))
        ranked.append(collect(screens[-1]))
    s.clock("screen", t)
    t = time.process_time()
    trials: list[Trial] = [s.empty(case.fitted)]
    s.clock("refits", t)
    if numbers:
        trials.append(s.empty(s.floated))
    t = time.process_time()
    # singles
    queue, seen = [], set()
    for sc, (singles, _) in zip(screens, ranked):
        rank = 0
        for value, groups in singles:
            if not groups:
                continue
            e = groups[0].candidate.effect
            if rank >= budget[0]:
                break
            rank += 1
            if e not in seen:
                seen.add(e)
                queue.append((sc, groups))
    # relatives at the leader's place
    def single(sc, groups):
        e = groups[0].candidate.effect
        same = [g for g in sc.groups if g.candidate.effect == e]
        same = sorted(same, key=lambda g: -sc.solve([g], False)[0])[:2]
        starts = [s.starts_of(sc, [g], False, case.fitted) for g in same]
        return s.refit((e,), case.fitted, starts)

    for sc, groups in queue:
        trial = single(sc, groups)
        if trial is not None:
            trials.append(trial)
    lead = max(trials, key=lambda tr: tr.total)
    place = lead.effects[0].place if lead.effects else None
    done = {tr.effects for tr in trials}
    for sc in screens[:1]:
        for g in sc.groups:
            e = g.candidate.effect
            if e.place == place and (e,) not in done:
                done.add((e,))
                trial = single(sc, [g])
                if trial is not None:
                    trials.append(trial)
    s.clock("refits", t)
    t = time.process_time()
    # sets beside the parameters
    base = s.floated if numbers else case.fitted
    tried = set()
    for sc, (_, sets) in zip(screens, ranked):
        rank = 0
        for value, groups in sets:
            if not groups:
                continue
            if rank >= budget[1]:
                break
            rank += 1
            key = frozenset((g.candidate.effect.kind, g.candidate.effect.place) for g in groups)
            if key in tried:
                continue
            tried.add(key)
            starts = [s.starts_of(sc, groups, bool(numbers), base)]
            trial = s.refit(tuple(g.candidate.effect for g in groups), base, starts)
            if trial is not None:
                trials.append(trial)
    s.clock("sets", t)
    s.trials = trials
    s.screens, s.ranked, s.prior_effect = screens, ranked, prior_effect
    return s


def table(s):
    """Log posterior of each set of effects and kind of base."""
    rows = {}
    for tr in s.trials:
        numbers = tr.base is not s.fitted
        value = tr.total + np.log(0.5) + s.prior_effect * len(tr.effects)
        key = (frozenset((e.kind, e.place) for e in tr.effects), numbers)
        if key not in rows or rows[key][0] < value:
            rows[key] = (value, tr)
    return sorted(rows.values(), key=lambda r: -r[0])


def words(tr, s):
    return ("+".join(f"{e.kind}@{e.place}" for e in tr.effects) or "nothing") + (" | numbers" if tr.base is not s.fitted else "")


if __name__ == "__main__":
    import sys

    sys.path.insert(0, "/work/main/benchmarks")
    from calibration_plants import controller, handed, made
    from calibration import is_truth

    first, count = int(sys.argv[1]), int(sys.argv[2])
    for seed in range(first, first + count):
        c, truth, p, records = made(seed)
        if records is None:
            continue
        t = time.process_time()
        with warnings.catch_warnings(), own_arithmetic():
            warnings.simplefilter("ignore")
            model = handed(p, c["handed"])
            try:
                case = case_of(model, records, controller=controller(p) if p.loop else None)
                s = search_case(case)
                rows = table(s)
            except Exception as e:
                import traceback
                traceback.print_exc()
                print(seed, c["plant"], "ERROR", repr(e)[:200])
                continue
            top = rows[0][0]
            pval, tests = tested(s, rows[0][1])
        print(f"{seed} {c['plant']} {c['handed']} {c['type']}/{c['missing']}@{c['site']} {c['nuisance']} {c['input']} noise {c['noise']} loss {c['loss']} CPU {time.process_time()-t:.1f} {({k: round(v,1) for k,v in s.log.items()})} fit0 {s.trials[0].fit.min():.0f} test p {pval:.3g}")
        for value, tr in rows[:6]:
            good = [is_truth(e, c, truth, p, model) for e in tr.effects] if truth else []
            print(f"    {value-top:8.1f} {words(tr, s)} {'TRUE' if good and all(good) else ''} fit {tr.fit.min():.1f} order {tr.whitener.orders}")
        sys.stdout.flush()
