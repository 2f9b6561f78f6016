"""The record: what it keeps, what it refuses, and how it is read."""

from __future__ import annotations

import copy
import pickle
import re
import sys
import warnings

import control as ct
import numpy as np
import pandas as pd
import pytest
import scipy.io

import rcorefine as rco
from rcorefine import DataError, ExcitationWarning, Measurement, MissingExtraError


@pytest.fixture
def record() -> Measurement:
    rng = np.random.default_rng(3)
    return Measurement(
        rng.standard_normal((2, 100)),
        rng.standard_normal((3, 100)),
        timepts=5.0 + 0.02 * np.arange(100),
        hold="foh",
        input_labels=["f1", "f2"],
        output_labels=["a", "b", "c"],
        input_units=["N", "N"],
        output_units=["m", "m/s", ""],
        name="run 7",
    )


def same(a: Measurement, b: Measurement) -> bool:
    fields = ("dt", "hold", "input_labels", "output_labels", "input_units", "output_units", "name")
    return all(getattr(a, f) == getattr(b, f) for f in fields) and all(
        np.array_equal(getattr(a, f), getattr(b, f)) for f in ("inputs", "outputs", "timepts")
    )


# ---------------------------------------------------------------------- what it keeps


def test_copies_are_independent_and_read_only():
    w, y, t = np.zeros(5), np.arange(5.0), 0.1 * np.arange(5)
    data = Measurement(w, y, timepts=t)
    w[:], y[:], t[:] = 9, 9, 9
    assert data.inputs.max() == 0
    assert data.outputs[0, 4] == 4
    assert data.timepts[4] == pytest.approx(0.4)
    for array in (data.inputs, data.outputs, data.timepts):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 1
    with pytest.raises(AttributeError):
        data.dt = 2.0


def test_one_dimensional_and_two_dimensional_inputs_give_the_same():
    assert same(Measurement([1, 2, 3], [4, 5, 6], dt=1), Measurement([[1, 2, 3]], [[4, 5, 6]], dt=1))


def test_pickle_and_deepcopy_keep_everything(record):
    for twin in (pickle.loads(pickle.dumps(record)), copy.deepcopy(record), copy.copy(record)):
        assert same(twin, record)
        assert not twin.inputs.flags.writeable
        assert not twin.timepts.flags.writeable


def test_default_labels_are_python_controls():
    data = Measurement(np.zeros((2, 4)), np.zeros(4), dt=1)
    system = ct.ss([], [], [], [[0, 0]])
    assert list(data.input_labels) == system.input_labels
    assert list(data.output_labels) == system.output_labels


def test_time_from_either_or_both():
    assert Measurement([0, 1, 2], [0, 1, 2], dt=0.3).timepts == pytest.approx([0, 0.3, 0.6])
    data = Measurement([0, 1, 2], [0, 1, 2], timepts=[1.0, 1.3, 1.6])
    assert data.dt == 0.3
    assert data.timepts[0] == 1.0
    both = Measurement([0, 1, 2], [0, 1, 2], dt=0.3, timepts=[1.0, 1.3, 1.6])
    assert both.dt == 0.3
    assert both.timepts[0] == 1.0


def test_rounded_times_of_a_text_file_are_accepted_and_held_on_the_grid():
    dt = 1 / 610.35
    rounded = np.round(dt * np.arange(5000), 5)
    data = Measurement(np.zeros(5000), np.zeros(5000), timepts=rounded)
    assert data.dt == pytest.approx(dt, rel=1e-6)
    assert np.ptp(np.diff(data.timepts)) < 1e-12
    ct.forced_response(ct.tf(1, [1, 1]), data.timepts, data.inputs[0])


def test_split_keeps_true_time_and_cuts_nothing(record):
    train, test = record.split(0.7)
    assert (train.n_samples, test.n_samples) == (70, 30)
    assert test.timepts[0] == pytest.approx(5.0 + 70 * 0.02)
    assert np.array_equal(np.hstack([train.outputs, test.outputs]), record.outputs)
    assert test.hold == "foh"
    assert test.output_units == record.output_units


def test_segment_is_half_open_in_the_records_own_seconds(record):
    part = record.segment(5.2, 5.4)
    assert part.n_samples == 10
    assert np.array_equal(part.outputs, record.outputs[:, 10:20])
    assert same(record.segment(), record)
    first, second = record.segment(stop=5.5), record.segment(start=5.5)
    assert first.n_samples + second.n_samples == record.n_samples


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1, 1.5, 1e-9, float("nan")])
def test_split_refuses_an_empty_part(record, fraction):
    with pytest.raises(DataError, match="fraction"):
        record.split(fraction)


