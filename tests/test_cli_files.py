"""compare, diagnose, improve and example from the terminal: files in, exit codes and figures out."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import control as ct
import numpy as np
import pytest
import scipy.io
from inner import example_csv, main

import rcorefine as rco
from rcorefine.commands.analysis import wanted_candidates
from rcorefine.commands.example import _EXAMPLES, example_toml
from rcorefine.commands.example import EXAMPLES as NAMES
from rcorefine.models.reading import builder_names

ROOT = Path(__file__).resolve().parent.parent
A, B, C = [[0.0, 1.0], [-100.0, -0.4]], [[0.0], [1.0]], [[1.0, 0.0]]
TOML = """[state_space]
A = [[0.0, 1.0], [-100.0, -0.4]]
B = [0.0, 1.0]
C = [1.0, 0.0]
inputs = ["force"]
outputs = ["q1"]
states = ["x", "v"]
"""


def run(*arguments, cwd):
    return subprocess.run(
        [sys.executable, "-m", "rcorefine", *map(str, arguments)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        timeout=300,
        check=False,
        cwd=cwd,
    )


def simulated(stiffness=100.0, n=1000, noise=0.02, seed=0):
    """Columns of a record of an oscillator."""
    rng = np.random.default_rng(seed)
    force = 10 * rng.standard_normal(n)
    true = rco.mass_spring_damper([1.0], [0.4], [stiffness])
    y = rco.simulate(true, rco.Measurement(force, np.zeros(n), dt=0.02), "zero").outputs[0]
    return {"time": 0.02 * np.arange(n), "force": force, "q1": y + noise * y.std() * rng.standard_normal(n)}


def csv(path, columns):
    np.savetxt(path, np.array(list(columns.values())).T, delimiter=",", header=",".join(columns), comments="")
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A model, a record that it explains, and one in which the spring is 15 % softer."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "model.toml").write_text(TOML)
    csv(folder / "right.csv", simulated())
    csv(folder / "soft.csv", simulated(85.0))
    csv(folder / "soft2.csv", simulated(85.0, seed=1))
    return folder


@pytest.fixture
def call(files, monkeypatch, capsys):
    """`main` in the folder of the files; returns code, output and errors."""
    monkeypatch.chdir(files)

    def go(*arguments):
        capsys.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return go


# ------------------------------------------------------------------ exit codes
def test_compare_says_0_where_nothing_fails_and_1_where_something_does(call):
    code, out, err = call("compare", "model.toml", "right.csv")
    assert (code, err) == (0, "")
    assert "fit [%]" in out
    code, out, err = call("compare", "model.toml", "soft.csv")
    assert (code, err) == (1, "")
    assert max(map(len, out.splitlines())) <= 80


def test_diagnose_and_improve_find_the_spring(call):
    words = ("--candidates", "stiffness,damping,cubic_stiffness")
    code, out, _ = call("diagnose", "model.toml", "soft.csv", *words)
    assert code == 1
    assert "stiffness at x" in out
    code, out, _ = call("diagnose", "model.toml", "right.csv", *words)
    assert code == 0
    assert "ADEQUATE" in out
    code, out, _ = call("improve", "model.toml", "soft.csv", *words)
    assert code == 1
    assert "add stiffness at x" in out
    code, out, _ = call("improve", "model.toml", "right.csv", *words)
    assert code == 0


def test_in_a_process_of_its_own(files):
    """As in a shell: code, streams, strict JSON on one line."""
    done = run("compare", "model.toml", "soft.csv", "--json", cwd=files)
    assert done.returncode == 1
    assert done.stderr == ""
    assert done.stdout.count("\n") == 1
    assert json.loads(done.stdout)["exit_code"] == 1


def test_warnings_are_lines_on_standard_error(files, tmp_path, monkeypatch, capsys):
    """A free decay: the constant input is pointed out, without a place in the source."""
    columns = simulated(n=400)
    columns["force"] = 0.0 * columns["force"]
    columns["q1"] = np.exp(-0.2 * columns["time"]) * np.cos(9.998 * columns["time"])
    path = csv(tmp_path / "decay.csv", columns)
    monkeypatch.setattr(sys, "argv", ["rcorefine", "compare", str(files / "model.toml"), str(path)])
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main() == 0
    err = capsys.readouterr().err
    assert err.startswith("rcorefine: warning: compare: constant")
    assert ".py" not in err


def test_a_reader_that_leaves_does_not_change_the_answer(files):
    """`rcorefine compare ... | true` ends with the code of what was found, quietly."""
    with subprocess.Popen(
        [sys.executable, "-m", "rcorefine", "compare", "model.toml", "soft.csv"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        text=True,
        cwd=files,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.wait(timeout=300) == 1
        assert process.stderr.read() == ""


def test_a_fault_of_the_program_is_no_answer(call, monkeypatch):
    """Python would end with 1, which means that something was found."""

    def broken(*_, **__):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(rco, "compare", broken)
    code, out, err = call("compare", "model.toml", "right.csv")
    assert code == 3
    assert out == ""
    assert "Traceback" in err
    assert "a bug" in err


BAD = {
    "no model": (["compare", "nix.toml", "right.csv"], "nix.toml: No such file"),
    "no record": (["diagnose", "model.toml", "nix.csv"], "nix.csv: No such file"),
    "kind of model": (["compare", "right.csv", "right.csv"], "a model is a .toml, .npz or .mat file"),
    "kind of record": (["compare", "model.toml", "model.toml"], "a record is a .csv"),
    "column": (
        ["compare", "model.toml", "right.csv", "--input", "current"],
        "no column 'current'; there are",
    ),
    "time": (["compare", "model.toml", "right.csv", "--time", "t"], "no column 't'"),
    "both times": (["compare", "model.toml", "right.csv", "--time", "time", "--dt", "0.3"], "dt"),
    "candidate": (["diagnose", "model.toml", "right.csv", "--candidates", "glue"], "no candidate 'glue'"),
    "place": (["diagnose", "model.toml", "right.csv", "--candidates", "damping@mars"], "mars"),
    "folder": (["compare", "model.toml", "right.csv", "--report", "no/x.html"], "does not exist"),
    "other file": (
        ["compare", "model.toml", "right.csv", "--report", "model.toml"],
        "no report of rcorefine",
    ),
    "parameter": (["diagnose", "model.toml", "right.csv", "--free", "mass7"], "mass7"),
}


@pytest.mark.parametrize("case", list(BAD))
def test_what_cannot_be_used_ends_with_2(call, case):
    arguments, message = BAD[case]
    code, out, err = call(*arguments)
    assert code == 2
    assert out == ""
    assert message in err
    assert err.startswith(f"rcorefine {arguments[0]}: ")
    assert err.count("\n") == 1


USAGE = [
    [],
    ["dmeo"],
    ["demo", "--no-such-option"],
    ["demo", "--seed", "-1"],
    ["demo", "--seed", "x"],
    ["compare"],
    ["compare", "model.toml"],
    ["compare", "model.toml", "right.csv", "--hold", "spline"],
    ["compare", "model.toml", "right.csv", "--dt", "-1"],
    ["compare", "model.toml", "right.csv", "--dt", "nan"],
    ["compare", "model.toml", "right.csv", "--split", "1.5"],
    ["compare", "model.toml", "right.csv", "--split", "0.5", "--validation", "soft.csv"],
    ["compare", "model.toml", "right.csv", "--input", "a,,b"],
    ["diagnose", "model.toml"],
    ["diagnose", "model.toml", "right.csv", "--tolerance", "-0.1"],
    ["diagnose", "model.toml", "right.csv", "--significance", "0"],
    ["improve", "model.toml", "right.csv", "--max-effects", "-1"],
    ["example", "perpetuum"],
]


@pytest.mark.parametrize("arguments", USAGE, ids=" ".join)
def test_wrong_usage_ends_with_2(call, arguments):
    code, out, err = call(*arguments)
    assert code == 2
    assert out == ""
    assert "usage: rcorefine" in err


@pytest.mark.parametrize("command", ["compare", "diagnose", "improve", "example"])
def test_help_names_exit_codes_and_keys(call, command):
    code, out, _ = call(command, "--help")
    assert code == 0
    assert "exit codes:" in out
    assert ("--json" in out) == (command != "example")


# ------------------------------------------------------------------ figures
def test_json_of_compare_holds_what_compare_says(call, files):
    code, out, _ = call("compare", "model.toml", "soft.csv", "--json")
    said = json.loads(out)
    data = rco.Measurement.from_csv(files / "soft.csv", "force", "q1", time="time")
    expected = rco.compare(ct.ss(A, B, C, 0, inputs="force", outputs="q1", states=["x", "v"]), data)
    [model] = said["models"]
    [output] = model["outputs"]
    assert output["name"] == "q1"
    assert output["fit"] == pytest.approx(float(expected.fit[0]), rel=1e-9)
    assert output["rmse"] == pytest.approx(float(expected.rmse[0]), rel=1e-9)
    assert output["bias"] == pytest.approx(float(expected.residual.mean()), rel=1e-9)
    assert said["record"]["samples"] == 1000
    assert said["exit_code"] == code == 1
    assert len(said["answer"]) == 3
    assert said["report"] is None
    assert model["failures"][0]["sentence"]
    _, out, _ = call("compare", "model.toml", "right.csv", "--json")
    assert json.loads(out)["models"][0]["failures"] == []


def test_documented_keys_are_the_keys(call):
    """What --help lists is what comes, no more and no less."""
    for command in ("compare", "diagnose", "improve"):
        more = [] if command == "compare" else ["--candidates", "stiffness"]
        _, out, _ = call(command, "model.toml", "soft.csv", "--json", *more)
        _, text, _ = call(command, "--help")
        listed = " ".join(text.split("Keys of --json:")[1].split(" exit codes:")[0].split("\n\n")[0].split())
        for key in json.loads(out):
            assert key in listed, f"{command} {key}"


def test_json_of_diagnose_and_improve(call):
    code, out, _ = call("diagnose", "model.toml", "soft.csv", "--json", "--candidates", "stiffness,damping")
    said = json.loads(out)
    assert said["verdict"] == "effect"
    best = said["ranking"][0]
    assert best["effect"] == {"kind": "stiffness", "place": "x"}
    # a spring of 85 for 100, mass 1: -15, within four standard deviations
    assert abs(best["coefficients"]["stiffness"] + 15) < 4 * best["std"]["stiffness"]
    assert {"name", "statistic", "dof", "p_value"} == set(said["tests"][0])
    code, out, _ = call("improve", "model.toml", "soft.csv", "--json", "--candidates", "stiffness,damping")
    said = json.loads(out)
    assert [step["action"] for step in said["steps"]] == ["start", "add"]
    assert said["steps"][1]["validation_rmse"][0] < 0.3 * said["steps"][0]["validation_rmse"][0]
    assert said["system"]["A"][1][0] == pytest.approx(-85, abs=1)
    assert code == 1


@pytest.mark.usefixtures("without_pictures")
def test_report_is_written_and_named(call, files):
    code, out, _ = call("compare", "model.toml", "soft.csv", "--report", "said.html")
    assert code == 1
    assert f"Report: {files / 'said.html'}" in out
    text = (files / "said.html").read_text()
    assert "rcorefine compare model.toml soft.csv --report said.html" in text
    _, out, _ = call(
        "diagnose", "model.toml", "soft.csv", "--candidates", "stiffness", "--json", "--report", "d.html"
    )
    assert json.loads(out)["report"] == str(files / "d.html")
    _, out, _ = call("improve", "model.toml", "soft.csv", "--candidates", "stiffness", "--report", "i.html")
    assert "sha256 of the inputs" in (files / "i.html").read_text()


def test_several_models(call, files):
    (files / "soft.toml").write_text(TOML.replace("-100.0", "-85.0"))
    code, out, _ = call("compare", "model.toml", "soft.toml", "soft.csv", "--json")
    said = json.loads(out)
    assert [model["name"] for model in said["models"]] == ["model", "soft"]
    fits = [model["outputs"][0]["fit"] for model in said["models"]]
    assert fits[1] > 97 > fits[0]
    assert code == 0, "the best of the models is judged"


def test_split_and_validation(call):
    _, out, _ = call("compare", "model.toml", "soft.csv", "--split", "0.7", "--json")
    assert json.loads(out)["record"]["samples"] == 300
    words = ("--candidates", "stiffness", "--json")
    _, out, _ = call("diagnose", "model.toml", "soft.csv", "--validation", "soft2.csv", *words)
    apart = json.loads(out)["ranking"][0]["fit_after"]
    _, out, _ = call("diagnose", "model.toml", "soft.csv", *words)
    assert apart != json.loads(out)["ranking"][0]["fit_after"]
    assert apart > 96
    _, out, _ = call("diagnose", "model.toml", "soft.csv", "--split", "0.6", *words)
    assert json.loads(out)["record"]["samples"] == 600


# ------------------------------------------------------------------ records
def test_records_of_every_kind_are_the_same_record(call, tmp_path):
    """CSV, MAT and NPZ, other column names, no times: one and the same answer."""
    columns = simulated(85.0)
    named = {"F": columns["force"], "x": columns["q1"]}
    np.savez(tmp_path / "r.npz", **named)
    scipy.io.savemat(tmp_path / "r.mat", {k: v[:, None] for k, v in named.items()})
    np.savetxt(
        tmp_path / "r.csv",
        np.array([*named.values()]).T,
        delimiter=";",
        header="F;x",
        comments="",
        fmt="%.17g",
    )
    said = []
    for suffix in ("npz", "mat", "csv"):
        code, out, err = call(
            "compare",
            "model.toml",
            tmp_path / f"r.{suffix}",
            "--input",
            "F",
            "--output",
            "x",
            "--dt",
            "0.02",
            "--json",
        )
        assert (code, err) == (1, "")
        said.append(json.loads(out))
    prints = [(s["record"]["sha256_inputs"], s["record"]["sha256_outputs"]) for s in said]
    assert prints[0] == prints[1] == prints[2]
    assert said[0]["record"]["outputs"] == ["q1"], "columns take the names of the model's signals"
    assert said[0]["models"][0]["outputs"][0]["fit"] == said[2]["models"][0]["outputs"][0]["fit"]


def test_fewer_outputs_are_found_by_name(call, tmp_path):
    (tmp_path / "two.toml").write_text(TOML.replace("C = [1.0, 0.0]", "C = [[1.0, 0.0], [0.0, 1.0]]").replace(
        'outputs = ["q1"]', 'outputs = ["q1", "v1"]'))  # fmt: skip
    code, out, _ = call("compare", tmp_path / "two.toml", "right.csv", "--output", "q1", "--json")
    assert code == 0
    assert [o["name"] for o in json.loads(out)["models"][0]["outputs"]] == ["q1"]


def test_columns_with_the_models_names_are_matched_by_name(call, tmp_path):
    """In whatever order they are asked for; other names stand in the model's order."""
    (tmp_path / "two.toml").write_text(
        TOML.replace("C = [1.0, 0.0]", "C = [[1.0, 0.0], [2.0, 0.0]]").replace('["q1"]', '["q1", "q2"]')
    )
    columns = simulated()
    columns["q2"] = 2 * columns["q1"]
    csv(tmp_path / "two.csv", columns)
    csv(tmp_path / "other.csv", dict(zip(("time", "F", "a", "b"), columns.values(), strict=True)))
    for words in (
        ["two.csv"],
        ["two.csv", "--output", "q2,q1"],
        ["other.csv", "--input", "F", "--output", "a,b"],
    ):
        code, out, _ = call("compare", tmp_path / "two.toml", tmp_path / words[0], *words[1:], "--json")
        assert code == 0
        assert all(o["fit"] > 97 for o in json.loads(out)["models"][0]["outputs"])
    _, out, _ = call(
        "compare", tmp_path / "two.toml", tmp_path / "other.csv", "--input", "F", "--output", "b,a", "--json"
    )
    assert any(o["fit"] < 60 for o in json.loads(out)["models"][0]["outputs"])


