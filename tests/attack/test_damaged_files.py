"""Damaged files are errors of ours: no wrong answer without a word, no crash, no raw exception."""

from __future__ import annotations

import io
import struct
import zipfile

import control as ct
import numpy as np
import pytest
import scipy.io
from inner import main

import rcorefine as rco
from rcorefine import DataError, Measurement, ModelError
from rcorefine.data import formats

OURS = (rco.RCOError, ct.ControlArgument, ct.ControlDimension)


def columns(n=40, seed=5):
    rng = np.random.default_rng(seed)
    return {"time": np.arange(n) * 0.01, "volt": rng.standard_normal(n), "speed": rng.standard_normal(n)}


def csv_text(found, delimiter=","):
    rows = np.array(list(found.values())).T
    lines = [delimiter.join(found), *(delimiter.join(f"{cell:.9g}" for cell in row) for row in rows)]
    return "\n".join(lines) + "\n"


def arrays_of_model():
    A = [[0.0, 1.0, 0.0], [-40.0, -0.3, 2.0], [0.0, -1.0, -5.0]]
    return {"A": A, "B": [[0.0], [0.0], [3.0]], "C": [[1.0, 0.0, 0.0]], "D": 0.0, "outputs": "angle"}


TOML = """[state_space]
A = [[0.0, 1.0, 0.0], [-40.0, -0.3, 2.0], [0.0, -1.0, -5.0]]
B = [0.0, 0.0, 3.0]
C = [[1.0, 0.0, 0.0]]
inputs = ["voltage"]
dt = 0
"""
TABLE = """[thermal_network]
capacities = [900.0, 4.5e3, 1_000.0]
resistances = {"1-2" = 0.5, "2-3" = 0.25, "3-0" = 2.0}
heat = [1]
name = "oven"
"""


def saved(write, content):
    stream = io.BytesIO()
    write(stream, content)
    return stream.getvalue()


def record_from(reader):
    return lambda path: getattr(Measurement, reader)(path, "volt", "speed", time="time")


def quoted():
    return csv_text({f'"{name}"': column for name, column in columns().items()}, ";").encode()


CSV, NPZ, MAT = (record_from(f"from_{kind}") for kind in ("csv", "npz", "mat"))
SAMPLES = {
    "record.csv": (lambda: csv_text(columns()).encode(), CSV),
    "quoted.csv": (quoted, CSV),
    "record.npz": (lambda: saved(lambda s, c: np.savez(s, **c), columns()), NPZ),
    "packed.npz": (lambda: saved(lambda s, c: np.savez_compressed(s, **c), columns()), NPZ),
    "record.mat": (lambda: saved(scipy.io.savemat, columns()), MAT),
    "packed.mat": (lambda: saved(lambda s, c: scipy.io.savemat(s, c, do_compression=True), columns()), MAT),
    "old.mat": (lambda: saved(lambda s, c: scipy.io.savemat(s, c, format="4"), columns()), MAT),
    "model.toml": (TOML.encode, rco.read_model),
    "table.toml": (TABLE.encode, rco.read_model),
    "model.npz": (lambda: saved(lambda s, c: np.savez(s, **c), arrays_of_model()), rco.read_model),
    "model.mat": (lambda: saved(scipy.io.savemat, arrays_of_model()), rco.read_model),
}