def test_segment_outside_says_where_the_record_runs(record):
    with pytest.raises(DataError, match=r"from 5 to 6.98 s"):
        record.segment(0, 1)
    with pytest.raises(ct.ControlArgument, match="seconds"):
        record.segment("0", 1)


def test_round_trip_through_python_controls_response(record):
    response = record.to_response()
    assert response.sysname == "run 7"
    assert response.output_labels == ["a", "b", "c"]
    back = Measurement.from_response(
        response, hold="foh", input_units=["N", "N"], output_units=["m", "m/s", ""]
    )
    assert same(back, record)


def test_from_response_of_a_simulation_and_its_refusals():
    system = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs="force", outputs="speed", name="cart")
    t = 0.1 * np.arange(30)
    data = Measurement.from_response(ct.forced_response(system, t, np.sin(t)), hold="foh")
    assert data.input_labels == ("force",)
    assert data.name == "cart"
    two = ct.step_response(ct.ss(-np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2))), t)
    with pytest.raises(DataError, match="2 traces"):
        Measurement.from_response(two)
    with pytest.raises(ct.ControlArgument, match="TimeResponseData"):
        Measurement.from_response(np.zeros(3))
    with pytest.raises(DataError, match="no inputs"):
        Measurement.from_response(ct.TimeResponseData([0, 1, 2], [0, 1, 2], issiso=True))


# ---------------------------------------------------------------------- what it refuses

Z = np.zeros(50)
STEPS = np.arange(50)
NAN, INF = np.where(STEPS == 17, np.nan, 0.0), np.where(STEPS == 3, -np.inf, 0.0)
TWICE, MASKED = np.r_[0:10, 9:49] * 0.1, np.ma.masked_greater(np.arange(50), 40)
SIZE, TYPE = ct.ControlDimension, ct.ControlArgument
#: Arguments besides two signals of 50 zeros and dt = 1 s; error; what it says.
BAD = [
    ({"inputs": NAN, "dt": 0.5, "input_labels": "force"}, DataError,
     r"input 'force' is NaN at sample 17 \(t = 8.5 s\)"),
    ({"outputs": [Z, INF], "output_labels": ["x", "v"]}, DataError, r"output 'v' is Inf at sample 3"),
    ({"outputs": np.zeros(49)}, SIZE, "50 samples and outputs 49"),
    ({"inputs": [[1, 2], [3]], "outputs": [1, 2]}, SIZE, "unequal lengths"),
    ({"inputs": np.zeros((50, 1))}, SIZE, r"transposed.*inputs\.T"),
    ({"outputs": np.zeros((50, 2))}, SIZE, r"2 signal.*outputs\.T"),
    ({"outputs": np.zeros((1, 1, 50))}, SIZE, r"\(1, 1, 50\)"),
    ({"dt": None}, DataError, "give dt"),
    ({"dt": 0.1, "timepts": 0.2 * STEPS}, DataError, "contradicts"),
    ({"dt": 0.01, "timepts": 10.0 * STEPS}, DataError, "contradicts"),  # milliseconds
    ({"dt": None, "timepts": np.delete(0.1 * np.arange(51), 20)}, DataError,
     r"from sample 19 to 20 \(t = 1.9 s\) it advances by 0.2 s instead of 0.1 s"),
    ({"dt": None, "timepts": TWICE}, DataError, "does not increase from sample 9"),
    ({"dt": None, "timepts": STEPS + 0.1 * np.sin(STEPS)}, DataError, "irregular"),
    ({"dt": None, "timepts": STEPS + 1e-3 * STEPS**2}, DataError, "irregular"),  # a clock that drifts
    ({"dt": None, "timepts": np.r_[np.nan, 1:50]}, DataError, "not finite at sample 0"),
    ({"dt": None, "timepts": np.arange(49)}, SIZE, r"\(49,\)"),
    ({"dt": None, "timepts": ["yesterday"] * 50}, TYPE, "seconds"),
    ({"dt": 0}, DataError, "positive"),
    ({"dt": -1.0}, DataError, "positive"),
    ({"dt": np.nan}, DataError, "positive and finite"),
    ({"dt": True}, TYPE, "seconds"),
    ({"dt": "0.1"}, TYPE, "seconds"),
    ({"inputs": [], "outputs": []}, DataError, "empty"),
    ({"inputs": np.zeros((0, 5)), "outputs": np.zeros(5)}, DataError, "empty"),
    ({"inputs": 1.0, "outputs": 1.0}, SIZE, "single number"),
    ({"outputs": 1j * Z}, TYPE, "outputs is complex"),
    ({"inputs": ["1", "2"], "outputs": [1, 2]}, TYPE, "real numbers.*'1'"),
    ({"inputs": [None, 2], "outputs": [1, 2]}, TYPE, "real numbers"),
    ({"outputs": MASKED}, DataError, r"masked at.*41"),
    ({"inputs": pd.DataFrame({"u": Z})}, TYPE, "from_frame"),
    ({"hold": "cubic"}, TYPE, "'bandlimited', not 'cubic'"),
    ({"input_labels": ["a", "b"]}, SIZE, "2 names for 1"),
    ({"inputs": [Z, Z], "input_labels": ["a", "a"]}, DataError, "'a' twice"),
    ({"input_labels": [1]}, TYPE, "strings"),
    ({"input_labels": ""}, DataError, "empty name"),
    ({"output_units": ["m", "m"]}, SIZE, "output_units"),
    ({"name": 3}, TYPE, "name"),
    ({"Ts": 1}, TypeError, "Ts"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "error", "message"), BAD)
