"""A nonlinear model of python-control as the start: against scipy, and found again with what was hidden."""

import pickle

import control as ct
import numpy as np
import pytest
from cases import slow
from inner import NUMBA, Engine, Problem, Structure
from scipy.integrate import solve_ivp

import rcorefine as rco
from rcorefine.engine import observer
from rcorefine.inference.search import sufficient_steps

DT = 0.02
PENDULUM = {"m": 1.0, "c": 0.1, "l": 0.5}


def swing(t, x, u, params):
    inertia = params["m"] * params["l"] ** 2
    pull = params["m"] * 9.81 * params["l"] * np.sin(x[0])
    return np.array([x[1], (u[0] - params["c"] * x[1] - pull) / inertia])


def angle(t, x, u, params):
    return x[:1]


def pendulum(update=swing, **params):
    return ct.nlsys(
        update, angle, params={**PENDULUM, **params}, name="pendulum",
        states=["theta", "omega"], inputs=["torque"], outputs=["angle"],
    )  # fmt: skip


def torque(seed, n):
    rng = np.random.default_rng(seed)
    w = np.convolve(rng.standard_normal(n + 100), np.hanning(61), mode="same")[50:-50]
    return 0.7 * w / w.std(), rng


def record(seed=0, n=600, hold="zoh", coulomb=0.0, noise=0.0, **params):
    """The plant by Runge and Kutta in steps of a fortieth of a sample."""
    p = {**PENDULUM, **params}
    w, rng = torque(seed, n)

    def rate(x, u):
        pull = p["m"] * 9.81 * p["l"] * np.sin(x[0]) + coulomb * np.tanh(x[1] / 1e-3)
        return np.array([x[1], (u - p["c"] * x[1] - pull) / (p["m"] * p["l"] ** 2)])

    steps, x, out = 40, np.zeros(2), np.zeros(n)
    h = DT / steps
    for k in range(n):
        out[k] = x[0]
        if k == n - 1:
            break
        for j in range(steps):
            a, b = (w[k] + (w[k + 1] - w[k]) * s / steps if hold == "foh" else w[k] for s in (j, j + 1))
            k1 = rate(x, a)
            k2 = rate(x + h / 2 * k1, (a + b) / 2)
            k3 = rate(x + h / 2 * k2, (a + b) / 2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, b))
    y = out + noise * out.std() * rng.standard_normal(n)
    return rco.Measurement(w, y, dt=DT, hold=hold, input_labels="torque", output_labels="angle")


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_free_run_is_that_of_a_finer_integration(hold):
    data = record(seed=1, hold=hold, n=300)
    assert np.abs(data.outputs).max() > 0.8  # far from the small angles of the linear model
    errors = [
        np.abs(Engine(Structure(pendulum()), data, substeps=s).run(np.zeros(0)).outputs - data.outputs).max()
        for s in (2, 4, 8)
    ]
    assert errors[2] < 1e-5
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.1)  # of fourth order
    assert np.abs(rco.simulate(pendulum(), data, "zero").outputs - data.outputs).max() < 2e-3


def test_sensitivities_are_differences_of_runs():
    effects = [
        rco.Effect("model_parameter", "l"), rco.Effect("damping", "theta"), rco.Effect("mass", "theta"),
        rco.Effect("coulomb_friction", "theta"), rco.Effect("input_gain", "torque"),
        rco.Effect("input_lag", "torque"), rco.Effect("output_gain", "angle"),
    ]  # fmt: skip
    engine = Engine(Structure(pendulum(), effects, constants={3: 0.1}), record(n=200), substeps=4)
    theta, x0 = np.array([0.02, 0.01, 0.02, 0.05, 0.03, 0.05, 0.02]), np.array([0.1, 0.2, 0.0])
    found = engine.run(theta, x0, initial_state=True).sensitivity[0]
    for j in range(10):
        step = 1e-6 * np.eye(10)[j]
        up, low = (
            engine.run(theta + s * step[:7], x0 + s * step[7:], sensitivity=False).outputs[0] for s in (1, -1)
        )
        np.testing.assert_allclose(found[:, j], (up - low) / 2e-6, atol=1e-5 * np.abs(found[:, j]).max())


