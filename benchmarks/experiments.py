"""Does the suggested experiment do what it promises? And does a second amplitude refute impostors?

`advice`: records that leave several laws standing; every option of `suggest_experiment` is then
carried out with `scipy.integrate.solve_ivp` under the truth (tests/hidden), the rivals are fitted
again, and the share of true separations is held against the mean of what was predicted.

`amplitude`: laws outside the library that one record lets pass as a single effect or a pair, and
true ones; `confirm` and `diagnose` get a second record at twice the amplitude.

    python benchmarks/experiments.py advice --seeds 100 --first 8000
    python benchmarks/experiments.py amplitude --seeds 100 --first 9000
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import beta

import rcorefine as rco
from rcorefine.diagnosis.confirm import confirm
from rcorefine.diagnosis.experiments import ExperimentOption
from rcorefine.diagnosis.refits import Fitter
from rcorefine.diagnosis.screening import Metric, Screen
from rcorefine.diagnosis.separation import sensor_rows, with_sensor
from rcorefine.inference.fitted import fitted_from
from rcorefine.inference.sensitivities import candidate_columns
from rcorefine.inference.starts import Motion
from rcorefine.refinement.refine import base_fit

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from hidden.generator import Hidden, _with, hidden_record, linear_states

Array = np.ndarray
CASES = {"1 % at 3 %": (0.01, 0.03), "5 % at 10 %": (0.05, 0.10)}
PLANTS = ("chain", "chain", "chain", "quarter car", "RLC", "thermal", "motor", "tanks")
DECIDED = 9.2


def interval(hits: int, n: int) -> tuple[float, float]:
    """95 % Clopper-Pearson interval."""
    low = beta.ppf(0.025, hits, n - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, n - hits) if hits < n else 1.0
    return float(low), float(high)


def measured(
    hidden: Hidden, w: Array, rng: np.random.Generator, sensor: str | None = None
) -> rco.Measurement:
    """The same plant with the same law under other inputs; the sensors' noise stays what it was."""
    plant = hidden.plant
    x0 = linear_states(plant, hidden.data.inputs)
    place = next(p for p in plant.places if p.name == hidden.place)

    def run(inputs: Array, made: object) -> Array:
        return _with(made, inputs, hidden.kind, place, hidden.strength, x0)

    if sensor is not None:
        row = np.eye(plant.A.shape[0])[plant.model.linear.state_labels.index(sensor)]
        plant = replace(
            plant,
            C=np.vstack([plant.C, row]),
            D=np.vstack([plant.D, np.zeros((1, plant.D.shape[1]))]),
            rates=np.vstack([plant.rates, 0 * row]),
        )
    level = hidden.noise * run(hidden.data.inputs, plant).std(axis=1, keepdims=True)
    truth = run(w, plant)
    return rco.Measurement(
        w, truth + level * rng.standard_normal(truth.shape), dt=plant.dt, hold=hidden.data.hold
    )


def leads(model: object, records: list[rco.Measurement], effects: list[rco.Effect], truth: tuple) -> Array:
    """Twice the log-likelihood by which the truth leads each rival, all fitted to these records."""
    base = base_fit(model, records, free=(), tolerance=0.0, offset=True, noise=None)
    fitted = fitted_from(base, records, tolerance=0.0)
    motion = Motion(fitted.structure, fitted.theta, fitted.problem.records[0])
    fitter, metric = Fitter(fitted, motion), Metric(fitted.problem.whitener(fitted.residuals()))
    values = {}
    for candidate in candidate_columns(fitted, effects, motion, (0.0,)):
        screen = Screen(fitted, [candidate], {}, metric, motion)
        starts = [screen.start([group], False, fitted) for group in screen.groups]
        trial = fitter.single((candidate.effect, starts))
        if trial is not None:
            values[candidate.effect.kind, candidate.effect.place] = trial.total
    return np.array([2 * (values[truth] - value) for key, value in values.items() if key != truth])


def carried_out(hidden: Hidden, found: rco.Diagnosis, option: ExperimentOption, seed: int) -> Array:
    """Leads of the truth after the experiment."""
    rng = np.random.default_rng([seed, abs(hash_of(option.name))])
    model, w = hidden.plant.model, option.inputs
    truth = (hidden.kind, hidden.place)
    effects = list(found.ambiguous)
    if option.kind == "sensor":
        place = option.name.rsplit(" ", 1)[1]
        _, label, row = next(s for s in sensor_rows(model, [place]))
        return leads(with_sensor(model, label, row), [measured(hidden, w, rng, place)], effects, truth)
    return leads(model, [hidden.data, measured(hidden, w, rng)], effects, truth)


