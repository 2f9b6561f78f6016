"""RCORefiner against equations (23)-(42) transcribed literally, with and without numba."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import control as ct
import numpy as np
import pytest
from literal_rco import Array, Plant, Trace, literal

import rcorefine as rco

UNIT = {"inputs": 1.0, "outputs": 1.0, "states": 1.0, "corrections": 1.0}
SETTINGS = {"order": 3, "window": 30, "markov": 1, "learning_rate": 20.0, "static_learning_rate": 5.0}
N = 2000


def channel(delay: int, zeros: list[float]) -> Plant:
    """Third-order path of relative degree `delay` with zeros inside the unit circle."""
    A = np.zeros((3, 3))
    A[:2, 1:] = np.eye(2)
    A[2] = -np.poly([0.5, 0.3 + 0.4j, 0.3 - 0.4j]).real[:0:-1]
    B = np.array([[0.0], [0.0], [1.0]])
    numerator = np.poly(zeros[: 3 - delay])
    D = np.zeros((1, 1))
    full = np.concatenate([np.zeros(4 - numerator.size), numerator])
    if delay == 0:
        D[0, 0] = full[0]
        full = full - full[0] * np.poly(np.linalg.eigvals(A)).real
    C = full[:0:-1][None, :]
    return Plant(A, B, B.copy(), C, D, D.copy())


def plant(size: int, delay: int) -> Plant:
    """`size` x `size` path, channels mixed so that nothing is diagonal."""
    parts = [channel(delay, zeros) for zeros in ([0.2, -0.4, 0.6], [-0.5, 0.7, 0.1])[:size]]
    stacked = [np.zeros((0, 0))] * 6
    for i, key in enumerate(Plant._fields):
        blocks = [getattr(part, key) for part in parts]
        rows, columns = sum(b.shape[0] for b in blocks), sum(b.shape[1] for b in blocks)
        whole, r, c = np.zeros((rows, columns)), 0, 0
        for b in blocks:
            whole[r : r + b.shape[0], c : c + b.shape[1]] = b
            r, c = r + b.shape[0], c + b.shape[1]
        stacked[i] = whole
    if size == 1:
        return Plant(*stacked)
    A, B, Bu, C, D, Du = stacked
    into, out = np.array([[1.0, 0.3], [-0.2, 1.0]]), np.array([[1.0, -0.4], [0.2, 0.8]])
    return Plant(A, B @ into, Bu @ into, out @ C, out @ D @ into, out @ Du @ into)


def record(model: Plant, seed: int, n_samples: int = N) -> tuple[Array, Array]:
    """Record of the model with other dynamics in the place of its correction, 1 % noise."""
    rng = np.random.default_rng(seed)
    n, l_u = model.Bu.shape
    gain = 0.1 * rng.standard_normal((l_u, n))
    w = rng.standard_normal((model.B.shape[1], n_samples))
    y, x = np.zeros((model.C.shape[0], n_samples)), np.zeros(n)
    for k in range(n_samples):
        u = gain @ x + 0.2 * w[:, k]
        y[:, k] = model.C @ x + model.D @ w[:, k] + model.Du @ u
        x = model.A @ x + model.B @ w[:, k] + model.Bu @ u
    return w, y + 0.01 * rng.standard_normal(y.shape)


def refiner_of(model: Plant, **settings: object) -> rco.RCORefiner:
    return rco.RCORefiner(
        ct.ss(model.A, model.B, model.C, model.D, 0.1),
        correction_input=model.Bu,
        correction_feedthrough=model.Du,
        scale=UNIT,
        history=True,
        static_average=1,
        **{**SETTINGS, **settings},
    )


def oracle(model: Plant, w: Array, y: Array, delay: int, markov: int = 1) -> tuple[Trace, Trace]:
    s = SETTINGS
    first = literal(model, w, y, delay, s["order"], s["window"], markov, s["learning_rate"])
    second = literal(model, w, y, delay, 0, s["window"], markov, s["static_learning_rate"], states=first.x)
    return first, second


def worst(ours: Array, theirs: Array) -> float:
    return float(np.abs(ours - theirs).max() / np.abs(theirs).max())


def discrepancies(size: int, delay: int, markov: int = 1, n_samples: int = N) -> list[float]:
    model = plant(size, delay)
    w, y = record(model, seed=10 * size + delay, n_samples=n_samples)
    first, second = oracle(model, w, y, delay, markov)
    refiner = refiner_of(model, markov=markov)
    refiner.update(w, y)
    h = refiner.history
    assert np.abs(first.theta[-1]).max() > 0.01, "the oracle has learned nothing"
    return [
        worst(h.theta1, np.moveaxis(first.theta[1:], 0, -1)),
        worst(h.theta2, np.moveaxis(second.theta[1:], 0, -1)),
        worst(h.z1, first.z),
        worst(h.z2, second.z),
        worst(h.x, first.x[:, :-1]),
    ]


@pytest.mark.parametrize("delay", [0, 1, 2])
@pytest.mark.parametrize("size", [1, 2], ids=["siso", "2x2"])
def test_both_stages_equal_the_literal_equations(size: int, delay: int) -> None:
    assert max(discrepancies(size, delay)) < 1e-8


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_several_markov_parameters(delay: int) -> None:
    assert max(discrepancies(1, delay, markov=4, n_samples=500)) < 1e-8


def test_more_outputs_than_corrections_and_the_reverse() -> None:
    model = plant(2, 1)
    w, y = record(model, seed=5, n_samples=400)
    tall = model._replace(Bu=model.Bu[:, :1], Du=model.Du[:, :1])
    wide = model._replace(C=model.C[:1], D=model.D[:1], Du=model.Du[:1])
    for case, outputs in ((tall, y), (wide, y[:1])):
        first, second = oracle(case, w, outputs, 1)
        refiner = refiner_of(case)
        refiner.update(w, outputs)
        assert worst(refiner.theta, first.theta[-1]) < 1e-8
        assert worst(refiner.static_theta, second.theta[-1]) < 1e-8


def test_the_parameter_stage_alone_is_the_literal_stage_of_order_zero() -> None:
    """Figure 6: the static stage on its own states is (23)-(42) with n_c = 0."""
    model = plant(1, 1)
    w, y = record(model, seed=3, n_samples=600)
    alone = literal(model, w, y, 1, 0, SETTINGS["window"], 1, SETTINGS["static_learning_rate"])
    refiner = refiner_of(model, use_estimated_states=False)
    refiner.update(w, y)
    h = refiner.history
    assert worst(h.theta2, np.moveaxis(alone.theta[1:], 0, -1)) < 1e-8
    assert worst(h.z2, alone.z) < 1e-8
    assert not h.theta1.any()


def test_without_numba_too() -> None:
    """The same comparison in a process where the kernels run as plain Python."""
    code = (
        "from test_rco_literal import discrepancies\n"
        "from rcorefine.jit import NUMBA\n"
        "assert not NUMBA\n"
        "for size in (1, 2):\n"
        "    for delay in (0, 1, 2):\n"
        "        worst = max(discrepancies(size, delay, n_samples=300))\n"
        "        assert worst < 1e-8, (size, delay, worst)\n"
    )
    here = Path(__file__).parent
    env = dict(os.environ, RCOREFINE_NUMBA="0", OMP_NUM_THREADS="1")
    env["PYTHONPATH"] = os.pathsep.join([str(here), str(Path(rco.__file__).parents[1])])
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