def test_bad_input_says_what_and_where(change, error, message):
    arguments = {"inputs": Z, "outputs": Z, "dt": 1} | change
    before = copy.deepcopy(arguments)
    with pytest.raises(error, match=message):
        Measurement(**arguments)
    for key, value in before.items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(np.asarray(arguments[key]), np.asarray(value))


def test_constant_input_is_accepted_and_named_at_use():
    data = Measurement(
        [Z, np.sin(np.arange(50))], np.exp(-0.1 * np.arange(50)), dt=1, input_labels=["f", "g"]
    )
    with pytest.warns(ExcitationWarning, match="'f' = 0"):
        assert data.check_excitation() == ("f",)
    with pytest.raises(DataError, match="input 'f' is constant"):
        data.frequency_response()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Measurement(np.arange(5), np.arange(5), dt=1).check_excitation() == ()


# ---------------------------------------------------------------------- files


def test_csv_with_quotes_trailing_columns_and_text_elsewhere(tmp_path):
    path = tmp_path / "motor.csv"
    path.write_text(
        '"time, s","voltage","rpm",,\n0.00,1,10,up,\n0.01,2,20,up,\n0.02,3,30,,\n\n', encoding="utf-8-sig"
    )
    data = Measurement.from_csv(path, "voltage", ["rpm"], time="time, s", output_units="rpm")
    assert data.inputs.tolist() == [[1, 2, 3]]
    assert data.outputs.tolist() == [[10, 20, 30]]
    assert (data.dt, data.name, data.output_units) == (0.01, "motor", ("rpm",))


def test_csv_as_numpy_writes_it(tmp_path):
    path = tmp_path / "r.txt"
    np.savetxt(path, np.arange(12.0).reshape(4, 3), header="t,u,y", delimiter=",")
    assert Measurement.from_csv(path, "u", "y", time="t").dt == 3.0