def test_hold_matters(call):
    _, zoh, _ = call("compare", "model.toml", "soft.csv", "--json")
    _, foh, _ = call("compare", "model.toml", "soft.csv", "--json", "--hold", "foh")
    assert json.loads(foh)["record"]["hold"] == "foh"
    first, second = (json.loads(t)["models"][0]["outputs"][0]["rmse"] for t in (zoh, foh))
    assert first != second


# ------------------------------------------------------------------ models
def same(system, reference):
    for key in "ABCD":
        assert np.array_equal(np.asarray(getattr(system, key)), np.asarray(getattr(reference, key))), key


def test_models_of_every_kind_are_the_same_model(tmp_path):
    reference = ct.ss(A, B, C, 0)
    (tmp_path / "m.toml").write_text(TOML)
    arrays = {"A": np.array(A), "B": np.array(B), "C": np.array(C)}
    np.savez(tmp_path / "m.npz", **arrays, inputs=["force"], outputs="q1", dt=0.0)
    scipy.io.savemat(
        tmp_path / "m.mat", arrays | {"D": 0.0, "inputs": "force", "outputs": np.array(["q1"], dtype=object)}
    )
    for suffix in ("toml", "npz", "mat"):
        system = rco.read_model(tmp_path / f"m.{suffix}")
        same(system, reference)
        assert system.input_labels == ["force"]
        assert system.output_labels == ["q1"]
        assert system.dt == 0
        assert system.name == "m"


