"""What users hand over and have set: flags, validation records, executors, names, NumPy's errors."""

from __future__ import annotations

import pickle

import control as ct
import numpy as np
import pytest
from inner import Engine, Structure, main
from test_report import code_of

import rcorefine as rco
from rcorefine.exceptions import own_arithmetic
from rcorefine.views import code as listing


def motor(friction=0.02, **options):
    return rco.mass_spring_damper(
        [0.4, 0.9], [friction, 0.3], [25.0, 60.0], sensors="displacement", **options
    )


def record(model, n=900, seed=8, noise=0.02, **options):
    rng = np.random.default_rng(seed)
    w = 3 * np.repeat(rng.standard_normal(n // 3), 3)
    blank = rco.Measurement(w, np.zeros((model.linear.n_outputs, n)), dt=0.02)
    y = rco.simulate(model, blank, "zero").outputs
    y = y + noise * y.std() * rng.standard_normal(y.shape)
    names = {"input_labels": model.linear.input_labels, "output_labels": model.linear.output_labels}
    return rco.Measurement(w, y, dt=0.02, **{**names, **options})


@pytest.fixture(scope="module")
def data():
    return record(motor())


LAWS = [rco.Effect("stiffness", "link1"), rco.Effect("damping", "link2")]
CALLS = {
    "refine": lambda model, data, **k: rco.refine(model, data, LAWS[:1], **k),
    "diagnose": lambda model, data, **k: rco.diagnose(model, data, candidates=LAWS, **k),
    "improve": lambda model, data, **k: rco.improve(model, data, candidates=LAWS, **k),
    "localize_damage": rco.localize_damage,
}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("flag", ["no", "False", 0, 1.0, None, np.array([True])])
def test_a_flag_is_true_or_false(name, flag, data):
    with pytest.raises(ct.ControlArgument, match="offset must be True or False"):
        CALLS[name](motor(), data, offset=flag)


@pytest.mark.parametrize("name", ["diagnose", "improve"])
@pytest.mark.parametrize("wrong", ["x", 0, [1.0], np.ones((2, 50))])
def test_a_validation_record_is_looked_at_where_nothing_is_missing_too(name, wrong, data):
    with pytest.raises(ct.ControlArgument, match="validation must be a Measurement"):
        CALLS[name](motor(), data, validation=wrong)
    other = record(motor(), 300, input_labels="voltage")
    with pytest.raises(ct.ControlDimension, match="voltage"):
        CALLS[name](motor(), data, validation=other)


@pytest.mark.parametrize("bound", [{"start": float("nan")}, {"stop": np.float64("nan")}])
def test_a_segment_has_no_bound_that_is_nan(bound, data):
    with pytest.raises(rco.DataError, match="must be finite"):
        data.segment(**bound)


# ------------------------------------------------------------------ executors
class Carrier:
    """An executor that sends everything by pickle and lets nothing compiled pass."""

    sent = 0

    def map(self, function, tasks):
        for task in tasks:
            parcel = pickle.dumps(task)
            assert b"numba" not in parcel
            self.sent += 1
            back = pickle.dumps(function(pickle.loads(parcel)))
            assert b"numba" not in back
            yield pickle.loads(back)


class Client:
    """As dask's: its own `map` returns futures, its executor results."""

    def __init__(self):
        self.carrier = Carrier()

    def get_executor(self):
        return self.carrier

    def map(self, function, tasks):
        raise AssertionError("futures")


@pytest.mark.parametrize("kind", [Carrier, Client])
def test_work_travels_without_compiled_code(kind):
    """Rivals refitted elsewhere are those refitted here, and no kernel is in the parcel."""
    data = record(motor(0.5), 600, seed=21)
    candidates = [rco.Effect(law, f"link{i}") for law in ("damping", "coulomb_friction") for i in (1, 2)]
    here = rco.diagnose(motor(), data, candidates=candidates)
    executor = kind()
    there = rco.diagnose(motor(), data, candidates=candidates, executor=executor)
    assert getattr(executor, "carrier", executor).sent > 0
    assert str(there) == str(here)


def test_a_pickled_engine_takes_the_kernel_of_its_new_process(data):
    structure = Structure(motor(), [rco.Effect("cubic_stiffness", "link2")])
    engine = Engine(structure, data, substeps=2)
    again = pickle.loads(pickle.dumps(engine))
    theta = np.array([400.0])
    np.testing.assert_array_equal(again.run(theta).outputs, engine.run(theta).outputs)


@pytest.mark.parametrize("wrong", ["processes", 4, object()])
def test_an_executor_is_one(wrong, data):
    with pytest.raises(ct.ControlArgument, match="executor must be"):
        rco.diagnose(motor(), data, candidates=LAWS, executor=wrong)


# ------------------------------------------------------------------ NumPy's errors
def test_numpy_may_raise_on_everything(data):
    """What underflows on the way is none of the user's errors, and his setting stays."""
    friction = record(motor(), 600, seed=3)
    candidates = [rco.Effect(law, "link2") for law in ("coulomb_friction", "stiffness", "hysteresis")]
    with np.errstate(all="raise"):
        before = np.geterr()
        rco.refine(motor(), friction, candidates[:1])
        rco.diagnose(motor(0.6), friction, candidates=candidates)
        rco.improve(motor(0.6), friction, candidates=candidates, max_effects=1)
        rco.localize_damage(motor(), data)
        rco.Monitor(motor(), dt=0.02, learn=400).run(data)
        assert np.geterr() == before


def test_blas_has_one_thread_while_anybody_computes():
    """Of two callers that overlap, the last one restores the number, whatever the order."""
    pools = pytest.importorskip("threadpoolctl", reason="the extra fast is not installed")

    def threads():
        return {pool["num_threads"] for pool in pools.threadpool_info() if pool["user_api"] == "blas"}

    with pools.threadpool_limits(2, "blas"):
        before = threads()
        one, other = own_arithmetic(), own_arithmetic()
        one.__enter__()
        other.__enter__()
        one.__exit__(None, None, None)
        assert threads() == {1}
        other.__exit__(None, None, None)
        assert threads() == before
        with pytest.raises(ZeroDivisionError), own_arithmetic():
            1 / 0  # noqa: B018
        assert threads() == before


# ------------------------------------------------------------------ names in scripts
@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("end", ["\n", "\r", "\r\n", "\x0c", "\u2028"])
def test_a_line_break_in_a_name_begins_no_line_of_code(end, tmp_path, monkeypatch):
    code = f"a{end}raise SystemError('live')  #"
    exec(compile(listing.comment(code), "comment", "exec"), {})
    assert len(listing.comment(code).splitlines()) == 1
    effect = rco.Effect("custom", "link1", law=lambda d, v: d, name=code)
    listed = listing.effects_code([effect]).replace("...", "0")
    exec(compile(listed, "effects", "exec"), {})
    if end == "\n":
        monkeypatch.chdir(tmp_path)
        model = tmp_path / f"model{end}raise SystemError('live')  #.toml"
        model.write_text("[series_rlc]\nR = 2.0\nL = 0.1\nC = 0.01\n")
        circuit = rco.series_rlc(2.0, 0.1, 0.01)
        found = record(circuit, 300)
        np.savez(
            "r.npz", **{found.input_labels[0]: found.inputs[0], found.output_labels[0]: found.outputs[0]}
        )
        assert main(["compare", model.name, "r.npz", "--dt", "0.02", "--report", "r.html"]) == 0
        head = code_of(tmp_path / "r.html").split("from hashlib", 1)[0]
        exec(compile(head, "report", "exec"), {})


# ------------------------------------------------------------------ measured responses
PLOTS = {
    "bode": ct.bode_plot,
    "nyquist": ct.nyquist_plot,
    "singular values": ct.singular_values_plot,
    "responses": lambda pair: ct.FrequencyResponseList(
        [ct.frequency_response(pair[0], pair[1].omega), pair[1]]
    ).plot(),
}


@pytest.mark.parametrize("plot", PLOTS)
def test_measured_responses_pass_where_python_control_takes_its_own(plot):
    model = rco.series_rlc(2.0, 0.1, 0.01)
    data = record(model, 1500, name="run.3", output_labels="board.current")
    measured = data.frequency_response()
    assert isinstance(measured, ct.FrequencyResponseData)
    drawn = PLOTS[plot]([model.system, measured])
    points = np.concatenate([np.ravel(line.get_ydata()) for line in np.ravel(drawn.lines)[-1]])
    assert points.size >= measured.omega.size


def test_measured_responses_compute_with_systems():
    model = rco.series_rlc(2.0, 0.1, 0.01)
    measured = record(model, 1500, noise=0.0).frequency_response()
    ratio = measured / ct.frequency_response(model.system, measured.omega)
    np.testing.assert_allclose(
        ratio.frdata, measured.response / model.system(1j * measured.omega, squeeze=False), rtol=1e-12
    )
    again = ct.frd(measured)
    np.testing.assert_array_equal(again.frdata, measured.response)
