"""Speed of the physical stage on a stream, with the accuracy beside every time.

    python benchmarks/kernels.py [--samples 4000] [--repeats 5]

The same recursion in plain numpy is written out below; both run on the same samples from the
same memory, and the largest difference of their coefficients is printed. Then a free run of a
nonlinear candidate against `control.input_output_response`. Times move with the machine's load;
the ratio is the median over interleaved runs in one process.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

import rcorefine as rco
from rcorefine.engine.engine import Engine
from rcorefine.engine.nonlinear import nonlinear_system
from rcorefine.engine.structure import Structure
from rcorefine.jit import NUMBA

WARM_UP = 4000  # samples before the clock starts: the refiner has settled


def chain(n: int, dt: float, n_samples: int) -> tuple[rco.RCORefiner, np.ndarray, np.ndarray]:
    """Chain with one weak spring, 5 % noise, a stiffness to find in each of the first three links."""
    k = np.linspace(10, 6, n)
    weak = k.copy()
    weak[1] *= 0.7
    sensors = ("displacement", (1, n))
    initial = rco.mass_spring_damper([1.0] * n, list(0.02 * k), list(k), sensors=sensors, force=n)
    true = rco.mass_spring_damper([1.0] * n, list(0.02 * k), list(weak), sensors=sensors, force=n)
    rng = np.random.default_rng(0)
    w = rng.standard_normal((1, n_samples))
    blank = rco.Measurement(w, np.zeros((2, n_samples)), dt=dt)
    y = rco.simulate(true, blank, "zero").outputs
    y = y + 0.05 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    effects = [rco.Effect("stiffness", f"link{i}") for i in (1, 2, 3)]
    return rco.RCORefiner(initial, dt=dt, effects=effects, use_estimated_states=False), w, y


class PlainNumpy:
    """The same recursion, one numpy call per product."""

    def __init__(self, refiner: rco.RCORefiner) -> None:
        part = refiner._estimator.filter
        self.setup, self.part = part.setup, part
        lay, memory = part.setup.layout, part.memory
        self.v = {name: lay.view(memory.packed, name).copy() for name in lay.shapes}
        self.centre, self.uncertain = memory.centre.copy(), int(memory.counters[1])
        self.discretize()

    def discretize(self) -> None:
        s, n, nu = self.setup.structure(self.part.memory.widths), self.setup.layout.n, self.setup.layout.nu
        d = s.discretize(self.centre, self.setup.settings.dt)
        M, dM = d.M[0], d.dM[0]
        self.Phi, self.dPhi = M[:, :n], dM[:, :, :n]
        self.Gam, self.dGam = (m[..., n : n + nu] + m[..., n + nu : n + 2 * nu] for m in (M, dM))
        self.O, self.dO = d.O, d.dO

    def sample(self, w: np.ndarray, y: np.ndarray) -> None:
        v, n = self.v, self.Phi.shape[0]
        shift = v["theta"] - self.centre
        Phi = self.Phi + np.tensordot(shift, self.dPhi, 1)
        Gam = self.Gam + np.tensordot(shift, self.dGam, 1)
        O = self.O + np.tensordot(shift, self.dO, 1)
        S = v["S"] @ Phi.T + self.dPhi @ v["x"] + self.dGam @ v["w"]
        x = Phi @ v["x"] + Gam @ v["w"]
        w = np.append(w, 1.0)
        xw = np.concatenate([x, w])
        yhat, h = O @ xw, S @ O[:, :n].T + self.dO @ xw
        Pb, Pt, level, count = v["Pb"], v["Pt"], v["level"], v["count"]
        H = O[:, :n] @ Phi
        for i in range(y.size):
            e = y[i] - yhat[i]
            count[i] += 1
            level[0, i] += (e * e - level[0, i]) / 32
            level[1, i] += max(1e-3, 1 / count[i]) * (e * e - level[1, i])
            R = max(0.5 * level[0, i], level[1, i])
            s, inner = R, e
            if self.uncertain:
                K = Pb @ H[i]
                s = R + H[i] @ K
                K /= s
            g = Pt @ h[:, i]
            st = s + g @ h[:, i]
            move = g * (e / st)
            v["theta"] += move
            inner -= h[:, i] @ move
            x += move @ S
            yhat[i + 1 :] += move @ h[:, i + 1 :]
            if self.uncertain:
                FK = Phi @ K
                x += FK * inner
                c = H[i + 1 :] @ K
                yhat[i + 1 :] += c * inner
                h[:, i + 1 :] -= np.outer(h[:, i], c)
                S -= np.outer(h[:, i], FK)
                Pb -= s * np.outer(K, K)
            Pt -= np.outer(g, g) / st
        if self.uncertain:
            Pb[:] = Phi @ Pb @ Phi.T
        v["x"], v["S"], v["w"] = x, S, w
        if np.any(np.abs(v["theta"] - self.centre) > np.sqrt(np.diag(Pt))):
            self.centre = v["theta"].copy()
            self.discretize()


def timed(run: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def stage(n: int, n_samples: int, repeats: int) -> list[str]:
    refiner, w, y = chain(n, 0.02, WARM_UP + n_samples)
    refiner.update(w[:, :WARM_UP], y[:, :WARM_UP])
    part = refiner._estimator.filter
    start = part.memory
    ahead = slice(WARM_UP, WARM_UP + n_samples)
    rest, measured = w[:, ahead], y[:, ahead]
    columns = [(rest[:, k].copy(), measured[:, k].copy()) for k in range(n_samples)]

    def restart() -> None:
        part.memory = replace(start.copied(), kernel=start.kernel)

    def singly() -> None:
        for one, other in columns:
            refiner.update(one, other)

    def blocks(size: int) -> Callable[[], None]:
        def run() -> None:
            for k in range(0, n_samples, size):
                refiner.update(rest[:, k : k + size], measured[:, k : k + size])

        return run

    variants = {"1 sample a call": singly, "blocks of 10": blocks(10), "blocks of 1000": blocks(1000)}
    spent: dict[str, list[float]] = {name: [] for name in ("numpy", *variants)}
    difference = 0.0
    for _ in range(repeats):
        restart()
        plain = PlainNumpy(refiner)
        spent["numpy"].append(timed(lambda plain=plain: [plain.sample(*c) for c in columns]))
        for name, run in variants.items():
            restart()
            spent[name].append(timed(run))
            difference = max(difference, float(np.abs(part.theta / plain.v["theta"] - 1).max()))
    lines = []
    for name in spent:
        ratio = np.median(np.array(spent["numpy"]) / np.array(spent[name]))
        each = 1e6 * np.median(spent[name]) / n_samples
        gap = "" if name == "numpy" else f"{difference:.1e}"
        lines.append(f"{2 * n:4d} states  {name:18}{each:10.2f} us{ratio:9.1f} x   {gap}")
    return lines


def streams(n_samples: int, repeats: int) -> list[str]:
    """What else streams: laws in a chain of three masses, and the refiner to which nothing was named."""
    plain, w, y = chain(3, 0.02, WARM_UP + n_samples)
    one = rco.mass_spring_damper([1.0], [0.2], [10.0], sensors="displacement")
    two = rco.mass_spring_damper([1.0, 1.0], [0.2, 0.2], [10.0, 8.0], sensors="displacement", force=2)
    cases: dict[str, tuple[Any, np.ndarray, int]] = {}
    for kind in ("clearance", "cubic_stiffness", "coulomb_friction"):
        effects = [rco.Effect(kind, "link2")]
        for size in (1, 1000):
            refiner = rco.RCORefiner(plain.model, dt=0.02, effects=effects, use_estimated_states=False)
            cases[f"{kind}, {size}"] = refiner, y, size
    rng = np.random.default_rng(1)
    for model, name in ((one, "one mass"), (two, "two masses")):
        record = rco.Measurement(w, np.zeros((model.system.noutputs, w.shape[1])), dt=0.02)
        out = rco.simulate(model, record, "zero").outputs
        out += 0.05 * out.std(axis=1, keepdims=True) * rng.standard_normal(out.shape)
        for size in (1, 10, 1000):
            cases[f"default, {name}, {size}"] = rco.RCORefiner(model, dt=0.02), out, size
    for refiner, out, _ in (*cases.values(), (plain, y, 0)):
        refiner.update(w[:, :WARM_UP], out[:, :WARM_UP])
    spent: dict[str, list[float]] = {name: [] for name in ("numpy", *cases)}
    ahead = range(WARM_UP, WARM_UP + n_samples)
    columns = [(w[:, k].copy(), y[:, k].copy()) for k in ahead]
    for _ in range(repeats):
        loop = PlainNumpy(plain)
        spent["numpy"].append(timed(lambda loop=loop: [loop.sample(*c) for c in columns]))
        for name, (refiner, out, size) in cases.items():
            parts = [slice(k, k + size) if size > 1 else k for k in ahead[::size]]
            blocks = [(w[:, part].copy(), out[:, part].copy()) for part in parts]
            spent[name].append(
                timed(lambda refiner=refiner, blocks=blocks: [refiner.update(*b) for b in blocks])
            )
    lines = []
    for name, times in spent.items():
        ratio = np.median(np.array(spent["numpy"]) / np.array(times))
        lines.append(f"{name:31}{1e6 * np.median(times) / n_samples:10.2f} us{ratio:9.1f} x")
    return lines


def adaptive_filter(n_samples: int) -> str | None:
    """padasip's recursive least squares of like size, where it is installed."""
    if importlib.util.find_spec("padasip") is None:
        return None
    import padasip

    rng = np.random.default_rng(0)
    X = rng.standard_normal((n_samples, 9))
    d = X @ np.arange(1.0, 10.0)
    peer = padasip.filters.FilterRLS(n=9, mu=0.999)
    seconds = timed(lambda: peer.run(d, X)) / n_samples
    return (
        f"   9 weights padasip FilterRLS{1e6 * seconds:9.2f} us  (a static regression, no state to estimate)"
    )


