"""Bad input: each error says what, where and what to do, and the failed call changes nothing."""

from __future__ import annotations

import pickle
from typing import Any

import control as ct
import numpy as np
import pytest
from inner import LinearModel
from test_rco_refiner import DT, SETTINGS, damaged, record_of, state_of, two_by_two

import rcorefine as rco
from rcorefine.streaming.history import poles_of
from rcorefine.streaming.scales import Plant, explain

N = 150


@pytest.fixture(scope="module")
def data() -> rco.Measurement:
    return record_of(damaged(two_by_two(DT)), n=600)


@pytest.fixture(params=[20, 100], ids=["held back", "learning"])
def refiner(request: pytest.FixtureRequest, data: rco.Measurement) -> rco.RCORefiner:
    """A refiner before and after its scales are known."""
    made = rco.RCORefiner(two_by_two(), dt=DT, history=True, **SETTINGS)
    made.update(data.inputs[:, : request.param], data.outputs[:, : request.param])
    return made


def block(data: rco.Measurement, first: int) -> tuple[np.ndarray, np.ndarray]:
    return data.inputs[:, first : first + N].copy(), data.outputs[:, first : first + N].copy()


def with_value(array: np.ndarray, row: int, sample: int, value: float) -> np.ndarray:
    changed = array.copy()
    changed[row, sample] = value
    return changed


BAD_BLOCKS: dict[str, tuple[Any, type[Exception], str]] = {
    "nan output": (
        lambda w, y: (w, with_value(y, 1, 7, np.nan)),
        rco.DataError,
        r"'v2' is NaN at sample {0}",
    ),
    "inf input": (lambda w, y: (with_value(w, 0, 3, np.inf), y), rco.DataError, r"'f1' is Inf at sample {1}"),
    "unequal lengths": (lambda w, y: (w[:, :-1], y), ct.ControlDimension, "149 sample.* and outputs 150"),
    "transposed": (lambda w, y: (w.T, y.T), ct.ControlDimension, "transposed.*inputs.T"),
    "wrong number": (lambda w, y: (w[:1], y), ct.ControlDimension, r"shape \(1, 150\).* 2 inputs"),
    "three axes": (lambda w, y: (w[None], y), ct.ControlDimension, "shape"),
    "number for two": (lambda w, y: (1.0, 1.0), ct.ControlDimension, "2 inputs"),
    "empty": (lambda w, y: (w[:, :0], y[:, :0]), rco.DataError, "empty"),
    "complex": (lambda w, y: (w, y + 1j), ct.ControlArgument, "outputs is complex"),
    "strings": (lambda w, y: (w.astype(str), y), ct.ControlArgument, "real numbers"),
    "objects": (lambda w, y: ([{}, {}], y), ct.ControlArgument, "real numbers"),
    "none": (lambda w, y: (None, y), ct.ControlArgument, "real numbers"),
    "ragged": (lambda w, y: ([[1.0, 2.0], [1.0]], y), ct.ControlDimension, "unequal lengths"),
    "masked": (lambda w, y: (np.ma.masked_equal(w, w[0, 4]), y), rco.DataError, r"masked at index \(0, 4\)"),
}


@pytest.mark.parametrize("case", BAD_BLOCKS)
def test_bad_block(refiner: rco.RCORefiner, data: rco.Measurement, case: str) -> None:
    change, error, message = BAD_BLOCKS[case]
    first = refiner.n_samples
    before = state_of(refiner)
    with pytest.raises(error, match=message.format(first + 7, first + 3)):
        refiner.update(*change(*block(data, first)))
    for now, then in zip(state_of(refiner), before, strict=True):
        np.testing.assert_array_equal(now, then)
    refiner.update(*block(data, first))  # and the stream goes on
    assert refiner.n_learned == first + N


@pytest.mark.parametrize(
    "w, message", [(np.nan * np.ones((2, 3)), "NaN"), (np.ones((3, 4)), "2 inputs"), ("text", "numbers")]
)
def test_bad_prediction(refiner: rco.RCORefiner, w: Any, message: str) -> None:
    with pytest.raises((rco.DataError, ct.ControlDimension, ct.ControlArgument), match=message):
        refiner.predict(w)


