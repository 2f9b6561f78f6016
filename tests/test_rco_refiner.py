"""RCORefiner as a stream: blocks, units, labels, prediction, history, memory."""

from __future__ import annotations

import copy
import pickle
import warnings
from typing import Any

import control as ct
import numpy as np
import pytest

import rcorefine as rco

Array = np.ndarray


def two_by_two(dt: float | None = None) -> ct.StateSpace:
    """Two masses, two forces, at each mass a sensor of velocity and some displacement, well damped."""
    M = np.diag([1.0, 2.0])
    K = np.array([[300.0, -100.0], [-100.0, 150.0]])
    C = np.array([[9.0, -4.0], [-4.0, 7.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    B = np.vstack([np.zeros((2, 2)), np.linalg.inv(M)])
    sys = ct.ss(
        A,
        B,
        np.hstack([5.0 * np.eye(2), np.eye(2)]),
        np.zeros((2, 2)),
        inputs=["f1", "f2"],
        outputs=["v1", "v2"],
        states=["x1", "x2", "v1", "v2"],
        name="chain",
    )
    return sys if dt is None else sys.sample(dt, name="chain")


def damaged(sys: ct.StateSpace) -> ct.StateSpace:
    """The discrete model with less stiffness at mass 1 and more damping at mass 2, exactly matched by B."""
    change = np.array([[120.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -3.5]])
    return ct.ss(sys.A + sys.B @ change, sys.B, sys.C, sys.D, sys.dt)


def record_of(sys: ct.StateSpace, n: int = 3000, seed: int = 0) -> rco.Measurement:
    """Response of a discrete model to forces of very different size."""
    rng = np.random.default_rng(seed)
    w = rng.standard_normal((2, n)) * np.array([[3.0], [500.0]])
    y, x = np.zeros((2, n)), np.zeros(sys.nstates)
    for k in range(n):
        y[:, k] = sys.C @ x + sys.D @ w[:, k]
        x = sys.A @ x + sys.B @ w[:, k]
    return rco.Measurement(w, y, dt=sys.dt, input_labels=["f1", "f2"], output_labels=["v1", "v2"])


DT = 0.02
SETTINGS: dict[str, Any] = {"order": 3, "window": 60, "learning_rate": 1.0}


@pytest.fixture(scope="module")
def data() -> rco.Measurement:
    return record_of(damaged(two_by_two(DT)))


def state_of(refiner: rco.RCORefiner) -> list[Array]:
    """Everything a call could have changed."""
    memory = refiner._estimator.memory
    arrays = [array.copy() for stage in memory.stages for array in stage]
    arrays += [memory.peak.copy(), memory.levels.copy(), memory.inputs.copy(), memory.outputs.copy()]
    return [
        *arrays,
        memory.recent_theta.copy(),
        np.array([memory.n_samples, len(refiner._estimator.records)]),
    ]


# -- stream ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("cut", [1, 7, 59, 60, 61, 1000])
def test_blocks_equal_samples(data: rco.Measurement, cut: int) -> None:
    """However the stream is cut, also within the samples that are held back for the scales."""
    n = 700
    whole = rco.RCORefiner(two_by_two(), dt=DT, static_average=20, history=True, **SETTINGS)
    whole.update(data.inputs[:, :n], data.outputs[:, :n])
    parts = rco.RCORefiner(two_by_two(), dt=DT, static_average=20, history=True, **SETTINGS)
    for k in range(0, n, cut):
        result = parts.update(data.inputs[:, k : min(k + cut, n)], data.outputs[:, k : min(k + cut, n)])
        assert result is None
    assert parts.n_learned == whole.n_learned == n
    for name in ("theta", "static_theta"):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), rtol=1e-12)
    for name in ("z1", "z2", "theta1", "theta2", "x", "y", "timepts"):
        ours, theirs = getattr(parts.history, name), getattr(whole.history, name)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * max(np.abs(theirs).max(), 1e-300))


