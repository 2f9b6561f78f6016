"""Files as labs write them: what is read, what is said of it, what is refused by name."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest

import rcorefine as rco
from rcorefine import DataError, Measurement, MissingExtraError

SEMICOLONS = "Prüfstand 3;;\nDatum;12.03.2024;\n\nt;U;n\ns;V;rpm\n0,00;1,5;0\n0,01;1,5;-2,25\n0,02;0;1e1\n"


def read(tmp_path, text, *columns, encoding="utf-8", **options):
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode(encoding))
    inputs, outputs = columns or ("u", "y")
    return Measurement.from_csv(path, inputs, outputs, **({"dt": 0.01} | options))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1"])
def test_semicolons_decimal_commas_units_and_a_preamble(tmp_path, encoding):
    data = read(tmp_path, SEMICOLONS, "U", "n", encoding=encoding, time="t", dt=None)
    assert data.dt == 0.01
    assert data.inputs.tolist() == [[1.5, 1.5, 0]]
    assert data.outputs.tolist() == [[0, -2.25, 10]]
    assert (data.input_units, data.output_units) == (("V",), ("rpm",))
    assert "header in line 4, units in line 5, cells separated by semicolon, decimal comma" in data.notes[0]
    assert ("Latin-1" in data.notes[0]) == (encoding == "latin-1")
    assert data.notes[0] in " ".join(str(data).split())
    assert data.split(0.7)[1].notes == data.segment(0.01).notes == data.with_hold("foh").notes == data.notes


@pytest.mark.parametrize(
    "header, unit", [("F [N]", "N"), ("F (mN)", "mN"), ("F / N", "N"), ("F [m/s²]", "m/s²"), ("F", "")]
)
def test_units_in_the_header(tmp_path, header, unit):
    data = read(tmp_path, f"t;{header};y\n0;1;2\n1;2;3\n", "F", "y")
    assert (data.input_labels, data.input_units) == (("F",), (unit,))
    assert read(tmp_path, f"{header};y\n1;2\n2;3\n", header, "y").inputs.tolist() == [[1, 2]]
    assert read(tmp_path, f"{header};y\n1;2\n2;3\n", "F", "y", input_units="kN").input_units == ("kN",)


@pytest.mark.parametrize("unit, step", [("ms", 1e-3), ("s", 1.0), ("µs", 1e-6), ("min", 60.0)])
def test_times_are_brought_to_seconds_and_it_is_said(tmp_path, unit, step):
    data = read(tmp_path, f"t ({unit})\tu\ty\n0\t1\t2\n5\t1\t2\n10\t1\t4\n", time="t", dt=None)
    np.testing.assert_allclose(data.dt, 5 * step, rtol=1e-12)
    assert any(f"from {unit} to s" in note for note in data.notes) == (unit != "s")


def test_labview(tmp_path):
    text = (
        "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t,\nTime\t10:11:12,5\n"
        "***End_of_Header***\t\n\t\nChannels\t2\nSamples\t3\t3\nX0\t0,0\t0,0\nDelta_X\t0,001\t0,001\n"
        "***End_of_Header***\t\t\t\nX_Value\tVoltage\tSpeed\tComment\n0,0000\t1,25\t0,5\tstart\n"
        "0,0010\t-1,25\t0,75\n0,0020\t0,0\t1,0\n"
    )
    data = read(tmp_path, text, "Voltage", "Speed", time="X_Value", dt=None)
    assert data.dt == 0.001
    assert data.inputs.tolist() == [[1.25, -1.25, 0]]
    assert data.outputs.tolist() == [[0.5, 0.75, 1]]


@pytest.mark.parametrize(
    "text",
    [
        "ets Jun  8 2016 00:22:57\nrst:0x1 (POWERON_RESET)\n.3,2\nu,y\n1,2.5\n3,4\n",
        "u y\n  1   2.5 \n  3   4 \n",
        "u|y\n1|2.5\n3|4\n",
        "u\ty\n1\t2.5\n3\t4\n",
        '"u","y"\n"1","2.5"\n"3","4"\n',
        '"u","y"\n"1,0","2,5"\n"3,0","4,00"\n',
        "% a log of u and y\n% u y\n1 2.5\n3 4\n",
    ],
)
def test_other_tables(tmp_path, text):
    data = read(tmp_path, text)
    assert data.inputs.tolist() == [[1, 3]]
    assert data.outputs.tolist() == [[2.5, 4]]


def test_a_file_without_a_header(tmp_path):
    data = read(tmp_path, "boot 1 2\n0.5 1 2\n0.6 3 4\n", header=["t", "u", "y"], time="t", dt=None)
    assert data.inputs.tolist() == [[1, 3]]
    assert "names by header=, 1 lines skipped" in data.notes[0]


@pytest.mark.parametrize(
    "text, options, message",
    [
        ("u;y\n1,234;5,678\n2,345;6,789\n", {}, "decimal comma or a separator of thousands.*give decimal="),
        ("u;y\n1.234,5;1\n2,5;2\n", {}, r"not a number: '1\.234,5'"),
        ("u;y\n1,5;1\n2.5;2\n2,5;2.5\n", {}, "comma and point cannot both"),
        ("u;y\n1,5;1\n2;2\n2.5;2\n", {}, r"line 4, column 'u' .* not a number: '2\.5' .*decimal="),
        ("u,y\n1,5,2,5\n2,5,3,5\n", {}, "line 2 has 4 cells and the header 2 .decimal commas between"),
        ("F [N];F [kN];y\n1;2;3\n", {"inputs": "F"}, r"'F' could be 'F \[N\]' or 'F \[kN\]'"),
        ("u;y\noff;off\n1;2\n", {}, "line 2, column 'u' .* not a number: 'off'"),
        ("u;y\nV;rpm\nV;rpm\n1;2\n", {}, "line 3, column 'u'|line 2, column 'u'"),
        ("t [furlong];u;y\n0;1;2\n1;1;2\n", {"time": "t", "dt": None}, "no column 't'"),
        ("t [V];u;y\n0;1;2\n1;1;2\n", {"time": "t", "dt": None}, "times is in 'V', not in one of s"),
        ("u y\n1 2\nu y\n1 2\n", {}, "line 3, column 'u' .* not a number"),
        ("1;2\n3;4\n", {}, "no column 'u'"),
        ("1;2\n3;4\n", {"header": ["a", "u", "y"]}, "no line of 3 cells"),
        ("1;2\n3;4\n", {"header": ["a", "b"]}, "header= for .*no column 'u'"),
        ("u;y\n1;2\n\0;4\n", {}, "UTF-8 or Latin-1"),
        ("u;y\n0;1\n;2\n", {}, r"line 3, column 'u' \(1\) is missing"),
        ("u;y\n0;1\n\n3;2\n", {}, "line 3 is empty in the midst"),
    ],
)
def test_what_cannot_be_told_is_refused_by_name(tmp_path, text, options, message):
    with pytest.raises(DataError, match=message):
        read(tmp_path, text, options.pop("inputs", "u"), "y", **options)


@pytest.mark.parametrize(
    "options", [{"decimal": ";"}, {"decimal": 1}, {"header": [1]}, {"delimiter": "--"}, {"delimiter": "\n"}]
)
def test_options_that_are_none(tmp_path, options):
    with pytest.raises(ct.ControlArgument, match=next(iter(options))):
        read(tmp_path, "u;y\n1;2\n", **options)


def test_what_is_ambiguous_can_be_said(tmp_path):
    assert read(tmp_path, "u;y\n1,234;5,678\n", decimal=",").inputs.tolist() == [[1.234]]
    assert read(tmp_path, "u;y\n1,234;1500\n").inputs.tolist() == [[1.234]]  # 1500 has no separator
    assert read(tmp_path, "u;y\n1,234;0,5\n").inputs.tolist() == [[1.234]]


def test_both_parsers_read_the_same(tmp_path):
    """Values drawn at random, written as labs do, against Python's own csv and float."""
    rng = np.random.default_rng(0)
    for trial in range(60):
        delimiter, decimal = [(",", "."), (";", ","), ("\t", ","), (" ", "."), ("|", ".")][trial % 5]
        values = rng.standard_normal((rng.integers(3, 9), 3)) * 10.0 ** rng.integers(-8, 9)
        rows = [[f"{x:.{rng.integers(4, 17)}g}".replace(".", decimal) for x in row] for row in values]
        damaged = rng.random() < 0.4
        if damaged:
            where = tuple(int(rng.integers(n)) for n in values.shape)
            rows[where[0]][where[1]] = rng.choice(["", "x", "1_0", "1 2", "--", "1.2.3", "1,2,3"])
        text = "\n".join(delimiter.join(row) for row in [["t", "u", "y"], *rows])
        path = tmp_path / "log.csv"
        path.write_text(text)
        expected = [[float(cell.replace(decimal, ".")) for cell in row] for row in rows if not damaged]
        if damaged:
            with pytest.raises(DataError):
                Measurement.from_csv(path, ["t", "u"], "y", dt=1, delimiter=delimiter, decimal=decimal)
        else:
            data = Measurement.from_csv(path, ["t", "u"], "y", dt=1, delimiter=delimiter, decimal=decimal)
            assert np.vstack([data.inputs, data.outputs]).T.tolist() == expected


