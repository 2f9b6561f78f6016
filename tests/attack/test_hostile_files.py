"""Files of every format that were damaged, claim too much, or lead elsewhere: refused, or read, in bounds.

The damage runs in a process of its own, so that a crash of a reader is a failed test and no end of the tests.
"""

from __future__ import annotations

import csv
import importlib.util
import io
import json
import os
import re
import resource
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import control as ct
import numpy as np
import pytest
import scipy.io
import test_damaged_files as plain

import rcorefine as rco
from rcorefine import DataError, Measurement

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
LONGEST, ROOM = 10, 200  # seconds; MB beside four times the file
NOT_HERE = [name for name in ("h5py", "pyuff") if importlib.util.find_spec(name) is None]


# ------------------------------------------------------------------ formats of other packages
def hdf5(path, **options):
    import h5py

    with h5py.File(path, "w") as file:
        for name, column in plain.columns().items():
            file.create_dataset(f"rig/{name}", data=column, **options)


def universal(path):
    """Time histories as the definition of the format has them."""
    text = ""
    for node, values in enumerate(list(plain.columns().values())[1:]):
        axis = f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} "
        rows = [values[i : i + 6] for i in range(0, len(values), 6)]
        text += "\n".join([
            "    -1", "    58", *["NONE"] * 5,
            f"{1:5d}{0:10d}{1:5d}{0:10d} {'NONE':10s}{node:10d}{3:4d} {'NONE':10s}{1:10d}{3:4d}",
            f"{2:10d}{len(values):10d}{1:10d}{0.0:13.5e}{0.01:13.5e}{0.0:13.5e}",
            *[axis + f"{unit:20s}" for unit in ("s", "V", "NONE", "NONE")],
            *["".join(f"{value:13.5e}" for value in row) for row in rows], "    -1", "",
        ])  # fmt: skip
    path.write_text(text)


def responses(path):
    rows = "".join(f"{k + 1},{1 / (k + 1):.6g},{-k},0.9\n" for k in range(40))
    path.write_text("f [Hz],H,phase [deg],coherence\n" + rows)


def labview(path):
    head = (
        "LabVIEW Measurement\nSeparator\tTab\nDecimal_Separator\t.\n***End_of_Header***\t\n\t\nChannels\t2\n"
    )
    rows = zip(*plain.columns().values(), strict=True)
    text = "".join("\t".join(f"{cell:.6g}" for cell in row) + "\n" for row in rows)
    path.write_text(head + "X_Value\tvolt\tspeed\n" + text)


def written(name):
    make, read = plain.SAMPLES[name]
    return lambda path: path.write_bytes(make()), read


in_rig = {"inputs": "rig/volt", "outputs": "rig/speed", "time": "rig/time"}
FORMATS = {
    "a.h5": (hdf5, lambda p: Measurement.from_hdf5(p, **in_rig)),
    "packed.h5": (
        lambda p: hdf5(p, compression="gzip", chunks=(16,)),
        lambda p: Measurement.from_hdf5(p, **in_rig),
    ),
    "a.uff": (universal, lambda p: Measurement.from_uff(p, 0, 1)),
    "frf.csv": (responses, lambda p: rco.FrequencyResponse.from_csv(p, "f", "H", phase="phase")),
    "a.lvm": (labview, lambda p: Measurement.from_csv(p, "volt", "speed", time="X_Value")),
    **{name: written(name) for name in plain.SAMPLES},
}  # fmt: skip
SLOW = {name for name in FORMATS if name.endswith((".mat", ".h5"))}  # a process each


