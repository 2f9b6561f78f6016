"""Speed of the refiner on a stream, and of a free run.

    python benchmarks/kernels.py [--samples 4000] [--repeats 5]

Time of a sample for chains with effects, laws, and models without any setting, one sample or more a call.
Then a free run of a nonlinear candidate against `control.input_output_response`. Times move with the
machine's load; each is the median over interleaved runs in one process.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
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


def timed(run: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def streams(n_samples: int, repeats: int) -> list[str]:
    """Chains with effects, laws in a chain of three masses, and models to which nothing was named."""
    cases: dict[str, tuple[rco.RCORefiner, np.ndarray, np.ndarray, int]] = {}
    for masses in (3, 6):
        for size in (1, 10, 1000):
            stream = chain(masses, 0.02, WARM_UP + n_samples)
            cases[f"stiffnesses, {2 * masses} states, {size}"] = *stream, size
    plain, w, y = chain(3, 0.02, WARM_UP + n_samples)
    for kind in ("clearance", "cubic_stiffness", "coulomb_friction"):
        effects = [rco.Effect(kind, "link2")]
        for size in (1, 1000):
            refiner = rco.RCORefiner(plain.model, dt=0.02, effects=effects, use_estimated_states=False)
            cases[f"{kind}, {size}"] = refiner, w, y, size
    for size in (1, 10, 1000):
        cases[f"default, 6 states, {size}"] = rco.RCORefiner(plain.model, dt=0.02), w, y, size
    for refiner, inputs, outputs, _ in cases.values():
        refiner.update(inputs[:, :WARM_UP], outputs[:, :WARM_UP])
    spent: dict[str, list[float]] = {name: [] for name in cases}
    ahead = range(WARM_UP, WARM_UP + n_samples)
    for _ in range(repeats):
        for name, (refiner, inputs, outputs, size) in cases.items():
            parts = [slice(k, k + size) if size > 1 else k for k in ahead[::size]]
            blocks = [(inputs[:, part].copy(), outputs[:, part].copy()) for part in parts]
            spent[name].append(
                timed(lambda refiner=refiner, blocks=blocks: [refiner.update(*b) for b in blocks])
            )
    return [f"{name:31}{1e6 * np.median(times) / n_samples:10.2f} us" for name, times in spent.items()]


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
    print("law or model, samples a call")
    print("\n".join(streams(options.samples, options.repeats)))
    peer = adaptive_filter(options.samples)
    if peer:
        print(peer)
    print(nonlinear(options.samples, options.repeats))


if __name__ == "__main__":
    main()
