"""Free decays: records without an input, of one release or of several."""

import warnings

import control as ct
import numpy as np
import pytest
from cases import few_or_all, offered, slow
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import rcorefine as rco
from rcorefine.comparison.signals import decay_of
from rcorefine.diagnosis.open_law import reached

DT = 0.03
LINEAR = ct.ss(
    [[0, 1], [-16, -0.05]], [[0], [1]], [[1, 0]], 0, states=["x", "v"], inputs=["force"], outputs=["x"]
)


def released(start, seed, rates, n=700, dt=DT, noise=1e-3, label="x"):
    t = np.arange(n) * dt
    run = solve_ivp(rates, (0, t[-1]), start, t_eval=t, rtol=1e-9, atol=1e-11, max_step=dt / 3)
    y = run.y[0] + noise * np.random.default_rng(seed).standard_normal(n)
    return rco.Measurement.free_decay(y, dt=dt, output_labels=label, release=0)


def dragged(t, x):
    return [x[1], -16 * x[0] - 0.05 * x[1] - 0.35 * abs(x[1]) * x[1]]


def linear(t, x):
    return [x[1], -16 * x[0] - 0.05 * x[1]]


@pytest.fixture(scope="module")
def releases():
    return [released([1.0, 0.0], 1, dragged), released([0.0, 2.0], 2, dragged)]


