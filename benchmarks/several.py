"""Two or three effects at once, parameters 20 to 40 % off: the set that is found against the truth.

python benchmarks/several.py --first 0 --seeds 30 --out rows.csv
"""

from __future__ import annotations

import argparse
import csv
import inspect
import sys
import time
import warnings
from pathlib import Path

import control as ct
import numpy as np
from calibration import interval
from calibration_plants import LAWS, PLANTS, excite, law
from scipy.signal import lfilter

import rcorefine as rco

USED = ("loadcell", "thermal4", "pend", "maxwell", "groundcell", "rlc4", "shunt", "accel2", "tanks")
AT_SITES = ("coulomb", "cubic", "quadratic", "clearance", "cubdamp", "quadspring", "smooth")
POSITION = {"cubic", "clearance", "quadspring"}


def march(p, u, laws, n):
    """Runge-Kutta, n steps a sample, input held."""
    x, N = np.zeros(len(p.A)), u.shape[1]
    y, seen, h = np.empty((len(p.C), N)), [np.empty((2, N)) for _ in laws], p.dt / n

    def rates(x, w):
        r = p.A @ x + p.B @ w
        forces = []
        for site, k, q, a, b in laws:
            d, v, g, _ = p.sites[site]
            f = q * law(k, d @ x, v @ x, 0.0, 0.0, a, b, 0.7)
            forces.append(f)
            r = r + g * f
        return r, forces

    for s in range(N):
        w = u[:, s]
        r, forces = rates(x, w)
        y[:, s] = p.Cs @ x + p.Cr @ r + p.Co @ w
        for (site, *_), f in zip(laws, forces, strict=True):
            y[:, s] += p.sites[site][3] * f
        for i, (site, *_) in enumerate(laws):
            seen[i][:, s] = p.sites[site][0] @ x, p.sites[site][1] @ x
        for _ in range(n):
            k1 = rates(x, w)[0]
            k2 = rates(x + h / 2 * k1, w)[0]
            k3 = rates(x + h / 2 * k2, w)[0]
            k4 = rates(x + h * k3, w)[0]
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if not np.isfinite(x).all() or abs(x).max() > 1e9:
            return None, None
    return y, seen