# ------------------------------------------------------------------ damage that knows the grammar
CELLS = [
    "nan", "inf", "-inf", "1e999", "-1e-999", "", " ", "--", "1,5", "0x1f", "1_0", "+-3", "1e", "'7'", '"',
    '""', '"8',
    "=1+1", "#", "true", "None", "\u0663", "\u221e", "9" * 400, "0." + "0" * 400 + "1", "2020-01-01",
    "12:00:01", "\t",
    "V", "[s]", "\ufeff3", "\u22122", "1.0.0", "NaN(7)", "1 000", "{", "]", "[[]]", "[1, [2]]",
    "1979-05-27T07:32:00Z", "{a=1}",
    "'''x", '"\\u0000"', "0b11", "-nan", "[" * 200, "1e308", "-9223372036854775809", "false",
]  # fmt: skip
WORDS = [
    "A", "B", "C", "D", "dt", "name", "inputs", "outputs", "states", "time", "volt", "speed", "m", "k",
    "links", "heat",
    "state_space", "mass_spring_damper", "thermal_network", "mechanical", "dc_motor", "a.b", "__class__", "",
]  # fmt: skip


def misspelled(rng, content):
    """Text whose cells, marks, lines or names were changed for others that could stand there."""
    lines = content.decode().split("\n")
    mark = max(",;\t=", key=content.decode().count)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(lines)))
        cells = lines[at].split(mark)
        which = int(rng.integers(len(cells)))
        match rng.integers(9):
            case 0 | 1 | 2:
                cells[which] = str(rng.choice(CELLS))
            case 3:
                cells[which] = str(rng.choice(WORDS))
            case 4:
                cells.insert(which, cells[int(rng.integers(len(cells)))])
            case 5:
                del cells[which]
            case 6:
                lines.insert(at, lines[int(rng.integers(len(lines)))])
                continue
            case 7:
                lines[at] = lines[at].replace(mark, str(rng.choice([",", ";", "\t", "=", " ", "|", ", "])))
                continue
            case 8:
                lines[at] += str(rng.choice(["\r", mark, mark * 9, " #", '"', "\0", "\x1a", "\u2028", "\\"]))
                continue
        lines[at] = mark.join(cells)
    return "\n".join(lines).encode("utf-8")


def attack(folder, name, seed, count):
    """Damage, read, count; the name of each is printed first, so that the last line tells of a crash."""

    def late(*_):
        raise TimeoutError(f"longer than {LONGEST} s")

    signal.signal(signal.SIGALRM, late)
    make, read = FORMATS[name]
    path = Path(folder, name)
    make(path)
    content = path.read_bytes()
    assert read(path) is not None
    text = name.endswith(("csv", "toml", "lvm"))
    refused, before = 0, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for index in range(count):
        rng = np.random.default_rng([seed, index])
        damage = misspelled if text and index % 2 else plain.damaged
        path.write_bytes(damage(rng, content))
        print(f"{name}, seed {seed}, mutant {index}", flush=True)
        signal.alarm(LONGEST)
        try:
            found = read(path)
            for array in (getattr(found, key, 0.0) for key in ("inputs", "outputs", "A", "B", "C", "D")):
                assert np.isfinite(array).all(), "read, with what is no number"
        except plain.OURS:
            refused += 1
        finally:
            signal.alarm(0)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
        assert grown < ROOM, f"{grown:.0f} MB"
    print(f"DONE {refused} of {count} refused")


@pytest.mark.skipif(bool(NOT_HERE) or os.name == "nt", reason="the formats of other packages")
def test_damaged_files_of_every_format(tmp_path, tally):
    """All in one process: bits, cuts, splices; in tables and TOML also cells, marks, names and lines."""
    counts = {name: tally.cases(4 if name in SLOW else 100) for name in FORMATS}
    work = [f"t.attack({str(tmp_path)!r}, {name!r}, 21, {count})" for name, count in counts.items()]
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(["import test_hostile_files as t", *work])],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, HERE.parent, HERE)))},
        capture_output=True,
        text=True,
        timeout=600 * max(1.0, tally.scale),
        check=False,
    )
    lines = done.stdout.strip().splitlines() or ["nothing"]
    assert done.returncode == 0, f"{lines[-1]:.300}\n{done.stderr[-1500:]}"
    over = [line.split() for line in lines if line.startswith("DONE")]
    assert len(over) == len(FORMATS)
    tally["files of every format, tried"] += sum(counts.values())
    tally["files of every format, refused"] += sum(int(one[1]) for one in over)


