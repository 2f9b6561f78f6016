"""Seconds of processor time where a person waits, beside those of another checkout.

    python benchmarks/waits.py [--against FOLDER] [--rows WORD ...] [--limit SECONDS]

Each row is one call on one record, in a process of its own: the second call, so that nothing is compiled
within. With --against, both checkouts run in turn on the same records, and the last column is the ratio.
The records are integrated here by Runge-Kutta, and not by the package.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent.parent
Record = tuple[np.ndarray, np.ndarray, float]

M, C, K = np.array([1.0, 0.8]), np.array([0.5, 0.4]), np.array([200.0, 150.0])
MODEL = "rco.mass_spring_damper([1.0, 0.8], [0.5, 0.4], [200.0, 150.0], sensors=['velocity', 1])"
PENDULUM = """ct.nlsys(
    lambda t, x, u, params: np.array([x[1], -9.81 * np.sin(x[0]) - 0.15 * x[1] + u[0]]),
    lambda t, x, u, params: np.array([x[0]]), inputs=["u"], outputs=["y"], states=["angle", "speed"])"""


def integrated(
    rates: Callable[[np.ndarray, float], np.ndarray],
    read: Callable[[np.ndarray], Any],
    n: int,
    w: np.ndarray,
    noise: float,
    dt: float,
) -> Record:
    """Record of a system from rest, 40 Runge-Kutta steps per sample, with noise."""
    x, h = np.zeros(n), dt / 40
    y = np.zeros((w.size, *np.shape(read(x))))
    for k, u in enumerate(w):
        y[k] = read(x)
        for _ in range(40):
            a = rates(x, u)
            b = rates(x + h / 2 * a, u)
            c = rates(x + h / 2 * b, u)
            x = x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c, u))
    return w, (y + noise * y.std(axis=0) * np.random.default_rng(1).standard_normal(y.shape)).T, dt


def chain(samples: int, extra: Callable[[np.ndarray], tuple[float, float]]) -> Record:
    """Two masses pushed at the first; `extra` gives the force between them, and the rate of its state."""

    def rates(x: np.ndarray, u: float) -> np.ndarray:
        more, inner = extra(x)
        first = -K[0] * x[0] - C[0] * x[2]
        between = -K[1] * (x[1] - x[0]) - C[1] * (x[3] - x[2]) - more
        return np.array([x[2], x[3], (first - between + u) / M[0], between / M[1], inner])

    w = 10 * np.random.default_rng(0).standard_normal(samples)
    return integrated(rates, lambda x: x[2], 5, w, 0.03, 0.01)


def long_chain(masses: int, samples: int, sensors: int) -> Record:
    """A chain of equal masses, pushed at the first, with dry friction at its third link; the first speeds."""

    def rates(x: np.ndarray, u: float) -> np.ndarray:
        d, v = np.diff(x[:masses], prepend=0.0), np.diff(x[masses:], prepend=0.0)
        pull = 300.0 * d + 0.3 * v + 0.6 * (np.arange(masses) == 2) * np.tanh(v / 1e-3)
        force = np.append(pull[1:], 0.0) - pull
        force[0] += u
        return np.concatenate([x[masses:], force])

    w = 10 * np.random.default_rng(3).standard_normal(samples)
    seen = list(range(masses, masses + sensors))
    return integrated(rates, lambda x: x[seen], 2 * masses, w, 0.02, 0.02)


def friction(x: np.ndarray) -> tuple[float, float]:
    return float(np.tanh((x[3] - x[2]) / 1e-3)), 0.0


def bouc_wen(x: np.ndarray) -> tuple[float, float]:
    v, z = x[3] - x[2], x[4]
    return 4.0 * z, float(20.0 * v - 12.0 * abs(v) * z * abs(z) - 8.0 * v * z * z)


def pendulum(samples: int) -> Record:
    """A pendulum that swings widely, with a drag that its model lacks."""
    w = np.repeat(np.random.default_rng(1).standard_normal(samples // 10), 10) * 8.0

    def rates(x: np.ndarray, u: float) -> np.ndarray:
        return np.array([x[1], -9.81 * np.sin(x[0]) - 0.15 * x[1] - 0.3 * x[1] * abs(x[1]) + u])

    return integrated(rates, lambda x: x[0], 2, w, 0.01, 0.02)


RECORDS: dict[str, Callable[[], Record]] = {
    "friction": lambda: chain(3000, friction),
    "short": lambda: chain(700, friction),
    "nothing": lambda: chain(3000, lambda x: (0.0, 0.0)),
    "long": lambda: chain(24000, lambda x: (0.0, 0.0)),
    "bouc_wen": lambda: chain(3000, bouc_wen),
    "pendulum": lambda: pendulum(2000),
    "four": lambda: long_chain(4, 4200, 1),
    "twelve": lambda: long_chain(12, 1500, 12),
}
CHAIN = (
    "rco.mass_spring_damper([1.0] * {0}, [0.3] * {0}, [300.0] * {0}, "
    "sensors=[('velocity', i + 1) for i in range({1})])"
)
#: What is called, the record and the model, and the environment.
ROWS = {
    "diagnose, friction found": ("rco.diagnose(model, data)", "friction", MODEL, {}),
    "diagnose, nothing missing": ("rco.diagnose(model, data)", "nothing", MODEL, {}),
    "the same, 24000 samples": ("rco.diagnose(model, data)", "long", MODEL, {}),
    "diagnose, Bouc-Wen, no law fits": (
        "rco.diagnose(model, data, candidates=[e for e in LIBRARY(model) if e.kind != 'hysteresis'])",
        "bouc_wen", MODEL, {},
    ),
    "diagnose, pendulum as nlsys": ("rco.diagnose(model, data)", "pendulum", PENDULUM, {}),
    "diagnose, four masses, one sensor": ("rco.diagnose(model, data)", "four", CHAIN.format(4, 1), {}),
    "diagnose, twelve masses": (
        "rco.diagnose(model, data, candidates=[rco.Effect('coulomb_friction', f'link{i}') for i in EIGHT])",
        "twelve", CHAIN.format(12, 12), {},
    ),
    "improve, friction": ("rco.improve(model, data)", "friction", MODEL, {}),
    "march, 5 derivatives, 100 times": ("[MARCH([], True) for _ in range(100)]", "friction", MODEL, {}),
    "march, 9 derivatives, 100 times": ("[MARCH(OWN, True) for _ in range(100)]", "friction", MODEL, {}),
    "compare().failures": ("rco.compare(model, data).failures", "friction", MODEL, {}),
    "check": ("rco.check(model, data)", "friction", MODEL, {}),
    "refine with friction": ("rco.refine(model, data, [FRICTION])", "short", MODEL, {}),
    "the same without numba": (
        "rco.refine(model, data, [FRICTION])", "short", MODEL, {"RCOREFINE_NUMBA": "0"},
    ),
}  # fmt: skip
CHILD = """
import json, sys, time
import control as ct, numpy as np
import rcorefine as rco
given = np.load(sys.argv[1])
model = {model}
data = rco.Measurement(given["w"], given["y"], dt=float(given["dt"]))
LIBRARY = rco.effect_library
FRICTION = rco.Effect("coulomb_friction", "link2")
EIGHT = range(1, 9)
OWN = [rco.Effect(kind, place) for kind in ("stiffness", "damping") for place in ("link1", "link2")]
def MARCH(more, start):
    from rcorefine.engine.engine import Engine
    from rcorefine.engine.structure import Structure
    structure = Structure(model, [FRICTION, *more], constants={{0: 1e-3}})
    theta = np.array([1.0] + [0.1] * len(more))
    Engine(structure, data, substeps=2).run(theta, np.zeros(4), initial_state=start)