def damaged(rng, content):
    """Content after one to three accidents."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(0, max(len(data), 1)))
        match rng.integers(0, 6):
            case 0 | 1:
                for place in rng.integers(0, max(len(data), 1), rng.integers(1, 6)):
                    if data:
                        data[place] ^= 1 << int(rng.integers(0, 8))
            case 2:
                del data[at:]
            case 3:
                data[at:at] = rng.bytes(int(rng.integers(1, 9)))
            case 4:
                del data[at : at + int(rng.integers(1, 9))]
            case 5:
                data[at:at] = data[at : at + int(rng.integers(1, 40))]
    return bytes(data)


def fuzz(folder, name, seed, count):
    """Read `count` damaged files of a kind; return how many were refused."""
    make, read = SAMPLES[name]
    content, refused = make(), 0
    path = folder / name
    for index in range(count):
        path.write_bytes(damaged(np.random.default_rng([seed, index]), content))
        try:
            read(path)
        except OURS:
            refused += 1
        except Exception as error:
            pytest.fail(f"{name}, seed {seed}, mutant {index}: {type(error).__name__}: {error}")
    return refused


@pytest.mark.parametrize("name", SAMPLES)
def test_samples_are_read(name, tmp_path):
    make, read = SAMPLES[name]
    (tmp_path / name).write_bytes(make())
    assert read(tmp_path / name) is not None


@pytest.mark.parametrize("name", SAMPLES)
def test_mutants_are_refused_or_read(name, tmp_path, tally):
    count = tally.cases(3 if name.endswith(".mat") else 60)  # a MATLAB file takes a process each
    refused = fuzz(tmp_path, name, 20, count)
    assert refused > 0
    tally.update({"files, tried": count, "files, refused": refused})


# ---------------------------------------------------------------------- text


def test_an_open_quote_swallows_no_lines(tmp_path):
    """Wherever it stands, and also where a second one closes it some lines below."""
    lines = csv_text(columns(20)).splitlines()
    path = tmp_path / "r.csv"
    for broken, closing in ((3, None), (7, 12), (20, None), (9, 10)):
        text = list(lines)
        for line in filter(None, (broken, closing)):
            first, *rest = text[line].split(",")
            text[line] = ",".join([first, '"' + rest[0], *rest[1:]])
        path.write_text("\n".join(text))
        with pytest.raises(DataError, match=rf"r\.csv, line {broken + 1}: a quote"):
            Measurement.from_csv(path, "volt", "speed", time="time")
    path.write_text('time,"volt,speed\n0,1,2\n1,3,4\n')
    with pytest.raises(DataError, match="line 1: a quote"):
        Measurement.from_csv(path, "volt", "speed", time="time")


def test_an_open_quote_in_another_column_swallows_none_either(tmp_path):
    path = tmp_path / "r.csv"
    path.write_text('# logger 7\nvolt,speed,note\n1,2,fine\n3,4,"not so\n5,6,fine\n7,8,fine"\n9,10,fine\n')
    with pytest.raises(DataError, match="line 4: a quote"):
        Measurement.from_csv(path, "volt", "speed", dt=0.1)


@pytest.mark.parametrize(
    "text, message",
    [
        ("u,y\n1,2\n3," + "4" * 200_000 + "\n", "line 3 cannot be read: field larger"),
        ("u,y\n1,2\n3,,4\n", "line 3 has 3 cells and the header 2"),
        ("u;y\n1;2\n1_000;4\n", "line 3, column 'u' .* not a number: '1_000'"),
    ],
)
def test_csv_lines_that_are_damaged(tmp_path, text, message):
    path = tmp_path / "r.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        Measurement.from_csv(path, "u", "y", dt=0.1)


@pytest.mark.parametrize("delimiter", ["", ";;", '"', "\n", 7])
def test_a_delimiter_is_one_character(tmp_path, delimiter):
    path = tmp_path / "r.csv"
    path.write_text("u,y\n1,2\n")
    with pytest.raises(ct.ControlArgument, match="one character|must be a text"):
        Measurement.from_csv(path, "u", "y", dt=0.1, delimiter=delimiter)


@pytest.mark.parametrize(
    "text, message",
    [
        ("[state_space]\nA = " + "[" * 700 + "1.0" + "]" * 700 + "\n", "nested too deeply"),
        ("[state_space]\nA = [[" + "7" * 5000 + "]]\nB = [1.0]\nC = [1.0]\n", "not TOML"),
        ("[state_space]\nA = [[" + "7" * 400 + "]]\nB = [1.0]\nC = [1.0]\n", "A must be numbers"),
        ("[state_space]\nA = [['1']]\nB = [1.0]\nC = [1.0]\n", "A must be numbers"),
        ("[state_space]\nA = [[1.0]]\nB = [1.0]\nC = [1.0]\nname = 'a.b'\n", "'a.b'"),
        ("[state_space]\nA = [[1.0]]\nB = [1.0]\nC = [1.0]\ninputs = ['a.b']\n", "'a.b'"),
        ("[state_space]\nA = [[1.0]]\nB = [1.0]\nC = [1.0]\ndt = 1" + "0" * 400 + "\n", "dt must be"),
        ("[mechanical]\nM = [[1.0]]\nK = [[1.0]]\nlinks = {foot = 3}\n", "wrong kind"),
        ("[mechanical]\nM = [[1.0]]\nK = [[1.0]]\nforce = [[1.0], [1.0, 2.0]]\n", "force"),
        ("[series_rlc]\nR = 1.0\nL = 1.0\nC = 1.0\nname = 'a.b'\n", "'a.b'"),
    ],
)
def test_model_files_that_are_wrong(tmp_path, text, message):
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(ModelError, match=r"wrong\.toml") as caught:
        rco.read_model(path)
    assert message in str(caught.value)


def test_a_dot_in_the_name_of_a_model_file(tmp_path, monkeypatch, capsys):
    """`rocket.2.1.toml` is a file like any other, also in the terminal."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rocket.2.1.toml").write_text(TOML)
    assert rco.read_model(tmp_path / "rocket.2.1.toml").name == "rocket_2_1"
    found = columns(400)
    (tmp_path / "run.1.csv").write_text(csv_text(found))
    words = ["--input", "volt", "--output", "speed"]
    assert main(["compare", "rocket.2.1.toml", "run.1.csv", *words]) == 1
    assert "rocket_2_1" in capsys.readouterr().out


