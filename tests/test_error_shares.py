"""What a model leaves: noise, or an error that matters or does not."""

import control as ct
import numpy as np
import pytest
from cases import slow
from scipy.integrate import solve_ivp

import rcorefine as rco
from rcorefine.diagnosis import noise as error_shares


def test_shares_of_white_noise_and_of_a_slow_error(rng):
    """A sine of 0.3 % beside white noise of 1 %: rms .0104 of the spread, .003 of it predictable."""
    n = 40_000
    y = np.sin(0.05 * np.arange(n))[None]
    spread = np.sqrt(0.5)
    noise = 0.01 * spread * rng.standard_normal((1, n))
    slow = 0.003 * np.sqrt(2.0) * spread * np.sin(0.011 * np.arange(n))[None]
    (share,) = error_shares.error_shares_of(["y"], [noise + slow], [y], np.array([0.01 * spread]), 0.0)
    assert share.share == pytest.approx(np.hypot(0.01, 0.003), rel=0.02)
    assert share.model == pytest.approx(0.003, rel=0.15)
    assert share.step == 0.0
    assert error_shares.matter([share], 0.002)
    assert not error_shares.matter([share], 0.01)
    # white to its own past, but found by the tests: 9 % of the power
    (share,) = error_shares.error_shares_of(["y"], [noise], [y], np.array([noise.std()]), 0.09)
    assert share.model == pytest.approx(0.003, rel=0.02)


def test_an_error_below_the_step_of_the_sensor_does_not_matter():
    t = np.arange(4000)
    y = np.round(np.sin(0.05 * t) / 0.1)[None] * 0.1
    (share,) = error_shares.error_shares_of(["y"], [0.02 * np.sin(0.01 * t)[None]], [y], np.zeros(1), 0.0)
    assert share.step == pytest.approx(0.1 / y.std(), rel=1e-6)
    assert share.model > 0.01
    assert not error_shares.matter([share], 0.01)


MODEL = ct.ss(
    [[0, 1], [-16, -0.4]], [[0], [1]], [[1, 0]], 0, states=["x", "v"], inputs=["force"], outputs=["x"]
)
NONE = [rco.Effect("coulomb_friction", "x"), rco.Effect("end_stop", "x")]


@pytest.fixture(scope="module")
def slightly_wrong():
    """A force without a law here, d^2 v: it changes the output by about a third of a percent."""
    rng, n, dt = np.random.default_rng(5), 12_000, 0.05
    w = np.repeat(rng.standard_normal(n // 8), 8)

    def run(strength):
        x, found, h = np.zeros(2), np.empty(n), dt / 4

        def rate(x, u):
            return np.array([x[1], -16 * x[0] - 0.4 * x[1] + u - strength * x[0] ** 2 * x[1]])

        for k in range(n):
            found[k] = x[0]
            for _ in range(4):
                a = rate(x, w[k])
                b = rate(x + h / 2 * a, w[k])
                c = rate(x + h / 2 * b, w[k])
                x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, w[k]))
        return found

    healthy = run(0.0)
    y = run(0.05)
    error = (y - healthy).std() / y.std()
    noisy = y + 0.003 * y.std() * rng.standard_normal(n)
    return rco.Measurement(w, noisy, dt=dt, input_labels="force", output_labels="x"), error


def test_a_small_error_is_significant_and_does_not_matter(slightly_wrong):
    data, error = slightly_wrong
    assert 0.001 < error < 0.006
    found = rco.diagnose(MODEL, data, candidates=NONE)
    assert (found.verdict, found.effects) == ("adequate", ())
    assert min(test.p_value for test in found.tests) < 1e-20
    assert found.adequate_to == pytest.approx(error, rel=0.5)
    assert found.adequate_to <= 1.05 * np.hypot(error, 0.003)
    told = str(found)
    assert "adequate to" in told
    assert "The residual is not noise" in told
    assert "No residual test is significant" not in told