def test_discrete_model(tmp_path):
    np.savez(tmp_path / "d.npz", A=[[0.5]], B=[[1.0, 2.0]], C=[[1.0], [3.0]], D=np.ones((2, 2)), dt=0.1)
    system = rco.read_model(tmp_path / "d.npz")
    assert (system.dt, system.ninputs, system.noutputs) == (0.1, 2, 2)


@pytest.mark.parametrize(
    "text, message",
    [
        ("[state_space]\nA = [[1", "not TOML"),
        ("", "it holds nothing"),
        ("[a]\n[b]\n", "it holds a, b"),
        ("[pendulum]\nl = 1\n", "no model is called 'pendulum'"),
        ("series_rlc = 3\n", "must be a table"),
        ("[state_space]\nA = [[1.0]]\n", "B, C missing"),
        ("[state_space]\nA = [[1.0, 2.0]]\nB = [1.0]\nC = [1.0]\n", "A is 1 x 2"),
        ("[state_space]\nA = [[1.0], [1.0, 2.0]]\nB = [1.0]\nC = [1.0]\n", "rows of equal length"),
        ("[state_space]\nA = [[1.0]]\nB = [[nan]]\nC = [1.0]\n", "B is not finite in row 1, column 1"),
        ("[state_space]\nA = [[1.0]]\nB = [1.0]\nC = [1.0]\ninputs = ['a', 'b']\n", "inputs must be 1 name"),
        ("[state_space]\nA = [[1.0]]\nB = [1.0]\nC = [1.0]\ndt = 'slow'\n", "dt must be"),
        ("[state_space]\nA = [[1.0]]\nB = [1.0]\nC = [1.0]\ngain = 2\n", "no key gain"),
        ("[series_rlc]\nR = 1.0\nl = 1.0\nC = 1.0\n", "no parameter l; there are R, L, C"),
        ("[series_rlc]\nR = 1.0\n", "L, C missing"),
        ("[series_rlc]\nR = 1.0\nL = -1.0\nC = 1.0\n", "L"),
        ("[series_rlc]\nR = 'big'\nL = 1.0\nC = 1.0\n", "R"),
        ("[mass_spring_damper]\nm = [1.0, 1.0]\nc = [1.0]\nk = [1.0, 1.0]\n", "c"),
        ("[thermal_network]\ncapacities = [1.0]\nresistances = {'1~0' = 2.0}\n", "must name two nodes"),
        ("[thermal_network]\ncapacities = [1.0]\nresistances = 4\n", "must be a table"),
    ],
)
def test_wrong_model_files_name_file_and_key(tmp_path, text, message):
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(rco.ModelError, match="wrong.toml") as caught:
        rco.read_model(path)
    assert message in str(caught.value)