# ---------------------------------------------------------------- files of other packages
U, Y = np.arange(6.0), np.linspace(-1, 1, 6)


@pytest.mark.parametrize("suffix", ["h5", "mat"])
def test_hdf5_and_matlab_73(tmp_path, suffix):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / f"run.{suffix}"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["rig/u"], file["rig/y"], file["M"] = U[None], Y[None], np.eye(3)
        file["note"] = np.array([[104], [105]], dtype=np.uint16)
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + (0x0200).to_bytes(2, "little") + b"IM")
    read_it = Measurement.from_hdf5 if suffix == "h5" else Measurement.from_mat
    data = read_it(path, "rig/u", "rig.y", dt=0.1)
    assert (data.inputs[0].tolist(), data.outputs[0].tolist()) == (U.tolist(), Y.tolist())
    for name, message in (("M", "3 x 3, not a vector"), ("note", "text"), ("z", "no variable 'z'; .*rig/u")):
        with pytest.raises(DataError, match=message):
            read_it(path, name, "rig/y", dt=0.1)
    path.write_bytes(path.read_bytes()[:700])
    with pytest.raises(DataError, match="damaged"):
        read_it(path, "rig/u", "rig/y", dt=0.1)


def type_58(node: int, values, step: float, unit: str) -> str:
    """A time history as the format's definition has it."""
    axis = f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} "
    lines = [
        "    -1", "    58", *["NONE"] * 5,
        f"{1:5d}{0:10d}{1:5d}{0:10d} {'NONE':10s}{node:10d}{3:4d} {'NONE':10s}{1:10d}{3:4d}",
        f"{2:10d}{len(values):10d}{1:10d}{0.0:13.5e}{step:13.5e}{0.0:13.5e}",
        axis + f"{'s':20s}", axis + f"{unit:20s}", axis + f"{'NONE':20s}", axis + f"{'NONE':20s}",
        "".join(f"{value:13.5e}" for value in values), "    -1", "",
    ]  # fmt: skip
    return "\n".join(lines)