def made(seed):
    rng = np.random.default_rng(910000 + seed)
    name = USED[seed % len(USED)]
    make = PLANTS[name]
    nominal = make()
    numbers = {n: q.default for n, q in inspect.signature(make).parameters.items() if n not in ("gr", "Rc")}
    for n in numbers:
        if rng.random() < 0.6:
            numbers[n] *= 1 + rng.uniform(0.2, 0.4) * rng.choice([-1, 1])
    true = make(**numbers)
    slow = np.abs(np.linalg.eigvals(true.A))
    slow = np.sort(slow[slow > 1e-6 * slow.max()])
    T, N = 2 * np.pi / np.sqrt(slow[0] * slow[len(slow) // 2]), 1500
    kind = str(rng.choice(["prbs", "multisine", "noise", "steps"]))
    u = np.array([excite(kind, N, true.dt, T, rng) * a for a in true.amp])
    n = int(max(6, min(40, np.ceil(true.dt * np.abs(np.linalg.eigvals(true.A)).max() / 0.2))))
    n = max(n, 24)  # dry friction turns over within a sample
    count = int(rng.choice([2, 2, 3]))
    chosen, laws, truth = [], [], []
    sent = u.copy()
    if rng.random() < 0.5:
        fault = str(rng.choice(["deadzone", "saturation", "lag"]))
        if fault == "deadzone":
            sent = np.sign(u) * np.maximum(abs(u) - 0.25 * true.amp[0], 0)
        elif fault == "saturation":
            sent = np.clip(u, -1.1 * true.amp[0], 1.1 * true.amp[0])
        else:
            a = np.exp(-true.dt / (T / 8))
            sent = lfilter([1 - a], [1, -a], u, axis=1)
        truth.append((fault, "input"))
    base, _ = march(true, sent, [], n)
    if (
        truth
        and np.sqrt(np.mean(np.var(base - march(true, u, [], n)[0], axis=1) / np.var(base, axis=1))) < 0.03
    ):
        truth, sent = [], u.copy()  # no more than the noise shows
    while len(truth) < count:
        site = str(rng.choice(list(true.sites)))
        moves = true.sites[site][0].any()
        pick = str(rng.choice([k for k in AT_SITES if moves or k not in POSITION]))
        velocity = pick not in POSITION
        if any(s == site and (k not in POSITION) == velocity for k, s in chosen):
            if all(any(s == t and (k not in POSITION) for k, s in chosen) for t in true.sites):
                break
            continue
        _, seen = march(true, sent, [(site, 0, 0.0, 1.0, 1.0)], n)
        a, b = max(seen[0][0].std(), 1e-12), max(seen[0][1].std(), 1e-12)
        q = 1e-3 * np.linalg.norm(true.A, 2) * b / np.linalg.norm(true.sites[site][2])
        ok = False
        for _ in range(10):
            y, _ = march(true, sent, [*laws, (site, LAWS[pick][0], q, a, b)], n)
            y0, _ = march(true, sent, laws, n)
            if y is None:
                q /= 8
                continue
            loss = np.sqrt(np.mean(np.var(y - y0, axis=1) / np.var(y0, axis=1)))
            if abs(np.log(max(loss, 1e-12) / 0.15)) < 0.25:
                ok = True
                break
            q *= float(np.clip(0.15 / max(loss, 1e-12), 0.05, 30)) ** 0.9
        if not ok:
            continue
        chosen.append((pick, site))
        laws.append((site, LAWS[pick][0], q, a, b))
        truth.append((pick, site))
    y, _ = march(true, sent, laws, n)
    y = y + 0.01 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    if len(np.unique(u)) == 2:  # a static curve of an input of two levels is a gain
        truth = [t for t in truth if t[0] not in ("deadzone", "saturation")]

    model = ct.ss(
        nominal.A,
        nominal.B,
        nominal.C,
        nominal.D,
        inputs=nominal.inputs,
        outputs=nominal.outputs,
        states=nominal.states,
    )
    data = rco.Measurement(u, y, dt=true.dt, input_labels=nominal.inputs, output_labels=nominal.outputs)
    return name, truth, nominal, model, data


KINDS = {
    "deadzone": {"input_deadzone"},
    "saturation": {"input_saturation"},
    "lag": {"input_lag", "input_smoothing", "input_delay", "output_lag", "output_smoothing", "output_delay"},
    **{k: LAWS[k][1] for k in AT_SITES},
}


def is_one(effect, truth, plant, model):
    kind, site = truth
    if effect.kind not in KINDS[kind]:
        return False
    if site == "input":
        return True
    _, v, g, _ = plant.sites[site]
    port = next((q for q in rco.ports(model) if q.name == effect.place), None)
    if port is None:
        return False
    par = lambda a, b: abs(a @ b) > 0.999 * np.linalg.norm(a) * np.linalg.norm(b)  # noqa: E731
    return par(port.velocity, v) and par(port.act, g)


def one(seed):
    """One record: what was said, as a row."""
    name, truth, plant, model, data = made(seed)
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = rco.diagnose(model, data)
    cpu = time.process_time() - start
    named = found.effects
    hits = sum(any(is_one(e, k, plant, model) for e in named) for k in truth)
    false = [e.label for e in named if not any(is_one(e, k, plant, model) for k in truth)]
    row = {"seed": seed, "plant": name, "truth": "+".join(f"{k}@{site}" for k, site in truth)}
    row |= {"verdict": found.verdict, "named": "+".join(e.label for e in named)}
    row |= {"P": round(float(found.best.probability), 3) if named else ""}
    row |= {"exact": hits == len(truth) == len(named), "false": "+".join(false), "hits": hits}
    return row | {"cpu": round(cpu, 1)}


def append(name, row):
    """A row at the end of a CSV file: a run can be stopped and continued."""
    new = not Path(name).exists()
    with open(name, "a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, row.keys())
        if new:
            writer.writeheader()
        writer.writerow(row)


def main():
    """Run the seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--out", help="a CSV file with a line per record")
    options = parser.parse_args()
    exact = []
    for seed in range(options.first, options.first + options.seeds):
        row = one(seed)
        exact.append(row["exact"])
        sys.stdout.write(" ".join(map(str, row.values())) + "\n")
        sys.stdout.flush()
        if options.out:
            append(options.out, row)
    low, high = interval(sum(exact), len(exact))
    sys.stdout.write(f"exact set {sum(exact)} of {len(exact)} ({low:.0f}-{high:.0f} %)\n")


if __name__ == "__main__":
    main()
