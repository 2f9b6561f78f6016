"""From the table of hypotheses to a verdict."""

from __future__ import annotations

import numpy as np

NAMED, EXCLUDED, FAMILY, SURE = 0.95, 0.01, 20.0, 3.0


def eligible(trial):
    """Whether each member is determined."""
    return all(x >= SURE for x in trial.surest()) if trial.effects else True


def verdict(search):
    """(word, effects named, probability, p-value)."""
    significance = search.case.significance
    rows = [(search.posterior(t), t) for t in search.trials if eligible(t)]
    by_set, variants = {}, {}
    for value, trial in rows:
        variants.setdefault(
            frozenset(trial.effects) if trial.effects else trial.base is not search.fitted, []
        ).append((value, trial))
        key = frozenset(trial.effects) if trial.effects else trial.base is not search.fitted
        old = by_set.get(key)
        best = trial if old is None or value > search.posterior(old[1]) else old[1]
        by_set[key] = (value if old is None else np.logaddexp(old[0], value), best)
    ordered = sorted(by_set.items(), key=lambda kv: -kv[1][0])
    nothing = by_set[False]
    total = np.logaddexp.reduce([v for _, (v, _) in ordered])
    p0 = search.tested(search.trials[0])[0]
    if p0 >= significance and ordered[0][1][0] - nothing[0] < np.log(FAMILY):
        return "adequate", (), float(np.exp(nothing[0] - total)), p0
    for key, (value, trial) in ordered[:4]:
        if value < ordered[0][1][0] - np.log(1 / EXCLUDED):
            break
        likely = sorted(
            (x for x in variants[key] if x[0] > value - np.log(1 / EXCLUDED)), key=lambda x: -x[0]
        )[:3]
        fine = [
            t
            for _, t in likely
            if search.tested(t)[0] >= significance
            and not search.odds.get(id(t), -np.inf) > np.log(1 / EXCLUDED)
        ]
        if not fine:
            continue
        trial = fine[0]
        p = search.tested(trial)[0]
        if not trial.effects:
            return ("parameters" if key else "adequate"), (), float(np.exp(value - total)), p
        # the simplest member of its family within 20:1, with the probability of the family
        name, mass = trial.effects, value
        if len(trial.effects) == 1:
            e = trial.effects[0]
            for other, (v, t) in ordered:
                if not t.effects or len(t.effects) != 1 or other == key:
                    continue
                o = t.effects[0]
                if o.place == e.place and (o.kind in e.spec.contains or e.kind in o.spec.contains):
                    if o.kind in e.spec.contains and v > value - np.log(FAMILY) and name == trial.effects:
                        name = t.effects
                    mass = np.logaddexp(mass, v)
        prob = float(np.exp(mass - total))
        prob /= 1.0 + np.exp(search.odds.get(id(trial), -np.inf))
        ties = [t.effects for _, (v, t) in ordered if v > ordered[0][1][0] - np.log(1 / EXCLUDED)]
        return ("effect" if (prob >= 0.5 and len(ties) == 1) or prob >= NAMED else "ambiguous"), name, prob, p
    return "unexplained", (), float(np.exp(ordered[0][1][0] - total)), p0