def test_effects_at_a_point_that_is_not_zero_are_absolute():
    """The same plant, linearized elsewhere, with effects at rates, input and output: the same run."""
    data = record(n=300)
    effects = [
        rco.Effect("damping", "theta"), rco.Effect("stiffness", "theta"), rco.Effect("mass", "theta"),
        rco.Effect("quadratic_damping", "theta"), rco.Effect("input_gain", "torque"),
        rco.Effect("output_gain", "angle"), rco.Effect("input_saturation", "torque", fixed={"limit": 0.9}),
    ]  # fmt: skip
    theta = np.array([0.03, 0.2, 0.03, 0.05, 0.1, -0.05])
    runs = []
    for point in ({"inputs": 0.0, "states": [0.0, 0.0]}, {"inputs": 0.3, "states": [0.4, 0.2]}):
        model = rco.physical(pendulum(), operating_point=point)
        op = model.operating_point
        above = data.deviation(op.inputs, op.outputs)
        run = Engine(Structure(model, effects), above, substeps=16).run(theta, -op.states)
        runs.append(run.outputs[0] + op.outputs[0])
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-4)
    p, w = PENDULUM, data.inputs[0]

    def rate(t, x, u):
        u = 1.1 * np.clip(u, -0.9, 0.9)
        force = 0.03 * x[1] + 0.2 * x[0] + 0.05 * x[1] * abs(x[1])
        pull = p["m"] * 9.81 * p["l"] * np.sin(x[0])
        return [x[1], (u - p["c"] * x[1] - pull - force) / (p["m"] * p["l"] ** 2 + 0.03)]

    x, out = np.zeros(2), []
    for u in w:
        out.append(0.95 * x[0])
        x = solve_ivp(rate, (0, DT), x, args=(u,), rtol=1e-9, atol=1e-10).y[:, -1]
    np.testing.assert_allclose(runs[1], out, atol=2e-4)


def test_refine_finds_parameters_and_friction():
    data = record(seed=0, n=1000, noise=0.02, coulomb=0.05)
    better = rco.refine(pendulum(l=0.485), data, [rco.Effect("coulomb_friction", "theta")], free=["l"])
    for name, true in (("l", 0.5), ("coulomb_friction", 0.05)):  # in units of the torque, whatever l was
        row = better.parameter(name)
        assert abs(row.value - true) < 4 * row.std < 0.1 * true
    assert better.parameter("l").initial == pytest.approx(0.485)
    rate = better.nonlinear.updfcn(0.0, [2.0, 0.5], [0.1], {})[1]
    length, friction = better.parameter("l").value, better.parameter("coulomb_friction").value
    exact = (0.1 - 0.1 * 0.5 - 9.81 * length * np.sin(2.0) - friction) / length**2
    assert rate == pytest.approx(exact, rel=1e-3)
    slope = better.linearize([2.0, 0.5], [0.1])
    assert slope.A[1, 0] == pytest.approx(-9.81 / length * np.cos(2.0), rel=1e-4)
    assert slope.state_labels == ["theta", "omega"]
    assert better.system.A[1, 0] == pytest.approx(-9.81 / length, rel=1e-4)


def test_tolerance_is_a_prior_of_params():
    data = record(seed=2, n=400, noise=0.02)
    better = rco.refine(pendulum(c=0.102, l=0.501), data, tolerance=0.05)
    assert {row.name for row in better.parameters if row.role == "linear"} == {"m", "c", "l"}
    assert better.parameter("l").value == pytest.approx(0.5, abs=4 * better.parameter("l").std)