def test_wrong_array_files(tmp_path):
    np.savez(tmp_path / "a.npz", A=np.eye(2), B=np.ones((3, 1)), C=np.ones((1, 2)))
    with pytest.raises(rco.ModelError, match="B is 3 x 1"):
        rco.read_model(tmp_path / "a.npz")
    np.save(tmp_path / "b.npy", np.eye(2))
    (tmp_path / "b.npy").rename(tmp_path / "b.npz")
    with pytest.raises(rco.DataError, match="one array without a name"):
        rco.read_model(tmp_path / "b.npz")
    (tmp_path / "c.npz").write_bytes(b"not a zip")
    with pytest.raises(rco.DataError, match="savez"):
        rco.read_model(tmp_path / "c.npz")
    np.savez(tmp_path / "e.npz", A=np.array([{}], dtype=object))
    with pytest.raises(rco.DataError, match="savez"):
        rco.read_model(tmp_path / "e.npz")
    np.savez(tmp_path / "f.npz", A=np.eye(1), B=np.eye(1), C=np.eye(1), dt=[1.0, 2.0])
    with pytest.raises(rco.ModelError, match="dt must be one number"):
        rco.read_model(tmp_path / "f.npz")


def test_records_from_npz(tmp_path):
    np.savez(tmp_path / "r.npz", t=[0.0, 0.1, 0.2], u=np.ones((1, 3)), y=np.ones((3, 1)), M=np.eye(3))
    data = rco.Measurement.from_npz(tmp_path / "r.npz", "u", "y", time="t")
    assert (data.n_samples, data.name, data.dt) == (3, "r", pytest.approx(0.1))
    with pytest.raises(rco.DataError, match="no variable 'z'; there are: t 3, u 1 x 3, y 3 x 1, M 3 x 3"):
        rco.Measurement.from_npz(tmp_path / "r.npz", "u", "z", time="t")
    with pytest.raises(rco.DataError, match="not a vector"):
        rco.Measurement.from_npz(tmp_path / "r.npz", "M", "y", time="t")