def hash_of(text: str) -> int:
    """The same number in every run."""
    return int.from_bytes(text.encode()[:8], "little") % 2**31


def group(option: ExperimentOption) -> str:
    """Row of the table."""
    return option.name if option.kind in ("repeat", "amplitude", "longer") else f"{option.kind} (one of them)"


def advice(first: int, seeds: int, case: str, verbose: bool, seconds: float) -> None:
    """Predicted and realized separation."""
    loss, noise = CASES[case]
    predicted, realized, wrong = defaultdict(list), defaultdict(list), defaultdict(int)
    pairs = lacking = tried = 0
    start = time.time()
    for seed in range(first, first + seeds):
        if time.time() - start > seconds:
            break
        tried += 1
        try:
            hidden = hidden_record(seed, plant=PLANTS[seed % len(PLANTS)], loss=loss, noise=noise)
        except FloatingPointError:
            continue
        found = rco.diagnose(hidden.plant.model, hidden.data, candidates=hidden.candidates)
        if found.verdict != "ambiguous":
            continue
        if (hidden.kind, hidden.place) not in [(e.kind, e.place) for e in found.ambiguous]:
            lacking += 1
            continue
        made = found.suggest_experiment()
        pairs += 1
        rng = np.random.default_rng([seed, 5])
        chosen = [o for o in made.options if o is made.chosen]
        options = [("chosen", o) for o in chosen]
        for kind in ("repeat", "amplitude", "longer", "band", "sensor"):
            mine = [o for o in made.options if o.kind == kind and not o.failed]
            if kind in ("band", "sensor") and mine:
                mine = [mine[int(rng.integers(len(mine)))]]
            options += [(group(o), o) for o in mine]
        done: dict[str, Array] = {}
        for name, option in options:
            try:
                if option.name not in done:
                    done[option.name] = carried_out(hidden, found, option, seed)
            except FloatingPointError:
                continue
            lead = done[option.name]
            predicted[name].append(option.probability)
            realized[name].append(bool((lead > DECIDED).all()))
            wrong[name] += bool((lead < -DECIDED).any())
            if verbose:
                print(
                    f"    {seed} {hidden.plant.name} {hidden.kind} at {hidden.place} of {len(made.rivals)}: "
                    f"{name}: {option.probability:.2f} D {option.distance:.3g} -> lead {lead.min():.1f}",
                    flush=True,
                )
    print(
        f"\n{case} noise, from seed {first}: {pairs} ambiguous of {tried}, {lacking} more without the truth"
    )
    print(f"{'option':32s} {'n':>4s} {'predicted':>9s} {'realized':>9s}  {'95 % interval':14s} {'wrong':>5s}")
    for name in ("chosen", *sorted(set(predicted) - {"chosen"})):
        n, hits = len(realized[name]), sum(realized[name])
        if n:
            low, high = interval(hits, n)
            figures = f"{np.mean(predicted[name]):9.2f} {hits / n:9.2f}  {low:.2f} to {high:.2f}"
            print(f"{name:32s} {n:4d} {figures}   {wrong[name]:5d}", flush=True)


def passed_model(hidden: Hidden) -> tuple[str, rco.Refinement | None, float]:
    """What one record lets pass: a single effect, a pair, or (None) nothing; and the unmeasured force."""
    model, data, laws = hidden.plant.model, hidden.data, hidden.candidates
    found = rco.diagnose(model, data, candidates=laws)
    if found.verdict in ("effect", "ambiguous"):
        return "single", found.best.refinement, found.force_ratio
    if found.best is None:
        return found.verdict, None, 0.0
    second = rco.diagnose(found.refine(), data, candidates=laws)
    if second.verdict in ("effect", "ambiguous"):
        return "pair", second.best.refinement, second.force_ratio
    return "unexplained", None, 0.0


def with_second(hidden: Hidden, seed: int, goal: float) -> tuple[Hidden, rco.Effect]:
    """Another plant of the same model: a spring (or damper) elsewhere is off as well, by the goal in loss."""
    plant, rng = hidden.plant, np.random.default_rng([seed, 7])
    others = [p for p in plant.places if p.name != hidden.place] or plant.places
    place = others[int(rng.integers(len(others)))]
    kind = "damping" if place.d is None or hidden.kind == "stiffness" else "stiffness"
    sense = place.v if kind == "damping" else place.d
    before, w = plant.C @ linear_states(plant, hidden.data.inputs), hidden.data.inputs
    direction = np.outer(place.act, sense)
    size = 0.02 * np.abs(plant.A).max() / np.abs(direction).max()
    for _ in range(8):
        changed = replace(plant, A=plant.A + size * direction)
        after = plant.C @ linear_states(changed, w)
        loss = np.linalg.norm(after - before) / np.linalg.norm(before)
        size *= float(np.clip(goal / max(loss, 1e-9), 0.1, 10))
    return replace(hidden, plant=replace(plant, A=plant.A + size * direction)), rco.Effect(kind, place.name)


