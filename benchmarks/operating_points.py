"""Two tanks about a level and a car about 24 m/s: the hidden law against the one that is named.

python benchmarks/operating_points.py --first 0 --seeds 20 --out rows.csv

The tanks drain through orifices: one outflow of two is a square root in the truth and a straight line in the
model. The car is braked by the air. Records are integrated by scipy; half of the models have a time constant
that is 10 to 25 % off. With `--deviations` the model has no operating point, and the record its mean removed.
"""

from __future__ import annotations

import argparse
import time
import warnings

import control as ct
import numpy as np
from calibration import interval
from scipy.integrate import solve_ivp
from several import append

import rcorefine as rco


def marched(rate, x0, inputs, dt):
    """States (n_x, N) at the samples, input held."""
    states = [np.asarray(x0, dtype=float)]
    for u in inputs[:-1]:
        run = solve_ivp(rate, (0, dt), states[-1], args=(u,), rtol=1e-8, atol=1e-10)
        states.append(run.y[:, -1])
    return np.array(states).T


def steps(rng, n, spread):
    """Random levels, each held for 10 to 40 samples, in [-1, 1]."""
    held = np.concatenate([np.full(int(rng.integers(10, 40)), rng.uniform(-1, 1)) for _ in range(n // 10)])
    return spread * held[:n]


def tanks(rng, n=1200):
    """One outflow of two is a square root."""
    area, flow = rng.uniform(0.6, 2.0, 2), rng.uniform(0.3, 0.9, 2)
    h0 = np.array([rng.uniform(0.8, 2.0), 0.0])
    q0 = flow[0] * np.sqrt(h0[0])
    h0[1] = (q0 / flow[1]) ** 2
    k, outlet = flow / (2 * np.sqrt(h0)), int(rng.integers(2))
    off = np.ones(2)
    if rng.random() < 0.5:
        off[int(rng.integers(2))] += rng.choice([-1, 1]) * rng.uniform(0.1, 0.25)
    q = q0 * (1 + steps(rng, n, 0.5))
    dt = 0.05 * (area / k).min()

    def rate(_, h, push):
        out = q0 + k * (h - h0)
        out[outlet] = flow[outlet] * np.sqrt(max(h[outlet], 0.0))
        return [(push - out[0]) / area[0], (out[0] - out[1]) / area[1]]

    y = marched(rate, h0, q, dt)
    k = k * off
    A = [[-k[0] / area[0], 0], [k[0] / area[1], -k[1] / area[1]]]
    names = {"inputs": ["q"], "outputs": ["h1", "h2"], "states": ["h1", "h2"]}
    model = ct.ss(A, [[1 / area[0]], [0]], np.eye(2), 0, **names)
    truth = rco.Effect("sqrt_flow", ("h1->h2", "h2")[outlet])
    return model, {"inputs": q0, "states": h0}, q, y, dt, truth


def car(rng, n=1200):
    """Drag of the air; the model has the tangent of all that brakes."""
    mass, roll, drag, v0 = rng.uniform(900, 1800), rng.uniform(20, 60), rng.uniform(0.3, 0.7), 24.0
    F0, slope = roll * v0 + drag * v0**2, roll + 2 * drag * v0
    off = 1 + (rng.random() < 0.5) * rng.choice([-1, 1]) * rng.uniform(0.1, 0.25)
    F, dt = F0 * (1 + steps(rng, n, 1.0)), 0.02 * mass / slope
    y = marched(lambda _, v, f: (f - roll * v - drag * v * np.abs(v)) / mass, [v0], F, dt)
    names = {"inputs": ["F"], "outputs": ["speed"], "states": ["v"]}
    model = ct.ss([[-off * slope / mass]], [[1 / mass]], [[1.0]], 0, **names)
    return model, {"inputs": F0, "states": v0}, F, y, dt, rco.Effect("quadratic_damping", "v")


def one(plant, seed, deviations):
    """One record: what was said, as a row."""
    rng = np.random.default_rng([920000 + seed, plant is car])
    model, point, u, y, dt, truth = plant(rng)
    y = y + 0.01 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    data = rco.Measurement(u, y, dt=dt, input_labels=model.input_labels, output_labels=model.output_labels)
    if deviations:
        data = data.deviation(inputs=u.mean(), outputs=y.mean(axis=1))
    else:
        model = rco.physical(model, operating_point=point)
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = rco.diagnose(model, data, progress=False)
    cpu = time.process_time() - start
    named, tied = set(found.effects), set(found.ambiguous)
    P = round(float(found.best.probability), 3) if named else ""
    what = "right" if named == {truth} else "tied" if truth in tied | named else found.verdict
    row = {
        "plant": plant.__name__,
        "seed": seed,
        "truth": truth.label,
        "what": what,
        "verdict": found.verdict,
    }
    return row | {"named": "+".join(e.label for e in found.effects), "P": P, "cpu": round(cpu, 1)}


def main():
    """Run the seeds, print the rates."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--deviations", action="store_true")
    parser.add_argument("--out", help="a CSV file with a line per record")
    options = parser.parse_args()
    for plant in (tanks, car):
        rows = []
        for seed in range(options.first, options.first + options.seeds):
            rows.append(one(plant, seed, options.deviations))
            print(*rows[-1].values(), flush=True)
            if options.out:
                append(options.out, rows[-1])
        good = sum(row["what"] in ("right", "tied") for row in rows)
        wrong = [r for r in rows if r["what"] == "effect" and r["P"] and r["P"] >= 0.95]
        low, high = interval(good, len(rows))
        print(f"{plant.__name__}: right or tied {good} of {len(rows)} ({low:.0f} to {high:.0f} %), ", end="")
        print(f"wrong at P >= 0.95: {len(wrong)}")


if __name__ == "__main__":
    main()