def test_one_sample_may_be_a_number_or_a_vector() -> None:
    example = rco.examples.rlc()
    record = example.record(300)
    block = rco.RCORefiner(example.initial, dt=example.dt)
    block.update(record.inputs, record.outputs)
    block_1d = rco.RCORefiner(example.initial, dt=example.dt)
    block_1d.update(record.inputs[0], record.outputs[0])
    numbers = rco.RCORefiner(example.initial, dt=example.dt)
    for w, y in zip(record.inputs[0], record.outputs[0], strict=True):
        numbers.update(w, y)
    np.testing.assert_array_equal(block.theta, block_1d.theta)
    np.testing.assert_allclose(numbers.theta, block.theta, rtol=1e-12)
    assert numbers.n_samples == 300


def test_run_is_update_over_the_record(data: rco.Measurement) -> None:
    run = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS)
    assert run.run(data) is run
    update = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS)
    update.update(data.inputs, data.outputs)
    np.testing.assert_allclose(run.theta, update.theta, rtol=1e-12)


def test_matched_change_is_found_with_two_inputs_and_outputs(data: rco.Measurement) -> None:
    """A change in the columns of B_u is found exactly, although the sensors see no state alone."""
    refiner = rco.RCORefiner(two_by_two(), dt=DT, **{**SETTINGS, "learning_rate": 0.01}).run(data)
    true = damaged(two_by_two(DT))
    np.testing.assert_allclose(refiner.discrete_system.A, true.A, atol=1e-3)
    np.testing.assert_allclose(refiner.discrete_system.B, true.B, atol=1e-5)


def test_reset_forgets(data: rco.Measurement) -> None:
    refiner = rco.RCORefiner(two_by_two(), dt=DT, history=True, **SETTINGS)
    fresh = state_of(refiner)
    refiner.run(data)
    first = refiner.theta
    refiner.reset()
    for ours, theirs in zip(state_of(refiner), fresh, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert refiner.history.n_samples == 0
    np.testing.assert_array_equal(refiner.run(data).theta, first)


def test_memory_is_constant_without_history() -> None:
    example = rco.examples.rlc()
    for settings in (example.settings, {}):
        refiner = rco.RCORefiner(example.initial, dt=example.dt, **settings)
        sizes = []
        for seed in range(3):
            record = example.record(4096, rng=seed)  # whole stretches of the race
            refiner.update(record.inputs, record.outputs)
            sizes.append(len(pickle.dumps(refiner)))
        assert max(sizes) - min(sizes) < 100


def test_input_arrays_are_left_alone(data: rco.Measurement) -> None:
    w, y = data.inputs.copy(), data.outputs.copy()
    refiner = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS)
    refiner.update(w, y)
    np.testing.assert_array_equal(w, data.inputs)
    np.testing.assert_array_equal(y, data.outputs)


# -- scales ----------------------------------------------------------------------------------------


def test_units_do_not_matter(data: rco.Measurement) -> None:
    """Whatever the units (powers of two, so that nothing is rounded): the same model comes out."""
    sys = two_by_two(DT)
    into, out, inside = 2.0 ** np.array([10, -7]), 2.0 ** np.array([-9, 5]), 2.0 ** np.array([-14, 2, 7, 3])
    other = ct.ss(
        sys.A * inside[:, None] / inside,
        sys.B * inside[:, None] / into,
        sys.C * out[:, None] / inside,
        sys.D * out[:, None] / into,
        DT,
    )
    plain = rco.RCORefiner(sys, dt=DT, **SETTINGS)
    plain.update(data.inputs, data.outputs)
    changed = rco.RCORefiner(other, dt=DT, **SETTINGS)
    changed.update(data.inputs * into[:, None], data.outputs * out[:, None])
    back = changed.static_theta * np.concatenate([inside, into]) / into[:, None]
    np.testing.assert_allclose(back, plain.static_theta, rtol=1e-12)


def test_unit_of_the_correction_does_not_matter(data: rco.Measurement) -> None:
    b_u = two_by_two().B
    plain = rco.RCORefiner(two_by_two(), dt=DT, correction_input=b_u, **SETTINGS).run(data)
    changed = rco.RCORefiner(two_by_two(), dt=DT, correction_input=b_u * [2.0**-10, 16.0], **SETTINGS).run(
        data
    )
    np.testing.assert_allclose(changed.system.A, plain.system.A, rtol=1e-6, atol=1e-7)