@pytest.mark.parametrize(
    "text, message",
    [
        ("t,u,y\n0,1,2\n1,5\n", r"line 3, column 'y' \(3\) is missing"),
        ("t,u,y\n0,1,2\n1,abc,3\n", r"line 3, column 'u' \(2\) is not a number: 'abc'"),
        ("t,u,z\n0,1,2\n", r"line 1: no column 'y'; there are 't', 'u', 'z'"),
        ("t,u,u,y\n0,1,2,3\n", "'u' stands there twice"),
        ("t,u,y\n", "no data lines"),
        ("", "no header"),
        ("t,u,y\n0,1,2\n1,nan,3\n", "input 'u' is NaN at sample 1"),
        ("t,u,y\n0,1,2\n1,2,3\n3,2,3\n", "irregular: from sample 1 to 2"),
    ],
)
def test_csv_errors_name_line_and_column(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        Measurement.from_csv(path, "u", "y", time="t")


def test_csv_other_refusals(tmp_path):
    with pytest.raises(FileNotFoundError):
        Measurement.from_csv(tmp_path / "none.csv", "u", "y", dt=1)
    path = tmp_path / "r.csv"
    path.write_bytes(b"\xff\xfe\x00u")
    with pytest.raises(DataError, match="no column 'u'"):
        Measurement.from_csv(path, "u", "y", dt=1)
    path.write_text("u,y\n1,2\n")
    with pytest.raises(TypeError):
        Measurement.from_csv(path, "u", "y", dt=1, delimeter=",")
    with pytest.raises(ct.ControlArgument, match="column names"):
        Measurement.from_csv(path, [0], "y", dt=1)
    with pytest.raises(DataError, match="give dt"):
        Measurement.from_csv(path, "u", "y")


def test_mat_vectors_and_structures(tmp_path):
    path = tmp_path / "bench.mat"
    scipy.io.savemat(
        path,
        {
            "V1": np.arange(5.0)[:, None],
            "V2": np.arange(5.0)[None],
            "t": np.arange(5) * 0.5,
            "s": {"y": np.ones(5)},
        },
    )
    data = Measurement.from_mat(path, "V1", ["V2", "s.y"], time="t")
    assert data.dt == 0.5
    assert data.outputs.shape == (2, 5)
    assert data.name == "bench"


@pytest.mark.parametrize(
    ("names", "error", "message"),
    [
        (("v1", "V2"), DataError, re.escape("no variable 'v1'; there are: V1 1 x 5, M 3 x 3")),
        (("V1", "M"), DataError, "'M' is 3 x 3, not a vector"),
        (("V1", "note"), DataError, "'note'"),
        (("V1", "V2"), ct.ControlDimension, "'V1' 5, 'V2' 4"),
    ],
)
def test_mat_errors_help(tmp_path, names, error, message):
    path = tmp_path / "bench.mat"
    scipy.io.savemat(path, {"V1": np.arange(5.0), "M": np.ones((3, 3)), "V2": np.arange(4.0), "note": "text"})
    with pytest.raises(error, match=message):
        Measurement.from_mat(path, *names, dt=1)


def test_no_mat_file(tmp_path):
    path = tmp_path / "none.mat"
    with pytest.raises(FileNotFoundError):
        Measurement.from_mat(path, "V1", "V2", dt=1)
    path.write_bytes(b"no MATLAB file" * 20)
    with pytest.raises(DataError, match="no MATLAB file"):
        Measurement.from_mat(path, "V1", "V2", dt=1)


def test_mat_version_73_says_what_to_do(tmp_path):
    path = tmp_path / "new.mat"
    head = b"MATLAB 7.3 MAT-file".ljust(124) + (0x0200).to_bytes(2, "little") + b"IM"
    path.write_bytes(head + b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(DataError, match=r"7\.3 .*-v7"):
        Measurement.from_mat(path, "V1", "V2", dt=1)


def test_frame_columns_and_missing_values():
    frame = pd.DataFrame({"t": [0.0, 0.1, 0.2], "u": [1, 2, 3], "y": [1.0, None, 2.0], "z": [1, 2, 4]})
    data = Measurement.from_frame(frame, "u", "z", time="t")
    assert data.dt == 0.1
    assert data.outputs.tolist() == [[1, 2, 4]]
    with pytest.raises(DataError, match="'y' is missing at row 1"):
        Measurement.from_frame(frame, "u", "y", time="t")
    with pytest.raises(DataError, match="no column 'x'; there are 't', 'u', 'y', 'z'"):
        Measurement.from_frame(frame, "u", "x", dt=1)
    assert Measurement.from_frame({"u": [1, 2], "y": [3, 4]}, "u", "y", dt=1).n_samples == 2
    assert Measurement.from_frame({"u [V]": [1, 2], "y": [3, 4]}, "u", "y", dt=1).input_labels == ("u",)
    with pytest.raises(ct.ControlArgument, match="DataFrame"):
        Measurement.from_frame([1, 2], "u", "y", dt=1)


def test_frame_without_pandas_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match=r"rcorefine\[pandas\]"):
        Measurement.from_frame({"u": [1, 2], "y": [3, 4]}, "u", "y", dt=1)


# ---------------------------------------------------------------------- what it shows


def test_tables_fit_80_columns_and_escape(record):
    assert all(len(line) <= 80 for line in str(record).splitlines())
    assert "run 7" in str(record)
    assert "m/s" in str(record)
    assert "100 samples" in repr(record)
    data = rco.Measurement(Z, Z, dt=1, name="<script>", input_labels="<b>" + "long" * 40)
    assert "<script>" not in data._repr_html_()
    assert "&lt;script&gt;" in data._repr_html_()
    assert all(len(line) <= 80 for line in str(data).splitlines())


def test_plot_is_a_control_plot_and_draws_on_given_axes(record):
    cplt = record.plot()
    assert cplt.axes.shape == (5, 1)
    assert cplt.figure.get_figwidth() == 7
    again = record.plot(ax=cplt.axes, label="again", show_legend=True)
    assert again.figure is cplt.figure
    assert len(cplt.axes[0, 0].lines) == 2
    assert again.legend is not None
    with pytest.raises(ct.ControlDimension, match="ax"):
        record.plot(ax=cplt.axes[:2])
