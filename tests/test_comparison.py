"""compare: figures against hand-computed cases and python-control's own simulation."""

from __future__ import annotations

import copy
import pickle
import warnings

import control as ct
import numpy as np
import pytest

import rcorefine as rco
from rcorefine import DataError, DivergenceError, ExcitationWarning, Measurement, compare, comparison

DT = 0.05
A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-20, 10, -0.4, 0.2], [10, -10, 0.2, -0.2]])
B = np.array([[0, 0], [0, 0], [1, 0], [0, 1]])
C = np.array([[1, 0, 0, 0], [0, 1, 0, 0.0]])
STATES = ["x1", "x2", "v1", "v2"]


def chain(stiffness: float = 20.0, name: str = "chain") -> ct.StateSpace:
    changed = A.copy()
    changed[2, 0] = -stiffness
    return ct.ss(
        changed, B, C, np.zeros((2, 2)), inputs=["f1", "f2"], outputs=["x1", "x2"], states=STATES, name=name
    )


def simulated(system, w, hold="zoh", x0=0.0):
    """Outputs by python-control: sampled system, or straight lines in continuous time."""
    t = DT * np.arange(w.shape[-1])
    seen = system.sample(DT) if hold == "zoh" else system
    return np.array(ct.forced_response(seen, t, w, x0).y)


@pytest.fixture
def w() -> np.ndarray:
    return np.random.default_rng(5).standard_normal((2, 400))


def record(w, y, **options) -> Measurement:
    names = {"input_labels": ["f1", "f2"], "output_labels": ["x1", "x2"], "name": "run 1"}
    return Measurement(w, y, **({"dt": DT} | names | options))


# ---------------------------------------------------------------------- figures


def test_fit_and_rmse_by_hand():
    y = [1.0, 2.0, 3.0, 4.0]
    assert comparison.fit_percent(y, y) == 100
    assert comparison.fit_percent(y, [2.5] * 4) == pytest.approx(0)
    # |y - yh| = 2, |y - mean| = sqrt(5)
    assert comparison.fit_percent(y, [2, 3, 4, 5]) == pytest.approx(100 * (1 - 2 / np.sqrt(5)))
    assert comparison.fit_percent(y, [4, 3, 2, 1]) == pytest.approx(-100)
    assert np.isnan(comparison.fit_percent([1, 1, 1], [1, 1, 1]))
    assert comparison.root_mean_square([1, 2, 2]) == pytest.approx(np.sqrt(3))
    with pytest.raises(ct.ControlDimension, match="time comes last"):
        comparison.fit_percent([1, 2, 3], [1, 2])


def test_figures_of_a_comparison_follow_their_definitions(w):
    y = simulated(chain(), w)
    result = compare(chain(17.0), record(w, y), x0="zero")
    expected = simulated(chain(17.0), w)
    np.testing.assert_allclose(result.simulated, expected, atol=1e-10)
    np.testing.assert_allclose(result.residual, y - expected, atol=1e-10)
    spread = np.linalg.norm(y - y.mean(axis=1, keepdims=True), axis=1)
    np.testing.assert_allclose(result.fit, 100 * (1 - np.linalg.norm(y - expected, axis=1) / spread))
    np.testing.assert_allclose(result.nrmse, 1 - result.fit / 100)
    np.testing.assert_allclose(result.rmse, np.sqrt(np.mean((y - expected) ** 2, axis=1)), rtol=1e-9)
    assert result.fit.shape == (2,)
    assert result.residual.shape == (2, 400)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_true_model_from_an_unknown_state_fits_perfectly(w, hold):
    x0 = np.array([0.3, -0.2, 1.0, 0.5])
    result = compare(chain(), record(w, simulated(chain(), w, hold, x0), hold=hold))
    assert result.fit.min() > 100 - 1e-6
    np.testing.assert_allclose(result.initial_states[0][0], x0, atol=1e-7)
    wrong = compare(chain(), record(w, simulated(chain(), w, hold, x0), hold=hold), x0="zero")
    assert wrong.fit.max() < 80
    given = compare(chain(), record(w, simulated(chain(), w, hold, x0), hold=hold), x0=x0)
    assert given.fit.min() > 100 - 1e-6