def test_first_samples_are_held_back_then_learned(data: rco.Measurement) -> None:
    refiner = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS)
    refiner.update(data.inputs[:, :59], data.outputs[:, :59])
    assert (refiner.n_samples, refiner.n_learned, refiner.scales) == (59, 0, None)
    np.testing.assert_array_equal(refiner.system.A, two_by_two().A)
    assert "held back" in str(refiner)
    refiner.update(data.inputs[:, 59], data.outputs[:, 59])
    assert refiner.n_learned == 60
    np.testing.assert_allclose(refiner.scales.inputs, np.sqrt(np.mean(data.inputs[:, :60] ** 2, axis=1)))


def test_quiet_start_is_waited_for() -> None:
    """A record that begins at rest: scales come from where something happens."""
    example = rco.examples.rlc()
    record = example.record(3000)
    w = np.concatenate([np.zeros((1, 150)), record.inputs], axis=1)
    y = np.concatenate([np.zeros((1, 150)), record.outputs], axis=1)
    refiner = rco.RCORefiner(example.initial, dt=example.dt, **example.settings)
    refiner.update(w[:, :200], y[:, :200])
    assert refiner.n_learned == 0
    refiner.update(w[:, 200:], y[:, 200:])
    assert refiner.n_learned == 3150
    inductance = 250.0 / float((refiner.system.C @ refiner.system.B)[0, 0])
    assert inductance == pytest.approx(55e-3, rel=1e-4)


def test_short_record_is_learned_at_its_end() -> None:
    example = rco.examples.rlc()
    refiner = rco.RCORefiner(example.initial, dt=example.dt, **example.settings).run(example.record(70))
    assert refiner.n_learned == 70
    assert refiner.theta.any()


def test_declared_scales_learn_from_the_first_sample(data: rco.Measurement) -> None:
    scale = {"inputs": [3.0, 500.0], "outputs": 10.0}
    refiner = rco.RCORefiner(two_by_two(), dt=DT, scale=scale, **SETTINGS)
    refiner.update(data.inputs[:, 0], data.outputs[:, 0])
    assert refiner.n_learned == 1
    np.testing.assert_array_equal(refiner.scales.outputs, [10.0, 10.0])
    refiner.update(data.inputs[:, 1:], data.outputs[:, 1:])
    assert np.isfinite(refiner.theta).all()


# -- systems ---------------------------------------------------------------------------------------


def test_continuous_in_continuous_out(data: rco.Measurement) -> None:
    refiner = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS).run(data)
    system, discrete = refiner.system, refiner.discrete_system
    assert (system.dt, discrete.dt) == (0, DT)
    for found in (system, discrete):
        assert found.input_labels == ["f1", "f2"]
        assert found.output_labels == ["v1", "v2"]
        assert found.state_labels == ["x1", "x2", "v1", "v2"]
    np.testing.assert_allclose(system.sample(DT).A, discrete.A, atol=1e-9)
    np.testing.assert_allclose(system.sample(DT).B, discrete.B, atol=1e-9)


def test_discrete_in_discrete_out(data: rco.Measurement) -> None:
    refiner = rco.RCORefiner(two_by_two(DT), **SETTINGS).run(data)
    assert refiner.system.dt == DT
    continuous = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS).run(data)
    np.testing.assert_allclose(refiner.system.A, continuous.discrete_system.A, atol=1e-4)


@pytest.mark.parametrize("dt", [True, None])
def test_indefinite_timebase_is_kept(data: rco.Measurement, dt: Any) -> None:
    sys = two_by_two(DT)
    loose = ct.ss(sys.A, sys.B, sys.C, sys.D, dt, inputs=["f1", "f2"], outputs=["v1", "v2"])
    refiner = rco.RCORefiner(loose, **SETTINGS).run(data)
    assert refiner.system.dt is dt
    assert rco.RCORefiner(loose, dt=DT, **SETTINGS).run(data).system.dt == DT


