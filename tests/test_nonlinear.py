"""Refinement.nonlinear: python-control simulates the same system, by its own integrator."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from inner import Engine, Structure, nonlinear_system

import rcorefine as rco
from rcorefine import Effect, Measurement, ModelError

STEP, N = 0.05, 160
A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-65, 25, -0.6, 0.3], [35.7, -35.7, 0.43, -0.43]])
WIDTH = 0.05


def chain():
    """Velocity and, with a direct path from the input, acceleration of mass 1."""
    return ct.ss(
        A, [[0], [0], [1], [0]], [[0, 0, 1, 0], A[2]], [[0], [1.0]],
        inputs="f", outputs=["v1", "a1"], states=["x1", "x2", "v1", "v2"],
    )  # fmt: skip


def drag(d, v):
    return d**3 + 0.1 * v


CASES = {
    "cubic_stiffness": ([Effect("cubic_stiffness", "x1-x2")], [30.0]),
    "quadratic_damping": ([Effect("quadratic_damping", "x2")], [0.5]),
    "coulomb_friction": ([Effect("coulomb_friction", "x1")], [1.0]),
    "asymmetric_damping": ([Effect("asymmetric_damping", "x1")], [0.4, 1.0]),
    "clearance": ([Effect("clearance", "x1")], [40.0, 0.15]),
    "hysteresis": ([Effect("hysteresis", "x1-x2")], [1.5, 0.1]),
    "hidden_mode": ([Effect("hidden_mode", "x2"), Effect("cubic_stiffness", "x1")], [0.1, 0.1, 5.0, 20.0]),
    "lags": ([Effect("input_lag", "f"), Effect("output_lag", "a1")], [0.1, 0.08]),
    "dead zone": ([Effect("input_deadzone", "f")], [2.0]),
    "saturation": ([Effect("input_saturation", "f"), Effect("output_saturation", "v1")], [9.0, 0.4]),
    "rectification": ([Effect("output_rectification", "v1"), Effect("output_offset", "a1")], [0.6, 0.3]),
    "gain and offset": ([Effect("input_gain", "f"), Effect("input_offset", "f")], [0.3, 1.0]),
    "custom": ([Effect("custom", "x1", law=drag)], [5.0]),
    "constant": (
        [Effect("constant_force", "x1"), Effect("stiffness", "x2"), Effect("mass", "x2")],
        [1.0, 4.0, 0.2],
    ),
}


@pytest.mark.parametrize("name", sorted(CASES))
def test_agrees_with_input_output_response(name):
    effects, theta = CASES[name]
    structure = Structure(chain(), effects, constants={i: WIDTH for i in range(len(effects))})
    w = 10 * np.random.default_rng(0).standard_normal(N)
    data = Measurement(w, np.zeros((2, N)), dt=STEP, hold="foh")
    ours = Engine(structure, data, substeps=64 if name != "custom" else 16).run(
        np.array(theta), sensitivity=False
    )
    system = nonlinear_system(structure, np.array(theta))
    assert isinstance(system, ct.NonlinearIOSystem)
    response = ct.input_output_response(
        system,
        data.timepts,
        w,
        np.zeros(system.nstates),
        solve_ivp_kwargs={"rtol": 1e-8, "atol": 1e-9, "max_step": STEP / 4},
    )
    scale = np.abs(ours.outputs).max(axis=1, keepdims=True)
    tolerance = (
        3e-3 if name in ("custom", "clearance", "coulomb_friction", "hysteresis", "dead zone") else 1e-3
    )
    assert np.max(np.abs(ours.outputs - response.outputs) / scale) < tolerance
    assert system.output_labels == ["v1", "a1"]


def test_refinement_gives_the_nonlinear_system():
    w = 10 * np.random.default_rng(1).standard_normal(200)
    structure = Structure(chain(), [Effect("cubic_stiffness", "x1-x2")])
    blank = Measurement(w, np.zeros((2, 200)), dt=STEP, hold="foh")
    response = ct.input_output_response(
        nonlinear_system(structure, np.array([30.0])), blank.timepts, w, np.zeros(4),
        solve_ivp_kwargs={"rtol": 1e-8, "atol": 1e-10},
    )  # fmt: skip
    data = Measurement(w, response.outputs, dt=STEP, hold="foh")
    result = rco.refine(chain(), data, [Effect("cubic_stiffness", "x1-x2")])
    assert abs(result.theta[0] - 30) < 0.05
    system = result.nonlinear
    assert system.name.endswith("_refined")
    again = ct.input_output_response(
        system, data.timepts, w, result.initial_states[0], solve_ivp_kwargs={"rtol": 1e-8, "atol": 1e-10}
    )
    assert np.abs(again.outputs - result.simulate(data).outputs).max() < 5e-3 * np.abs(data.outputs).max()
    # the linear part alone is .system
    np.testing.assert_allclose(result.system.A, A, atol=1e-12)


def test_delay_has_no_state_equation():
    structure = Structure(chain(), [Effect("input_delay", "f")])
    with pytest.raises(ModelError, match="no state equation"):
        nonlinear_system(structure, np.array([0.1]))