def test_hold_matters(w):
    y = simulated(chain(), w, "foh")
    assert compare(chain(), record(w, y, hold="foh")).fit.min() > compare(chain(), record(w, y)).fit.max() + 1


def test_discrete_model_equals_its_continuous_one(w):
    y = simulated(chain(17.0), w) + 0.01 * np.random.default_rng(0).standard_normal((2, 400))
    result = compare([chain(), chain().sample(DT)], record(w, y))
    np.testing.assert_allclose(result.simulated[0], result.simulated[1], atol=1e-8)


def test_several_models_have_a_leading_axis_and_unique_names(w):
    result = compare([chain(17.0), chain(), chain()], record(w, simulated(chain(), w)))
    assert result.names == ("chain", "chain (2)", "chain (3)")
    assert result.fit.shape == (3, 2)
    assert result.simulated.shape == (3, 2, 400)
    one = result.select("chain (2)")
    assert one.fit.shape == (2,)
    np.testing.assert_array_equal(one.fit, result.fit[1])
    np.testing.assert_array_equal(result.select(-1).residual, result.residual[2])
    assert compare([chain()], record(w, simulated(chain(), w))).fit.shape == (1, 2)
    with pytest.raises(ct.ControlArgument, match="'chain', 'chain \\(2\\)'"):
        result.select("other")
    with pytest.raises(ct.ControlArgument, match="no model 3"):
        result.select(3)


# ---------------------------------------------------------------------- horizon


def test_horizon_starts_anew_and_tames_an_integrator():
    rng = np.random.default_rng(2)
    w = rng.standard_normal(2000)
    cart = ct.ss([[0, 1], [0, -0.5]], [[0], [1.0]], [[1, 0]], 0, inputs="f", outputs="q", name="cart")
    y = simulated(cart, w + 0.1)  # an offset that the model does not know of
    data = Measurement(w, y, dt=DT)
    free, windowed = compare(cart, data), compare(cart, data, horizon=1.0)
    assert windowed.starts == tuple(range(0, 2000, 20))
    assert windowed.initial_states[0].shape == (100, 2)
    assert windowed.rmse[0] < 0.05 * free.rmse[0]
    part = compare(cart, data.segment(3.0, 4.0))
    np.testing.assert_allclose(windowed.simulated[:, 60:80], part.simulated, atol=1e-9)


def test_horizon_windows_cover_the_record_evenly(w):
    result = compare(chain(), record(w, simulated(chain(), w)), horizon=3.3)
    edges = np.array([*result.starts, 400])
    assert len(result.starts) == 6
    assert np.ptp(np.diff(edges)) <= 1
    assert result.fit.min() > 100 - 1e-6
    assert compare(chain(), record(w, simulated(chain(), w)), horizon=1e6).starts == (0,)


@pytest.mark.parametrize(
    "options, error, message",
    [
        ({"horizon": 0.1}, DataError, "2 samples of 2 output"),
        ({"horizon": -1}, ct.ControlArgument, "positive"),
        ({"horizon": np.nan}, ct.ControlArgument, "positive"),
        ({"horizon": "1"}, ct.ControlArgument, "seconds"),
        ({"horizon": 5.0, "x0": np.zeros(4)}, ct.ControlArgument, "one start only"),
        ({"x0": "guess"}, ct.ControlArgument, "guess"),
        ({"x0": np.zeros(3)}, ct.ControlDimension, "3"),
        ({"x_0": "zero"}, TypeError, "x_0"),
    ],
)
def test_bad_options(w, options, error, message):
    with pytest.raises(error, match=message):
        compare(chain(), record(w, simulated(chain(), w)), **options)


# ---------------------------------------------------------------------- channels


