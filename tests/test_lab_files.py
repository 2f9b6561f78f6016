"""Files as labs write them: what is read, what is said of it, what is refused by name."""

from __future__ import annotations

import csv
import sys
import time
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest

from rcorefine import DataError, Measurement, MissingExtraError
from rcorefine.data.files import read_record

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
        "10:00:00.100 -> u,y\n10:00:00.110 -> 1,2.5\n10:00:00.120 -> 3,4\n",
        "y:2.5\nu:1,y:2.5\nu:3,y:4\n",
        "12:00:00.100 -> u: 1 y: 2.5\n12:00:00.200 -> u: 3 y: 4\n",
        "u y\n  1   2.5 \n  3   4 \n",
        "u|y\n1|2.5\n3|4\n",
        '"u","y"\n"1","2.5"\n"3","4"\n',
        '"u","y"\n"1,0","2,5"\n"3,0","4,00"\n',
        "% a log of u and y\n% u y\n1 2.5\n3 4\n",
    ],
)
def test_serial_logs_and_other_tables(tmp_path, text):
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
        ("u:1 y:2\nu:1\n", {}, "line 2 is not labeled u, y"),
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


@pytest.mark.benchmark
def test_fast(tmp_path):
    """At least a quarter of the speed of NumPy's own reader, and faster than Python's csv alone."""
    n = 50_000
    table = np.column_stack([np.arange(n) * 1e-3, np.random.default_rng(0).standard_normal((n, 2))])
    path = tmp_path / "long.csv"
    np.savetxt(path, table, delimiter=",", header="t,u,y", comments="", fmt="%.6g")

    def seconds(call):
        taken = []
        for _ in range(3):
            start = time.process_time()
            call()
            taken.append(time.process_time() - start)
        return min(taken)

    def by_hand():
        with path.open() as file:
            rows = csv.reader(file)
            next(rows)
            return [[float(cell) for cell in row] for row in rows]

    ours = seconds(lambda: Measurement.from_csv(path, "u", "y", time="t"))
    assert ours < 4 * seconds(lambda: np.loadtxt(path, delimiter=",", skiprows=1))
    assert ours < seconds(by_hand)


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


def test_tdms(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    path = tmp_path / "run.tdms"
    channels = [
        nptdms.ChannelObject("rig", "u", U, properties={"unit_string": "V", "wf_increment": 0.1}),
        nptdms.ChannelObject("rig", "y", Y),
        nptdms.ChannelObject("spare", "y", U),
    ]
    with nptdms.TdmsWriter(str(path)) as file:
        file.write_segment(channels)
    data = Measurement.from_tdms(path, "u", "rig/y", dt=0.1)
    assert (data.inputs[0].tolist(), data.outputs[0].tolist()) == (U.tolist(), Y.tolist())
    assert data.input_units == ("V",)
    assert "wf_increment = 0.1" in data.notes[0]
    for name, message in (("y", "2 channels 'y'; there are: 'rig/u' 6"), ("z", "no channel 'z'")):
        with pytest.raises(DataError, match=message):
            Measurement.from_tdms(path, "u", name, dt=0.1)
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(DataError, match="not a TDMS file|no channel 'u'"):
        Measurement.from_tdms(path, "u", "y", dt=0.1)


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
    [("h5py", "from_hdf5"), ("nptdms", "from_tdms"), ("pyuff", "from_uff"), ("rosbags", "from_rosbag")],
)
def test_what_is_not_installed_is_named(monkeypatch, module, reader):
    monkeypatch.setitem(sys.modules, module, None)
    columns = (0, 1) if reader == "from_uff" else ("u", "y")
    with pytest.raises(MissingExtraError, match=rf"{reader} needs {module}; install the extra .formats."):
        getattr(Measurement, reader)("none", *columns, **({} if reader == "from_uff" else {"dt": 1.0}))


# ------------------------------------------------------------------ ROS
SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND  # ns: bags count from 1970