def test_refined_model_is_the_initial_one_in_feedback(data: rco.Measurement) -> None:
    """A + B_u theta_x, B + B_u theta_w, C + D_u theta_x, D + D_u theta_w, with any B_u and D_u."""
    rng = np.random.default_rng(3)
    discrete = two_by_two(DT)
    b_u, d_u = 0.8 * discrete.B, 0.1 * np.eye(2)
    refiner = rco.RCORefiner(
        discrete, correction_input=b_u, correction_feedthrough=d_u, **{**SETTINGS, "learning_rate": 100.0}
    )
    refiner.update(data.inputs[:, :300], data.outputs[:, :300])
    theta = refiner.static_theta
    on_x, on_w = theta[:, :4], theta[:, 4:]
    found = refiner.system
    for ours, theirs in (
        (found.A, discrete.A + b_u @ on_x),
        (found.B, discrete.B + b_u @ on_w),
        (found.C, discrete.C + d_u @ on_x),
        (found.D, discrete.D + d_u @ on_w),
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    x, w = rng.standard_normal(4), rng.standard_normal(2)
    u = theta @ np.concatenate([x, w])
    np.testing.assert_allclose(
        found.A @ x + found.B @ w, discrete.A @ x + discrete.B @ w + b_u @ u, rtol=1e-10
    )


def test_refined_systems_go_on_in_python_control(data: rco.Measurement) -> None:
    refiner = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS).run(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ct.bode_plot(refiner.system)
        ct.nyquist_plot(refiner.system[0, 0])
    assert ct.feedback(refiner.system[0, 0], 1).nstates == 4
    assert refiner.system.sample(0.01).dt == 0.01
    assert copy.deepcopy(refiner.system).name == refiner.system.name == "chain$refined"


def test_static_gain_model() -> None:
    """No state at all: the correction acts through D_u, d = 0."""
    rng = np.random.default_rng(0)
    w = rng.standard_normal((1, 400))
    refiner = rco.RCORefiner(ct.ss([], [], [], [[2.0]], 0.1), order=0, learning_rate=1.0)
    refiner.update(w, 3.0 * w)
    assert refiner.system.D[0, 0] == pytest.approx(3.0, rel=1e-6)


def test_physical_models_are_taken_as_they_are() -> None:
    model = rco.mass_spring_damper([1.0], [1.0, 0.0], [200.0, 0.0])
    data = record_of_one(model.system)
    refiner = rco.RCORefiner(model, dt=0.05, **SETTINGS).run(data)
    assert refiner.discrete_system.state_labels == list(model.system.state_labels)


def record_of_one(sys: ct.StateSpace) -> rco.Measurement:
    rng = np.random.default_rng(1)
    w = rng.standard_normal((sys.ninputs, 500))
    response = ct.forced_response(sys.sample(0.05), inputs=w)
    return rco.Measurement(
        w,
        np.atleast_2d(response.outputs),
        dt=0.05,
        input_labels=list(sys.input_labels),
        output_labels=list(sys.output_labels),
    )


# -- prediction ------------------------------------------------------------------------------------


def test_predict_is_a_free_run_from_the_present_state(data: rco.Measurement) -> None:
    refiner = rco.RCORefiner(two_by_two(), dt=DT, **{**SETTINGS, "learning_rate": 0.01})
    refiner.update(data.inputs[:, :2500], data.outputs[:, :2500])
    before = state_of(refiner)
    predicted = refiner.predict(data.inputs[:, 2500:])
    error = np.linalg.norm(predicted - data.outputs[:, 2500:]) / np.linalg.norm(data.outputs[:, 2500:])
    assert predicted.shape == (2, 500)
    assert error < 0.05
    for ours, theirs in zip(state_of(refiner), before, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_predict_before_learning_is_the_initial_model() -> None:
    example = rco.examples.rlc()
    record = example.record(90)
    refiner = rco.RCORefiner(example.initial, dt=example.dt)
    expected = example.simulate(record.inputs, model="initial").outputs
    np.testing.assert_allclose(refiner.predict(record.inputs), expected, rtol=1e-9, atol=1e-12)
    refiner.update(record.inputs[:, :20], record.outputs[:, :20])
    np.testing.assert_allclose(refiner.predict(record.inputs[0, 20:]), expected[20:], rtol=1e-9, atol=1e-12)


# -- what is shown ---------------------------------------------------------------------------------


def test_history_needs_to_be_asked_for(data: rco.Measurement) -> None:
    with pytest.raises(rco.RCOError, match="history=True"):
        _ = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS).run(data).history


def test_history_shapes_and_plot(data: rco.Measurement) -> None:
    refiner = rco.RCORefiner(two_by_two(), dt=DT, history=True, static_average=1, **SETTINGS).run(data)
    h = refiner.history
    assert h.z1.shape == h.z2.shape == h.y.shape == (2, 3000)
    assert h.theta1.shape == (2, 4 * 6 + 3 * 2, 3000)
    assert h.theta2.shape == (2, 6, 3000)
    assert h.x.shape == (4, 3000)
    np.testing.assert_allclose(h.timepts, data.timepts, atol=1e-9)
    np.testing.assert_array_equal(h.theta2[:, :, -1], refiner.static_theta)
    np.testing.assert_array_equal(h.y, data.outputs)
    assert h.poles.shape == (4, 200)
    cplt = h.plot(title="course")
    assert cplt.axes.shape == (4, 1)
    with pytest.raises(AttributeError):
        h.z1 = h.z2  # frozen
    assert np.isnan(h.performance(5000)[0]).all()


def test_bode_plot_with_and_without_the_measured_response(data: rco.Measurement) -> None:
    refiner = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS).run(data)
    assert refiner.bode_plot().axes.shape == (4, 2)
    assert refiner.bode_plot(data, title="chain").axes.shape == (6, 2)