def test_named_channels_may_stand_in_any_order(w):
    y = simulated(chain(), w)
    swapped = record(w[::-1], y[::-1], input_labels=["f2", "f1"], output_labels=["x2", "x1"])
    result = compare([chain(17.0), chain()], swapped)
    straight = compare([chain(17.0), chain()], record(w, y))
    np.testing.assert_allclose(result.fit, straight.fit[:, ::-1], rtol=1e-9)
    assert result.fit[1].min() > 100 - 1e-6
    assert any("reordered by name" in note for note in result.notes)
    assert straight.notes == ()
    # the linear models follow the record, so the Bode plot does too
    cplt = result.plot("bode", label=["start", "true"])
    assert cplt.axes.shape == (6, 2)
    assert cplt.axes[0, 0].lines[1].get_ydata()[0] > 0


def test_default_names_match_by_position(w):
    y = simulated(chain(), w)
    assert compare(chain(), Measurement(w, y, dt=DT)).fit.min() > 100 - 1e-6
    bare = ct.ss(A, B, C, np.zeros((2, 2)))
    assert compare(bare, record(w, y)).fit.min() > 100 - 1e-6


def test_missing_names_and_counts_are_named(w):
    y = simulated(chain(), w)
    with pytest.raises(ct.ControlDimension, match="has no input 'f2' of model 'chain'; it has 'f1', 'g'"):
        compare(chain(), record(w, y, input_labels=["f1", "g"]))
    with pytest.raises(ct.ControlDimension, match="has no output 'x1', 'x2'"):
        compare(chain(), record(w, y, output_labels=["a", "b"]))
    with pytest.raises(ct.ControlDimension, match=r"2 input\(s\) \(f1, f2\).*1 \(u\[0\]\)"):
        compare(chain(), Measurement(w[0], y, dt=DT))


def test_outputs_that_were_not_measured_are_left_out_and_said(w):
    y = simulated(chain(), w)
    result = compare([chain(17.0), chain()], record(w, y[1], output_labels="x2"))
    assert result.fit.shape == (2, 1)
    assert result.fit[1, 0] > 100 - 1e-6
    assert "not measured, so not compared: x1" in result.notes
    assert result.data.output_labels == ("x2",)


def test_record_with_more_channels_than_the_model(w):
    y = simulated(chain(), w)
    one = ct.ss(A, B[:, :1], C[:1], 0, inputs="f1", outputs="x1", states=STATES, name="part")
    y_part = simulated(one, w[:1])
    data = record(w, np.vstack([y_part, y[1]]))
    result = compare(one, data)
    assert result.fit.tolist() == pytest.approx([100])
    assert any("f2" in note for note in result.notes)
    assert result.plot("bode").axes.shape == (3, 2)


# ---------------------------------------------------------------------- refusals


def test_what_is_no_model_or_no_record(w):
    data = record(w, simulated(chain(), w))
    with pytest.raises(ct.ControlArgument, match="FrequencyResponseData"):
        compare(ct.frd([1.0, 0.5], [1.0, 2.0]), data)
    with pytest.raises(ct.ControlArgument, match="no model"):
        compare([], data)
    with pytest.raises(ct.ControlArgument, match="Measurement"):
        compare(chain(), data.to_response())
    with pytest.raises(rco.RCOError, match="dt = 0.1"):
        compare(chain().sample(0.1), data)


def test_too_short_a_record():
    with pytest.raises(DataError, match="2 samples of 2 output"):
        compare(chain(), record(np.ones((2, 2)), np.ones((2, 2)) * [[1], [2]]))


def test_constant_input_warns_once_and_still_compares():
    y = simulated(chain(), np.zeros((2, 300)), x0=np.array([1, 0, 0, 0.0]))
    with pytest.warns(ExcitationWarning, match="free decay") as caught:
        result = compare([chain(17.0), chain()], record(np.zeros((2, 300)), y))
    assert len(caught) == 1
    assert caught[0].filename == __file__
    assert result.fit[1].min() > 100 - 1e-6
    with pytest.raises(DataError, match="constant"):
        result.plot("bode")