def test_compare_and_the_untold_outputs():
    data = record(seed=1, n=300)
    found = rco.compare([pendulum(), pendulum(l=0.45), rco.physical(pendulum()).system], data)
    assert found.fit[0, 0] > 99.5
    assert found.fit[1, 0] < 90
    assert found.fit[2, 0] < 90  # the linear model misses the angle
    states = ct.nlsys(swing, None, params=PENDULUM, states=2, inputs=1, outputs=2)
    both = rco.Measurement(data.inputs, np.vstack([data.outputs, data.outputs]), dt=DT)
    assert rco.simulate(states, both, "zero").outputs.shape == (2, 300)


@pytest.mark.parametrize("seed", [0, *slow(1)])
def test_diagnose_names_friction_at_the_pivot(seed):
    data = record(seed=seed, n=700, coulomb=0.05, noise=0.02)
    friction = ["coulomb_friction", "damping", "cubic_damping", "quadratic_damping", "stiffness"]
    laws = [rco.Effect(kind, "theta") for kind in friction]
    found = rco.diagnose(pendulum(), data, candidates=laws)
    assert found.verdict == "effect"
    assert found.best.effect == rco.Effect("coulomb_friction", "theta")


def test_nothing_missing_is_adequate_and_wrong_numbers_are_parameters():
    exact = rco.diagnose(pendulum(), record(seed=3, n=500, noise=0.03))
    assert exact.verdict == "adequate"


def test_improve_adds_the_friction():
    data = record(seed=4, n=1500, coulomb=0.05, noise=0.02)
    laws = [rco.Effect(kind, "theta") for kind in ("coulomb_friction", "damping", "stiffness")]
    ladder = rco.improve(pendulum(), data, candidates=laws)
    assert [step.effect.kind for step in ladder.steps[1:]] == ["coulomb_friction"]


def test_a_link_is_declared():
    def tanks(t, h, u, params):
        flow = params["a"] * np.sqrt(np.maximum(h[0], 0.0))
        return np.array([u[0] - flow, flow - params["b"] * np.sqrt(np.maximum(h[1], 0.0))])

    system = ct.nlsys(
        tanks, None, params={"a": 0.5, "b": 0.4}, states=["h1", "h2"], inputs=["q"], outputs=["h1", "h2"]
    )
    nowhere = ct.nlsys(
        lambda t, x, u, p: np.log(x) if x > 0 else x + np.inf, None, states=1, inputs=1, outputs=1
    )
    with pytest.raises(rco.ModelError, match="operating_point"):
        rco.physical(nowhere)
    model = rco.physical(
        system,
        links={"shunt": {"h1": 1.0, "h2": -1.0}},
        operating_point={"inputs": 0.6, "states": {"h1": 1.44, "h2": 2.25}},
    )
    assert "shunt" in [port.name for port in model.ports]
    steady = rco.simulate(
        model, rco.Measurement(np.full(50, 0.6), np.tile([[1.44], [2.25]], 50), dt=0.5), "zero"
    )
    np.testing.assert_allclose(steady.outputs[:, -1], [1.44, 2.25], rtol=1e-6)