def test_universal_files(tmp_path):
    pytest.importorskip("pyuff")
    path = tmp_path / "run.uff"
    path.write_text(type_58(1, U, 0.1, "V") + type_58(2, Y, 0.1, "mm") + type_58(3, Y, 0.2, "mm"))
    data = Measurement.from_uff(path, 0, [1])
    assert (data.inputs[0].tolist(), data.dt) == (U.tolist(), 0.1)
    np.testing.assert_allclose(data.outputs[0], Y, rtol=1e-5)  # five digits in the file
    assert (data.input_labels, data.output_labels) == (("1:3",), ("2:3",))
    assert (data.input_units, data.output_units) == (("V",), ("mm",))
    for given, error, message in (
        ((0, 2), DataError, "different sampling times"),
        ((0, 7), DataError, "data set 7 is not a record .there is none"),
        (("x", 1), ct.ControlArgument, "input_set"),
        ((0, []), ct.ControlArgument, "output_set"),
        ((0, 1.5), ct.ControlArgument, "output_set"),
    ):
        with pytest.raises(error, match=message):
            Measurement.from_uff(path, *given)


def test_objects_of_nonlinear_benchmarks():
    data = Measurement.from_benchmark(SimpleNamespace(u=U, y=Y[:, None], sampling_time=0.5, name="box"))
    assert (data.dt, data.name, data.outputs.shape) == (0.5, "box", (1, 6))
    with pytest.raises(ct.ControlArgument, match="without sampling_time"):
        Measurement.from_benchmark(SimpleNamespace(u=U, y=Y))
    with pytest.raises(DataError, match="give dt"):
        Measurement.from_benchmark(SimpleNamespace(u=U, y=Y, sampling_time=None))