# -- settings --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings, error, message",
    [
        ({"order": -1}, rco.ModelError, r"order \(n_c\) must be at least 0, not -1"),
        ({"window": 0}, rco.ModelError, r"window \(p\) must be at least 1"),
        ({"markov": 0}, rco.ModelError, r"markov \(mu\)"),
        ({"learning_rate": 0.0}, rco.ModelError, r"learning_rate \(alpha\) = 0 must be positive"),
        ({"learning_rate": -3}, rco.ModelError, "alpha"),
        ({"learning_rate": np.inf}, rco.ModelError, "alpha"),
        ({"learning_rate": "fast"}, ct.ControlArgument, "must be a number"),
        ({"static_learning_rate": 0}, rco.ModelError, "static_learning_rate"),
        ({"static_window": 0}, rco.ModelError, "static_window"),
        ({"static_markov": 0}, rco.ModelError, "static_markov"),
        ({"static_average": 0}, rco.ModelError, "static_average"),
        ({"order": 2.5}, ct.ControlArgument, "whole number"),
        ({"window": True}, ct.ControlArgument, "whole number"),
        ({"history": "yes"}, ct.ControlArgument, "history"),
        ({"use_estimated_states": 1}, ct.ControlArgument, "use_estimated_states"),
        ({"correction_input": np.ones(3)}, ct.ControlDimension, r"B_u.*\(4, l_u\)"),
        ({"correction_input": np.full((4, 1), np.nan)}, rco.ModelError, r"B_u.*\[0, 0\]"),
        ({"correction_input": np.zeros((4, 1))}, rco.ModelError, "reaches no output"),
        ({"correction_input": np.eye(4)[:, 1:] * [0.0, 1.0, 1.0]}, rco.ModelError, "correction 0"),
        ({"correction_feedthrough": np.ones((2, 3))}, ct.ControlDimension, "D_u"),
        ({"correction_input": 1j * np.ones(4)}, ct.ControlArgument, "real"),
        ({"scale": "none"}, ct.ControlArgument, "auto"),
        ({"scale": 3.0}, ct.ControlArgument, "mapping"),
        ({"scale": {"inputs": 1.0}}, ct.ControlArgument, "'outputs' is missing"),
        ({"scale": {"inputs": 1.0, "outputs": 1.0, "x": 1.0}}, ct.ControlArgument, "'x' is unknown"),
        ({"scale": {"inputs": 1.0, "outputs": 0.0}}, rco.ModelError, "outputs must be positive"),
        ({"scale": {"inputs": [1.0] * 3, "outputs": 1.0}}, ct.ControlDimension, "inputs has shape"),
        ({"dt": -1.0}, rco.ModelError, "dt|sampling time"),
        ({"dt": None}, rco.ModelError, "'chain' is continuous: give dt"),
    ],
)
def test_bad_settings(settings: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        rco.RCORefiner(two_by_two(), **{"dt": DT, **settings})


def test_unknown_keyword() -> None:
    with pytest.raises(TypeError, match="windows"):
        rco.RCORefiner(two_by_two(), dt=DT, windows=3)


@pytest.mark.parametrize(
    "model, advice",
    [
        (ct.frd([1.0, 0.5], [1.0, 2.0]), "StateSpace, not FrequencyResponseData"),
        (ct.nlsys(None, lambda t, x, u, params: u, inputs=1, outputs=1), "linearize"),
        (np.eye(2), "StateSpace"),
        (None, "StateSpace"),
    ],
)
def test_models_that_are_none(model: Any, advice: str) -> None:
    with pytest.raises(ct.ControlArgument, match=advice):
        rco.RCORefiner(model, dt=DT)


def test_contradictory_dt() -> None:
    with pytest.raises(rco.ModelError, match=r"dt = 0.5 s contradicts model 'chain', which has dt = 0.02"):
        rco.RCORefiner(two_by_two(DT), dt=0.5)


# -- records ---------------------------------------------------------------------------------------


def test_records_that_do_not_fit(data: rco.Measurement) -> None:
    made = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS)
    before = state_of(made)

    def changed(**fields: Any) -> rco.Measurement:
        given = {
            "inputs": data.inputs,
            "outputs": data.outputs,
            "dt": DT,
            "input_labels": ["f1", "f2"],
            "output_labels": ["v1", "v2"],
        }
        return rco.Measurement(**{**given, **fields})

    constant = data.inputs.copy()
    constant[1] = 4.0
    for record, error, message in (
        (changed(dt=0.5), rco.ModelError, "dt = 0.5 s"),
        (changed(inputs=constant), rco.DataError, r"'f2' is constant \(4\) from sample 0 to 599"),
        (changed(hold="foh"), rco.DataError, "hold='foh'"),
        (changed(input_labels=["f1", "g"]), ct.ControlDimension, "f2"),
        (changed(output_labels=["v1", "g"]), ct.ControlDimension, "v2"),
        (
            changed(inputs=data.inputs[:, :3], outputs=data.outputs[:, :3]),
            rco.DataError,
            "3 sample.* 4 states",
        ),
        (data.inputs, ct.ControlArgument, "must be a Measurement"),
        (
            ct.forced_response(two_by_two(), np.arange(5.0), data.inputs[:, :5]),
            ct.ControlArgument,
            "Measurement",
        ),
    ):
        with pytest.raises(error, match=message):
            made.run(record)
    for now, then in zip(state_of(made), before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_channels_are_matched_by_name(data: rco.Measurement) -> None:
    swapped = rco.Measurement(
        data.inputs[::-1],
        data.outputs[::-1],
        dt=DT,
        input_labels=["f2", "f1"],
        output_labels=["v2", "v1"],
    )
    plain = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS).run(data)
    np.testing.assert_array_equal(
        rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS).run(swapped).theta, plain.theta
    )