def bag(path, form):
    """A robot's arm as a bag: effort at 20 Hz without a header, its joints at 50 Hz, an IMU at 100 Hz.

    The joints are recorded 30 ms after the time that they bear; what is recorded is known in closed form.
    """
    pytest.importorskip("rosbags")
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    old = form == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
    kinds = store.types
    header, stamp = kinds["std_msgs/msg/Header"], kinds["builtin_interfaces/msg/Time"]

    def head(k, ns):
        at = stamp(ns // SECOND, ns % SECOND)
        return header(k, at, "base") if old else header(at, "base")

    def write(writer, topic, kind, messages):
        connection = writer.add_connection(topic, kind, typestore=store)
        raw = store.serialize_ros1 if old else store.serialize_cdr
        for at, message in messages:
            writer.write(connection, at, bytes(raw(message, kind)))

    vector, turn = kinds["geometry_msgs/msg/Vector3"], kinds["geometry_msgs/msg/Quaternion"]
    no, at = np.zeros(9), [(k, BEGIN + k * SECOND // 50) for k in range(251)]
    joints = [
        (t + 30_000_000, kinds["sensor_msgs/msg/JointState"](
            head(k, t), ["wrist", "elbow"], np.array([0.5, np.sin((t - BEGIN) / SECOND)]), no[:2], no[:2]
        ))
        for k, t in at
    ]  # fmt: skip
    faster = [(k, BEGIN + k * SECOND // 100) for k in range(501)]
    imu = [
        (t, kinds["sensor_msgs/msg/Imu"](
            head(k, t), turn(0.0, 0.0, 0.0, 1.0), no, vector(0.0, 0.0, np.cos((t - BEGIN) / SECOND)), no,
            vector(0.0, 0.0, 0.0), no,
        ))
        for k, t in faster
    ]  # fmt: skip
    effort = [(BEGIN + k * SECOND // 20, kinds["std_msgs/msg/Float64"](float(k % 7))) for k in range(101)]
    made = rosbag1.Writer(path) if old else rosbag2.Writer(
        path, version=9, storage_plugin=rosbag2.StoragePlugin[{"mcap": "MCAP", "sqlite3": "SQLITE3"}[form]]
    )  # fmt: skip
    with made as writer:
        write(writer, "/arm/effort", "std_msgs/msg/Float64", effort)
        write(writer, "/arm/joints", "sensor_msgs/msg/JointState", joints)
        write(writer, "/imu", "sensor_msgs/msg/Imu", imu)
    return path


@pytest.mark.parametrize("form", ["ros1", "sqlite3", "mcap"])
def test_a_bag_comes_on_one_grid(tmp_path, form):
    path = bag(tmp_path / ("run.bag" if form == "ros1" else "run"), form)
    outputs = ["/arm/joints/position[elbow]", "/imu/angular_velocity/z"]
    for where in [path, *path.glob("*.mcap")] if path.is_dir() else [path]:
        data = Measurement.from_rosbag(where, "/arm/effort/data", outputs)
        assert data.dt == pytest.approx(0.02, rel=1e-6)  # of the slower topic
        assert data.output_labels == tuple(outputs)
        inside = slice(5, -5)  # the grid of 100 Hz passed a filter
        t = data.timepts[inside]
        np.testing.assert_allclose(data.outputs[0, inside], np.sin(t), atol=2e-4)
        np.testing.assert_allclose(data.outputs[1, inside], np.cos(t), atol=2e-4)
        assert "/arm/effort: messages bear no time of their own" in data.notes[-1]
    late = Measurement.from_rosbag(path, "/arm/effort/data", outputs[0], stamps="log", dt=0.01)
    np.testing.assert_allclose(late.outputs[0], np.sin(late.timepts - 0.03), atol=1e-6)
    k = np.floor(late.timepts * 20 + 1e-6)
    np.testing.assert_allclose(late.inputs[0], k % 7, atol=1e-6)


def test_a_grid_far_finer_than_its_stamps_is_refused(tmp_path):
    """It took all memory there is."""
    t = 0.01 * np.arange(200)
    with pytest.raises(DataError, match=r"dt = 1e-09 s makes 1990000001 samples of stamps 0.01 s apart"):
        Measurement.from_timestamps(t, np.sin(t), np.cos(t), dt=1e-9)
    assert Measurement.from_timestamps(t, np.sin(t), np.cos(t), dt=2e-4).n_samples == 9951


def test_a_bag_is_a_record_of_the_terminal(tmp_path):
    folder = bag(tmp_path / "run", "mcap")
    (path,) = folder.glob("*.mcap")
    model = ct.ss([[-1.0]], [[1.0]], [[1.0]], 0, inputs=["effort"], outputs=["elbow"])
    names = {"inputs": ["/arm/effort/data"], "outputs": ["/arm/joints/position[elbow]"]}
    record = read_record(path, model, **names)
    assert (record.input_labels, record.output_labels, record.dt) == (("effort",), ("elbow",), 0.02)
    with pytest.raises(DataError, match="a bag, whose messages bear their times"):
        read_record(path, model, time="t", **names)


def test_what_a_bag_does_not_hold_is_named(tmp_path):
    path = bag(tmp_path / "run", "mcap")
    effort = "/arm/effort/data"
    for name, message in (
        (
            "/arm/speed/data",
            r"no topic of '/arm/speed/data'.*Topics: /arm/effort \(std_msgs/msg/Float64\), /arm",
        ),
        ("/imu/angular_velocity/w", r"has no field 'w'; there are: x, y, z"),
        ("/imu/angular_velocity", r"is .*Vector3.*, no number; name a part of it"),
        ("/arm/joints/position[hip]", r"no entry 'hip' in 'position'; it has 2: wrist, elbow"),
        ("/arm/joints/position[7]", r"no entry '7' in 'position'; it has 2"),
        ("/arm/joints/__class__", r"no field '__class__'; there are: header, name, position"),
    ):
        with pytest.raises(DataError, match=message):
            Measurement.from_rosbag(path, effort, name)
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:900])
    with pytest.raises(DataError, match="no ROS bag that rosbags can read, or it is damaged"):
        Measurement.from_rosbag(file, effort, "/imu/angular_velocity/z")
    with pytest.raises(FileNotFoundError):
        Measurement.from_rosbag(tmp_path / "none.bag", effort, "/imu/angular_velocity/z")


# ---------------------------------------------------------------- times of clocks and calendars
@pytest.mark.parametrize(
    "cells",
    [
        ["2024-03-31T01:59:59.75+01:00", "2024-03-31T02:00:00+01:00", "2024-03-31T03:00:00.25+02:00"],
        ["2024-12-31 23:59:59.75", "2025-01-01 00:00:00", "2025-01-01 00:00:00.25"],
        ["31.12.24 23:59:59,75", "01.01.25 00:00:00,00", "01.01.25 00:00:00,25"],
        ["3/4/2024 1:00:00.5 PM", "3/4/2024 1:00:00.75 PM", "3/4/2024 1:00:01 PM"],
        ["11:59:59.75 AM", "12:00:00.00 PM", "12:00:00.25 PM"],
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
        (["10:00:00", "25:00:01"], "line 3.*no such hour"),
        (["1/2/24 10:00:00", "2/2/24 10:00:00"], "either order; write the year first"),
        (["1/2/24 10:00:00", "13/2/24 10:00:00", "1/14/24 10:00:00"], "dates that no order explains"),
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