def test_builder_values_of_each_shape(tmp_path):
    """Sensors as pairs and lists, resistances by pairs of nodes, force maps as matrices."""
    path = tmp_path / "m.toml"
    path.write_text(
        "[mass_spring_damper]\nm = [1.0, 2.0]\nc = [0.1, 0.1]\nk = [5.0, 6.0]\nforce = [[1.0], [-1.0]]\n"
        'sensors = [["velocity", 1], ["displacement", "link2"]]\n'
    )
    model = rco.read_model(path)
    expected = rco.mass_spring_damper(
        [1.0, 2.0], [0.1, 0.1], [5.0, 6.0], sensors=[("velocity", 1), ("displacement", "link2")],
        force=np.array([[1.0], [-1.0]]),
    )  # fmt: skip
    same(model.system, expected.system)
    path.write_text(
        '[thermal_network]\ncapacities = [1.0, 2.0]\nresistances = {"1-2" = 0.5, "2 - 0" = 2.0}\n'
    )
    same(rco.read_model(path).system, rco.thermal_network([1.0, 2.0], {(1, 2): 0.5, (2, 0): 2.0}).system)
    path.write_text(
        "[mechanical]\nM = [[2.0, 0.0], [0.0, 1.0]]\nK = [[3.0, -1.0], [-1.0, 1.0]]\n"
        "damping_ratio = [0.02, 0.03]\nlinks = { foot = [1, 0], both = [1.0, 1.0] }\n"
    )
    expected = rco.mechanical(
        [[2.0, 0.0], [0.0, 1.0]], None, [[3.0, -1.0], [-1.0, 1.0]], damping_ratio=[0.02, 0.03],
        links={"foot": (1, 0), "both": np.array([1.0, 1.0])},
    )  # fmt: skip
    assert [p.name for p in rco.read_model(path).ports] == [p.name for p in expected.ports]
    same(rco.read_model(path).system, expected.system)