def test_constant_input_in_a_stream_is_refused_in_the_end(data: rco.Measurement) -> None:
    """A stream may start at rest, but not for ever: 16 warm-ups, then the input is named."""
    made = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS)
    made.update(np.ones((2, 900)), np.random.default_rng(0).standard_normal((2, 900)))
    assert made.n_learned == 0
    before = state_of(made)
    with pytest.raises(rco.DataError, match=r"input 'f1' is constant \(1\) from sample 0 to 959"):
        made.update(np.ones((2, 100)), np.random.default_rng(1).standard_normal((2, 100)))
    for now, then in zip(state_of(made), before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_unstable_initial_model_is_named() -> None:
    wild = ct.ss([[60.0]], [[1.0]], [[1.0]], [[0.0]])
    made = rco.RCORefiner(wild, dt=0.1, window=100)
    w = np.random.default_rng(0).standard_normal(200)
    with pytest.raises(rco.ModelError, match="unstable"):
        made.update(w, w)


# -- divergence ------------------------------------------------------------------------------------


SHORT = {"window": 100, "markov": 1}  # one Markov parameter hides the zero


def nonminimum_phase() -> tuple[ct.StateSpace, rco.Measurement]:
    """A path with a zero at 1.5, which stage 1 inverts with one Markov parameter."""
    model = ct.ss([[0.5, 0.2], [0.0, 0.6]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]], 0.1)
    model = ct.ss(model.A, model.B, [[-5.0, 1.0]], model.D, 0.1, name="tank", outputs="level")
    rng = np.random.default_rng(0)
    w = rng.standard_normal((1, 4000))
    y, x = np.zeros((1, 4000)), np.zeros(2)
    for k in range(4000):
        y[:, k] = model.C @ x
        x = (model.A * 1.1) @ x + 1.3 * model.B @ w[:, k]
    return model, rco.Measurement(w, y, dt=0.1, output_labels="level")


@pytest.fixture(scope="module")
def diverging() -> tuple[ct.StateSpace, rco.Measurement, int]:
    model, record = nonminimum_phase()
    made = rco.RCORefiner(model, **SHORT, learning_rate=1e-3, order=4, history=True)
    with pytest.raises(rco.DivergenceError) as caught:
        made.run(record)
    sample = int(str(caught.value).split("sample ")[1].split(" ")[0])
    return model, record, sample


