"""The lowest modes of large structures against dense eigenproblems and the whole model."""

import control as ct
import numpy as np
import pytest
from scipy.io import mmwrite
from scipy.linalg import eigh
from scipy.sparse import coo_matrix, csr_matrix, diags, kron

import rcorefine as rco


def plate(side=16, foundation=0.0, seed=None):
    """Masses on a square net of springs: double frequencies, and one rigid mode where it floats."""
    rng = np.random.default_rng(seed)
    line = diags(
        [-np.ones(side - 1), np.r_[1.0, np.full(side - 2, 2.0), 1.0], -np.ones(side - 1)], [-1, 0, 1]
    )
    one = diags(np.ones(side))
    K = 1e4 * (kron(line, one) + kron(one, line)) + foundation * diags(np.ones(side**2))
    M = diags(np.full(side**2, 0.5) if seed is None else rng.uniform(0.3, 0.7, side**2))
    return M, K


def beam(elements=150):
    """A free-free Euler beam with consistent masses: two rigid modes, rotations beside displacements."""
    h, n = 1.0 / elements, 2 * elements + 2
    k = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4.0]])
    m = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4.0]]) / 420
    scale = np.array([1, h, 1, h])
    M, K = np.zeros((n, n)), np.zeros((n, n))
    for e in range(elements):
        at = np.ix_(range(2 * e, 2 * e + 4), range(2 * e, 2 * e + 4))
        M[at] += h * m * np.outer(scale, scale)
        K[at] += k / h**3 * np.outer(scale, scale)
    return csr_matrix(M), csr_matrix(K)


def squares_of(model):
    return np.array([q.value for q in model.parameters if q.kind == "stiffness"])


def response(model, omega):
    A, B, C, D = (getattr(model.linear, key) for key in "ABCD")
    return np.stack([C @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B + 0j) + D for w in omega], axis=-1)


@pytest.mark.parametrize(
    ("M", "K", "rigid"),
    [(*plate(), 1), (*plate(foundation=50.0, seed=1), 0), (*plate(side=9), 1), (*beam(), 2)],
    ids=["floating", "founded", "small", "beam"],
)
def test_frequencies_are_those_of_the_dense_problem(M, K, rigid):
    dense = eigh(K.toarray(), M.toarray(), eigvals_only=True)
    model = rco.mechanical(M, K=K, n_modes=8, sensors=("displacement", 1))
    found = squares_of(model)
    assert np.count_nonzero(found == 0) == rigid
    rounding = 1e-13 * dense[-1]
    np.testing.assert_allclose(found, np.where(np.arange(8) < rigid, 0, dense[:8]), rtol=1e-7, atol=rounding)
    assert model.linear.n_states == 16


def test_a_free_beam_has_the_frequencies_of_the_closed_form():
    model = rco.mechanical(beam(60)[0], K=beam(60)[1], n_modes=5, sensors=("displacement", 1))
    expected = np.array([4.73004074, 7.85320462, 10.9956078]) ** 4  # cos x cosh x = 1
    np.testing.assert_allclose(squares_of(model)[2:], expected, rtol=1e-4)


def test_below_the_cut_the_response_is_that_of_the_whole():
    M, K = plate(foundation=200.0, seed=3)
    omega2, shapes = eigh(K.toarray(), M.toarray())
    kept = 40
    C = 0.2 * M + 1e-5 * K
    keys = {"force_map": [1, 120], "sensors": [("displacement", 40), ("velocity", 200), ("acceleration", 1)]}
    model = rco.mechanical(M, C, K, n_modes=kept, **keys)
    omega = np.linspace(0.05, 0.5, 30) * np.sqrt(omega2[kept])
    F = np.zeros((256, 2))
    F[0, 0] = F[119, 1] = 1.0
    rows = [(39, 0), (199, 1), (0, 2)]

    def answer(w):
        x = np.linalg.solve(K.toarray() + 1j * w * C.toarray() - w**2 * M.toarray(), F)
        return np.array([(1j * w) ** order * x[at] for at, order in rows])

    def modal(w):  # the sum over the modes that are kept, from the dense problem
        phi = shapes[:, :kept]
        x = phi @ ((phi.T @ F) / (omega2[:kept] + 1j * w * (0.2 + 1e-5 * omega2[:kept]) - w**2)[:, None])
        return np.array([(1j * w) ** order * x[at] for at, order in rows])

    found = response(model, omega)
    scale = np.abs(found).max(axis=(1, 2), keepdims=True)
    assert np.abs((found - np.stack([modal(w) for w in omega], axis=-1)) / scale).max() < 1e-8
    whole = np.stack([answer(w) for w in omega], axis=-1)
    # a mode left out keeps at most 1 / (1 - 1/4) of its static part below half the cut
    higher = shapes[:, kept:] / omega2[kept:]
    left = np.abs(shapes[[39, 199, 0], kept:])[:, None] * np.abs(higher[[0, 119]])[None]
    order = np.array([0, 1, 2])[:, None, None]
    assert (np.abs(found - whole) <= 4 / 3 * left.sum(axis=-1)[..., None] * omega**order + 1e-12).all()
    # and near a resonance that is nothing
    assert np.abs((found - whole) / np.abs(whole).max(axis=-1, keepdims=True)).max() < 0.05