for _ in range(1 if {once} else 2):
    begin = time.process_time()
    found = {call}
    seconds = time.process_time() - begin
verdict = getattr(found, "verdict", "")
first = [r.effect.label for r in found.ranking[:1]] if verdict == "effect" else []
print(json.dumps([seconds, " ".join([verdict, *first])]))
"""


def measured(row: str, folder: Path, record: Path, limit: float) -> tuple[float, str]:
    """Seconds of a row in a checkout, and its answer; not a number where it takes longer than the limit."""
    call, _, model, more = ROWS[row]
    code = CHILD.format(model=model, call=call, once=bool(more))
    command = [sys.executable, "-W", "ignore", "-c", code, str(record)]
    environment = {**os.environ, "PYTHONPATH": str(folder), **more}
    try:
        done = subprocess.run(
            command, env=environment, cwd=folder, capture_output=True, text=True, timeout=limit, check=False
        )
    except subprocess.TimeoutExpired:
        return np.nan, f"> {limit:g} s"
    if done.returncode:
        return np.nan, (done.stderr.strip().splitlines() or ["failed"])[-1]
    seconds, answer = json.loads(done.stdout.splitlines()[-1])
    return float(seconds), answer


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, help="another checkout")
    parser.add_argument("--rows", nargs="*", default=[], help="words of the rows to run")
    parser.add_argument("--limit", type=float, default=400.0, help="seconds after which a row is given up")
    asked = parser.parse_args()
    chosen = [row for row in ROWS if not asked.rows or any(word in row for word in asked.rows)]
    with tempfile.TemporaryDirectory() as place:
        print(f"{'what':34}{'CPU s':>8}{'before':>9}{'ratio':>7}  answer")
        for row in chosen:
            path = Path(place) / f"{ROWS[row][1]}.npz"
            if not path.exists():
                w, y, dt = RECORDS[ROWS[row][1]]()
                np.savez(path, w=w, y=y, dt=dt)
            seconds, answer = measured(row, HERE, path, asked.limit)
            line = f"{row:34}{seconds:8.2f}"
            if asked.against:
                other, said = measured(row, asked.against.resolve(), path, asked.limit)
                line += f"{other:9.2f}{other / seconds:7.2f}"
                answer += "" if said == answer else f" (before: {said})"
            else:
                line += " " * 16
            print(f"{line}  {answer}", flush=True)


if __name__ == "__main__":
    main()