def nonlinear(n_samples: int, repeats: int) -> str:
    """Free run of a quadratic damper in a chain: the engine against python-control's integrator."""
    dt = 0.02
    model = rco.mass_spring_damper([1.0] * 3, [0.2, 0.16, 0.12], [10.0, 8.0, 6.0], force=3)
    structure = Structure(model, [rco.Effect("quadratic_damping", "link2")])
    theta = np.array([0.5])
    w = np.random.default_rng(0).standard_normal((1, n_samples))
    data = rco.Measurement(w, np.zeros((3, n_samples)), dt=dt, hold="foh")
    peer = nonlinear_system(structure, theta)
    engine = Engine(structure, data)
    engine.run(theta, sensitivity=False)

    def theirs(**options: Any) -> np.ndarray:
        answer = ct.input_output_response(peer, data.timepts, w, **options)
        return np.asarray(answer.outputs)

    few = min(n_samples, 400)
    short = ct.input_output_response(
        peer, data.timepts[:few], w[:, :few], solve_ivp_kwargs={"rtol": 1e-9, "atol": 1e-12}
    ).outputs
    ours_s = [timed(lambda: engine.run(theta, sensitivity=False)) for _ in range(5 * repeats)]
    begin = time.perf_counter()
    found = theirs()
    theirs_s = time.perf_counter() - begin
    mine = engine.run(theta, sensitivity=False).outputs
    scale = np.abs(short).max()
    return (
        f"free run, quadratic damper, {n_samples} samples: control.input_output_response "
        f"{1e3 * theirs_s:.0f} ms "
        f"(error {np.abs(found[:, :few] - short).max() / scale:.1e}), "
        f"engine {1e3 * np.median(ours_s):.2f} ms "
        f"(error {np.abs(mine[:, :few] - short).max() / scale:.1e}): {theirs_s / np.median(ours_s):.0f} x"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=4000)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    print(f"numba {'on' if NUMBA else 'off'}, {options.samples} samples, median of {options.repeats} runs")
    print(f"{'size':13}{'':18}{'per sample':>11}{'numpy /':>11}   largest relative difference")
    for n in (3, 6):
        print("\n".join(stage(n, options.samples, options.repeats)))
    print("law or model, samples a call")
    print("\n".join(streams(options.samples, options.repeats)))
    peer = adaptive_filter(options.samples)
    if peer:
        print(peer)
    print(nonlinear(options.samples, options.repeats))


if __name__ == "__main__":
    main()