# ------------------------------------------------------------------ what claims too much, or leads elsewhere
def grown(code, *words):
    """MB that a process needs for some code, beyond what it needed before."""
    script = f"""
import resource, sys
import numpy as np
import rcorefine as rco
rco.Measurement, rco.RCORefiner, rco.DataError, rco.read_model
def most():
    both = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return max(resource.getrusage(who).ru_maxrss for who in both) / 1024
before = most()
try:
    {code}
    print("read", most() - before)
except rco.RCOError:
    print("refused", most() - before)
"""
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, words)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-900:]
    said, size = done.stdout.split()
    return said, float(size)


def bomb(path, names, size):
    """Arrays of zeros, of `size` bytes each, in a thousandth of that."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            head = io.BytesIO()
            np.lib.format.write_array_header_1_0(
                head, {"descr": "<f8", "fortran_order": False, "shape": (size // 8,)}
            )
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                member.write(head.getvalue())
                for _ in range(size >> 20):
                    member.write(bytes(1 << 20))


@pytest.mark.skipif(os.name == "nt", reason="resource")
def test_archives_that_unfold_to_hundreds_of_megabytes(tmp_path):
    bomb(tmp_path / "a.npz", "uy", 300 << 20)
    bomb(tmp_path / "m.npz", "ABC", 300 << 20)
    for code in (
        "rco.Measurement.from_npz(sys.argv[1] + '/a.npz', 'u', 'y', dt=0.1)",
        "rco.read_model(sys.argv[1] + '/m.npz')",
        "rco.RCORefiner.load(sys.argv[1] + '/a.npz')",
        "rco.Monitor.load(sys.argv[1] + '/a.npz')",
    ):
        said, size = grown(code, tmp_path)
        assert said == "refused"
        assert size < ROOM
    scipy.io.savemat(tmp_path / "a.mat", {n: np.zeros(30 << 20) for n in "uy"}, do_compression=True)
    said, size = grown("rco.Measurement.from_mat(sys.argv[1] + '/a.mat', 'u', 'y', dt=0.1)", tmp_path)
    assert (said, size < ROOM) == ("refused", True), size


@pytest.mark.skipif("h5py" in NOT_HERE, reason="h5py")
def test_damage_on_which_hdf5_fills_the_memory(tmp_path):
    """A group whose list of names leads back into itself: the library took 23 GB of a file of some kB."""
    hdf5(tmp_path / "a.h5")
    content = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "a.h5").write_bytes(plain.damaged(np.random.default_rng([21, 1487]), content))
    said, size = grown("rco.Measurement.from_hdf5(sys.argv[1] + '/a.h5', 'rig/u', 'rig/y', dt=0.1)", tmp_path)
    assert (said, size < ROOM) == ("refused", True), size


@pytest.mark.skipif("h5py" in NOT_HERE, reason="h5py")
def test_data_sets_that_are_not_in_their_file(tmp_path):
    """A thousand million elements that nobody wrote; values that stand in another file."""
    import h5py

    path, other = tmp_path / "a.h5", tmp_path / "secret.bin"
    np.arange(10.0).tofile(other)
    with h5py.File(path, "w") as file:
        for name in "uy":
            file.create_dataset(name, (10**9,), "f8", chunks=(1000,))
        file.create_dataset("led", (10,), "f8", external=[(str(other), 0, 80)])
        layout = h5py.VirtualLayout((10,), "f8")
        layout[:] = h5py.VirtualSource(str(other), "x", (10,))
        file.create_virtual_dataset("virtual", layout)
        file["away"] = h5py.ExternalLink(str(other), "x")
        file["fine"] = np.arange(10.0)
        file["words"] = "mm, N"
    with pytest.raises(DataError, match="claim 16000000000 bytes"):
        Measurement.from_hdf5(path, "u", "y", dt=0.1)
    for name, message in (
        ("led", "lies in another file"),
        ("virtual", "lies in another file"),
        ("away", "away"),
        ("words", "words"),
        ("nul\0", "nul"),
        ("long" * 100_000, "long"),
    ):
        with pytest.raises(DataError, match=message):
            Measurement.from_hdf5(path, "fine", name, dt=0.1)


@pytest.mark.skipif(os.name == "nt", reason="links and pipes")
def test_paths_that_are_no_files(tmp_path):
    """A link to itself, one to nothing, a folder; names in an archive that point outside."""
    (tmp_path / "round.csv").symlink_to("round.csv")
    (tmp_path / "nothing.npz").symlink_to("gone")
    (tmp_path / "folder.mat").mkdir()
    found = [tmp_path / name for name in ("round.csv", "nothing.npz", "folder.mat")]
    readers = (Measurement.from_csv, Measurement.from_npz, Measurement.from_mat)
    for path in found:
        for read in readers:
            with pytest.raises((OSError, DataError)):
                read(path, "u", "y", dt=0.1)
        with pytest.raises((OSError, rco.RCOError)):
            rco.read_model(path)
    for name in ("../a.npy", "/etc/passwd.npy", "a/../../u.npy"):  # nothing of an archive is unpacked
        with zipfile.ZipFile(tmp_path / "tricks.npz", "w") as archive:
            archive.writestr(name, plain.saved(np.save, np.ones(10)))
        with pytest.raises(DataError, match="no variable|'u'"):
            Measurement.from_npz(tmp_path / "tricks.npz", "u", "y", dt=0.1)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "folder.mat", "nothing.npz", "round.csv", "tricks.npz"
    ]  # fmt: skip


@pytest.mark.skipif(os.name == "nt", reason="resource")
@pytest.mark.parametrize("kind", ["csv", "npz", "mat"])
def test_memory_that_a_large_record_takes(kind, tmp_path, tally):
    """At most four times the file and 200 MB."""
    rows = np.random.default_rng(3).standard_normal((2, 250_000 if tally.scale <= 1 else 4_000_000))
    path = tmp_path / f"a.{kind}"
    if kind == "csv":
        np.savetxt(path, rows.T, delimiter=",", header="u,y", comments="", fmt="%.6g")
    else:
        save = np.savez if kind == "npz" else lambda to, **arrays: scipy.io.savemat(to, arrays)
        save(path, u=rows[0], y=rows[1])
    said, size = grown(f"rco.Measurement.from_{kind}(sys.argv[1], 'u', 'y', dt=0.1)", path)
    assert said == "read"
    assert size < ROOM + 4 * os.path.getsize(path) / 2**20


def test_a_matrix_file_with_a_zero_byte_ends_no_process(tmp_path):
    """Its library dies of one with a segmentation fault; it reads in a process of its own."""
    rows = b"%%MatrixMarket matrix array real general\n2 2\n"
    head = b"%%MatrixMarket matrix coordinate real general\n2 2 1\n"
    after = [head + b"1 1 1\0000\n", head + b"1 1 1.0\0", rows + b"1.0\0002.0\n3.0\n4.0\n", rows + b"1\0" * 4]
    for content in (*after, head + b"1 1 \0 1.0\n", head + b"1 \0\n", b"\0" + head, head + b"\0" * 40):
        (tmp_path / "A.mtx").write_bytes(content)
        (tmp_path / "m.toml").write_text('[state_space]\nA = "A.mtx"\nB = [[0.0], [2.0]]\nC = [[1.0, 0.0]]\n')
        with pytest.raises(rco.ModelError, match=r"A\.mtx"):
            rco.read_model(tmp_path / "m.toml")


def test_values_of_the_wrong_kind_are_errors_of_ours(tmp_path):
    path = tmp_path / "m.toml"
    path.write_text("[state_space]\nA = [[-1.0]]\nB = [[1.0]]\nC = [[1.0]]\ninputs = 5\n")
    with pytest.raises(rco.ModelError, match=r"inputs must be 1 name\(s\), not 5"):
        rco.read_model(path)
    np.save(tmp_path / "A.npy", [[-1.0]])
    header = (tmp_path / "A.npy").read_bytes().replace(b"(1, 1), }", b"(1, 1), S")
    (tmp_path / "A.npy").write_bytes(header)
    path.write_text('[state_space]\nA = "A.npy"\nB = [[1.0]]\nC = [[1.0]]\n')
    with pytest.raises(rco.ModelError, match=r"A\.npy holds no matrix"):
        rco.read_model(path)
    rows = dict.fromkeys(("inputs", "outputs"), np.zeros((1, 9)))
    for level in ("1e999", "[" * 100_000):
        about = f'{{"plant": "motor", "seals": [], "level": {level}}}'
        np.savez(tmp_path / "e.npz", about=np.array(about), **rows)
        with pytest.raises(rco.DataError, match="no exercise"):
            rco.exercises.load_exercise(tmp_path / "e.npz")
    with pytest.raises(rco.ModelError, match="more memory than there is"):
        rco.RCORefiner(rco.mass_spring_damper(1.0, 0.4, 100.0), dt=0.02, order=10**6)


#: What a file may hold that nobody expects: by name, the bytes, or the fields of an answer that differ.
HOSTILE = {
    "deep lists": b"[" * 100_000,
    "deep objects": b'{"a":' * 50_000,
    "more digits than a float": {"coefficient": 10**400},
    "more digits than an integer": b'{"coefficient": ' + b"9" * 6000 + b"}",
    "half a character": {"student": "\ud800"},
    "not a number": {"coefficient": float("nan")},
    "infinite": {"coefficient": float("inf")},
    "true": {"coefficient": True},
    "a list for a number": {"coefficient": [0.1]},
    "an object for a name": {"student": {"first": "Bob"}},
    "null for a name": {"student": None},
    "a formula": {"student": "=1+1;@SUM(A1)\r\n=2"},
    "control characters": {"student": "Bob\x00\x1b[2J\u202e"},
    "empty": b"",
    "a mark of byte order": b"\xef\xbb\xbf{}",
    "two bytes a character": "{}".encode("utf-16"),
    "zero bytes": b"\x00" * 5000,
    "not text": bytes(range(256)) * 20,
}


def hostile(name, answer):
    """Bytes of a hostile file; where fields of an answer are given, of such an answer."""
    content = HOSTILE[name]
    return content if isinstance(content, bytes) else json.dumps(answer | content).encode()


def test_no_answer_ends_the_grading_of_the_others(tmp_path):
    exercise = rco.exercises.hidden_effect(3, "motor")
    exercise.save(tmp_path / "ada.npz")
    ada = exercise.hand_in(tmp_path / "ada.json", "Ada", "input_gain", "voltage", 0.1)
    (alone,) = rco.exercises.grade(tmp_path).rows
    for number, name in enumerate(HOSTILE):
        (tmp_path / f"bob{number}.json").write_bytes(hostile(name, json.loads(ada.read_text())))
    (tmp_path / "folder.json").mkdir()
    found = rco.exercises.grade(tmp_path)
    assert len(found.rows) == len(HOSTILE) + 2
    assert [row for row in found.rows if row.file == "ada.json"] == [alone]
    for line in csv.reader((tmp_path / "class.csv").read_text().splitlines()):
        assert not any(re.match(r"[=+@-]", part) for cell in line for part in cell.split(";")), line


def test_neither_file_of_a_class_replaces_one_of_the_user(tmp_path):
    exercise = rco.exercises.hidden_effect(3, "motor")
    exercise.save(tmp_path / "ada.npz")
    for mine in ("class.csv", "class.html"):
        (tmp_path / mine).write_text("mine")
        with pytest.raises(FileExistsError, match=mine):
            rco.exercises.grade(tmp_path)
        assert (tmp_path / mine).read_text() == "mine"
        (tmp_path / mine).unlink()
        assert not list(tmp_path.glob("class.*"))
    rco.exercises.grade(tmp_path)
    rco.exercises.grade(tmp_path)  # its own files it may replace


@pytest.mark.parametrize("suffix", [".toml", ".csv", ".npz", ".mat", ".h5", ".uff"])
def test_hostile_models_and_records_are_refused_by_name(suffix, tmp_path):
    for name in HOSTILE:
        path = tmp_path / f"bob{suffix}"
        path.write_bytes(hostile(name, {}))
        for read in (rco.read_model, rco.read_record):
            with pytest.raises((rco.RCOError, ct.ControlArgument, OSError), match="bob"):
                read(path)
