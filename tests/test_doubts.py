"""Estimates that mean nothing: refine warns, names why, and does not call it a success."""

from __future__ import annotations

import warnings

import control as ct
import numpy as np
import pytest
from cases import slow
from hidden.generator import Law, held_motion
from scipy.signal import butter, sosfilt

import rcorefine as rco
from rcorefine import Effect, IdentifiabilityWarning, Measurement

SPRING = Effect("stiffness", "link2")


def chain(k2=150.0, masses=2, **options) -> rco.PhysicalModel:
    k = [200.0, k2, 120.0][:masses]
    return rco.mass_spring_damper([1.0, 0.7, 1.2][:masses], [0.5] * masses, k, **options)


def record(system, n=1000, dt=0.04, noise=0.01, seed=5, signs=None) -> Measurement:
    rng = np.random.default_rng(seed)
    w = rng.standard_normal(n)
    y = np.atleast_2d(ct.forced_response(system.system.sample(dt), U=w).outputs)
    y = y + noise * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    return Measurement(w, y if signs is None else np.array(signs)[:, None] * y, dt=dt)


def refined(model, data, *args, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = rco.refine(model, data, *args, **options)
    said = " ".join(str(w.message) for w in caught if issubclass(w.category, IdentifiabilityWarning))
    return found, said


@pytest.mark.parametrize("signs, named", [((-1, -1), "q1, q2"), ((1, -1), "q2")])
def test_a_swapped_sign_is_named(signs, named):
    found, said = refined(chain(), record(chain(120.0), signs=signs), [SPRING])
    assert not found.success
    assert f"the sign of {named} reversed" in said
    assert found.message.startswith("Not to be trusted")


def test_a_right_sign_is_not_doubted_however_noisy():
    found, said = refined(chain(), record(chain(120.0), noise=2.0), [SPRING])
    row = found.parameters[0]
    assert found.success
    assert said == ""
    assert abs(row.coefficient + 30) < 4 * row.std


@pytest.mark.parametrize("level", [0.0, 3.0])
@pytest.mark.filterwarnings("ignore:overflow")
def test_an_output_that_does_not_move_or_only_hisses(level):
    rng = np.random.default_rng(1)
    w, one = rng.standard_normal(1500), chain(masses=1)
    law = [Effect("damping", "link1")]
    found, said = refined(one, Measurement(w, np.full(1500, level), dt=0.04), law)
    assert not found.success
    assert "q1 does not move" in said or "y[0] does not move" in said
    found, said = refined(one, Measurement(w, level + 0.1 * rng.standard_normal(1500), dt=0.04), law)
    assert not found.success
    assert "explains nothing" in said


def test_modes_above_half_the_sampling_frequency():
    """Force that moves between the samples, integrated 20 times finer than it is recorded."""
    rng, dt, fine = np.random.default_rng(2), 0.3, 20
    true, one = chain(masses=1), rco.mass_spring_damper([1.0], [0.5], [230.0])
    w = sosfilt(butter(4, 0.5 / fine, output="sos"), rng.standard_normal(2000 * fine))
    y = ct.forced_response(true.system.sample(dt / fine), U=w).outputs[::fine]
    data = Measurement(w[::fine], y + 0.01 * y.std() * rng.standard_normal(2000), dt=dt)
    found, said = refined(one, data, [Effect("stiffness", "link1")])
    assert abs(found.parameters[0].coefficient + 30) > 5 * found.parameters[0].std  # wrong, with small errors
    assert not found.success
    assert "above half the sampling frequency (10.47 rad/s)" in said
    assert "15.1" in said  # the model's mode, sqrt(230 - 1/16)


def test_modes_above_it_under_a_held_force_are_only_warned_of():
    model, true = (rco.mass_spring_damper([1.0], [0.5], [k]) for k in (230.0, 200.0))
    found, said = refined(model, record(true, dt=0.3), [Effect("stiffness", "link1")])
    row = found.parameters[0]
    assert "above half the sampling frequency" in said
    assert found.success == (abs(row.coefficient + 30) < 5 * row.std)


@pytest.mark.parametrize("seed", [1, *slow(8)])
def test_what_three_free_masses_leave_undetermined_is_named(seed):
    """Noise in proportion to positions that wander hides how the links move."""

    def free(k2):
        return rco.mass_spring_damper([1.0, 1.0, 1.0], [0.0, 0.4, 0.4], [0.0, k2, 100.0])

    data = record(free(80.0), n=1500, dt=0.05, seed=seed)
    found, said = refined(free(100.0), data, free="linear")
    truth = {"m1": 1.0, "m2": 1.0, "m3": 1.0, "k2": 80.0, "k3": 100.0}
    assert not found.success
    assert "does not determine" in said
    for row in found.parameters:
        named = row.name.startswith("m") and f"mass at {row.place}" in said
        named |= row.name.startswith("k") and f"stiffness at {row.place}" in said
        assert named or row.name not in truth or abs(row.value - truth[row.name]) < 4 * row.std


def test_what_a_grounded_chain_determines_is_not_doubted():
    found, said = refined(chain(masses=3), record(chain(130.0, 3)), free="linear")
    assert found.success
    assert said == ""


def test_diagnose_says_that_nothing_was_excited():
    rng = np.random.default_rng(4)
    model = chain()
    noise = 1e-3 * rng.standard_normal((2, 900))
    with pytest.warns(rco.ExcitationWarning):
        found = rco.diagnose(
            model, Measurement(np.full(900, 2.0), 0.006 + noise, dt=0.04, input_labels="force")
        )
    assert found.verdict == "ambiguous"
    assert not found.ranking
    assert "nothing was excited" in str(found).replace("\n", " ")
    assert "force is constant" in str(found).replace("\n", " ")


def test_a_free_decay_is_excitation_enough():
    model = chain()
    y = ct.initial_response(model.system.sample(0.04), np.arange(900) * 0.04, X0=[0.1, -0.05, 0, 0]).outputs
    y = y + 0.005 * y.std() * np.random.default_rng(4).standard_normal(y.shape)
    with pytest.warns(rco.ExcitationWarning):
        found = rco.diagnose(model, Measurement(np.zeros(900), y, dt=0.04), candidates=[SPRING])
    assert found.verdict == "adequate"


def free_drive(seed):
    """A drive without a place of rest, a one-sided spring at its load, the motor's and the load's angle."""
    Jm, Jl, N, k, c, bm, bl, dt = 5e-4, 0.03, 5.0, 14.0, 0.02, 2e-3, 0.03, 0.005
    g, inverse = np.array([1 / N, -1.0]), np.diag([1 / Jm, 1 / Jl])
    K, C = k * np.outer(g, g), c * np.outer(g, g) + np.diag([bm, bl])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ K, -inverse @ C]])
    B = np.array([0, 0, 1 / Jm, 0])
    rng = np.random.default_rng(seed)
    w = 0.05 * np.repeat(rng.choice([-1.0, 1.0], 12), 40)
    spring = Law("bilinear_stiffness", np.array([1.2, 0.0, 0.0]))
    at = [np.array([0, 0, 0, -1 / Jl]), np.array([0, 1.0, 0, 0]), np.array([0, 0, 0, 1.0])]
    y = held_motion(A, np.outer(w, B), dt, [(spring, *at)])[:, :2].T
    names = {"inputs": ["torque"], "outputs": ["motor", "load"]}
    model = ct.ss(A, B[:, None], np.eye(2, 4), 0, states=["thm", "thl", "wm", "wl"], **names)
    noisy = y + 0.003 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    return model, rco.Measurement(w, noisy, dt=dt, input_labels=["torque"], output_labels=["motor", "load"])


@pytest.mark.parametrize("seed", [1, *slow(7)])
def test_a_law_whose_size_the_record_does_not_tell_is_not_named(seed):
    model, data = free_drive(seed)
    laws = [rco.Effect(kind, "thl") for kind in ("hidden_mode", "damping", "coulomb_friction")]
    found = rco.diagnose(model, data, candidates=laws)  # the truth is none of them
    assert found.verdict == "unexplained"
    assert any("do not determine it" in note for note in found.notes)
