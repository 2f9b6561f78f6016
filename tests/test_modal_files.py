"""Modes of universal files as models, against the response of the structure that they belong to."""

import control as ct
import numpy as np
import pytest
from scipy.linalg import eig, eigh

import rcorefine as rco

pyuff = pytest.importorskip("pyuff")

M = np.diag([2.0, 1.0, 0.5])
K = np.array([[500.0, -200.0, 0], [-200, 350, -150], [0, -150, 150]])
RATIOS = np.array([0.01, 0.02, 0.03])
OMEGA = np.geomspace(2.0, 60.0, 40)


def put(path, shape, **numbers):
    """A mode along z at nodes 11, 12, 13."""
    zero = np.zeros(3, shape.dtype)
    is_complex = np.iscomplexobj(shape)
    mode = {
        "type": 55, "model_type": 1, "analysis_type": 3 if is_complex else 2, "data_ch": 2,
        "spec_data_type": 8, "data_type": 5 if is_complex else 2, "n_data_per_node": 3, "r1": zero,
        "r2": zero, "r3": shape, "load_case": 1, "node_nums": np.array([11, 12, 13]),
    }  # fmt: skip
    pyuff.UFF(str(path)).write_sets(mode | numbers | {f"id{k}": "NONE" for k in range(1, 6)}, "add")
    return path


def normal_modes(path, scale=1.0, **changed):
    squares, shapes = eigh(K, M)
    for k in (1, 0, 2):  # in no order
        numbers = {"modal_m": scale**2, "modal_damp_vis": RATIOS[k], "modal_damp_his": 0.0} | changed
        put(path, scale * shapes[:, k], mode_n=k + 1, freq=np.sqrt(squares[k]) / 2 / np.pi, **numbers)
    return path


def response(C):
    """From node 11 to 13, written out."""
    return np.array([np.linalg.solve(K + 1j * w * C - w * w * M, [1.0, 0, 0])[2] for w in OMEGA])


def modal_damping():
    squares, shapes = eigh(K, M)
    return M @ shapes @ np.diag(2 * RATIOS * np.sqrt(squares)) @ shapes.T @ M


def of(model):
    return np.asarray(model(1j * OMEGA)).ravel()


@pytest.mark.parametrize("sensors, power", [("displacement", 0), ("velocity", 1), ("acceleration", 2)])
def test_normal_modes(tmp_path, sensors, power):
    model = rco.modal_model(normal_modes(tmp_path / "d.uff", 3.0), "11:3", "13:-3", sensors=sensors)
    assert (model.input_labels, model.output_labels, model.name) == (["11:3"], ["13:-3"], "d")
    np.testing.assert_allclose(of(model), -((1j * OMEGA) ** power) * response(modal_damping()), rtol=2e-3)
    assert [port.name for port in rco.ports(model)] == ["mode1", "mode2", "mode3"]


def test_complex_modes(tmp_path):
    C = np.diag([0.5, 0.0, 2.0])  # not proportional
    zero = np.zeros((3, 3))
    first = np.block([[C, M], [M, zero]]), np.block([[K, zero], [zero, -M]])
    poles, vectors = eig(-first[1], first[0])
    for k in np.flatnonzero(poles.imag < 0):  # either of a pair will do
        a = vectors[:, k] @ first[0] @ vectors[:, k]
        put(tmp_path / "c.uff", vectors[:3, k], mode_n=1, eig=poles[k], modal_a=a, modal_b=-poles[k] * a)
    model = rco.modal_model(tmp_path / "c.uff", "11:3", "13:3")
    np.testing.assert_allclose(of(model), response(C), rtol=2e-3)


def test_a_mode_that_lacks_the_motion_of_a_node_is_damaged(tmp_path):
    path = normal_modes(tmp_path / "d.uff")
    lines = path.read_text().splitlines()
    assert lines[15].split() == ["0.00000e+00", "0.00000e+00", lines[15].split()[2]]
    path.write_text("\n".join([*lines[:15], *lines[16:], ""]))
    with pytest.raises(rco.DataError, match=r"d\.uff.*damaged"):
        rco.modal_model(path, "11:3", "13:3")


def test_scales_that_a_file_does_not_tell(tmp_path):
    with pytest.raises(rco.ModelError, match="has no modal mass in the file.*modal_mass="):
        rco.modal_model(normal_modes(tmp_path / "a.uff", 3.0, modal_m=0.0), "11:3")
    given = rco.modal_model(tmp_path / "a.uff", "11:3", "13:3", modal_mass=9.0)
    np.testing.assert_allclose(of(given), response(modal_damping()), rtol=2e-3)
    with pytest.raises(ct.ControlDimension, match="2 numbers for the 3 modes"):
        rco.modal_model(tmp_path / "a.uff", "11:3", modal_mass=[1.0, 2.0])
    with pytest.warns(rco.ConversionWarning, match="every modal mass is 1"):
        unit = rco.modal_model(normal_modes(tmp_path / "b.uff"), "11:3")
    assert unit.output_labels == ["11:3", "12:3", "13:3"]
    lossy = normal_modes(tmp_path / "l.uff", 2.0, modal_damp_vis=0.0, modal_damp_his=0.04)
    with pytest.warns(rco.ConversionWarning, match="loss factor 0.04 is taken as a damping ratio of 0.02"):
        damped = rco.modal_model(lossy, "11:3")
    np.testing.assert_allclose(ct.damp(damped, doprint=False)[1], 0.02, rtol=1e-4)


def test_what_is_not_there(tmp_path):
    path = normal_modes(tmp_path / "a.uff", 2.0)
    with pytest.raises(rco.ModelError, match="'14:3' is not in every shape; the nodes .* 11, 12, 13"):
        rco.modal_model(path, "14:3")
    with pytest.raises(rco.ModelError, match="write .node:direction."):
        rco.modal_model(path, "11z")
    still = put(
        tmp_path / "s.uff",
        np.zeros(3),
        mode_n=4,
        freq=1.0,
        modal_m=1.0,
        modal_damp_vis=0.01,
        modal_damp_his=0.0,
    )
    with pytest.raises(rco.DataError, match="mode 4 has no shape"):
        rco.modal_model(still, "11:3")


def test_a_mode_that_is_off_is_named(tmp_path):
    """What the modes were measured on has another damping since: the record says in which mode."""
    model = rco.modal_model(normal_modes(tmp_path / "d.uff", 2.0), "11:3", ["11:3", "13:3"])
    shapes = eigh(K, M)[1]
    added = M @ np.outer(shapes[:, 1], shapes[:, 1]) @ M * 2.0
    rng = np.random.default_rng(0)
    C = modal_damping() + added
    G = np.array([np.linalg.solve(K + 1j * w * C - w * w * M, [1.0, 0, 0]) for w in OMEGA])
    std = 0.01 * np.abs(G[:, [0, 2]].T)
    points = G[:, [0, 2]].T + std * (rng.standard_normal(std.shape) + 1j * rng.standard_normal(std.shape))
    measured = rco.FrequencyResponse(
        points[:, None], OMEGA, std=std[:, None], input_labels="11:3", output_labels=["11:3", "13:3"]
    )
    best = rco.diagnose(model, measured).best
    assert (best.effect.kind, best.effect.place) == ("damping", "mode2")
