"""Streams with little noise or none, and what is shown of streams in every state, without a warning."""

from __future__ import annotations

from dataclasses import replace

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest

import rcorefine as rco

DT = 0.05


def chain(stiffness=100.0):
    return rco.mass_spring_damper(1.0, 0.4, stiffness, sensors="displacement")


def exact(model, n, seed=0, x0=0.0):
    """Input, output and last state of a record by python-control."""
    w = np.random.default_rng(seed).standard_normal((model.ninputs, n + 1))
    run = ct.forced_response(model.sample(DT), inputs=w, X0=x0, return_states=True)
    return w[:, :n], run.outputs.reshape(model.noutputs, -1)[:, :n], run.states[:, n]


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-6, 1e-5, 1e-3])
def test_a_stiffness_that_halves_is_seen_within_four_periods_beside_any_noise(noise):
    """Half of the stiffness moves the output by its own size: no noise up to 1e-3 of it hides that."""
    w, y, x = exact(chain().system, 600)
    later, after, _ = exact(chain(50.0).system, 50, 1, x)
    scatter = noise * y.std() * np.random.default_rng(2).standard_normal(650)
    monitor = rco.Monitor(chain(), [rco.Effect("stiffness", "link1")], dt=DT, learn=500)
    monitor.update(w, y + scatter[:600])
    assert monitor.statistic.max() < 1.0
    assert "no alarm" in str(monitor)
    for k in range(50):  # 13 samples are a period
        monitor.update(later[:, k], after[:, k] + scatter[600 + k])
        if "a threshold was crossed" in str(monitor):
            return
    pytest.fail(f"no statistic crossed its threshold; the largest is {monitor.statistic.max():.2g} of it")


@pytest.mark.parametrize("offset", [0.0, 50.0])
def test_an_exact_healthy_record_rings_nothing(offset):
    """Three masses, two sensors, every effect of the library: rounding is no change of the plant."""
    whole = rco.mass_spring_damper([1.0] * 3, [0.4, 0.3, 0.2], [100.0, 120.0, 80.0], sensors="displacement")
    s = whole.system
    names = {"inputs": s.input_labels, "outputs": [s.output_labels[i] for i in (0, 2)]}
    model = ct.ss(s.A, s.B, s.C[[0, 2]], s.D[[0, 2]], **names)
    w, y, _ = exact(model, 1200)
    monitor = rco.Monitor(model, dt=DT, learn=300)
    monitor.update(w, y + offset)
    assert monitor.alarm is None
    assert monitor.statistic.max() < 0.1


def test_a_statistic_that_is_not_a_number_is_an_error_and_changes_nothing():
    w, y, _ = exact(chain().system, 300)
    monitor = rco.Monitor(chain(), [rco.Effect("stiffness", "link1")], dt=DT, learn=200)
    monitor.update(w[:, :250], y[:, :250])
    memory = monitor._memory
    shared = np.full_like(memory.state.shared, np.nan)
    monitor._memory = replace(memory, state=memory.state._replace(shared=shared))
    with pytest.raises(rco.DivergenceError, match="statistic at sample 248 is not a number"):
        monitor.update(w[:, 250:], y[:, 250:])
    assert monitor.n_samples == 250


W, Y, _ = exact(chain().system, 300)
NOISY = Y + 1e-3 * Y.std() * np.random.default_rng(3).standard_normal(Y.shape)
SPRING = rco.Table(d=[-1.0, 0.0, 1.0], force=[-2.0, 0.0, 9.0])
SOFTER = [rco.Effect("stiffness", "link1")]
STREAMS = {
    "forms": lambda: rco.RCORefiner(chain(), dt=DT, history=True),
    "entries": lambda: rco.RCORefiner(chain(), dt=DT, effects=["A[1,0]"], history=True),
    "effects": lambda: rco.RCORefiner(chain(), dt=DT, effects=SOFTER, history=True),
    "paper": lambda: rco.RCORefiner.paper(chain(), dt=DT, window=50, history=True),
    "stiffness": lambda: rco.Monitor(chain(), [rco.Effect("stiffness", "link1")], dt=DT, learn=200),
    "table": lambda: rco.Monitor(chain(), [rco.Effect("tabulated", "link1", law=SPRING)], dt=DT, learn=200),
}  # fmt: skip


@pytest.mark.parametrize("kind", STREAMS)
@pytest.mark.parametrize("state", ["empty", "one sample", "exact", "noisy", "reset"])
def test_every_state_is_shown_without_a_warning(kind, state):
    """Warnings are errors here; arithmetic that raises is a setting of the user."""
    stream = STREAMS[kind]()
    if state == "one sample":
        stream.update(W[:, :1], Y[:, :1])
    elif state != "empty":
        stream.update(W, NOISY if state == "noisy" else Y)
    if state == "reset":
        stream.reset()
    shown = [stream, *([stream.history] if isinstance(stream, rco.RCORefiner) else [])]
    with np.errstate(all="raise"):
        for one in shown:
            assert str(one)
            assert repr(one)
            if one is stream:
                assert "<" in one._repr_html_()
                one.to_dict()
                one.answer()
            for name in ("plot", "bode_plot"):
                nothing = isinstance(one, rco.Monitor) and name == "plot" and not one.timepts.size
                if hasattr(one, name) and not nothing:
                    getattr(one, name)()
    plt.close("all")