def test_candidates_by_kind_place_or_both():
    chain = rco.mass_spring_damper([1.0, 1.0], [1.0, 1.0], [50.0, 50.0])
    assert wanted_candidates(chain, None) is None
    at_link2 = wanted_candidates(chain, ["link2"])
    assert {effect.place for effect in at_link2} == {"link2"}
    [one] = wanted_candidates(chain, ["hysteresis@link1", "hysteresis@link1"])
    assert (one.kind, one.place) == ("hysteresis", "link1")


# ------------------------------------------------------------------ examples
def test_every_builder_has_an_example():
    assert set(NAMES) == {"state_space", *builder_names()}


def test_example_prints_both_files(call):
    code, out, err = call("example")
    assert (code, err) == (0, "")
    assert "[mass_spring_damper]" in out
    assert "time,force,v1" in out
    assert "rcorefine example mass_spring_damper --write" in out


@pytest.mark.parametrize("name", NAMES)
def test_examples_work_when_fed_back(call, tmp_path, name):
    """The record hides an effect: compare says so; it differs from the one that hides nothing."""
    code, out, _ = call("example", name, "--write", tmp_path / "new")
    assert code == 0
    model, record = tmp_path / "new" / f"{name}.toml", tmp_path / "new" / f"{name}.csv"
    assert model.read_text() == example_toml(name)
    assert record.read_text() == example_csv(name)
    assert f"rcorefine compare {model} {record}" in out
    code, out, err = call("compare", model, record, "--json")
    assert (code, err) == (1, "")
    worst = min(o["fit"] for o in json.loads(out)["models"][0]["outputs"])
    assert worst < 97
    code, _, err = call("example", name, "--write", tmp_path / "new")
    assert code == 2
    assert "exists" in err
    exact = tmp_path / "exact.csv"
    exact.write_text(example_csv(name, exact=True))
    system = rco.read_model(model)
    data = rco.read_record(exact, system)
    # 2 % of noise leaves a fit of 98 %
    assert np.abs(rco.compare(system, data).fit - 98).max() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_examples_hide_what_diagnose_finds(call, tmp_path, name):
    call("example", name, "--write", tmp_path)
    code, out, _ = call("diagnose", tmp_path / f"{name}.toml", tmp_path / f"{name}.csv", "--json")
    assert code == 1
    made = _EXAMPLES[name]
    first = json.loads(out)["ranking"][0]
    rows = [
        row for row in (first, *first["same"]) if row["effect"] == {"kind": made.kind, "place": made.place}
    ]
    sizes = zip(rows[0]["coefficients"].values(), rows[0]["std"].values(), made.values, strict=True)
    assert all(abs(found - true) < 4 * std for found, std, true in sizes)
