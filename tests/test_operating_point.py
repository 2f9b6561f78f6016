"""Records about an operating point: the model is linear about it, laws feel absolute values."""

import pickle

import control as ct
import numpy as np
import pytest
from cases import named, slow
from inner import Engine, Structure, ordered_record
from scipy.integrate import solve_ivp

import rcorefine as rco

M, B, V0, DT = 1200.0, 40.0, 24.0, 0.1


def car(F0, slope=B, **more):
    """Linear about 24 m/s, where the losses grow by `slope` with the speed."""
    system = ct.ss([[-slope / M]], [[1 / M]], [[1.0]], 0, states=["v"], inputs=["F"], outputs=["speed"])
    return rco.physical(system, operating_point={"inputs": F0, "states": V0, "outputs": [V0]}, **more)


def record(rate, F0, seed=0, n=400, noise=0.0, size=900.0):
    """A plant whose `rate(v, F)` is integrated by scipy, F held, from its equilibrium."""
    rng = np.random.default_rng(seed)
    F = F0 + size * np.repeat(rng.standard_normal(n // 20), 20)
    v = [V0]
    for force in F[:-1]:
        run = solve_ivp(lambda t, x, F=force: rate(x, F), (0, DT), [v[-1]], rtol=1e-9, atol=1e-9)
        v.append(run.y[0, -1])
    y = np.array(v) + noise * np.std(v) * rng.standard_normal(n)
    return rco.Measurement(F, y, dt=DT, input_labels="F", output_labels="speed")


DRAG = 0.5
F_DRAG = B * V0 + DRAG * V0**2
SLOPE = B + 2 * DRAG * V0  # of all that brakes at 24 m/s: what a linearization contains


def dragged(v, F):
    return (F - B * v - DRAG * v * np.abs(v)) / M


def test_drag_about_24_m_per_s_against_scipy():
    data = record(dragged, F_DRAG)
    effect = rco.Effect("quadratic_damping", "v", start={"quadratic_damping": DRAG})
    structure = Structure(car(F_DRAG, SLOPE), [effect])
    engine = Engine(structure, ordered_record(structure.model, data), substeps=4)
    run = engine.run(np.array([DRAG]), np.zeros(1))
    assert np.abs(run.outputs[0] + V0 - data.outputs[0]).max() < 1e-5
    up, low = (
        engine.run(np.array([DRAG + s]), np.zeros(1), sensitivity=False).outputs for s in (1e-5, -1e-5)
    )
    np.testing.assert_allclose(run.sensitivity[0, :, 0], (up - low)[0] / 2e-5, rtol=1e-5, atol=1e-6)


def test_refined_drag_is_absolute_and_its_nonlinear_system_too():
    data = record(dragged, F_DRAG, noise=0.005, n=1200, size=2500.0)
    better = rco.refine(car(F_DRAG, SLOPE), data, [rco.Effect("quadratic_damping", "v")])
    row = better.parameter("quadratic_damping")
    assert abs(row.value - DRAG) < 4 * row.std < 0.05
    slope = ct.linearize(better.nonlinear, [V0], [F_DRAG]).A[0, 0]
    assert slope == pytest.approx(-SLOPE / M, rel=1e-6)  # linear parameters keep their meaning
    assert better.system.A[0, 0] == pytest.approx(-SLOPE / M, rel=1e-9)
    rate = better.nonlinear.updfcn(0.0, [V0 + 1], [F_DRAG], {})
    assert rate[0] == pytest.approx(-(SLOPE + row.value) / M, rel=1e-6)  # (v0 + 1)^2 above its tangent is 1
    run = better.simulate(data, x0=[V0])
    assert run.states[0, 0] == pytest.approx(V0)
    assert abs(run.outputs.mean() - data.outputs.mean()) < 0.1


@pytest.mark.parametrize("seed", [0, *slow(1, 2)])
def test_diagnose_names_the_drag(seed):
    found = rco.diagnose(
        car(F_DRAG, SLOPE), record(dragged, F_DRAG, seed=seed, noise=0.005, n=1200, size=2500.0)
    )
    assert "used without its tangent" in " ".join(str(found).split())
    named(found, rco.Effect("quadratic_damping", "v"), DRAG)


@pytest.mark.parametrize("outlet", [0, *slow(1)])
def test_diagnose_names_a_square_root_outflow_of_two_tanks(outlet):
    """One tank drains through an orifice, the other in proportion; the model is linear about the levels."""
    flow, h0 = (0.8, 0.6), np.array([1.2, 0.8**2 * 1.2 / 0.6**2])
    q0, k = 0.8 * np.sqrt(1.2), np.array(flow) / (2 * np.sqrt(h0))
    rng = np.random.default_rng(outlet)
    q = q0 * (1 + 0.35 * np.clip(np.repeat(rng.standard_normal(60), 15), -2, 2))

    def rate(t, h, push):
        out = q0 + k * (h - h0)
        out[outlet] = flow[outlet] * np.sqrt(max(h[outlet], 0.0))
        return [push - out[0], (out[0] - out[1]) / 1.5]

    levels = [h0]
    for push in q[:-1]:
        run = solve_ivp(rate, (0, 0.5), levels[-1], args=(push,), rtol=1e-8, atol=1e-10)
        levels.append(run.y[:, -1])
    y = np.array(levels).T
    y = y + 0.01 * y.std(axis=1, keepdims=True) * rng.standard_normal(y.shape)
    names = {"inputs": ["q"], "outputs": ["h1", "h2"]}
    A = [[-k[0], 0], [k[0] / 1.5, -k[1] / 1.5]]
    linear = ct.ss(A, [[1.0], [0]], np.eye(2), 0, states=["h1", "h2"], **names)
    tanks = rco.physical(linear, operating_point={"inputs": q0, "states": h0})
    data = rco.Measurement(q, y, dt=0.5, input_labels=["q"], output_labels=["h1", "h2"])
    found = rco.diagnose(tanks, data)
    place = ("h1->h2", "h2")[outlet]
    assert rco.Effect("sqrt_flow", place) in (*found.ambiguous, found.best.effect)


def test_linear_effects_are_those_of_deviations():
    data = record(lambda v, F: (F - F_DRAG - 60.0 * (v - V0)) / M, F_DRAG, noise=0.02)
    about = rco.refine(car(F_DRAG), data, [rco.Effect("damping", "v")])
    bare = rco.refine(
        rco.physical(car(F_DRAG).system),
        data.deviation(inputs=F_DRAG, outputs=V0),
        [rco.Effect("damping", "v")],
    )
    np.testing.assert_allclose(about.theta, bare.theta, rtol=1e-6, atol=1e-8)


def test_input_and_output_saturate_at_absolute_values():
    limit = F_DRAG + 600.0
    data = record(lambda v, F: (np.minimum(F, limit) - F_DRAG - B * (v - V0)) / M, F_DRAG)
    shown = rco.Measurement(
        data.inputs, np.minimum(data.outputs, 25.0), dt=DT, input_labels="F", output_labels="speed"
    )
    effects = [
        rco.Effect("input_saturation", "F", fixed={"limit": limit}),
        rco.Effect("output_saturation", "speed", fixed={"limit": 25.0}),
        rco.Effect("output_offset", "speed"),
    ]
    better = rco.refine(car(F_DRAG), shown, effects, offset=False)
    assert abs(better.theta[0]) < 1e-4
    assert better.rmse[0] < 1e-4


def test_radiation_about_293_kelvin():
    """The state is absolute, in K: the law is q T^4."""
    C, G, T0, q, n = 500.0, 2.0, 293.0, 3.0, 600
    rng = np.random.default_rng(0)
    P = 400.0 + 300.0 * np.repeat(rng.standard_normal(n // 30), 30)
    T = [T0]
    for power in P[:-1]:
        run = solve_ivp(
            lambda t, x, p=power: (p - 400.0 - G * (x - T0) - q * ((x / 100) ** 4 - (T0 / 100) ** 4)) / C,
            (0, 10.0), [T[-1]], rtol=1e-9,
        )  # fmt: skip
        T.append(run.y[0, -1])
    slope = G + 4 * q * T0**3 * 1e-8  # of all losses at 293 K
    room = ct.ss([[-slope / C]], [[1 / C]], [[1.0]], 0, states=["T"], inputs=["P"], outputs=["T"])
    model = rco.physical(room, operating_point={"inputs": 400.0, "states": T0})
    data = rco.Measurement(P, T + 0.01 * rng.standard_normal(n), dt=10.0, input_labels="P", output_labels="T")
    law = rco.Effect("radiation", "T", fixed={"temperature": 0.0})
    row = rco.refine(model, data, [law]).parameters[0]
    assert row.value == pytest.approx(q * 1e-8, abs=4 * row.std)
    assert row.std < 0.02 * q * 1e-8


def test_deviation_knows_what_was_taken_off():
    data = record(dragged, F_DRAG)
    above = data.deviation(inputs=F_DRAG, outputs=V0)
    again = pickle.loads(pickle.dumps(above)).deviation(inputs=F_DRAG, outputs=V0).split(0.5)[0]
    np.testing.assert_allclose(again.outputs, data.outputs[:, :200] - V0, atol=1e-12)
    np.testing.assert_allclose(above.deviation().origin, [data.inputs.mean(), data.outputs.mean()])
    effect = [rco.Effect("quadratic_damping", "v")]
    one, two = (rco.refine(car(F_DRAG, SLOPE), each, effect) for each in (data, above))
    np.testing.assert_allclose(one.theta, two.theta, rtol=1e-6)
    assert rco.simulate(one, above).outputs.mean() == pytest.approx(above.outputs.mean(), abs=0.05)


def test_check_says_which_of_the_two_a_record_looks_like():
    data = record(dragged, F_DRAG, noise=0.02)
    bare = rco.Measurement(
        data.inputs - F_DRAG, data.outputs - V0, dt=DT, input_labels="F", output_labels="speed"
    )

    def level(model, data):
        (row,) = [row for row in rco.check(model, data, information=False).rows if row.what == "level"]
        return row.status, row.sentence

    assert level(car(F_DRAG), data)[0] == "ok"
    assert level(car(F_DRAG), bare)[0] == "look"
    assert "as it was measured" in level(car(F_DRAG), bare)[1]
    assert "look like absolute values" in level(rco.physical(car(F_DRAG).system), data)[1]
    assert "deviations" in level(rco.physical(car(F_DRAG).system), bare)[1]


@pytest.mark.parametrize(
    ("point", "error", "words"),
    [
        ({"inputs": 1.0}, rco.ModelError, "lacks 'states'"),
        ({"inputs": 1.0, "states": {"x": 1.0}}, rco.ModelError, "names 'x'"),
        ({"inputs": {}, "states": 1.0}, rco.ModelError, "lacks F"),
        ({"inputs": 1.0, "states": [1.0, 2.0]}, ct.ControlDimension, "expected 1"),
        ({"inputs": 1.0, "states": "fast"}, ct.ControlArgument, "states of operating_point"),
        ({"inputs": 1.0, "states": 1.0, "u": 1.0}, rco.ModelError, "names 'u'"),
        (3.0, ct.ControlArgument, "operating_point must be a mapping"),
    ],
)
def test_bad_points_are_refused_by_name(point, error, words):
    with pytest.raises(error, match=words):
        rco.physical(car(0.0).system, operating_point=point)


def test_what_takes_no_point_says_so():
    model = car(F_DRAG)
    with pytest.raises(rco.ModelError, match="no operating point yet"):
        rco.Monitor(model, dt=DT)
    with pytest.raises(rco.ModelError, match="no operating point yet"):
        rco.frequency_response_at(model, [1.0], [1.0])
    with pytest.raises(rco.ModelError, match="no operating point yet"):
        rco.RCORefiner(model, dt=DT, effects=[rco.Effect("damping", "v")])
