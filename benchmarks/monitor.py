"""False alarms and delays of `Monitor` on plants of ``tests/hidden``, which shares no code with it.

Healthy plants are integrated exactly (`scipy.signal.lsim`), changing ones by
`scipy.integrate.solve_ivp` with the law's strength a function of time.

    python benchmarks/monitor.py --null white ar --seeds 100 --first 1000 --samples 100000
    python benchmarks/monitor.py --change step ramp heal coulomb cubic --seeds 40 --first 2000
    python benchmarks/monitor.py --change step --plant "quarter car" --seeds 20 --first 3000
    python benchmarks/monitor.py --fault spike burst many early --size 1000 --seeds 40 --first 4000
    python benchmarks/monitor.py --fault jump --size 5 --seeds 40 --first 4000
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.stats import beta, poisson

import rcorefine as rco

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from hidden.generator import SECOND_ORDER, coloured, excitation, linear_states, outputs
from hidden.plants import PLANTS, Place, Plant

NULLS = {  # sensor noise, unmeasured force over the input, sensors
    "white": ("white", 0.0, 1),
    "two sensors": ("white", 0.0, 2),
    "ar": ("ar", 0.0, 1),
    "resonant": ("resonant", 0.0, 1),
    "t3": ("t3", 0.0, 1),
    "force 3": ("white", 0.03, 1),
    "force 30": ("white", 0.3, 1),
    "ar and force 3": ("ar", 0.03, 1),
}
HEALTHY = 6000  # samples before the change
AFTER, MOST_AFTER = 40, 6000  # periods of the first mode, and samples, after it


@dataclass
class Change:
    """A record with a change, and what it is."""

    plant: Plant
    w: np.ndarray
    y: np.ndarray
    kind: str
    place: str
    size: float
    period: float  # samples


def healthy_record(
    seed: int, case: str, samples: int, plant: str = "chain"
) -> tuple[Plant, np.ndarray, np.ndarray]:
    """A plant without any change."""
    noise, unmeasured, sensors = NULLS[case]
    rng = np.random.default_rng([seed, 41])
    made = PLANTS[plant](rng, sensors)
    w = excitation(rng, made, samples)
    driven = w + unmeasured * w.std() * rng.standard_normal(w.shape) if unmeasured else w
    y = outputs(made, linear_states(made, driven), driven, None, None)
    return made, w, y + 0.03 * y.std(axis=1, keepdims=True) * coloured(rng, noise, y.shape)


def integrated(
    plant: Plant, w: np.ndarray, law: Callable[[float, float, float], float], place: Place, start: int
) -> np.ndarray:
    """States (n, N): exact while healthy, by an adaptive integrator with the law from `start` on."""
    healthy = linear_states(plant, w[:, : start + 1])
    steer = (plant.B @ w).T
    sense = place.d if place.d is not None else 0.0 * place.v

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        k = min(int(t / plant.dt), w.shape[1] - 2)
        drive = steer[k] + (t / plant.dt - k) * (steer[k + 1] - steer[k])
        return plant.A @ x + drive + place.act * law(t, float(sense @ x), float(place.v @ x))

    t = np.arange(start, w.shape[1]) * plant.dt
    size = 1e-9 * float(np.abs(healthy).max())
    answer = solve_ivp(rate, (t[0], t[-1]), healthy[:, -1], t_eval=t, max_step=plant.dt, rtol=1e-6, atol=size)
    return np.hstack([healthy[:, :-1], answer.y])


def changing_record(
    seed: int,
    profile: Callable[[float], float],
    *,
    kind: str = "stiffness",
    loss: float = 0.1,
    noise: float = 0.03,
    noise_kind: str = "white",
    plant: str = "chain",
) -> Change:
    """A plant with a law whose strength follows `profile` of the periods since sample HEALTHY."""
    rng = np.random.default_rng([seed, 43])
    made = PLANTS[plant](rng, 1)
    poles = np.linalg.eigvals(made.A)
    swinging = np.abs(poles[np.abs(poles.imag) > 0.2 * np.abs(poles)])
    # where nothing swings, two time constants of the slowest state
    period = (2 * np.pi / swinging.min() if swinging.size else 2 / np.abs(poles).min()) / made.dt
    N = HEALTHY + min(int(AFTER * period), MOST_AFTER)
    w = excitation(rng, made, N)
    needs = kind.endswith("stiffness")
    places = [p for p in made.places if (p.d is not None or not needs) and (not p.laws or kind in p.laws)]
    place = places[int(rng.integers(len(places)))]
    x0 = linear_states(made, w)
    v_rms = float(np.std(place.v @ x0))
    d_rms = float(np.std(place.d @ x0)) if place.d is not None else 1.0
    shape = SECOND_ORDER[kind]
    nominal = {(q.kind, q.place): q.value for q in made.model.parameters}
    if kind in ("stiffness", "damping") and (kind, place.name) in nominal:
        size = -loss * nominal[kind, place.name]
    else:  # a force of that share of the one which moves the place
        inertia = abs(float(place.v @ place.act))
        force = float(np.std(np.gradient(place.v @ x0, made.dt))) / inertia
        size = loss * force / abs(shape(d_rms, v_rms, 1e-3 * v_rms))

    def law(t: float, d: float, v: float) -> float:
        return float(size * profile((t / made.dt - HEALTHY) / period) * shape(d, v, 0.003 * v_rms))

    x = integrated(made, w, law, place, HEALTHY)
    d = place.d @ x if place.d is not None else np.zeros(N)
    force = np.array([law(k * made.dt, d[k], float(place.v @ x[:, k])) for k in range(N)])
    y = outputs(made, x, w, force, place)
    level = y[:, :HEALTHY].std(axis=1, keepdims=True)
    y = y + noise * level * coloured(rng, noise_kind, y.shape)
    return Change(made, w, y, kind, place.name, size, period)


PROFILES: dict[str, tuple[str, Callable[[float], float]]] = {
    "step": ("stiffness", lambda t: float(t > 0)),
    "ramp": ("stiffness", lambda t: min(max(t / 30, 0.0), 1.0)),
    "heal": ("stiffness", lambda t: float(0 < t < 15)),
    "damper": ("damping", lambda t: float(t > 0)),
    "coulomb": ("coulomb_friction", lambda t: float(t > 0)),
    "cubic": ("cubic_stiffness", lambda t: float(t > 0)),
    "quadratic": ("quadratic_damping", lambda t: float(t > 0)),
}


def same(record: Change, place: str) -> bool:
    """Whether a place is the true one, or one that no sensor can tell from it (two springs at one mass)."""
    known = {p.name: p for p in record.plant.places}
    if place not in known:
        return False
    one, two = known[place], known[record.place]
    return place == record.place or (
        one.d is not None
        and two.d is not None
        and np.array_equal(one.act, two.act)
        and np.array_equal(one.d, two.d)
    )


def null(case: str, seeds: range, samples: int, false_alarms: float) -> None:
    """False alarms over healthy records."""
    alarms, began = [], time.perf_counter()
    for seed in seeds:
        plant, w, y = healthy_record(seed, case, samples)
        monitor = rco.Monitor(plant.model, dt=plant.dt, hold="foh", false_alarms=false_alarms)
        monitor.run(rco.Measurement(w, y, dt=plant.dt, hold="foh"))
        found = len(monitor.past_alarms) + (monitor.alarm is not None)
        alarms.append(found)
        if found:
            print(f"    seed {seed} {plant.name}: {monitor.alarm or monitor.past_alarms[0]}", flush=True)
    total = sum(alarms)
    stated = false_alarms * samples / 1e5 * len(seeds)
    chance = poisson.sf(total - 1, stated)
    print(
        f"{case:16s} {len(seeds)} x {samples} samples: {total} false alarms, stated {stated:g} "
        f"(as many or more by chance: {chance:.2g}); {time.perf_counter() - began:.0f} s",
        flush=True,
    )


def change(name: str, seeds: range, plant: str, loss: float, noise_kind: str) -> None:
    """Delay and name after a change."""
    kind, profile = PROFILES[name]
    delays, crossed, right, exact, early, since, size, ended = [], [], [], [], 0, [], [], []
    for seed in seeds:
        record = changing_record(seed, profile, kind=kind, loss=loss, plant=plant, noise_kind=noise_kind)
        made, T = record.plant, record.period
        monitor = rco.Monitor(made.model, dt=made.dt, hold="foh", learn=3000)
        first = None
        for k in range(0, record.w.shape[1], 20):
            monitor.update(record.w[:, k : k + 20], record.y[:, k : k + 20])
            if first is None and (monitor.alarm or monitor.past_alarms):
                first = monitor.alarm or monitor.past_alarms[0]
        last = monitor.alarm or (monitor.past_alarms[-1] if monitor.past_alarms else None)
        if first is None or last is None:
            delays.append(np.inf)
            right.append(False)
            exact.append(False)
            print(f"    seed {seed} {made.name} {record.place}: not found", flush=True)
            continue
        early += first.sample < HEALTHY
        delays.append((first.sample - HEALTHY) / T)
        crossed.append((first.crossed / made.dt - HEALTHY) / T)
        since.append((last.since_sample - HEALTHY) / T)
        right.append(same(record, first.effect.place))
        exact.append(same(record, last.effect.place) and last.effect.kind == record.kind)
        size.append(next(iter(last.coefficients.values())) / record.size if exact[-1] else np.nan)
        ended.append((last.ended / made.dt - HEALTHY) / T if last.ended else np.nan)
        if not (right[-1] and exact[-1]):
            print(
                f"    seed {seed} {made.name} true {record.kind} at {record.place}; first "
                f"{first.effect.label} ({first.probability:.2f}), last {last.effect.label} "
                f"({last.probability:.2f})",
                flush=True,
            )
    n, hits = len(right), int(np.sum(right))
    low = beta.ppf(0.05, hits, n - hits + 1) if hits else 0.0
    q = np.quantile(delays, [0.5, 0.9])
    text = (
        f"{name:10s} {plant} {n} seeds: threshold crossed after {np.median(crossed):.2f} periods, alarm "
        f"after {q[0]:.2f} (90 %: {q[1]:.2f}); place at the alarm right {hits}/{n} (> {low:.2f} with "
        "95 % confidence), "
        f"place and kind at the end {int(np.sum(exact))}/{n}; since off by {np.median(since):+.2f} periods; "
        f"coefficient over truth {np.median(np.where(np.isfinite(size), size, 0)):.3f}; "
        f"before the change {early}"
    )
    if name == "heal":
        gone = np.array(ended)
        after = np.median(np.where(np.isfinite(gone), gone, np.inf))
        text += f"; gone after {after:.1f} periods (healed at 15) in {np.isfinite(gone).sum()}/{n}"
    print(text, flush=True)


def faulty(seed: int, fault: str, size: float, plant: str) -> tuple[Plant, np.ndarray, np.ndarray]:
    """A healthy plant with a sensor that fails for moments, or drifts and jumps back."""
    made, w, y = healthy_record(seed, "white", HEALTHY, plant)
    rng = np.random.default_rng([seed, 47])
    sigma = 0.03 * y.std(axis=1)
    at, sign = int(rng.integers(2500, HEALTHY - 500)), rng.choice([-1.0, 1.0])
    if fault == "spike":
        y[:, at] += sign * size * sigma
    elif fault == "burst":
        y[:, at : at + 3] += size * sigma[:, None] * rng.standard_normal((len(y), 3))
    elif fault == "many":  # one in 500
        y[:, rng.integers(2100, HEALTHY, HEALTHY // 500)] += sign * size * sigma[:, None]
    elif fault == "early":  # in the learning phase
        y[:, int(rng.integers(100, 1900))] += sign * size * sigma
    else:
        y[:, :at] += sign * size * sigma[:, None] * np.linspace(0, 1, at)
    return made, w, y


def fault(name: str, seeds: range, size: float, plant: str) -> None:
    """Streams that ring, and streams that die, for a sensor fault on a healthy plant."""
    rung, dead, names = 0, 0, []
    for seed in seeds:
        made, w, y = faulty(seed, name, size, plant)
        monitor = rco.Monitor(made.model, dt=made.dt, hold="foh", learn=2000)
        try:
            for k in range(0, HEALTHY, 50):
                monitor.update(w[:, k : k + 50], y[:, k : k + 50])
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            dead += 1
            continue
        found = [*monitor.past_alarms, *([monitor.alarm] if monitor.alarm else [])]
        rung += bool(found)
        names += [found[0].effect.kind] if found else []
    print(
        f"{name:8s} {size:g} sigma, {plant}: rang in {rung}, died in {dead} of {len(seeds)} {names}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--null", nargs="*", default=[], choices=list(NULLS))
    parser.add_argument("--change", nargs="*", default=[], choices=list(PROFILES))
    parser.add_argument("--fault", nargs="*", default=[], choices=["spike", "burst", "many", "early", "jump"])
    parser.add_argument(
        "--size", type=float, default=1000.0, help="of a fault, in standard deviations of the noise"
    )
    parser.add_argument("--plant", default="chain", choices=list(PLANTS))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--false-alarms", type=float, default=0.01)
    parser.add_argument("--loss", type=float, default=0.1)
    parser.add_argument("--noise", default="white", help="color of the sensor noise in --change")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    for case in options.null:
        null(case, seeds, options.samples, options.false_alarms)
    for name in options.change:
        change(name, seeds, options.plant, options.loss, options.noise)
    for name in options.fault:
        fault(name, seeds, options.size, options.plant)


if __name__ == "__main__":
    main()