def test_python_and_compiled_give_the_same():
    if not NUMBA:
        pytest.skip("nothing is compiled")
    import numba

    assert rco.physical(pendulum()).operating_point.field.speed == "compiled"
    assert rco.physical(pendulum(numba.njit(swing))).operating_point.field.speed == "compiled"

    def untyped(t, x, u, params):  # nor is it traced: it asks for the value of a state
        return swing(t, x, u, {k: params[k] for k in list(params) if x[0] == x[0]})

    with pytest.warns(rco.RCOWarning, match="called in Python"):
        slow = rco.physical(pendulum(untyped))
    data = record(n=60)
    one, two = (
        Engine(Structure(m, [rco.Effect("model_parameter", "c")]), data, substeps=2).run(np.array([0.01]))
        for m in (slow, rco.physical(pendulum()))
    )
    np.testing.assert_allclose(one.outputs, two.outputs, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(one.sensitivity, two.sensitivity, rtol=1e-6, atol=1e-9)


def test_a_model_is_made_once_and_pickles():
    system = pendulum()
    from inner import as_physical

    assert as_physical(system) is as_physical(system)
    system.params["l"] = 0.6
    assert as_physical(system).parameters[2].value == 0.6
    again = pickle.loads(pickle.dumps(as_physical(system)))
    data = record(n=50)
    np.testing.assert_allclose(
        rco.simulate(again, data, "zero").outputs, rco.simulate(system, data, "zero").outputs
    )


def late(t, x, u, params):
    return np.array([np.sin(t + 0.1) - x[0]])


@pytest.mark.parametrize(
    ("system", "words"),
    [
        (lambda: ct.nlsys(late, None, states=1, inputs=1, outputs=1), "depends on time"),
        (lambda: ct.nlsys(swing, angle, params=PENDULUM, states=2, inputs=1, outputs=1, dt=0.1), "discrete"),
        (lambda: ct.nlsys(swing, angle, params=PENDULUM, states=3, inputs=1, outputs=1), "give 3 numbers"),
        (lambda: ct.nlsys(swing, angle, params=PENDULUM, inputs=1, outputs=1), "how many states"),
    ],
)
def test_what_cannot_be_taken_is_refused(system, words):
    with pytest.raises(rco.ModelError, match=words):
        rco.physical(system())


def test_what_takes_no_nonlinear_model_says_so():
    model = rco.physical(pendulum())
    for refused in (
        lambda: rco.RCORefiner(model, dt=DT, effects=[rco.Effect("damping", "theta")]),
        lambda: rco.Monitor(pendulum(), dt=DT),
        lambda: rco.frequency_response_at(model, [1.0], [1.0]),
        lambda: rco.localize_damage(model, record(n=100)),
    ):
        with pytest.raises(rco.ModelError, match="no nonlinear model yet"):
            refused()
    with pytest.raises(rco.ModelError, match="no port 'x'"):
        rco.refine(model, record(n=100), [rco.Effect("model_parameter", "x")])


def wild(seed, n=1000):
    """A record that goes over the top again and again, by Heun's method; friction 0.05 at the pivot."""
    w, rng = torque(seed, n)
    w, x, out = 4.0 / 0.7 * w, np.zeros(2), np.zeros(n)

    def rate(x, u):
        return np.array([x[1], (u - 0.1 * x[1] - 4.905 * np.sin(x[0]) - 0.05 * np.tanh(x[1] / 1e-3)) / 0.25])

    for k in range(n):
        out[k] = x[0]
        for _ in range(40):
            a = rate(x, w[k])
            x = x + DT / 80 * (a + rate(x + DT / 40 * a, w[k]))
    y = out + 0.01 * rng.standard_normal(n)
    return rco.Measurement(w, y, dt=DT, input_labels="torque", output_labels="angle")


def test_the_growth_of_an_error_is_that_of_two_runs_side_by_side():
    data = wild(0, n=300)
    model = rco.physical(pendulum())
    run = rco.simulate(model, data, "zero")
    by = []
    for start in (np.array([1e-7, 0.0]), np.array([0.0, 1e-7])):
        by.append((rco.simulate(model, data, start).states - run.states)[:, -1] / 1e-7)
    growth = observer.growth(model, run.states, data)
    # the slopes are 1 and that of the pull: in units of the speed of their ratio both are equally large
    slope = 9.81 / PENDULUM["l"] * np.cos(run.states[0])
    units = np.array([1.0, np.mean(slope**2) ** 0.25])
    at_end = np.array(by).T * units / units[:, None]
    assert np.log(np.linalg.norm(at_end, 2)) < growth + 0.1  # the largest, which need not be at the end
    assert observer.steadying_ratio(model, record(seed=1, n=300)) is None


def airplane(unit):
    """Speed, angle of attack, pitch and its rate of a light airplane, the speed in `unit` m/s: stable."""

    def rates(t, x, u, params):
        speed, attack, pitch, rate = max(unit * x[0], 5.0), *x[1:]
        pressure, thrust = 9.6 * speed**2, 1313.0
        lift, path = 0.4 + 5.0 * attack, pitch - attack
        turned = pressure * lift + thrust * np.sin(attack)
        ahead = thrust * np.cos(attack) - pressure * (0.03 + 0.05 * lift**2)
        moment = -0.8 * attack - 9.0 * rate / speed - 1.1 * u[0]
        return np.array([
            (ahead / 1200 - 9.81 * np.sin(path)) / unit,
            rate - turned / (1200 * speed) + 9.81 / speed * np.cos(path), rate, pressure * moment / 1200,
        ])  # fmt: skip

    names = ["V", "alpha", "theta", "q"]
    return ct.nlsys(
        rates, lambda t, x, u, p: x[[0, 2, 3]], states=names, inputs=["e"], outputs=[*names[::2], "q"]
    )


def test_a_stable_motion_is_not_chaotic_in_any_unit():
    e = 0.02 * np.repeat(np.random.default_rng(0).standard_normal(20), 40)
    grown = []
    for unit in (0.01, 1.0, 100.0):
        plane = airplane(unit)
        states, inputs = ct.find_operating_point(plane, [60.0 / unit, 0.02, 0.02, 0.0], [0.0])[:2]
        assert np.linalg.eigvals(ct.linearize(plane, states, inputs).A).real.max() < 0
        run = ct.input_output_response(plane, 0.1 * np.arange(e.size), e, states, squeeze=False)
        data = rco.Measurement(e, run.outputs, dt=0.1, input_labels="e", output_labels=["V", "theta", "q"])
        model = rco.physical(plane)
        point = model.operating_point
        data = data.deviation(point.inputs, point.outputs)
        grown.append(observer.growth(model, run.states - np.array(point.states)[:, None], data))
        assert observer.steadying_ratio(model, data) is None
    np.testing.assert_allclose(grown, grown[0], rtol=1e-3)


def test_a_given_horizon_is_obeyed_where_the_motion_is_chaotic():
    data, whole = wild(5), {"horizon": 1000 * DT}
    assert rco.compare(pendulum(), data).led
    free = rco.compare(pendulum(), data, **whole)
    assert not free.led
    run = rco.simulate(pendulum(), data, free.initial_states[0][0])
    np.testing.assert_allclose(free.runs[0, 0], run.outputs[0], atol=1e-6)
    assert "chaotic" not in rco.refine(pendulum(), data, **whole).message


def test_a_chaotic_motion_is_judged_one_sample_ahead():
    data = wild(0)
    assert np.ptp(data.outputs) > 20.0
    result = rco.compare(pendulum(), data)
    assert result.led
    assert result.fit[0] > 99.0
    better = rco.refine(pendulum(), data, [rco.Effect("coulomb_friction", "theta")])
    assert better.led
    assert "chaotic" in better.message
    assert abs(better.parameters[0].value - 0.05) < 4 * better.parameters[0].std < 0.02


def duffing(t, x, u, params):
    spring = params["k"] * x[0] + params["k3"] * x[0] ** 3
    return np.array([x[1], (u[0] - params["c"] * x[1] - spring) / params["m"]])


def test_a_better_observer_is_no_fault_of_the_model():
    """A chaotic motion is led by an observer, which a gain of the output would sharpen."""
    true = {"m": 2.06, "c": 0.84, "k": 78.0, "k3": 930.0}
    rng = np.random.default_rng(1)
    force = 9.0 * np.repeat(rng.standard_normal(223), 9)[:2000]
    x, z, h = np.zeros(2), np.empty(2000), DT / 20
    for k, u in enumerate(force):
        z[k] = x[0]
        for _ in range(20):  # Runge and Kutta
            a = duffing(0, x, [u], true)
            b = duffing(0, x + h / 2 * a, [u], true)
            c = duffing(0, x + h / 2 * b, [u], true)
            x = x + h / 6 * (a + 2 * b + 2 * c + duffing(0, x + h * c, [u], true))
    model = ct.nlsys(
        duffing, angle, params={"m": 2.0, "c": 0.8, "k": 80.0, "k3": 900.0},
        states=["d", "v"], inputs=["F"], outputs=["z"],
    )  # fmt: skip
    seen = z + 0.01 * z.std() * rng.standard_normal(2000)
    data = rco.Measurement(force, seen, dt=DT, input_labels="F", output_labels="z")
    found = rco.diagnose(model, data, candidates=[rco.Effect("output_gain", "z"), rco.Effect("clock", "F")])
    assert found.verdict == "parameters"
    for number in found.parameters:
        value = true["m"] if number.kind == "mass" else true[number.place]
        assert abs(number.value - value) < 4 * number.std


def test_the_params_of_a_model_are_candidates():
    """Nothing says whether the winding pulls harder or its current is larger."""
    library = rco.effect_library(pendulum())
    assert {e.place for e in library if e.kind == "model_parameter"} == {"m", "c", "l"}


def falling(t, x, u, params):
    return np.array([-params["a"] * x[0] + params["b"] * x[0] ** 3 + u[0]])


def escaped(u, dt):
    """When x' = -x + x^3 / 2 + u from rest is beyond all bounds, by scipy; the input is held."""
    x, big = 0.0, 1e4
    for k, push in enumerate(u):
        run = solve_ivp(
            lambda t, x, push=push: -x + 0.5 * x**3 + push, (0.0, dt), [x], rtol=1e-9, max_step=dt / 20,
            events=lambda t, x: abs(x[0]) - big,
        )  # fmt: skip
        x = float(run.y[0, -1])
        if abs(x) >= 0.99 * big or run.status != 0:
            return k
    return None


def test_a_run_that_leaves_the_record_for_good_is_over():
    model = ct.nlsys(falling, None, params={"a": 1.0, "b": 0.5}, states=["q"], inputs=["u"], outputs=["q"])
    rng = np.random.default_rng(21)
    u = np.repeat(rng.uniform(-2.0, 2.0, 40), 20)
    gone = escaped(u, 0.05)
    assert 0 < gone < 700
    y = np.convolve(u, np.exp(-0.05 * np.arange(100)) * 0.05)[: u.size]
    data = rco.Measurement(u, y, dt=0.05, input_labels="u", output_labels="q")
    for substeps in (8, 32):  # a coarse one finds another root of its equations, and goes on from there
        run = Engine(Structure(model), data, substeps=substeps).run(np.zeros(0), check=False)
        assert abs(run.blew_up - gone) <= 1
        assert not np.isfinite(run.outputs[:, run.blew_up + 1 :]).any()
    # nor do finer substeps help: they were doubled until the time was gone
    problem = Problem(Structure(model), [data], np.ones(1), substeps=8, initial=np.zeros(1))
    assert sufficient_steps(lambda s, n, _: problem.like(None, substeps=n), [data], problem, np.zeros(0)) == 8


@pytest.mark.skipif(not NUMBA, reason="compares what numba compiles")
def test_states_picked_by_a_list_are_compiled():
    model = ct.nlsys(
        lambda t, x, u, params: np.array([x[1], -x[0], x[0] - x[2] + u[0] + 0.0 * np.sign(x[0])]),
        lambda t, x, u, params: x[[2, -3]],
        params={"a": 1.0}, states=3, inputs=1, outputs=2,
    )  # fmt: skip
    field = rco.physical(model).operating_point.field
    assert field.speed == "compiled"
    shown = field.table(field.nominal, np.array([0.3, -0.7, 1.1, 0.0]))[3:, 0]
    np.testing.assert_allclose(shown, [0.0, 0.0], atol=1e-12)  # the linear part has all of it
