"""What gives way with a delay, or on one side: plants of this file, integrated by Runge-Kutta here."""

from __future__ import annotations

import numpy as np
import pytest
from cases import slow

import rcorefine as rco


def marched(rate, x, steps, h, inner=10):
    """States at each step, by the classical method."""
    found = np.empty((steps, len(x)))
    for k in range(steps):
        found[k] = x
        for _ in range(inner):
            a = rate(x, k)
            b = rate(x + h / inner / 2 * a, k)
            c = rate(x + h / inner / 2 * b, k)
            d = rate(x + h / inner * c, k)
            x = x + h / inner / 6 * (a + 2 * b + 2 * c + d)
    return found


def mount(rng, extra, N=500, dt=0.01):
    """A machine of 40 kg on a mount, with one more force: rows time, states d, v, z."""
    push = 60.0 * np.repeat(rng.choice([-1.0, 1.0], N // 5), 5)

    def rate(x, k):
        f, dz = extra(x)
        return np.array([x[1], (push[k] - 9e3 * x[0] - 120.0 * x[1] - f) / 40.0, dz])

    d = marched(rate, np.zeros(3), N, dt)[:, 0]
    model = rco.mass_spring_damper([40.0], [120.0], [9e3], name="machine")
    data = rco.Measurement(
        push, d + 0.01 * d.std() * rng.standard_normal(N), dt=dt, input_labels=model.linear.input_labels
    )
    return model, data


@pytest.mark.parametrize("side", [-1.0, *slow(1.0)])
def test_a_stop_on_one_side(rng, side):
    model, data = mount(rng, lambda x: (3e4 * side * max(side * x[0] - 0.006, 0.0), 0.0))
    found = rco.diagnose(model, data)
    assert found.verdict == "effect"
    assert found.best.effect.kind == "end_stop"
    for name, truth in {"stiffness": 3e4, "position": side * 0.006}.items():
        assert abs(found.best.coefficients[name] - truth) < 4 * found.best.std[name]


def test_a_mount_that_relaxes(rng):
    model, data = mount(rng, lambda x: (4e3 * x[2], x[1] - x[2] / 0.06))
    found = rco.diagnose(model, data)
    assert (found.verdict, found.best.effect.kind) == ("effect", "maxwell_element")


def test_a_wall_that_stores_heat(rng):
    N, ambient, room = 600, 293.0, rco.thermal_network([30.0], {(1, 0): 2.0})
    heat = 4.0 * np.repeat(rng.uniform(0, 1, N // 20), 20)
    around = ambient + 2.0 * np.sin(2 * np.pi * np.arange(N) / 260)

    def rate(x, k):
        wall = 0.9 * (x[0] - x[1])
        return np.array([(heat[k] - 0.5 * (x[0] - around[k]) - wall) / 30.0, wall / 22.0])

    T = marched(rate, ambient + np.array([2.0, 1.0]), N, 1.0)[:, 0]
    data = rco.Measurement(
        [heat, around], T + 0.02 * rng.standard_normal(N), dt=1.0, input_labels=room.linear.input_labels
    )
    found = rco.diagnose(room, data)
    assert (found.verdict, found.best.effect.kind) == ("effect", "hidden_store")
    fitted = rco.refine(room, data, [rco.Effect("hidden_store", "T1")])
    mass, damping = fitted.parameters[:2]
    assert abs(mass.value - 22.0) < 4 * mass.std
    assert abs(damping.value - 0.9) < 4 * damping.std
    # offsets of heat and surroundings act alike: what of them no record sees stays where it was
    assert all(abs(q.value) < 1.0 for q in fitted.parameters if q.role == "offset")


def test_nothing_is_named_that_moves_the_free_run_away():
    """Squeezed, a spring stiffens; pulled, it lets go: in time the mass is gone, and no law tells where."""
    rng, model = np.random.default_rng(2), rco.mass_spring_damper([3.0], [4.0], [700.0])
    push = 25.0 * np.repeat(rng.uniform(-1, 1, 117), 6)[:700]

    def rate(x, k):
        missing = 30.0 * (np.expm1(x[0] / 0.03) - x[0] / 0.03)
        return np.array([x[1], (push[k] - 700.0 * x[0] - 4.0 * x[1] - missing) / 3.0])

    d = marched(rate, np.zeros(2), 700, 0.01, inner=12)[:, 0]
    assert np.abs(d).max() > 1e20
    noisy = d + 0.01 * d.std() * rng.standard_normal(700)
    found = rco.diagnose(model, rco.Measurement(push, noisy, dt=0.01, input_labels=model.linear.input_labels))
    assert found.verdict == "unexplained"