def test_divergence_says_when_why_and_what_to_change(
    diverging: tuple[ct.StateSpace, rco.Measurement, int],
) -> None:
    model, record, sample = diverging
    made = rco.RCORefiner(model, **SHORT, learning_rate=1e-3, order=4)
    with pytest.raises(rco.DivergenceError) as caught:
        made.run(record)
    message = str(caught.value)
    assert f"at sample {sample} (t = {sample * 0.1:.6g} s)" in message
    for word in (
        "Zeros",
        "|z| = 1.5",
        "markov (now 1",
        "Place",
        "correction_input",
        "Scaling",
        "learning_rate",
    ):
        assert word in message, word
    assert pickle.loads(pickle.dumps(caught.value)).args


def test_run_keeps_what_was_learned_before_the_divergence(
    diverging: tuple[ct.StateSpace, rco.Measurement, int],
) -> None:
    model, record, sample = diverging
    made = rco.RCORefiner(model, **SHORT, learning_rate=1e-3, order=4, history=True)
    with pytest.raises(rco.DivergenceError):
        made.run(record)
    assert made.n_learned == sample
    assert np.isfinite(made.history.z1).all()
    assert made.history.n_samples == sample
    assert np.isfinite(made.system.A).all()
    known = {name: getattr(made.scales, name) for name in ("inputs", "outputs", "states", "corrections")}
    twin = rco.RCORefiner(model, **SHORT, learning_rate=1e-3, order=4, scale=known)
    twin.update(record.inputs[:, :sample], record.outputs[:, :sample])
    np.testing.assert_array_equal(twin.theta, made.theta)


def test_update_that_diverges_changes_nothing(
    diverging: tuple[ct.StateSpace, rco.Measurement, int],
) -> None:
    model, record, _ = diverging
    made = rco.RCORefiner(
        model,
        **SHORT,
        learning_rate=1e-3,
        order=4,
        history=True,
        scale={"inputs": 1.0, "outputs": record.outputs.std()},
    )
    with pytest.raises(rco.DivergenceError) as caught:
        made.update(record.inputs, record.outputs)
    assert made.n_samples == 0
    sample = int(str(caught.value).split("sample ")[1].split(" ")[0])
    cut = sample - 10
    made.update(record.inputs[:, :cut], record.outputs[:, :cut])
    before = state_of(made)
    with pytest.raises(rco.DivergenceError, match=f"sample {sample} "):
        made.update(record.inputs[:, cut:], record.outputs[:, cut:])
    for now, then in zip(state_of(made), before, strict=True):
        np.testing.assert_array_equal(now, then)
    made.update(record.inputs[:, cut : cut + 5], record.outputs[:, cut : cut + 5])
    assert made.n_learned == cut + 5


def test_what_the_message_advises_helps(diverging: tuple[ct.StateSpace, rco.Measurement, int]) -> None:
    model, record, _ = diverging
    made = rco.RCORefiner(model, window=100, learning_rate=1e-1, order=4, markov=30, history=True).run(record)
    assert made.history.performance(3000)[0][0] < 0.5


def test_an_outlier_is_no_divergence() -> None:
    """One sensor spike of 1000 times the signal is learned through; the charge it left decays slowly."""
    example = rco.examples.rlc()
    record = example.record(4000, noise=0.01)
    y = record.outputs.copy()
    y[0, 1500] += 1000.0 * y.std()
    made = rco.RCORefiner(example.initial, dt=example.dt, history=True, **example.settings)
    made.update(record.inputs, y)
    assert made.history.performance(3000)[0][0] < 0.5


def test_a_path_whose_zeros_overflow_is_explained():
    """Numbers of a damaged state file: the pencil has no eigenvalues in double precision."""
    A = np.array([[0.9, 0.1, 0.0, 0.0], [-0.1, 0.9, 0.1, 0.0], [0.0, 0.1, 0.8, 0.1], [0.0, 0.0, -0.1, 0.7]])
    far, one, none = np.full((4, 1), 1e300), np.eye(4)[:1], np.zeros((1, 1))
    said = explain(Plant(A, far, far, one, none, none), 1, 8, 1.0, 1, "sample 3", 1.0)
    assert "cannot be computed" in said


def test_a_history_may_hold_a_model_without_poles():
    good = LinearModel.from_statespace(ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]))
    poles = poles_of([good, good.with_arrays(A=np.array([[np.nan]]))], None)
    assert poles[0, 0] == -1.0
    assert np.isnan(poles[0, 1])