def test_large_models_are_refused_with_the_limit_and_others_are_fast(tmp_path):
    path = tmp_path / "chain.toml"
    for masses in (3000, 400):
        path.write_text(
            f"[mass_spring_damper]\nm = {[1.0] * masses}\nc = {[0.1] * masses}\nk = {[9.0] * masses}\n"
        )
        if masses == 3000:
            with pytest.raises(ModelError, match="6000 states; from a file at most 1000"):
                rco.read_model(path)
    assert rco.read_model(path).linear.n_states == 800
    np.savez(tmp_path / "large.npz", A=np.eye(1001), B=np.ones((1001, 1)), C=np.ones((1, 1001)))
    with pytest.raises(ModelError, match="at most 1000"):
        rco.read_model(tmp_path / "large.npz")


# ---------------------------------------------------------------------- arrays


def npz_with_header(path, shape, dtype="<f8", body=b"\0" * 80):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("u.npy", stream.getvalue() + body)
        archive.writestr("y.npy", saved(np.save, np.ones(10)))


@pytest.mark.parametrize("shape", [(10**9,), (3 * 10**4, 10**5), (-10,), (2**40, 2**40), (9,), (11,)])
def test_npz_headers_that_claim_what_is_not_there(tmp_path, shape):
    path = tmp_path / "r.npz"
    npz_with_header(path, shape)
    with pytest.raises(DataError, match=r"r\.npz .*'u'"):
        Measurement.from_npz(path, "u", "y", dt=0.1)
    npz_with_header(path, (10,))
    assert Measurement.from_npz(path, "u", "y", dt=0.1).n_samples == 10