@pytest.mark.parametrize("excitation", ["force", "base"])
def test_all_modes_are_the_model_itself(excitation):
    rng = np.random.default_rng(2)
    Q = rng.normal(size=(5, 5))
    M, K, C = np.diag(rng.uniform(1, 2, 5)), Q @ Q.T + 4 * np.eye(5), np.diag(rng.uniform(0.1, 0.3, 5))
    C[0, 1], C[1, 0] = 0.4, -0.4  # gyroscopic
    keys = {
        "excitation": excitation,
        "force_map": [2, 5],
        "links": {"brace": (1, 3), "foot": (2, 0)},
        "sensors": ["acceleration", ("velocity", 2), ("displacement", "brace")],
    }
    whole, modal = (rco.mechanical(M, C, K, n_modes=n, **keys) for n in (None, 5))
    omega = np.geomspace(0.1, 30, 20)
    np.testing.assert_allclose(response(modal, omega), response(whole, omega), rtol=1e-9, atol=1e-12)
    # a spring at a named link moves the poles of both alike
    for name in ("brace", "foot"):
        poles = []
        for model in (whole, modal):
            port = model.port(name)
            poles.append(np.linalg.eigvals(model.linear.A + 3.0 * np.outer(port.act, port.position)))
        np.testing.assert_allclose(np.sort_complex(poles[0]), np.sort_complex(poles[1]), rtol=1e-8)
        assert port.position_unit == "m"
    ratio = [
        rco.mechanical(M, K=K, damping_ratio=[0.01, 0.02, 0.03, 0.04, 0.05], n_modes=n) for n in (None, 5)
    ]
    np.testing.assert_allclose(response(ratio[1], omega), response(ratio[0], omega), rtol=1e-9, atol=1e-12)


def test_modes_are_places_with_a_frequency_and_a_damping():
    M, K = plate(foundation=30.0, seed=5)
    model = rco.mechanical(
        M, K=K, damping_ratio=0.02, n_modes=3, sensors=("velocity", 7), links={"tie": (7, 0)}
    )
    assert model.places[:4] == ("tie", "mode1", "mode2", "mode3")
    kinds = {e.kind for e in rco.effect_library(model, places="mode2")}
    assert kinds == {"stiffness", "damping"}
    assert "cubic_stiffness" in {e.kind for e in rco.effect_library(model, places="tie")}
    ratios = ct.damp(model.system, doprint=False)[1]
    np.testing.assert_allclose(ratios, 0.02, rtol=1e-9)
    w = 50 * np.random.default_rng(0).standard_normal(2000)
    truth = rco.mechanical(M, K=K, damping_ratio=[0.02, 0.05, 0.02], n_modes=3, sensors=("velocity", 7))
    y = ct.forced_response(truth.system.sample(0.02), None, w).outputs
    y = y + 0.01 * y.std() * np.random.default_rng(1).standard_normal(y.size)
    found = rco.refine(model, rco.Measurement(w, y, dt=0.02), [rco.Effect("damping", "mode2")])
    (row,) = [row for row in found.parameters if row.role == "effect"]
    assert abs(row.value - 0.10 * np.sqrt(squares_of(model)[1])) < 4 * row.std


def test_sparse_matrices_without_a_cut_and_from_files(tmp_path):
    M, K = plate(side=4, foundation=10.0)
    same = rco.mechanical(M.toarray(), K=K.toarray(), damping_ratio=0.02)
    np.testing.assert_array_equal(rco.mechanical(M, K=K, damping_ratio=0.02).linear.A, same.linear.A)
    M, K = plate(side=40, foundation=10.0, seed=2)  # 1600: more than a file may hold whole
    mmwrite(tmp_path / "M.mtx", coo_matrix(M))
    mmwrite(tmp_path / "K.mtx", coo_matrix(K), symmetry="symmetric")
    text = '[mechanical]\nM = "M.mtx"\nK = "K.mtx"\ndamping_ratio = 0.01\nsensors = [["velocity", 3]]\n'
    (tmp_path / "plate.toml").write_text(text + "n_modes = 4\n")
    expected = rco.mechanical(M, K=K, damping_ratio=0.01, n_modes=4, sensors=("velocity", 3))
    np.testing.assert_allclose(rco.read_model(tmp_path / "plate.toml").linear.A, expected.linear.A, rtol=1e-9)
    (tmp_path / "plate.toml").write_text(text)
    with pytest.raises(rco.ModelError, match="1600 states"):
        rco.read_model(tmp_path / "plate.toml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_modes": 0}, "n_modes"),
        ({"n_modes": 257}, "there are 1 to 256"),
        ({"n_modes": 2.5}, "n_modes"),
        ({"M": diags(np.r_[np.ones(255), 0.0])}, "positive definite"),
        ({"M": diags(np.r_[np.ones(255), -1.0])}, "positive definite"),
        ({"M": diags(np.ones(255))}, "shape"),
        ({"M": diags(np.r_[np.ones(255), np.nan])}, "not finite"),
        ({"M": diags(np.ones(256) * 1j)}, "real"),
        ({"K": -plate()[1]}, "negative direction"),
        ({"K": plate()[1] + diags([np.ones(255)], [1])}, "K is not symmetric"),
        ({"K": diags(np.ones(255))}, "K has shape"),
        ({"C": diags(np.ones(3))}, "C has shape"),
        ({"C": diags(np.ones(256)), "damping_ratio": 0.1}, "not both"),
        ({"damping_ratio": [0.1, 0.2, 0.3]}, "one per mode"),
        ({"links": {"a": (1, 300)}}, "link 'a'"),
        ({"links": {"mode1": (1, 2)}}, "mode1"),
    ],
)
def test_what_is_wrong_is_said(change, message):
    M, K = plate()
    keys = {"M": M, "K": K, "n_modes": 4, "sensors": ("velocity", 1), **change}
    with pytest.raises((rco.ModelError, ct.ControlDimension, ct.ControlArgument), match=message):
        rco.mechanical(keys.pop("M"), **keys)