def test_constant_output_has_no_fit(w):
    result = compare(ct.ss([[-1.0]], [[1.0, 0]], [[1.0]], 0), Measurement(w, np.full(400, 2.0), dt=DT))
    assert np.isnan(result.fit[0])
    assert "constant" in str(result)


def test_divergence_names_the_model_and_the_way_out():
    w = np.sin(np.arange(20_000.0))
    wild = ct.ss(
        [[1.1]], [[0.1]], [[1.0]], [[0.0]], 0.1, name="wild"
    )  # a continuous one is led (test_unstable)
    with pytest.raises(DivergenceError, match="'wild' diverges.*horizon"):
        compare(wild, Measurement(w, w, dt=0.1))
    assert np.isfinite(compare(wild, Measurement(w, w, dt=0.1), horizon=2.0).rmse).all()


def test_nothing_is_changed(w):
    data, model = record(w, simulated(chain(), w)), chain()
    before = (data.inputs.copy(), data.outputs.copy(), model.A.copy())
    compare(model, data)
    for left, right in zip(before, (data.inputs, data.outputs, model.A), strict=True):
        np.testing.assert_array_equal(left, right)


# ---------------------------------------------------------------------- interoperation


def test_result_survives_pickle_and_deepcopy(w):
    result = compare([chain(17.0), chain()], record(w, simulated(chain(), w)))
    for twin in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        assert isinstance(twin, rco.Comparison)
        assert str(twin) == str(result)
        np.testing.assert_array_equal(twin.residual, result.residual)
        twin.plot()
    with pytest.raises(AttributeError):
        result.names = ()


def test_responses_go_into_python_control(w):
    result = compare([chain(17.0), chain()], record(w, simulated(chain(), w)))
    assert [r.sysname for r in result.responses] == ["chain", "chain (2)"]
    cplt = ct.TimeResponseList(result.responses).plot(label=["start", "true"])
    assert cplt.axes.size > 0
    measured = result.data.frequency_response().frd
    model = chain().sample(DT, name="chain_d")
    joined = ct.FrequencyResponseList([ct.frequency_response(model, measured.omega), measured])
    assert joined.plot(label=["model", "measured"], wrap_phase=True).axes.shape == (4, 2)


def test_physical_model_passes(w):
    model = rco.PhysicalModel.from_statespace(chain())
    assert compare(model, record(w, simulated(chain(), w))).fit.min() > 100 - 1e-5
    with pytest.raises(ct.ControlDimension, match=r"x1.*\.system"):
        compare(model, record(w, simulated(chain(), w)[1], output_labels="x2"))


def test_no_warning_in_the_ordinary_case(w):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        compare(chain(), record(w, simulated(chain(), w))).plot("time")


def test_lines_of_a_periodic_record_against_the_closed_form():
    """cos^2 has half of itself at the second line, cos^3 a quarter at the third; noise 2 s / sqrt(P M)."""
    rng, period, periods, s = np.random.default_rng(0), 200, 41, 0.02
    c = np.cos(2 * np.pi * np.arange(period * periods) / period)
    data = rco.Measurement(c, c + 0.1 * c**2 + 0.2 * c**3 + s * rng.standard_normal(c.size), dt=0.01)
    result = compare(ct.ss([], [], [], [[1.0]]), data, x0="zero")
    found = result.line_levels
    assert list(found.kind) == ["sent", "even", "odd", "even", "odd"]
    expected = 2 * s / np.sqrt(period * (periods - 1))
    np.testing.assert_allclose(found.amplitude[0], [1.15, 0.05, 0.05, 0, 0], atol=4 * expected)
    assert np.sqrt(np.mean(found.noise**2)) == pytest.approx(expected, rel=0.2)
    # two odd lines beside the one sent, the fifth empty: 0.05 / sqrt(2) over 1.15
    assert found.level("odd") == pytest.approx(20 * np.log10(0.05 / np.sqrt(2) / 1.15), abs=0.3)
    assert "odd distortion -30 dB" in " ".join(str(result).split())


def test_no_lines_without_a_period(w):
    assert compare(chain(), record(w, simulated(chain(), w))).line_levels is None