def test_npz_that_unfolds_to_gigabytes_is_refused(tmp_path):
    """The directory claims more than any record of this size can hold; nothing is unfolded."""
    path = tmp_path / "r.npz"
    np.savez_compressed(path, u=np.zeros(1000), y=np.zeros(1000))
    raw = path.read_bytes()
    size = np.frombuffer(raw[raw.rindex(b"PK\x01\x02") :], "<u4", 1, 24)[0]
    path.write_bytes(raw.replace(struct.pack("<I", size), struct.pack("<I", 4_000_000_000)))
    with pytest.raises(DataError, match="8000000000 bytes"):
        Measurement.from_npz(path, "u", "y", dt=0.1)


def test_fortran_order_and_other_types_come_through(tmp_path):
    A = np.asfortranarray(np.arange(4, dtype=np.int16).reshape(2, 2))
    np.savez(tmp_path / "m.npz", A=A, B=np.ones((2, 1), dtype=bool), C=np.ones((1, 2), ">f4"), inputs="ü")
    system = rco.read_model(tmp_path / "m.npz")
    np.testing.assert_array_equal(system.A, A)
    assert system.input_labels == ["ü"]


@pytest.mark.parametrize("suffix", ["npz", "mat"])
def test_complex_matrices_are_refused(tmp_path, suffix):
    """A model in modal form keeps its imaginary part, or there is no model."""
    path = tmp_path / f"modal.{suffix}"
    arrays = {"A": np.diag([-1 + 3j, -1 - 3j]), "B": np.ones((2, 1)), "C": np.ones((1, 2))}
    if suffix == "npz":
        np.savez(path, **arrays)
    else:
        scipy.io.savemat(path, arrays)
    with pytest.raises(ModelError, match="A is complex"):
        rco.read_model(path)


# ---------------------------------------------------------------------- MATLAB


def test_matlab_files_are_read_in_a_process_that_may_die(tmp_path, monkeypatch):
    """Whatever happens there (a crash, an endless loop, all memory) is one sentence here."""
    path, child = tmp_path / "r.mat", tmp_path / "child.py"
    scipy.io.savemat(path, columns())
    monkeypatch.setattr(formats, "_CHILD", child)
    monkeypatch.setattr(formats, "_PATIENCE", 2.0)
    for code, message in (
        ("import os; os.abort()", "ended with code -6"),
        ("while True: pass", "could not be read within 2 s"),
        ("raise MemoryError('no room')", "no room"),
    ):
        child.write_text(code)
        with pytest.raises(DataError, match=message):
            Measurement.from_mat(path, "volt", "speed", time="time")


def test_matlab_file_that_claims_gigabytes(tmp_path):
    """Version 4: the header alone says how much is to be made."""
    path = tmp_path / "r.mat"
    path.write_bytes(struct.pack("<5i", 0, 200_000, 100_000, 0, 2) + b"u\0" + bytes(80))
    with pytest.raises(DataError, match=r"r\.mat"):
        Measurement.from_mat(path, "u", "u", dt=0.1)


def test_matlab_structures_texts_and_what_else_there_is(tmp_path):
    path = tmp_path / "bench.mat"
    cells = np.empty(2, dtype=object)
    cells[:] = ["left", "right"]
    mixed = np.empty(2, dtype=object)
    mixed[:] = [np.ones(3), "text"]
    run = {"speed": np.arange(4.0), "rig": {"volt": np.ones(4)}}
    scipy.io.savemat(path, {"run": run, "names": cells, "mixed": mixed, "fs": 1000.0})
    data = Measurement.from_mat(path, "run.rig.volt", "run.speed", dt=0.1)
    assert data.outputs.tolist() == [[0.0, 1.0, 2.0, 3.0]]
    listed = "run structure with fields speed, rig, names 2 <U5, mixed cell array, fs 1 x 1"
    with pytest.raises(DataError, match=listed):
        Measurement.from_mat(path, "run.rpm", "run.speed", dt=0.1)
    for wrong in ("mixed", "run", "run.rig"):
        with pytest.raises(DataError, match="not a vector of numbers"):
            Measurement.from_mat(path, wrong, "run.speed", dt=0.1)