@pytest.fixture(autouse=True)
def silent():
    """A record that says it has no input is no reason for a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", rco.ExcitationWarning)
        yield


# ---------------------------------------------------------------------- the record
def test_a_decay_has_no_inputs_and_keeps_its_parts(releases):
    record = releases[0]
    assert (record.n_inputs, record.inputs.shape) == (0, (0, 700))
    first, second = record.split(0.5)
    assert (first.n_inputs, second.n_samples) == (0, 350)
    assert record.decimate(2).n_inputs == 0
    assert "inputs" not in repr(record.plot().axes)


@pytest.mark.parametrize("held", [40, 200])
def test_the_release_is_the_end_of_the_held_excursion(held):
    t = np.arange(600) * 0.01
    swing = np.exp(-0.05 * t) * np.cos(5 * t)
    pushed = np.concatenate([np.zeros(50), np.linspace(0, 1, 30), np.ones(held), swing])
    record = rco.Measurement.free_decay(pushed, dt=0.01)
    at = pushed.size - record.n_samples
    # the cosine falls by 0.2 % within 0.063 / 5 s, and the envelope by 0.2 % within 0.04 s
    assert 80 + held - 1 <= at <= 80 + held + 2
    assert f"{at} samples before it left out" in record.notes[0]


@pytest.mark.parametrize(("release", "said"), [(99.0, "is not in the record"), (-1e9, "")])
def test_a_given_release(release, said):
    y = np.cos(np.arange(100) * 0.1)
    if said:
        with pytest.raises(rco.DataError, match=said):
            rco.Measurement.free_decay(y, dt=0.1, release=release)
    else:
        assert rco.Measurement.free_decay(y, dt=0.1, release=release).n_samples == 100


# ---------------------------------------------------------------------- what is missing
@pytest.mark.parametrize("count", [1, *slow(2)])
def test_what_a_decay_lacks_is_named_on_one_release_and_on_two(releases, count):
    found = rco.diagnose(LINEAR, releases[:count])
    assert found.verdict == "effect"
    assert [e.label for e in found.effects] == ["quadratic_damping at x"]
    (value,), (std,) = found.best.coefficients.values(), found.best.std.values()
    assert abs(value - 0.35) < 3 * std


@pytest.mark.parametrize("kinds", few_or_all("damping", "quadratic_damping", "coulomb_friction"))
def test_every_verb_takes_releases(releases, kinds):
    assert rco.compare(LINEAR, releases[0]).fit < 60
    assert not rco.check(LINEAR, releases[0]).stops
    assert not [row for row in rco.check(LINEAR, releases[0]).rows if row.what in ("gain", "delay")]
    better = rco.refine(LINEAR, releases[0], [rco.Effect("quadratic_damping", "x")])
    found = rco.confirm(better, releases)
    assert found.verdict == "confirmed"
    rms = [np.sqrt(np.mean(r.outputs**2)) for r in releases]
    np.testing.assert_allclose(found.estimates[1].level, rms[1] / rms[0], rtol=1e-12)
    steps = rco.improve(LINEAR, releases, candidates=offered(LINEAR, kinds)).steps
    assert [s.effect and s.effect.kind for s in steps] == [None, "quadratic_damping"]
    assert steps[-1].validation_rmse < 1.2e-3  # noise 1e-3


@pytest.mark.parametrize("n", [4, *slow(10)])
def test_nothing_is_missing_in_a_linear_decay(n):
    words = [rco.diagnose(LINEAR, released([1.0, 0.0], seed, linear)).verdict for seed in range(n)]
    assert words == ["adequate"] * n  # of these records, exactly


def test_friction_of_a_pendulum_is_named_beside_the_sine_or_what_looks_like_it():
    def swings(t, x):
        return [x[1], -25 * np.sin(x[0]) - 0.1 * x[1] - 0.12 * np.tanh(x[1] / 1e-3)]

    model = ct.ss(
        [[0, 1], [-25, -0.1]], [[0], [1]], [[1, 0]], 0, states=["theta", "rate"], inputs=["torque"],
        outputs=["theta"],
    )  # fmt: skip
    data = released([np.radians(20), 0], 1, swings, 1000, 0.02, 5e-4, "theta")
    assert any(e.kind == "gravity" for e in rco.effect_library(model))
    found = rco.diagnose(model, data)
    sets = [{e.kind for e in row.effects} for row in found.ranking if row.alike]
    assert {"coulomb_friction", "gravity"} in sets
    row = next(r for r in found.ranking if {e.kind for e in r.effects} == {"coulomb_friction", "gravity"})
    better = row.refinement
    values = {q.name: (q.value, q.std) for q in better.parameters}
    for name, truth in (("force", 0.12), ("torque", 25.0)):
        assert abs(values[name][0] - truth) < 3 * values[name][1]


def test_effects_that_need_a_moving_input_cannot_be_asked_for(releases):
    with pytest.raises(rco.ModelError, match="input_delay at force cannot be seen while no input moves"):
        rco.diagnose(LINEAR, releases[0], candidates=[rco.Effect("input_delay", "force")])


def test_the_stream_says_why_it_needs_an_input(releases):
    with pytest.raises(rco.DataError, match="has no input"):
        rco.RCORefiner(LINEAR, dt=DT).run(releases[0])


# ---------------------------------------------------------------------- amplitude, period, damping
def test_damping_ratio_of_a_linear_decay_in_closed_form():
    t = np.arange(6000) * 0.005
    for ratio in (0.003, 0.02, 0.1):
        damped = 8.0 * np.sqrt(1 - ratio**2)
        found = decay_of(2.0 + np.exp(-ratio * 8.0 * t) * np.cos(damped * t + 0.4), 0.005)
        clear = found.amplitude > 0.02
        np.testing.assert_allclose(found.damping_ratio[clear], ratio, rtol=2e-3)
        np.testing.assert_allclose(found.period[clear], 2 * np.pi / damped, rtol=2e-3)


def test_coulomb_friction_takes_the_same_from_every_half_cycle():
    """By 2 f/k of the amplitude (Meirovitch, sec. 2.9), here 2 * 0.1/16."""
    record = released([1.0, 0.0], 0, lambda t, x: [x[1], -16 * x[0] - 0.1 * np.tanh(x[1] / 1e-4)], noise=0.0)
    amplitude = decay_of(record.outputs[0], DT).amplitude
    np.testing.assert_allclose(-np.diff(amplitude)[:20], 2 * 0.1 / 16, rtol=0.02)


def test_a_signal_that_does_not_swing_is_refused():
    with pytest.raises(rco.DataError, match="at least four"):
        decay_of(np.exp(-np.arange(500) * 0.01), 0.01)


def test_the_picture_has_four_panels_an_output(releases):
    shown = rco.compare(LINEAR, releases[0]).plot("decay")
    assert shown.axes.shape == (2, 2)
    labels = [ax.get_ylabel() for ax in shown.axes.ravel()]
    assert labels == ["Amplitude of x", "Damping ratio [%]", "Period [s]", "Frequency [Hz]"]


@pytest.mark.parametrize("discrete", [False, True])
def test_a_decay_is_simulated_without_inputs(discrete):
    """From a given and from an estimated state, against the matrix exponential."""
    t = np.arange(200) * DT
    x0 = np.array([1.0, 0.5])
    states = np.array([expm(LINEAR.A * at) @ x0 for at in t]).T
    record = rco.Measurement.free_decay(states[0], dt=DT, output_labels="x", release=0)
    model = LINEAR.sample(DT) if discrete else LINEAR
    for start in (x0, "estimate"):
        run = rco.simulate(model, record, start)
        np.testing.assert_allclose(run.states, states, atol=1e-6)
        assert run.outputs.shape == (1, 200)
    refined = rco.refine(LINEAR, record, [])
    np.testing.assert_allclose(refined.simulate(record, x0).outputs, states[:1], atol=1e-6)
    with pytest.raises(ct.ControlDimension, match="has 2 inputs and the model 1"):
        rco.simulate(model, rco.Measurement(np.ones((2, 200)), states[0], dt=DT))


def test_a_tabulated_force_has_the_velocities_of_the_decay():
    """Those of the observer are three times as large at first, until it follows."""

    def odd(t, x):
        return [x[1], -16 * x[0] - 0.05 * x[1] - 0.6 * abs(x[1]) * x[1] * (1 + 0.8 * np.sin(5 * x[0]))]

    t = np.arange(400) * DT
    v = solve_ivp(odd, (0, t[-1]), [3.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-10).y[1]
    candidates = [rco.Effect(kind, "x") for kind in ("cubic_stiffness", "coulomb_friction")]
    found = rco.diagnose(LINEAR, released([3.0, 0.0], 0, odd, n=400), candidates=candidates)
    table = found.law().law
    assert 1.1 * v.min() < table.v[0] < 0.5 * v.min()
    assert 0.5 * v.max() < table.v[-1] < 1.1 * v.max()


def test_a_table_with_fewer_knots_is_the_same_function(rng):
    whole = rco.Table(np.arange(6.0), np.arange(5.0) - 2.0, rng.standard_normal((6, 5)))
    d, v = rng.uniform(0.7, 3.4, 300), rng.uniform(-1.6, 0.2, 300)
    part = reached(whole, d, v)
    np.testing.assert_allclose(part.d, [d.min(), 1.0, 2.0, 3.0, d.max()])
    np.testing.assert_allclose(part.v, [v.min(), -1.0, 0.0, v.max()])
    np.testing.assert_allclose(part(d, v), whole(d, v), rtol=1e-9, atol=1e-12)
    spring = rco.Table(d=[0.0, 1.0, 4.0], force=[0.0, 2.0, 1.0])
    np.testing.assert_allclose(reached(spring, d, v)(d, v), spring(d, v), rtol=1e-12)
    assert reached(whole, 9.0 + d, v) is whole