ROWS = {
    "clearance 3 % at 3 %": ("clearance", 0.03, 0.03),
    "clearance 3 % at 10 %": ("clearance", 0.03, 0.10),
    "clearance 10 % at 3 %": ("clearance", 0.10, 0.03),
    "jenkins 3 % at 10 %": ("jenkins", 0.03, 0.10),
    "jenkins 10 % at 10 %": ("jenkins", 0.10, 0.10),
    "true effect 5 % at 3 %": ("any", 0.05, 0.03),
    "true effect 3 % at 10 %": ("any", 0.03, 0.10),
    "true effect 20 % at 3 %": ("any", 0.20, 0.03),
    "true pair 5 % at 3 %": ("pair", 0.05, 0.03),
    "true pair 10 % at 10 %": ("pair", 0.10, 0.10),
}


def taught(
    seed: int, kind: str, loss: float, noise: float
) -> tuple[Hidden, str, rco.Refinement | None, float]:
    """A record, and the model that it lets pass; for the rows of true laws the model that holds them."""
    plant = ("chain", "chain", "quarter car", "ring")[seed % 4]
    true = kind in ("any", "pair")
    hidden = hidden_record(seed, plant=plant, effect="any" if true else kind, loss=loss, noise=noise)
    if not true:
        return hidden, *passed_model(hidden)
    effects = [rco.Effect(hidden.kind, hidden.place)]
    if kind == "pair":
        hidden, second = with_second(hidden, seed, loss)
        if (second.kind, second.place) == (hidden.kind, hidden.place):
            return hidden, "none", None, 0.0
        effects.append(second)
        data = measured(hidden, hidden.data.inputs, np.random.default_rng([seed, 8]))
        hidden = replace(hidden, data=data)
    model = rco.refine(hidden.plant.model, hidden.data, effects)
    return hidden, "pair" if kind == "pair" else "single", model, 0.0


def amplitude(first: int, seeds: int, rows: list[str], verbose: bool, seconds: float) -> None:
    """Impostors and true laws against a second record at twice the amplitude."""
    print(
        f"{'hidden':26s} {'passed one record':>27s} {'refuted':>8s}  {'95 % interval':14s} diagnose([1, 2])"
    )
    for name in rows:
        passed, refuted, singles, demoted = defaultdict(int), defaultdict(int), 0, 0
        start = time.time()
        for seed in range(first, first + seeds):
            if time.time() - start > seconds:
                break
            try:
                hidden, how, model, ratio = taught(seed, *ROWS[name])
                passed[how] += 1
                if model is None:
                    continue
                second = measured(hidden, 2 * hidden.data.inputs, np.random.default_rng([seed, 6]))
            except FloatingPointError:
                continue
            records = [hidden.data, second]
            seen = confirm(model, records, candidates=hidden.candidates, force_ratio=ratio)
            refuted[how] += seen.verdict == "refuted"
            word = ""
            if how == "single":
                again = rco.diagnose(hidden.plant.model, records, candidates=hidden.candidates)
                singles += 1
                demoted += again.verdict == "unexplained"
                word = again.verdict
            if verbose:
                worst = seen.estimates[1]
                print(
                    f"    {seed} {hidden.plant.name} {hidden.kind} at {hidden.place} {how} {seen.verdict} "
                    f"agree {worst.agreement:.1e} residual {worst.residual:.1e} {word}",
                    flush=True,
                )
        n, hits = passed["single"] + passed["pair"], refuted["single"] + refuted["pair"]
        text = f"{passed['single']} single, {passed['pair']} pair of {sum(passed.values())}"
        low, high = interval(hits, n) if n else (0.0, 1.0)
        share = f"{hits}/{n}"
        print(
            f"{name:26s} {text:>27s} {share:>8s}  {low:.2f} to {high:.2f}   unexplained {demoted}/{singles}",
            flush=True,
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["advice", "amplitude"])
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=8000)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop each table after that")
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.what == "advice":
        for case in given.cases:
            advice(given.first, given.seeds, case, given.verbose, given.seconds)
    else:
        amplitude(given.first, given.seeds, given.rows, given.verbose, given.seconds)


if __name__ == "__main__":
    main()
