"""Models in the loop of a known controller: simulated, compared, refined, diagnosed there."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import rcorefine as rco

DT = 0.02
MAGNET = ct.ss(
    [[0, 1], [4.0, -0.3]],
    [[0], [2.0]],
    [[1, 0]],
    0,
    states=["q", "v"],
    inputs=["u"],
    outputs=["y"],
    name="lev",
)
A = np.array([[1, 0], [0, 0.6]])
B = np.array([[DT, -DT], [1.0, -1.0]])
C = np.array([[3.0, -1.2 * 0.4**2 / DT]])
D = np.array([[8.0 + 24.0, -8.0 - 24.0]])
PID = ct.ss(A, B, C, D, DT, inputs=["r", "y"], outputs=["u"], name="pid")  # 8 + 3/s + 1.2 s, filtered


def sampled(system, dt):
    """Transition over a sample of held inputs, by an exponential of its own."""
    n, m = system.nstates, system.ninputs
    block = expm(np.block([[system.A, system.B], [np.zeros((m, n + m))]]) * dt)
    return block[:n, :n], block[:n, n:]


def loop(seed, n=1500, noise=0.01, force=lambda x: 0.0, gain=1.0, parts=20):
    """Reference, input and output of the magnet under the PID, sample by sample."""
    rng = np.random.default_rng([seed, 4])
    r = np.repeat(0.5 * rng.standard_normal(n // 50 + 1), 50)[:n]
    Phi, Gamma = sampled(MAGNET, DT / parts)
    x, xi, u, y = np.zeros(2), np.zeros(2), np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = x[0] + noise * rng.standard_normal()
        u[k] = (C @ xi + D @ [r[k], y[k]])[0]
        xi = A @ xi + B @ [r[k], y[k]]
        for _ in range(parts):
            ahead = Phi @ x + Gamma[:, 0] * (gain * u[k] - force(x))
            x = Phi @ x + Gamma[:, 0] * (gain * u[k] - 0.5 * (force(x) + force(ahead)))
    return r, u, y


def records(r, u, y):
    """What labs keep of such a loop: reference and input, the reference alone, the input alone."""
    return {
        "both": rco.Measurement([r, u], y, dt=DT, input_labels=["r", "u"], output_labels="y"),
        "reference": rco.Measurement(r, y, dt=DT, input_labels="r", output_labels="y"),
        "input": rco.Measurement(u, y, dt=DT, input_labels="u", output_labels="y"),
    }


@pytest.mark.parametrize("kept", ["both", "reference", "input"])
def test_the_loop_is_that_of_the_model_without_the_noise(kept):
    clean = loop(1, noise=0.0)[2]
    run = rco.simulate(MAGNET, records(*loop(1))[kept], "zero", controller=PID)
    np.testing.assert_allclose(run.outputs[0], clean, atol=1e-9)
    assert (run.states.shape, run.x0.shape) == ((2, 1500), (2,))


def test_from_a_reference_the_loop_hangs_on_no_output():
    r, _, _ = loop(1, n=300)
    blank = rco.Measurement(r, np.zeros(300), dt=DT, input_labels="r", output_labels="y")
    run = rco.simulate(MAGNET, blank, "zero", controller=PID)
    np.testing.assert_allclose(run.outputs[0], loop(1, n=300, noise=0.0)[2], atol=1e-9)


@pytest.mark.parametrize("dt", [DT, 0])
def test_without_names_it_is_the_negative_feedback_of_control(dt):
    plant = ct.ss([[0, 1], [-2.0, -0.4]], [[0], [1.0]], [[1, 0]], 0)
    law = ct.ss([[-5.0]], [[3.0]], [[1.0]], [[2.0]])
    step = 0.005
    w = np.random.default_rng(0).standard_normal(800)
    blank = rco.Measurement(w, np.zeros(800), dt=step)
    t = step * np.arange(800)
    if dt:
        law = law.sample(step, "tustin")
        closed = ct.feedback(plant.sample(step), law)
        wanted, close = ct.forced_response(closed, t, w).outputs, 1e-9
    else:  # of a continuous one the error of the outputs is held over a sample
        fine = np.arange(8000) * step / 10
        closed = ct.feedback(plant, law).sample(step / 10)
        wanted, close = ct.forced_response(closed, fine, np.repeat(w, 10)).outputs[::10], 2e-4
    run = rco.simulate(plant, blank, "zero", controller=law)
    assert np.abs(run.outputs[0] - wanted).max() < close + 0.02 * (dt == 0) * np.abs(wanted).max()


def test_a_continuous_controller_follows_a_smooth_reference():
    law = ct.ss(
        [[0, 0], [0, -20.0]], [[1, -1], [20, -20]], [[3.0, -24.0]], [[32.0, -32.0]],
        inputs=["r", "y"], outputs=["u"],
    )  # fmt: skip
    errors = []
    for step in (0.01, 0.005):
        t = step * np.arange(round(6 / step))
        r = np.sin(t) ** 3
        loop_ = ct.interconnect([MAGNET, law], inputs=["r"], outputs=["y"])
        wanted = ct.forced_response(loop_, t, r).outputs
        data = rco.Measurement(r, wanted, dt=step, input_labels="r", output_labels="y")
        errors.append(np.abs(rco.simulate(MAGNET, data, "zero", controller=law).outputs[0] - wanted).max())
    assert errors[0] < 1e-3
    assert errors[1] < 0.4 * errors[0]


def test_a_record_may_begin_in_motion():
    r, u, y = loop(2, noise=0.0)
    for kept, record in records(r, u, y).items():
        late = record.segment(11.0)
        result = rco.compare(MAGNET, late, controller=PID)
        assert result.looped, kept
        assert result.rmse[0] < 1e-8, kept  # the integrator held something, which is found
        assert "in closed loop" in str(result)


def test_refine_finds_the_numbers_and_keeps_the_controller():
    train, test = records(*loop(3, gain=0.8))["reference"].split(0.7)
    better = rco.refine(MAGNET, train, [rco.Effect("input_gain", "u")], controller=PID)
    row = better.parameters[0]
    assert abs(row.value - 0.8) < 4 * row.std < 0.05
    assert better.led
    assert "one sample ahead; compare and simulate run the closed loop" in better.message
    assert better.system.nstates == better.nonlinear.nstates == 2  # the plant alone
    assert rco.compare(better, test).rmse[0] < 0.015 < rco.compare(MAGNET, test, controller=PID).rmse[0]
    assert better.simulate(test).states.shape == (2, test.n_samples)
    with pytest.raises(rco.ModelError, match="takes no controller yet"):
        rco.RCORefiner(better, dt=DT)


@pytest.mark.parametrize("kept", ["reference", "input"])
def test_what_is_missing_is_named_in_the_loop(kept):
    laws = [rco.Effect(kind, "q") for kind in ("cubic_stiffness", "damping", "coulomb_friction", "stiffness")]
    hidden = records(*loop(4, force=lambda x: 1.5 * x[0] ** 3))[kept]
    found = rco.diagnose(MAGNET, hidden, candidates=laws, controller=PID)
    assert found.verdict == "effect"
    assert found.best.effect == laws[0]
    assert abs(found.best.coefficients["cubic_stiffness"] - 1.5) < 4 * found.best.std["cubic_stiffness"]
    assert (
        rco.diagnose(MAGNET, records(*loop(5))[kept], candidates=laws, controller=PID).verdict == "adequate"
    )


def test_a_nonlinear_model_runs_in_the_loop():
    def rates(t, x, u, params):
        return np.array([x[1], 4.0 * x[0] - 0.3 * x[1] + 2.0 * (u[0] - params["k3"] * x[0] ** 3)])

    ball = ct.nlsys(rates, lambda t, x, u, p: x[:1], params={"k3": 1.0}, states=["q", "v"], inputs=["u"],
                    outputs=["y"], name="ball")  # fmt: skip
    data = records(*loop(6, n=600, force=lambda x: 1.5 * x[0] ** 3))["reference"]
    row = rco.refine(ball, data, free=["k3"], controller=PID).parameter("k3")
    assert abs(row.value - 1.5) < 4 * row.std < 0.5


def test_check_lays_the_controller_beside_the_input():
    r, u, y = loop(7)
    for given, status in ((u, "ok"), (np.clip(u, -0.5, 0.5), "look")):
        rows = rco.check(MAGNET, records(r, given, y)["both"], controller=PID).rows
        assert [row.status for row in rows if row.what == "controller"] == [status]


STATIC = {"inputs": ["y"], "outputs": ["u"]}


@pytest.mark.parametrize(
    ("controller", "error", "words"),
    [
        (3.0, ct.ControlArgument, "must be a control.StateSpace"),
        (ct.ss([], [], [], [[-9.0]], 0.01, **STATIC), rco.ModelError, "at the sampling time of the record"),
        (ct.ss([], [], [], [[9.0]], DT, **STATIC), rco.ModelError, "sign of the feedback"),
        (ct.ss([], [], [], [[9.0]], DT, inputs=["y"], outputs=["w"]), ct.ControlDimension, "drives w"),
        (ct.ss([], [], [], [[9.0]], DT, inputs=["z"], outputs=["u"]), ct.ControlDimension, "reads z"),
        (ct.ss([], [], [], [[9.0, 1.0]], DT), ct.ControlDimension, "unnamed input"),
        (
            ct.ss([], [], [], [[1.0, -9.0]], DT, inputs=["s", "y"], outputs=["u"]),
            ct.ControlDimension,
            "nor s",
        ),
    ],
)
def test_what_is_no_controller_of_the_model_is_said(controller, error, words):
    kept = "input" if "sign" in words else "reference"
    data = records(*loop(1, n=600))[kept]
    for call in (rco.compare, rco.refine, rco.diagnose, rco.improve):
        with pytest.raises(error, match=words):
            call(MAGNET, data, controller=controller)


def test_an_algebraic_loop_is_refused():
    direct = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.5]], inputs=["u"], outputs=["y"])
    law = ct.ss([], [], [], [[-1.0]], DT, **STATIC)
    with pytest.raises(rco.ModelError, match="algebraic loop"):
        rco.compare(direct, records(*loop(1, n=200))["input"], controller=law)
