"""The plants of a control course, refined by `RCORefiner(model, dt=...)` with no other setting.

    python benchmarks/textbook.py                   10 seeds of every plant, about 20 minutes
    python benchmarks/textbook.py --seeds 3 --only servo motor
    python benchmarks/textbook.py --refine          beside rcorefine.refine(free="linear"): hours
    python benchmarks/textbook.py --course          samples until within a point of the end

Each parameter of the initial model is 10 to 50 % off, up or down at random; 6000 samples, 70 % learned,
the rest predicted in a free run from its best initial state. Inputs are steps, PRBS and multisines,
noise is 1, 2 and 5 % of each output, in turn.
"""

from __future__ import annotations

import argparse
import time
import warnings

import control as ct
import numpy as np
from textbook_plants import PLANTS, WRONG, Plant

import rcorefine as rco

N, SHARE = 6000, 0.7
NOISE = (0.01, 0.02, 0.05)
INPUTS = ("steps", "prbs", "multisine")


def excitation(kind: str, channels: int, n_samples: int, rng: np.random.Generator) -> np.ndarray:
    """Inputs of unit size, shape (n_samples, channels)."""
    shape = (n_samples // 5 + 1, channels)
    if kind == "steps":
        return np.repeat(rng.uniform(-1, 1, shape), 20, axis=0)[:n_samples]
    if kind == "prbs":
        return np.repeat(rng.choice([-1.0, 1.0], shape), 5, axis=0)[:n_samples]
    tones = np.geomspace(2 * np.pi / 500, 0.5, 25)
    phases = rng.uniform(0, 2 * np.pi, (25, 1, channels))
    return np.sin(tones[:, None, None] * np.arange(n_samples)[None, :, None] + phases).sum(axis=0) / 3.5


def held(system: ct.StateSpace, dt: float) -> tuple[np.ndarray, ...]:
    discrete = system if system.dt else system.sample(dt)
    return discrete.A, discrete.B, discrete.C, discrete.D


def record(plant: Plant, truth: ct.StateSpace, w: np.ndarray, level: float, rng: np.random.Generator):
    """Inputs as the plant sees them and noisy outputs, shapes (N, n_w), (N, n_y)."""
    A, B, C, D = held(truth, plant.dt)
    gain = None
    if plant.controlled:
        gain = np.asarray(ct.dlqr(A, B, np.eye(len(A)), np.eye(B.shape[1]))[0])
    x, u, y = np.zeros(len(A)), w.copy(), np.empty((len(w), C.shape[0]))
    force = plant.force_noise * rng.standard_normal((len(w), B.shape[1]))
    for k in range(len(w)):
        if gain is not None:
            u[k] -= gain @ x
        y[k] = C @ x + D @ u[k]
        x = A @ x + B @ (u[k] + force[k])
    return u, y + level * y.std(axis=0) * rng.standard_normal(y.shape)


def free_run(system: ct.StateSpace, dt: float, w: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fit in % of each output, the initial state fitted by least squares."""
    A, B, C, D = held(system, dt)
    x, X = np.zeros(len(A)), np.eye(len(A))
    e, H = np.empty_like(y), np.empty((*y.shape, len(A)))
    with np.errstate(all="ignore"):
        for k in range(len(w)):
            e[k], H[k] = y[k] - C @ x - D @ w[k], C @ X
            x, X = A @ x + B @ w[k], A @ X
        size = y.std(axis=0)
        columns = (H / size[:, None]).reshape(-1, len(A))
        if not (np.isfinite(columns).all() and np.isfinite(e).all()):
            return np.full(y.shape[1], -np.inf)
        x0 = np.linalg.lstsq(columns, (e / size).ravel(), rcond=None)[0]
        return 100 * (1 - np.linalg.norm(e - H @ x0, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0))


def bode_error(system: ct.StateSpace, truth: ct.StateSpace, dt: float) -> float:
    omega = np.geomspace(1e-3, 1, 200) * np.pi / dt
    found, true = (ct.frequency_response(s, omega).frdata for s in (system, truth))
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def run(plant: Plant, seed: int, with_refine: bool) -> dict[str, object]:
    rng = np.random.default_rng([seed, sum(map(ord, plant.name))])
    kind, level = INPUTS[seed % 3], NOISE[(seed // 3) % 3]
    truth, start = plant.systems(rng)
    w = excitation(kind, truth.ninputs, N, rng)
    w, y = record(plant, truth, w, level, rng)
    cut = int(SHARE * N)
    train = rco.Measurement(w[:cut].T, y[:cut].T, dt=plant.dt)
    row = {"plant": plant.name, "seed": seed, "input": kind, "noise": level, "error": ""}
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            refiner = rco.RCORefiner(start, dt=plant.dt).run(train)
            row["us"] = 1e6 * (time.process_time() - begin) / cut
            system = refiner.system
        except Exception as error:
            return row | {"error": repr(error)}
    row["form"] = refiner.form
    rest = w[cut:], y[cut:]
    if plant.controlled:
        row["bode"] = [bode_error(s, truth, plant.dt) for s in (start, system)]
        return row
    row["start"], row["refined"], row["true"] = (free_run(s, plant.dt, *rest) for s in (start, system, truth))
    if with_refine or plant.wrong:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            begin = time.process_time()
            try:
                other = rco.refine(start, train, free="linear").system
                row["refine"] = free_run(other, plant.dt, *rest)
            except rco.RCOError as error:
                row["refine"] = np.full(y.shape[1], -np.inf)
                row["refine error"] = str(error)[:80]
            row["refine s"] = time.process_time() - begin
    return row


HEAD = (
    f"{'plant':28s} {'runs':>4s} {'start':>6s} {'refined, min / med':>18s} {'true':>6s} {'refine':>6s}"
    f" {'within 1':>8s} {'worse':>5s} {'fails':>5s} {'us':>4s}  forms"
)


def line(mine: list[dict[str, object]], total: dict[str, int]) -> str:
    """One row of the table: all runs of a plant, counted in `total` as well."""
    good = [row for row in mine if not row["error"]]
    fails, text = len(mine) - len(good), f"{mine[0]['plant']:28s} {len(mine):4d}"
    total["runs"] += len(mine)
    total["fails"] += fails
    if not good:
        return f"{text} all fail: {mine[0]['error'][:80]}"
    chosen = [row["form"] for row in good]
    forms = ", ".join(f"{form} {chosen.count(form)}" for form in dict.fromkeys(chosen))
    end = f"{fails:5d} {np.median([row['us'] for row in good]):4.0f}  {forms}"
    if "bode" in good[0]:
        before, after = np.array([row["bode"] for row in good]).T
        errors = f"{np.median(before):.2f} -> {np.median(after):.5f}, worst {after.max():.5f}"
        return f"{text} Bode error {errors}; within .01: {np.sum(after <= 0.01)} {end}"
    key = "refine" if "refine" in good[0] else "true"
    means = {k: np.array([row[k].mean() for row in good]) for k in ("start", "refined", "true", key)}
    within = int(np.sum(means["refined"] > means[key] - 1))
    worse = sum(bool(np.any(row["refined"] < row["start"] - 1)) for row in good)
    for what, count in (("compared", len(good)), ("within", within), ("worse", worse)):
        total[what] += count
    middle = {k: np.median(values) for k, values in means.items()}
    shown = f"{middle['refine']:6.1f}" if key == "refine" else 6 * " "
    return (f"{text} {middle['start']:6.1f} {means['refined'].min():9.1f}{middle['refined']:9.1f} "
            f"{middle['true']:6.1f} {shown} {within:8d} {worse:5d} {end}")  # fmt: skip


def course(plant: Plant, seed: int) -> str:
    """Samples until the refined model is within a point of the end, and what refitting every time costs."""
    rng = np.random.default_rng([seed, sum(map(ord, plant.name))])
    truth, start = plant.systems(rng)
    w, y = record(plant, truth, excitation("steps", truth.ninputs, N, rng), 0.02, rng)
    cut = int(SHARE * N)
    marks = [50, 100, 200, 400, 800, 1600, cut]
    found: dict[str, list[float]] = {"stream": [], "refit": []}
    seconds = {"stream": 0.0, "refit": 0.0}
    refiner, before = rco.RCORefiner(start, dt=plant.dt), 0
    for mark in marks:
        begin = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            refiner.update(w[before:mark].T, y[before:mark].T)
            system = refiner.system
            seconds["stream"] += time.process_time() - begin
            begin = time.process_time()
            data = rco.Measurement(w[:mark].T, y[:mark].T, dt=plant.dt)
            try:
                other = rco.refine(start, data, free="linear").system
            except rco.RCOError:
                other = start
            seconds["refit"] += time.process_time() - begin
        found["stream"].append(free_run(system, plant.dt, w[cut:], y[cut:]).mean())
        found["refit"].append(free_run(other, plant.dt, w[cut:], y[cut:]).mean())
        before = mark
    text = []
    for key, fits in found.items():
        near = next(m for i, m in enumerate(marks) if all(f > fits[-1] - 1 for f in fits[i:]))
        text.append(f"{key}: {near:5d} samples to {fits[-1]:.1f} %, {seconds[key]:.2f} s")
    return f"{plant.name:28s} " + "; ".join(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", nargs="*", help="plants whose name holds one of these")
    parser.add_argument("--refine", action="store_true", help="refine(free='linear') beside every run")
    parser.add_argument("--course", action="store_true", help="samples until within a point of the end")
    options = parser.parse_args()
    plants = [p for p in (*PLANTS, *WRONG) if not options.only or any(o in p.name for o in options.only)]
    if options.course:
        for plant in plants:
            if not plant.controlled:
                print(course(plant, options.first), flush=True)
        return
    total = dict.fromkeys(("runs", "fails", "compared", "within", "worse"), 0)
    print(HEAD, flush=True)
    for plant in plants:
        rows = [run(plant, options.first + s, options.refine) for s in range(options.seeds)]
        print(line(rows, total), flush=True)
        for row in rows:
            if row["error"]:
                print(row)
    print(
        "{runs} runs, {fails} fail; an output more than a point below the start in {worse}; within a point "
        "of the reference (refine where it ran, else the true model) in {within} of {compared}".format(
            **total
        )
    )


if __name__ == "__main__":
    main()