@pytest.mark.slow
def test_the_same_error_is_unexplained_where_less_matters(slightly_wrong):
    strict = rco.diagnose(MODEL, slightly_wrong[0], candidates=NONE, matters=0.0005)
    assert strict.verdict == "unexplained"
    assert np.isnan(strict.adequate_to)


@pytest.mark.parametrize(("matters", "word"), [(0.01, "adequate"), *slow((0.0005, "unexplained"))])
def test_the_improvement_says_the_same(slightly_wrong, matters, word):
    data, _ = slightly_wrong
    found = rco.improve(MODEL, data, candidates=NONE, matters=matters)
    assert found.verdict == word
    if word == "adequate":
        assert found.effects == ()
        assert found.error_shares[0].model < 0.01
        assert "adequate to" in found.message


def test_records_confirm_what_is_wrong_by_less_than_matters(slightly_wrong):
    data, error = slightly_wrong
    as_it_is = rco.refine(MODEL, data)
    found = rco.confirm(as_it_is, data.split(0.5), candidates=NONE)
    assert found.verdict == "confirmed"
    assert found.p_value < 1e-10
    assert found.estimates[1].error == pytest.approx(error, rel=0.5)
    assert "less than what matters" in found.message
    strict = rco.confirm(as_it_is, data.split(0.5), candidates=NONE, matters=0.0005)
    assert strict.verdict == "refuted"
    assert "of the motion" in strict.message


@pytest.fixture(scope="module")
def released():
    """A pendulum with friction, let go at 92 degrees; inertia and loss of its linear model are wrong."""
    k, inertia, loss = 0.22, 0.0035, 2e-4
    true = solve_ivp(
        lambda t, x: [x[1], (-k * np.sin(x[0]) - loss * x[1] - 2e-4 * np.tanh(20 * x[1])) / inertia],
        (0, 9.0), [1.6, 0.0], t_eval=np.arange(900) * 0.01, rtol=1e-9, atol=1e-11,
    )  # fmt: skip
    y = true.y[0] + 4e-4 * np.random.default_rng(3).standard_normal(900)
    J = 1.05 * inertia
    model = ct.ss(
        [[0, 1], [-k / J, -1e-4 / J]], [[0], [1 / J]], [[1, 0]], 0,
        states=["angle", "rate"], inputs=["torque"], outputs=["angle"],
    )  # fmt: skip
    return model, rco.Measurement.free_decay(y, dt=0.01, output_labels="angle", release=0)


LAWS = ("cubic_stiffness", "gravity", "soft_clearance", "clearance", "quadratic_damping")


@pytest.mark.slow
def test_a_release_is_diagnosed_although_the_model_is_out_of_step(released):
    """A simulation with another period explains nothing of nine seconds: no reason to see no motion."""
    model, data = released
    laws = [rco.Effect(kind, "angle") for kind in (*LAWS, "coulomb_friction")]
    found = rco.diagnose(model, data, candidates=laws)
    assert found.base.fit[0] < 5.0
    assert (found.verdict, {e.kind for e in found.effects}) == ("effect", {"gravity", "coulomb_friction"})
    assert np.isnan(found.adequate_to)


@pytest.mark.slow
def test_an_imitation_of_the_large_swing_fails_where_it_has_become_smaller(released):
    """Without friction among the candidates no set passes; gravity is what holds for all of the decay."""
    model, data = released
    found = rco.diagnose(model, data, candidates=[rco.Effect(kind, "angle") for kind in LAWS])
    assert "gravity" in [effect.kind for effect in found.effects]
    assert found.adequate_to < 0.01
    assert "smaller" in " ".join(found.notes)
    assert np.isnan(found.best.probability)
    better = rco.improve(model, data, candidates=[rco.Effect(kind, "angle") for kind in LAWS])
    assert better.verdict == "adequate"
    assert set(better.effects) == {e for e in better.effects if e.kind in {f.kind for f in found.effects}}