def test_text_and_html(data: rco.Measurement) -> None:
    refiner = rco.RCORefiner(two_by_two(), dt=DT, **SETTINGS).run(data)
    lines = str(refiner).splitlines()
    assert 10 <= len(lines) <= 20
    assert max(map(len, lines)) <= 80
    assert "alpha" in str(refiner)
    assert "3000 samples" in repr(refiner)


def test_survives_pickle_and_deepcopy(data: rco.Measurement) -> None:
    refiner = rco.RCORefiner(two_by_two(), dt=DT, history=True, **SETTINGS)
    refiner.update(data.inputs[:, :500], data.outputs[:, :500])
    for twin in (pickle.loads(pickle.dumps(refiner)), copy.deepcopy(refiner)):
        np.testing.assert_array_equal(twin.theta, refiner.theta)
        twin.update(data.inputs[:, 500:600], data.outputs[:, 500:600])
        assert (twin.n_samples, refiner.n_samples) == (600, 500)
        assert isinstance(twin.model, ct.StateSpace)
        assert pickle.loads(pickle.dumps(refiner.history)).n_samples == 500
    refiner.update(data.inputs[:, 500:600], data.outputs[:, 500:600])
    np.testing.assert_array_equal(twin.theta, refiner.theta)


@pytest.mark.parametrize("samples", [1, 40])
def test_a_call_that_raises_changes_none_of_the_forms(monkeypatch: pytest.MonkeyPatch, samples: int) -> None:
    """The second form of the race runs out of memory; the same samples go in afterwards as if it had not."""
    from inner import CoefficientFilter

    example = rco.examples.rlc()
    data = example.record(300)
    w, y = data.inputs, data.outputs
    fine = rco.RCORefiner(example.initial, dt=example.dt)
    tried = rco.RCORefiner(example.initial, dt=example.dt)
    for refiner in (fine, tried):
        refiner.update(w[:, :100], y[:, :100])
    take, calls = CoefficientFilter.take, []

    def once(self: Any, block: Any, **how: Any) -> Any:
        calls.append(self)
        if len(calls) == 2:
            raise MemoryError("forced")
        return take(self, block, **how)

    def feed() -> None:
        for k in range(100, 140, samples):
            tried.update(w[:, k : k + samples], y[:, k : k + samples])

    with monkeypatch.context() as patch:
        patch.setattr(CoefficientFilter, "take", once)
        with pytest.raises(MemoryError):
            feed()
    at = tried.n_samples
    assert at == (100 if samples > 1 else 132)  # single samples wait for one another
    if at > 100:
        fine.update(w[:, 100:at], y[:, 100:at])
    for refiner in (fine, tried):
        refiner.update(w[:, at:], y[:, at:])
    np.testing.assert_array_equal(tried.system.A, fine.system.A)
    assert tried.n_samples == fine.n_samples == 300
