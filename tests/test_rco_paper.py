"""The figures that the paper's examples must reach with the paper's n_c, p, mu and alpha."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from inner import NUMBA, bode_error

import rcorefine as rco

NOMINAL = np.array([55e-3, 23.5e-6])
# Everything here is a simulation of thousands of samples; without numba fewer seeds have to do.
SEEDS = 20 if NUMBA else 4


def run(example: Any, seed: int, n_samples: int = 4000, noise: float = 0.0, **changes: Any) -> rco.RCORefiner:
    settings = {**example.settings, **changes}
    refiner = rco.RCORefiner.paper(example.initial, dt=example.dt, history=True, **settings)
    return refiner.run(example.record(n_samples, noise=noise, rng=seed))


def circuit(system: Any) -> np.ndarray:
    """L and C from what no change of states can touch: C B = R/L and det A = 1/(L C)."""
    inductance = 250.0 / float((system.C @ system.B)[0, 0])
    return np.array([inductance, 1.0 / (inductance * float(np.linalg.det(system.A)))])


def errors(example: Any, refiner: rco.RCORefiner) -> tuple[float, float]:
    """Bode error of the initial and of the refined model, sampled as the record is."""
    true = example.true.sample(example.dt)
    return (
        bode_error(true, example.initial.sample(example.dt)),
        bode_error(true, refiner.discrete_system),
    )


def static_performance(refiner: rco.RCORefiner) -> float:
    """Rms of the parameter stage over std(y), second half of the record."""
    return float(refiner.history.performance(refiner.n_samples // 2)[1][0])


@pytest.mark.parametrize("seed", range(4))
def test_circuit_is_found_exactly_without_noise(seed: int) -> None:
    refiner = run(rco.examples.rlc(), seed)
    np.testing.assert_allclose(circuit(refiner.system), NOMINAL, rtol=1e-4)
    stage1, _ = refiner.history.performance(3000)
    assert stage1[0] < 1e-9


def test_circuit_with_noise() -> None:
    """2 % noise on the output; coefficients averaged over two windows, as is the default."""
    found = np.array([circuit(run(rco.examples.rlc(), seed, noise=0.02).system) for seed in range(SEEDS)])
    assert (np.abs(found.mean(axis=0) / NOMINAL - 1.0) < 0.02).all()
    assert (np.abs(found / NOMINAL - 1.0) < 0.06).all()


def test_circuit_with_noise_as_the_paper_reads_it_off() -> None:
    """The last coefficients alone see 100 samples: right on average, each seed scattered."""
    found = np.array(
        [circuit(run(rco.examples.rlc(), seed, noise=0.02, static_average=1).system) for seed in range(SEEDS)]
    )
    share = found / NOMINAL - 1.0
    bound = 3.0 * share.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    assert (np.abs(share.mean(axis=0)) < np.maximum(bound, 0.02)).all()


@pytest.mark.parametrize(
    "form, target",
    # 0.176 and 0.168; 20 other seeds: median 0.22, worst 0.32, for one window decides. The limit for a
    # long window is 0.21: a correction through B cannot reach what is uncertain in C (DESIGN 2.4).
    [("observable", 0.31), ("given", 0.18)],
)
def test_transmissibility(form: str, target: float) -> None:
    example = rco.examples.one_dof(form=form)
    refiner = run(example, 0)
    before, after = errors(example, refiner)
    assert before == pytest.approx(0.605, abs=0.001)
    assert after <= target
    assert refiner.history.performance(2000)[0][0] <= 1e-2


@pytest.mark.parametrize("form", ["observable", "given"])
def test_transmissibility_on_any_seed(form: str) -> None:
    example = rco.examples.one_dof(form=form)
    for seed in range(1, 1 + SEEDS // 4):
        refiner = run(example, seed, static_average=500)
        assert refiner.history.performance(2000)[0][0] <= 1e-2
        assert errors(example, refiner)[1] < 0.26


@pytest.mark.parametrize(
    "form, dt, target",
    [
        ("observable", 1e-3, 0.16),
        ("given", 1e-3, 0.02),
        ("observable", 5e-3, 0.03),
        ("given", 5e-3, 0.02),
    ],
)
def test_structure(form: str, dt: float, target: float) -> None:
    example = rco.examples.two_dof(form=form, dt=dt)
    before, after = errors(example, run(example, 0))
    assert before == pytest.approx(0.74, abs=0.006)
    assert after <= target
    for seed in range(1, 1 + SEEDS // 4):
        assert errors(example, run(example, seed, static_average=1000))[1] <= max(target, 0.025)


@pytest.mark.parametrize("form", ["observable", "given"])
@pytest.mark.parametrize("name, least", [("one_dof", 10.0), ("two_dof", 2.5)])
def test_figure_7_beats_figure_6(name: str, least: float, form: str) -> None:
    """Parameter stage with the states of stage 1 (figure 7) and without (figure 6)."""
    example = getattr(rco.examples, name)(form=form)
    for seed in range(SEEDS // 4):
        with_states = static_performance(run(example, seed))
        without = static_performance(run(example, seed, use_estimated_states=False))
        assert without >= least * with_states, (seed, without, with_states)


def test_at_5_ms_the_states_of_stage_1_make_no_difference() -> None:
    example = rco.examples.two_dof(dt=5e-3)
    ratio = static_performance(run(example, 0, use_estimated_states=False)) / static_performance(
        run(example, 0)
    )
    assert 0.7 < ratio < 1.5


@pytest.mark.parametrize(
    "example",
    [rco.examples.two_dof(), rco.examples.one_dof(form="observable"), rco.examples.rlc()],
    ids=["structure", "transmissibility", "circuit"],
)
def test_state_estimates_beat_the_initial_model(example: Any) -> None:
    """Figures 5, 11 and 16: x - x_Delta is smaller than x - x_0 for every state."""
    record = example.record(4000)
    refiner = rco.RCORefiner.paper(example.initial, dt=example.dt, history=True, **example.settings).run(
        record
    )
    true = example.simulate(record.inputs).states[:, 2000:]
    initial = example.simulate(record.inputs, model="initial").states[:, 2000:]
    ours = np.sqrt(np.mean((true - refiner.history.x[:, 2000:]) ** 2, axis=1))
    theirs = np.sqrt(np.mean((true - initial) ** 2, axis=1))
    assert (ours < 0.5 * theirs).all()
