"""Model files whose matrices stand in files of their own, and what a plain model's file may declare."""

import control as ct
import numpy as np
import pytest
from inner import main
from scipy.io import mmwrite
from scipy.sparse import coo_matrix

import rcorefine as rco

A, B, C = np.array([[0.0, 1.0], [-4.0, -0.4]]), np.array([[0.0], [2.0]]), np.array([[1.0, 0.0]])
LABELS = 'inputs = ["u"]\noutputs = ["y"]\nstates = ["x", "v"]\n'


def written(folder, a='"A.csv"', more=""):
    path = folder / "model.toml"
    path.write_text(f"[state_space]\nA = {a}\nB = [[0.0], [2.0]]\nC = [[1.0, 0.0]]\n{LABELS}{more}")
    return path


def as_csv(path):
    np.savetxt(path, A, delimiter=",")


def as_german(path):
    path.write_text("# Steifigkeit\n0;1\n\n-4;-0,4\n")


def as_blanks(path):
    path.write_text("0 1\n-4 -0.4  # last row\n")


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("A.csv", as_csv),
        ("A.csv", as_german),
        ("sub/A.CSV", as_blanks),
        ("A.npy", lambda path: np.save(path, A)),
        ("A.mtx", lambda path: mmwrite(path, A)),
        ("A.mtx", lambda path: mmwrite(path, coo_matrix(A))),
    ],
)
@pytest.mark.parametrize("absolute", [False, True])
def test_a_matrix_in_a_file_of_its_own(tmp_path, name, write, absolute):
    (tmp_path / "sub").mkdir()
    write(tmp_path / name)
    model = rco.read_model(written(tmp_path, repr(str(tmp_path / name) if absolute else name)))
    assert isinstance(model, ct.StateSpace)
    np.testing.assert_array_equal(model.A, A)


def test_all_matrices_in_files_and_those_of_a_structure(tmp_path):
    for key, value in zip("ABCD", (A, B.ravel(), C, [[0.5]]), strict=True):
        np.save(tmp_path / f"{key}.npy", value)
    (tmp_path / "all.toml").write_text("[state_space]\n" + "".join(f'{k} = "{k}.npy"\n' for k in "ABCD"))
    model = rco.read_model(tmp_path / "all.toml")
    np.testing.assert_array_equal(model.B, B)
    np.testing.assert_array_equal(model.D, [[0.5]])
    K = coo_matrix([[3.0, -1.0], [-1.0, 1.0]])
    mmwrite(tmp_path / "K.mtx", K, symmetry="symmetric")
    (tmp_path / "s.toml").write_text('[mechanical]\nM = [2.0, 1.0]\nK = "K.mtx"\ndamping_ratio = 0.02\n')
    same = rco.mechanical([2.0, 1.0], K=K.toarray(), damping_ratio=0.02)
    np.testing.assert_allclose(rco.read_model(tmp_path / "s.toml").linear.A, same.linear.A)


HUGE = "%%MatrixMarket matrix coordinate real general\n2 2 4000000000\n1 1 1.0\n"
WIDE = "%%MatrixMarket matrix coordinate real general\n900000 900000 1\n1 1 1.0\n"
COMPLEX = "%%MatrixMarket matrix array complex general\n1 1\n1.0 2.0\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.csv", None, "none.csv cannot be read: No such file"),
        ("A.txt", "1", "a .csv, .mtx, .npy file, not 'A.txt'"),
        ("A.csv", "", "it is empty"),
        ("A.csv", "a,b\n1,2\n", "holds no matrix"),
        ("A.csv", "1,2\n3\n", "holds no matrix"),
        ("A.csv", "1,nan\n2,3\n", "not finite in row 1, column 2"),
        ("A.csv", "1,2,3\n4,5,6\n", "A is 2 x 3"),
        ("A.csv", b"\xff\xfe\x00", "holds no matrix"),
        ("A.npy", b"PK not an array", "holds no matrix"),
        ("A.mtx", "1 2 3", "holds no matrix"),
        ("A.mtx", HUGE, "promises more numbers"),
        ("A.mtx", WIDE, "900000 states"),
        ("A.mtx", COMPLEX, "complex"),
    ],
)
def test_a_file_that_does_not_fit_is_named(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(rco.ModelError, match=r"model\.toml, \[state_space\]") as caught:
        rco.read_model(written(tmp_path, repr(name)))
    assert message in str(caught.value)
    if "must" not in message and " x " not in message and "states" not in message:
        assert name in str(caught.value)


def test_objects_are_never_opened(tmp_path):
    np.save(tmp_path / "A.npy", np.array([[{}]]), allow_pickle=True)
    with pytest.raises(rco.ModelError, match="Python objects"):
        rco.read_model(written(tmp_path, '"A.npy"'))


POINT = "operating_point = {inputs = {u = 3.0}, states = [9.0, 0.0]}\n"


def test_a_file_declares_an_operating_point_and_compare_takes_it(tmp_path, capsys):
    as_csv(tmp_path / "A.csv")
    more = POINT + 'units = {x = "m", u = "N"}\n'
    path = written(tmp_path, more=more)
    model = rco.read_model(path)
    assert (model.state_units[0], model.input_units) == ("m", ("N",))
    np.testing.assert_array_equal(model.operating_point.outputs, [9.0])
    t = 0.05 * np.arange(400)
    u = 3.0 + np.sign(np.sin(1.1 * t))
    y = 9.0 + ct.forced_response(ct.ss(A, B, C, 0).sample(0.05), t, u - 3.0).outputs
    y += 0.01 * np.random.default_rng(1).standard_normal(t.size)
    np.savetxt(tmp_path / "r.csv", np.c_[t, u, y], delimiter=",", header="time,u,y", comments="")
    assert main(["compare", str(path), str(tmp_path / "r.csv")]) == 0
    assert "No significant failure" in capsys.readouterr().out
    assert main(["compare", str(written(tmp_path)), str(tmp_path / "r.csv")]) == 1  # not about the point


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ("{inputs = [3.0]}", "lacks 'states'"),
        ("{inputs = [3.0, 1.0], states = [1.5, 0.0]}", "inputs"),
        ("{inputs = {w = 3.0}, states = [1.5, 0.0]}", "names 'w'"),
        ("4.0", "operating_point"),
    ],
)
def test_a_wrong_operating_point_is_named(tmp_path, point, message):
    as_csv(tmp_path / "A.csv")
    with pytest.raises(rco.ModelError, match=r"model\.toml") as caught:
        rco.read_model(written(tmp_path, more=f"operating_point = {point}\n"))
    assert message in str(caught.value)