@pytest.mark.parametrize(
    "module, reader",
    [("h5py", "from_hdf5"), ("pyuff", "from_uff")],
)
def test_what_is_not_installed_is_named(monkeypatch, module, reader):
    monkeypatch.setitem(sys.modules, module, None)
    columns = (0, 1) if reader == "from_uff" else ("u", "y")
    with pytest.raises(MissingExtraError, match=rf"{reader} needs {module}; install the extra .formats."):
        getattr(Measurement, reader)("none", *columns, **({} if reader == "from_uff" else {"dt": 1.0}))


def test_a_grid_far_finer_than_its_stamps_is_refused(tmp_path):
    """It took all memory there is."""
    t = 0.01 * np.arange(200)
    with pytest.raises(DataError, match=r"dt = 1e-09 s makes 1990000001 samples of stamps 0.01 s apart"):
        Measurement.from_timestamps(t, np.sin(t), np.cos(t), dt=1e-9)
    assert Measurement.from_timestamps(t, np.sin(t), np.cos(t), dt=2e-4).n_samples == 9951


# ------------------------------------------------------------------ recipes of the how-to page
def run_recipe(word):
    """Run the block of the page that holds a word; what it makes."""
    page = (Path(__file__).parent.parent / "docs" / "howto.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```py\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    scope = {"np": np, "rco": rco}
    exec(next(block for block in blocks if word in block), scope)
    return scope["data"]


def test_tdms_by_recipe(tmp_path, monkeypatch):
    nptdms = pytest.importorskip("nptdms")
    monkeypatch.chdir(tmp_path)
    with nptdms.TdmsWriter("run.tdms") as file:
        file.write_segment([
            nptdms.ChannelObject("rig", "u", U, properties={"wf_increment": 0.1}),
            nptdms.ChannelObject("rig", "y", Y),
        ])  # fmt: skip
    data = run_recipe("nptdms")
    assert (data.inputs[0].tolist(), data.outputs[0].tolist(), data.dt) == (U.tolist(), Y.tolist(), 0.1)


def test_ros_bag_by_recipe(tmp_path, monkeypatch):
    """Effort at 20 Hz and joints at 50 Hz, known in closed form."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    monkeypatch.chdir(tmp_path)
    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds, none = store.types, np.zeros(0)
    header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](0, 0), "base")
    with rosbag2.Writer("run", version=9) as writer:
        for topic, kind, rate, message in (
            ("/effort", "std_msgs/msg/Float64", 20, lambda t: (float(round(20 * t) % 7),)),
            ("/joints", "sensor_msgs/msg/JointState", 50,
             lambda t: (header, ["elbow"], np.sin([t]), none, none)),
        ):  # fmt: skip
            connection = writer.add_connection(topic, kind, typestore=store)
            for k in range(5 * rate + 1):
                raw = store.serialize_cdr(kinds[kind](*message(k / rate)), kind)
                writer.write(connection, 10**18 + k * 10**9 // rate, raw)
    data = run_recipe("rosbags")
    assert data.dt == pytest.approx(0.02)
    np.testing.assert_allclose(data.outputs[0], np.sin(data.timepts), atol=1e-6)
    at = np.arange(0, data.n_samples, 5)  # grid points on switches of the effort
    np.testing.assert_allclose(data.inputs[0, at], np.floor(data.timepts[at] * 20 + 1e-6) % 7, atol=1e-6)


def test_a_record_is_read_by_names_or_for_a_model(tmp_path):
    """The suffix picks the reader; a model tells columns and units, and another order of its own."""
    t = 0.1 * np.arange(5)
    (tmp_path / "r.csv").write_text("time;F [N];x\n" + "".join(f"{k:.1f};{k};{2 * k}\n" for k in t))
    np.savez(tmp_path / "r.npz", time=t, F=t, x=2 * t)
    for name in ("r.csv", "r.npz"):
        data = rco.read_record(tmp_path / name, inputs="F", outputs=["x"])
        assert (data.dt, data.input_labels, data.output_labels) == (pytest.approx(0.1), ("F",), ("x",))
        np.testing.assert_allclose(data.outputs[0], 2 * t)
    model = rco.mass_spring_damper([1.0], [0.4], [100.0], inputs="push", outputs="x", sensors="displacement")
    data = rco.read_record(str(tmp_path / "r.csv"), model, inputs=["F"])
    assert (data.input_labels, data.output_units) == (("push",), ("m",))
    with pytest.raises(ct.ControlArgument, match="outputs must name columns of r.csv"):
        rco.read_record(tmp_path / "r.csv", inputs="F")


@pytest.mark.parametrize("name", ["run.tdms", "run.bag", "run.mcap"])
def test_other_files_are_sent_to_the_recipes(name):
    model = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0)
    with pytest.raises(DataError, match="a record is a .csv, .* how-to page"):
        rco.read_record(Path(name), model)


# ---------------------------------------------------------------- times of clocks and calendars
@pytest.mark.parametrize(
    "cells",
    [
        ["2024-03-31T01:59:59.75+01:00", "2024-03-31T02:00:00+01:00", "2024-03-31T03:00:00.25+02:00"],
        ["2024-12-31 23:59:59.75", "2025-01-01 00:00:00", "2025-01-01 00:00:00.25"],
        ["9:59:59,75", "10:00:00,00", "10:00:00,25"],
        ["23:59:59.75", "00:00:00", "00:00:00.25"],
    ],
)
@pytest.mark.parametrize("delimiter", [",", ";"])
def test_times_of_a_clock(tmp_path, cells, delimiter):
    rows = [delimiter.join([f'"{cell}"', "1.5", str(k)]) for k, cell in enumerate(cells)]
    data = read(tmp_path, "\n".join([delimiter.join("tuy"), *rows]), time="t", dt=None)
    assert data.dt == 0.25
    assert data.timepts[0] == 0
    assert data.outputs.tolist() == [[0, 1, 2]]
    assert f"counted from {cells[0]}" in data.notes[0]
    assert Measurement([1.5] * 3, range(3), timepts=cells).dt == 0.25


@pytest.mark.parametrize(
    "cells, message",
    [
        (
            ["10:00:00", "10:00:01", "x"],
            "line 4, column 't' .* is no time like the first one, '10:00:00': 'x'",
        ),
        (["10:00:00", "10:00:01 AM"], "line 3.*no time like"),
        (["10:00:00", "25:00:01"], "line 3.*no time that exists"),
        (["2024-02-29 10:00:00", "2024-02-30 10:00:01"], "line 3.*no time that exists"),
        (["31.12.24 10:00:00", "31.12.24 10:00:01"], "line 2.*with pandas, then use from_frame"),
        (["10:00:00", "09:00:00"], "does not increase"),
    ],
)
def test_times_that_cannot_be_told(tmp_path, cells, message):
    with pytest.raises(DataError, match=message):
        read(tmp_path, "t,u,y\n" + "".join(f"{cell},1,2\n" for cell in cells), time="t", dt=None)


def test_times_of_pandas_and_datetime():
    pd = pytest.importorskip("pandas")
    zoned = pd.date_range("2024-03-31T01:59:59.75", periods=6, freq="250ms", tz="Europe/Berlin")
    plain = zoned.tz_convert("UTC").tz_localize(None)
    for times in (zoned, plain, plain - plain[0], zoned.astype(str), list(zoned.to_pydatetime())):
        frame = pd.DataFrame({"t": times, "u": range(6), "y": range(6)})
        assert Measurement.from_frame(frame, "u", "y", time="t").dt == 0.25
        assert Measurement.from_timestamps(times, range(6), range(6)).dt == 0.25
    with pytest.raises(DataError, match="not finite at sample 2"):
        Measurement(range(6), range(6), timepts=plain.where(np.arange(6) != 2))


def test_utf_16(tmp_path):
    data = read(tmp_path, "u;y\n1,5;2\n3;4\n", encoding="utf-16")
    assert data.inputs.tolist() == [[1.5, 3]]
    assert "read as UTF-16" in data.notes[0]


@pytest.mark.parametrize(
    ("unit", "seconds"), [("S", 1.0), ("SEC", 1.0), ("Sec", 1.0), ("MS", 1e-3), ("MIN", 60.0), ("H", 3600.0)]
)
def test_units_of_time_in_large_letters(tmp_path, unit, seconds):
    path = tmp_path / "run.csv"
    path.write_text(f"Time({unit}),u,G (S)\n0,1,2\n0.5,1,3\n1,1,4\n")
    data = Measurement.from_csv(path, "u", "G", time="Time")
    assert data.dt == 0.5 * seconds
    assert data.output_units == ("S",)  # siemens


def test_megaseconds_or_milliseconds(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("Time(Ms),u,y\n0,1,2\n0.5,1,3\n1,1,4\n")
    with pytest.raises(DataError, match="is in 'Ms'"):
        Measurement.from_csv(path, "u", "y", time="Time")


def test_whole_numbers_as_times_are_told(tmp_path):
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"t": 1_700_000_000_000_000_000 + 10_000_000 * np.arange(50), "u": 1.0, "y": 2.0})
    note = "times of column 't' hold whole numbers without a unit, taken as seconds"
    data = Measurement.from_frame(frame, "u", "y", time="t")
    assert any(note in said for said in data.notes)
    frame["t"] = pd.to_datetime(frame["t"])
    assert not Measurement.from_frame(frame, "u", "y", time="t").notes
    path = tmp_path / "run.csv"
    for header, first, told in (("t", "0", True), ("t [s]", "0", False), ("t", "0.5", False)):
        path.write_text(f"{header},u,y\n{first},1,2\n{float(first) + 10},1,3\n{float(first) + 20},1,4\n")
        data = Measurement.from_csv(path, "u", "y", time="t")
        assert any(note in said for said in data.notes) == told
    path.write_text("t,u,y\n10:00:00,1,2\n10:00:10,1,3\n10:00:20,1,4\n")
    assert "whole" not in str(Measurement.from_csv(path, "u", "y", time="t").notes)


def test_columns_that_are_no_texts():
    pd = pytest.importorskip("pandas")
    values = np.arange(12.0).reshape(4, 3) / 7
    several = pd.DataFrame(
        values, columns=pd.MultiIndex.from_tuples([("", "t"), ("motor", "u"), ("load", "y")])
    )
    data = Measurement.from_frame(several, "('motor', 'u')", "('load', 'y')", time="t")
    np.testing.assert_array_equal(data.outputs[0], values[:, 2])
    with pytest.raises(DataError, match=r"no column 'u'; there are 't', .\('motor', 'u'\)."):
        Measurement.from_frame(several, "u", "y", dt=1.0)
    dated = several.set_index(pd.date_range("2024", periods=4, freq="2s"))
    assert Measurement.from_frame(dated, "('motor', 'u')", "('load', 'y')").dt == 2.0
    numbered = pd.DataFrame(values)
    np.testing.assert_array_equal(Measurement.from_frame(numbered, "1", "2", dt=1.0).outputs[0], values[:, 2])
