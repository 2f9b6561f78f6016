"""One defect planted in a random structure: does the top row of the failure map name it, and its region?

    python benchmarks/failure_map.py                    # 100 seeds per defect, 200 without one
    python benchmarks/failure_map.py --seeds 20 --only "clipping,drift" --first 1000

Chains of 1 to 5 masses with light damping, one or two sensors (displacement, velocity or acceleration),
a white, colored, swept or multisine force, 60 s at 50 Hz, 2 % noise. The records are made here, with exact
propagation of the linear part and forces integrated at 20 steps per sample: nothing of rcorefine makes them.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm
from scipy.signal import butter, chirp, lfilter
from scipy.stats import beta

import rcorefine as rco
from rcorefine.views.tables import TextTable

Array = np.ndarray
DT, SAMPLES, NOISE, STEPS = 0.02, 3000, 0.02, 20


@dataclass
class Structure:
    """Chain of masses as matrices written out here, and the model that is handed to compare."""

    A: Array
    B: Array
    C: Array
    D: Array
    through: list[Array]  # what a force at each link does to the outputs at once
    links: list[tuple[str, Array, Array, Array]]  # name, d row, v row, act
    model: rco.PhysicalModel
    w: Array
    rng: np.random.Generator

    def response(
        self,
        A: Array | None = None,
        w: Array | None = None,
        law: Callable | None = None,
        link: int = 0,
        late: float = 0.0,
    ) -> Array:
        """Outputs (n_y, N) from rest; the force is held over each sample."""
        A = self.A if A is None else A
        w = self.w if w is None else w
        n, h = A.shape[0], DT / STEPS
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n:] = A, self.B
        if law is None and late == 0.0:
            M = expm(block * DT)
            Phi, G = M[:n, :n], M[:n, n]
            x, X = np.zeros(n), np.empty((n, w.size))
            for k in range(w.size):
                X[:, k] = x
                x = Phi @ x + G * w[k]
            return self.C @ X + self.D * w
        M = expm(block * h)
        Phi, G = M[:n, :n], M[:n, n]
        fine = np.repeat(w, STEPS)
        shift = round(late * STEPS)
        fine = np.concatenate([np.zeros(shift), fine])[: fine.size]
        if law is None:
            x, X = np.zeros(n), np.empty((n, w.size))
            for k in range(fine.size):
                if k % STEPS == 0:
                    X[:, k // STEPS] = x
                x = Phi @ x + G * fine[k]
            return (
                self.C @ X + self.D * np.append(0.0, w[:-1])[None] * (shift > 0) + self.D * w * (shift == 0)
            )
        _, d, v, act = self.links[link]
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n] = A, act
        push = expm(block * h)[:n, n]
        out, x = np.empty((self.C.shape[0], w.size)), np.zeros(n)
        for k in range(fine.size):
            f = law(d @ x, v @ x)
            if k % STEPS == 0:
                out[:, k // STEPS] = self.C @ x + (self.D[:, 0] * fine[k]) + self.through[link] * f
            middle = Phi @ x + G * fine[k] + push * f
            x = middle + 0.5 * push * (law(d @ middle, v @ middle) - f)
        return out


def structure(seed: int, *, sensors: int = 0, masses: int = 0) -> Structure:
    """A random chain."""
    rng = np.random.default_rng([seed, 7007])
    n = masses or int(rng.integers(1, 6))
    m = rng.uniform(0.6, 1.6, n)
    k = rng.uniform(80, 300, n)
    c = 2 * rng.uniform(0.006, 0.03) * np.sqrt(k * m.mean())
    K, Cd, links = np.zeros((n, n)), np.zeros((n, n)), []
    for i in range(n):
        e = np.zeros(n)
        e[i] = 1.0
        if i:
            e[i - 1] = -1.0
        K += k[i] * np.outer(e, e)
        Cd += c[i] * np.outer(e, e)
        zero = np.zeros(n)
        links.append((f"link{i + 1}", np.append(e, zero), np.append(zero, e), np.append(zero, -e / m)))
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-K / m[:, None], -Cd / m[:, None]]])
    force = int(rng.integers(n))
    B = np.zeros((2 * n, 1))
    B[n + force] = 1 / m[force]
    count = sensors or int(rng.integers(1, min(2, n) + 1))
    spots = rng.permutation(n)[:count] if n >= count else np.zeros(count, int)
    kinds = [str(rng.choice(["displacement", "velocity", "acceleration"])) for _ in spots]
    C, D, through = np.zeros((count, 2 * n)), np.zeros((count, 1)), [np.zeros(count) for _ in range(n)]
    for row, (spot, kind) in enumerate(zip(spots, kinds, strict=True)):
        if kind == "acceleration":
            C[row], D[row] = A[n + spot], B[n + spot]
            for i in range(n):
                through[i][row] = links[i][3][n + spot]
        else:
            C[row, spot + (n if kind == "velocity" else 0)] = 1.0
    model = rco.mass_spring_damper(
        m, c, k, force=force + 1, sensors=[(kind, int(s) + 1) for kind, s in zip(kinds, spots, strict=True)]
    )
    t = np.arange(SAMPLES) * DT
    what = rng.choice(["white", "colored", "multisine", "sweep"])
    if what == "white":
        w = rng.standard_normal(SAMPLES)
    elif what == "colored":
        w = lfilter([1], [1, -0.6], rng.standard_normal(SAMPLES))
    elif what == "multisine":
        lines = np.arange(0.1, 12.0, 0.1)
        w = np.sum(
            [
                np.cos(2 * np.pi * f * t + p)
                for f, p in zip(lines, rng.uniform(0, 6.28, lines.size), strict=True)
            ],
            0,
        )
    else:
        w = chirp(t, 0.3, t[-1], 10.0) + 0.1 * rng.standard_normal(SAMPLES)
    return Structure(A, B, C, D, through, links, model, 10 * w / w.std(), rng)


@dataclass
class Planted:
    """A record with a defect, and what the top row must say."""

    structure: Structure
    outputs: Array
    right: Callable[[rco.comparison.Failure], bool]
    noise: str = "white"
    after: Callable[[Array], Array] = field(default=lambda y: y)  # what happens behind the noise

    def record(self, dirty: float = NOISE) -> rco.Measurement:
        s = self.structure
        e = s.rng.standard_normal(self.outputs.shape)
        if self.noise == "AR(0.9)":
            e = lfilter([1], [1, -0.9], e)
        elif self.noise == "AR(0.99)":
            e = lfilter([1], [1, -0.99], e)
        elif self.noise == "resonant":
            e = lfilter([1], [1, -1.85, 0.95], e)
        elif self.noise == "pink":
            e = sum(lfilter([1 - p], [1, -p], s.rng.standard_normal(e.shape)) for p in (0.0, 0.7, 0.97))
        e = e / e.std(axis=1, keepdims=True)
        y = self.after(self.outputs + dirty * self.outputs.std(axis=1, keepdims=True) * e)
        linear = s.model.linear
        return rco.Measurement(
            s.w, y, dt=DT, input_labels=list(linear.input_labels), output_labels=list(linear.output_labels)
        )


def moved_mode(seed: int, frequency: float, damping: float) -> Planted:
    """One mode elsewhere; it carries at least a tenth of an output."""
    for attempt in range(50):
        s = structure(seed + 100_000 * attempt)
        values, right = np.linalg.eig(s.A)
        left = np.linalg.inv(right)
        spread = s.response().std(axis=1)
        candidates = []
        for i in np.flatnonzero(values.imag > 0):
            part = np.zeros_like(s.A, dtype=complex)
            part += np.outer(right[:, i], left[i]) * 0.02 * values[i]
            change = s.response(s.A + 2 * part.real) - s.response()
            if (change.std(axis=1) / spread).max() > 0.05:
                candidates.append(i)
        if candidates:
            break
    i = int(s.rng.choice(candidates))
    old = values[i]
    omega, zeta = abs(old) * frequency, -old.real / abs(old) * damping
    new = complex(-zeta * omega, omega * np.sqrt(1 - zeta**2))
    A = s.A + 2 * (np.outer(right[:, i], left[i]) * (new - old)).real

    def right_row(row: rco.comparison.Failure) -> bool:
        v = row.values
        center = v["modes"][0]["omega"] if "modes" in v else v.get("center", np.nan)
        return row.dimension == "frequency" and abs(center / omega - 1) < 0.05

    return Planted(s, s.response(A), right_row)


def band_gain(seed: int) -> Planted:
    """An output 25-50 % off in a band that holds at least a tenth of its energy."""
    for attempt in range(50):
        s = structure(seed + 100_000 * attempt)
        y = s.response()
        i = int(s.rng.integers(y.shape[0]))
        low = float(s.rng.uniform(0.4, 8.0))
        high = min(low * float(s.rng.uniform(1.3, 2.5)), 20.0)
        part = lfilter(*butter(2, [low, high], "bandpass", fs=1 / DT), y[i])
        if 0.2 < part.std() / y[i].std() < 0.8:
            break
    gain = float(s.rng.choice([-1, 1]) * s.rng.uniform(0.25, 0.5))
    y[i] += gain * part
    low, high = 2 * np.pi * low, 2 * np.pi * high

    def right(row: rco.comparison.Failure) -> bool:
        v = row.values
        center = v["modes"][0]["omega"] if "modes" in v else v.get("center", np.nan)
        return row.dimension == "frequency" and low / 1.3 < center < high * 1.3

    return Planted(s, y, right)


def delay(seed: int) -> Planted:
    s = structure(seed)
    y = s.response(late=0.7)

    def right(row: rco.comparison.Failure) -> bool:
        return row.dimension == "time" and row.measure == "delay" and 0.5 < row.values["samples"] < 0.9

    return Planted(s, y, right)


def clipped(seed: int) -> Planted:
    s = structure(seed)
    y = s.response()
    i, sides = int(s.rng.integers(y.shape[0])), s.rng.choice(["both", "above", "below"])
    limit = float(np.quantile(np.abs(y[i]), s.rng.uniform(0.85, 0.97)))
    low, high = (-limit if sides != "above" else -np.inf), (limit if sides != "below" else np.inf)

    def cut(values: Array) -> Array:
        values = values.copy()
        values[i] = np.clip(values[i], low, high)
        return values

    def right(row: rco.comparison.Failure) -> bool:
        v = row.values
        return (
            row.dimension == "time"
            and row.measure == "clipping"
            and abs(abs(v["limit"]) / limit - 1) < 0.1
            and v["output"] == s.model.linear.output_labels[i]
        )

    behind = bool(s.rng.integers(2))
    return Planted(s, y if behind else cut(y), right, after=cut if behind else (lambda v: v))


def dropout(seed: int) -> Planted:
    s = structure(seed)
    y = s.response()
    i, start = int(s.rng.integers(y.shape[0])), float(s.rng.uniform(3, 54))
    a, b = round(start / DT), round((start + 2.0) / DT)
    hold = bool(s.rng.integers(2))

    def lost(values: Array) -> Array:
        values = values.copy()
        values[i, a:b] = values[i, a - 1] if hold else 0.0
        return values

    def right(row: rco.comparison.Failure) -> bool:
        v = row.values
        return (
            row.dimension == "time"
            and "start" in v
            and abs(v["start"] - start) < 0.3
            and abs(v["stop"] - start - 2.0) < 0.3
            and v["output"] == s.model.linear.output_labels[i]
        )

    behind = bool(s.rng.integers(2))
    return Planted(s, y if behind else lost(y), right, after=lost if behind else (lambda v: v))


def drift(seed: int) -> Planted:
    s = structure(seed)
    y = s.response()
    i, t = int(s.rng.integers(y.shape[0])), np.linspace(0, 1, SAMPLES)
    shapes = [t, t**2, np.sin(2 * np.pi * t + s.rng.uniform(0, 6)), 1 - np.exp(-3 * t)]
    shape = shapes[int(s.rng.integers(4))]
    y[i] += s.rng.uniform(0.2, 0.6) * s.rng.choice([-1, 1]) * y[i].std() * shape / np.ptp(shape)

    def right(row: rco.comparison.Failure) -> bool:
        v = row.values
        return (
            row.dimension == "time"
            and v.get("kind") == "drift"
            and v["output"] == s.model.linear.output_labels[i]
        )

    return Planted(s, y, right)


def hidden_law(
    seed: int, make: Callable[[Structure, Array, Array], Callable], right_law: Callable
) -> Planted:
    """A force law at a link that changes the response by 10 to 40 %."""
    s = structure(seed)
    link = int(s.rng.integers(len(s.links)))
    n = s.A.shape[0]
    states = Structure(s.A, s.B, np.eye(n), np.zeros((n, 1)), [], [], s.model, s.w, s.rng).response()
    d, v = s.links[link][1] @ states, s.links[link][2] @ states
    plain = s.response()
    strength, law = 0.1, make(s, d, v)
    for _ in range(12):
        y = s.response(law=lambda a, b, k=strength: k * law(a, b), link=link)
        loss = float((np.linalg.norm(y - plain, axis=1) / np.linalg.norm(plain, axis=1)).max())
        if 0.1 < loss < 0.4:
            break
        strength *= np.clip(0.2 / max(loss, 1e-6), 0.2, 5.0)
    name = s.links[link][0]
    return Planted(
        s, y, lambda row: row.dimension == "state" and row.values["place"] == name and right_law(row.values)
    )


def coulomb(seed: int) -> Planted:
    def make(s: Structure, d: Array, v: Array) -> Callable:
        level, width = float(np.std(np.gradient(v, DT))), 1e-3 * float(v.std())
        return lambda a, b: level * np.tanh(b / width)

    return hidden_law(seed, make, lambda v: v["law"].startswith("dry"))


def hardening(seed: int) -> Planted:
    def make(s: Structure, d: Array, v: Array) -> Callable:
        gap, slope = float(s.rng.uniform(0.8, 1.5) * d.std()), float(np.std(np.gradient(v, DT)) / d.std())
        return lambda a, b: 10 * slope * np.sign(a) * max(abs(a) - gap, 0.0)

    return hidden_law(seed, make, lambda v: v["law"] in ("beyond", "odd displacement"))


def wrong_sign(seed: int) -> Planted:
    s = structure(seed, sensors=2, masses=int(np.random.default_rng(seed).integers(2, 6)))
    y = s.response()
    i = int(s.rng.integers(2))
    y[i] *= -1
    name = s.model.linear.output_labels[i]
    return Planted(
        s, y, lambda row: row.dimension == "time" and row.measure == "sign" and row.values["output"] == name
    )


def exact(noise: str) -> Callable[[int], Planted]:
    def make(seed: int) -> Planted:
        s = structure(seed)
        return Planted(s, s.response(), lambda row: False, noise=noise)

    return make


def _sign(seed: int) -> int:
    return 1 if np.random.default_rng([seed, 3]).integers(2) else -1


DEFECTS: dict[str, Callable[[int], Planted]] = {
    "mode 3 % off in frequency": lambda seed: moved_mode(seed, 1 + 0.03 * _sign(seed), 1.0),
    "damping 50 % off": lambda seed: moved_mode(seed, 1.0, 1 + 0.5 * _sign(seed)),
    "gain off in one band": band_gain,
    "delay of 0.7 sample": delay,
    "clipping": clipped,
    "dropout of 2 s": dropout,
    "drift": drift,
    "Coulomb friction": coulomb,
    "hardening above an amplitude": hardening,
    "wrong sign of one output": wrong_sign,
}
NOTHING = {
    f"exact model, {noise} noise": exact(noise)
    for noise in ("white", "AR(0.9)", "AR(0.99)", "resonant", "pink")
}


def interval(hits: int, count: int) -> tuple[float, float]:
    """Binomial 95 % interval (Clopper and Pearson)."""
    low = 0.0 if hits == 0 else float(beta.ppf(0.025, hits, count - hits + 1))
    high = 1.0 if hits == count else float(beta.ppf(0.975, hits + 1, count - hits))
    return low, high


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=100, help="per defect; twice as many without one")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", default="", help="comma-separated beginnings of names")
    parser.add_argument("--misses", action="store_true", help="print the top rows of the misses")
    options = parser.parse_args(arguments)
    chosen = {**DEFECTS, **NOTHING}
    if options.only:
        chosen = {k: v for k, v in chosen.items() if k.startswith(tuple(options.only.split(",")))}
    rows, met = [], True
    for name, make in chosen.items():
        empty = name in NOTHING
        count, hits, spent = options.seeds * (2 if empty else 1), 0, 0.0
        for seed in range(options.first, options.first + count):
            planted = make(seed)
            data = planted.record()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", rco.RCOWarning)
                began = time.perf_counter()
                found = rco.compare(planted.structure.model, data).failures
                spent += time.perf_counter() - began
            hit = not found if empty else bool(found) and planted.right(found[0])
            hits += hit
            if options.misses and not hit:
                print(f"--- {name}, seed {seed} ({len(planted.structure.links)} masses)")
                for row in list(found)[:3]:
                    print(
                        f"    {row.dimension}: {row.where}: {row.measure} {row.statistic:.0f} "
                        f"{row.share:.3f} {row.p_value:.1g}"
                    )
        low, high = interval(hits, count)
        met &= hits / count >= 0.95
        rows.append(
            [
                name,
                str(count),
                f"{100 * hits / count:.1f}",
                f"{100 * low:.0f} - {100 * high:.0f}",
                f"{spent / count:.1f}",
            ]
        )
        print(f"{name}: {hits}/{count}", file=sys.stderr)
    print(
        TextTable(
            ["planted", "seeds", "right [%]", "95 % interval", "time [s]"],
            rows,
            title=f"Top row of the failure map names dimension and region; {100 * NOISE:g} % noise",
            notes=[
                "Without a defect: the map is empty. Demanded: at least 95 %. time: of one compare with map."
            ],
        ).text()
    )
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
