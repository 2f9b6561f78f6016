"""A measured frequency response: how it is made, read from files, and what is refused."""

from __future__ import annotations

import control as ct
import numpy as np
import pytest

import rcorefine as rco


def lag(omega):
    return 1 / (1j * omega + 2)


OMEGA = np.linspace(1.0, 10.0, 10)


def test_made_from_arrays_and_sorted():
    measured = rco.FrequencyResponse(lag(OMEGA[::-1]), OMEGA[::-1], std=0.1, amplitude=np.arange(10, 0, -1))
    np.testing.assert_allclose(measured.response[0, 0], lag(OMEGA))
    np.testing.assert_allclose(measured.omega, OMEGA)
    np.testing.assert_allclose(measured.amplitude, np.arange(1, 11))
    assert measured.std.shape == measured.response.shape == (1, 1, 10)
    assert ct.bode_plot(measured).axes.shape == (2, 1)
    assert rco.FrequencyResponse(lag(OMEGA), OMEGA).std is None


def test_deviation_from_coherence_is_that_of_many_estimates():
    """Bendat and Piersol against the scatter of averaged cross spectra, white noise at the output."""
    rng, n, trials = np.random.default_rng(0), 40, 4000
    w, e = ((rng.standard_normal((2, trials, n)) * [[[1]], [[1j]]]).sum(axis=0) for _ in range(2))
    true, noise = 0.7 - 0.4j, 0.5
    y = true * w + noise * e
    estimates = (y * w.conj()).sum(axis=1) / (abs(w) ** 2).sum(axis=1)
    coherence = abs(true) ** 2 / (abs(true) ** 2 + noise**2)
    measured = rco.FrequencyResponse([true], [1.0], coherence=[coherence], n_averages=n)
    assert measured.std[0, 0, 0] == pytest.approx(estimates.real.std(), rel=0.05)
    assert measured.std[0, 0, 0] == pytest.approx(abs(estimates).std(), rel=0.05)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"omega": [1.0, 1.0, *range(2, 10)]}, "twice"),
        ({"omega": [0.0, *range(1, 10)]}, "positive"),
        ({"omega": [1.0, 2.0]}, "10 points and omega 2"),
        ({"response": np.full(10, np.nan)}, "not finite"),
        ({"response": np.ones((2, 10))}, "shape"),
        ({"response": "loud"}, "real numbers"),
        ({"std": -1.0}, "negative"),
        ({"std": [1.0, 2.0]}, "shape"),
        ({"coherence": np.full(10, 1.5)}, "between 0 and 1"),
        ({"coherence": np.ones(9)}, "shape"),
        ({"amplitude": -1.0}, "positive"),
        ({"amplitude": [1.0, 2.0]}, "2 entries"),
        ({"input_labels": ["a", "b"]}, "2 names for 1"),
        ({"output_labels": [""]}, "empty"),
        ({"n_averages": 0}, "positive"),
        ({"dt": -1.0}, "dt"),
        ({"hold": "later"}, "hold"),
    ],
)
def test_what_is_no_response_is_refused(change, said):
    given = {"response": lag(OMEGA), "omega": OMEGA} | change
    with pytest.raises((ValueError, ct.ControlArgument, ct.ControlDimension), match=said):
        rco.FrequencyResponse(**given)


def write(path, text):
    path.write_text(text)
    return path


def test_text_files_with_units_in_the_header(tmp_path):
    h = lag(OMEGA)
    rows = [
        f"{w / 2 / np.pi:.12f};{20 * np.log10(abs(g)):.12f};{np.angle(g, deg=True):.12f};0.9".replace(
            ".", ","
        )
        for w, g in zip(OMEGA, h, strict=True)
    ]
    path = write(tmp_path / "a.csv", "\n".join(["f [Hz];H [dB];phase [deg];coh", *rows]))
    measured = rco.FrequencyResponse.from_csv(path, "f", "H", "phase", coherence="coh", amplitude=2.0)
    np.testing.assert_allclose(measured.response[0, 0], h, rtol=1e-9)
    np.testing.assert_allclose(measured.omega, OMEGA)
    assert (measured.name, measured.coherence[0, 0], measured.amplitude[0]) == ("a", 0.9, 2.0)


def test_text_files_with_real_and_imaginary_parts_of_two_outputs(tmp_path):
    h = lag(OMEGA)
    rows = [f"{w},{g.real},{g.imag},{2 * g.real},{2 * g.imag},0.1,0.2" for w, g in zip(OMEGA, h, strict=True)]
    path = write(tmp_path / "b.csv", "\n".join(["w,r1,i1,r2,i2,s1,s2", *rows]))
    columns = {"real": ["r1", "r2"], "imag": ["i1", "i2"], "std": ["s1", "s2"]}
    measured = rco.FrequencyResponse.from_csv(path, "w", **columns, frequency_unit="rad/s")
    np.testing.assert_allclose(measured.response[:, 0], [h, 2 * h])
    np.testing.assert_allclose(measured.std[:, 0, 0], [0.1, 0.2])
    assert measured.output_labels == ("r1", "r2")


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"magnitude": "H"}, "both of one pair"),
        ({"real": "H", "imag": "p", "magnitude": "H"}, "both of one pair"),
        ({"magnitude": "H", "phase": "p", "phase_unit": "deg"}, "frequency_unit"),
        ({"magnitude": "H", "phase": "p", "frequency_unit": "Hz"}, "phase_unit"),
        ({"magnitude": "H", "phase": ["p", "H"], "frequency_unit": "Hz", "phase_unit": "deg"}, "1 response"),
        ({"magnitude": "X", "phase": "p", "frequency_unit": "Hz", "phase_unit": "deg"}, "X"),
        ({"magnitude": "H", "phase": "p", "frequency_unit": "furlongs"}, "frequency_unit"),
        ({"magnitude": "H", "phase": "p", "magnitude_unit": "Np"}, "magnitude_unit"),
    ],
)
def test_columns_that_do_not_make_a_response(tmp_path, columns, said):
    path = write(tmp_path / "c.csv", "f,H,p\n1,2,3\n2,3,4\n")
    with pytest.raises((ValueError, ct.ControlArgument, ct.ControlDimension), match=said):
        rco.FrequencyResponse.from_csv(path, "f", **columns)


def universal(pyuff, path, *, func_type=4, rsp=(1, 2), freq=OMEGA):
    for node in rsp:
        data = (node * lag(2 * np.pi * freq)).astype(complex) if func_type == 4 else np.full(freq.size, 0.8)
        pyuff.UFF(str(path)).write_sets(
            pyuff.prepare_58(
                func_type=func_type, rsp_node=node, rsp_dir=3, ref_node=1, ref_dir=3, data=data, x=freq,
                binary=0, id1="id1", rsp_ent_name="a", ref_ent_name="b", abscissa_spacing=1,
                abscissa_spec_data_type=18,
                ordinate_spec_data_type=12, orddenom_spec_data_type=13,
            ),
            "add",
        )  # fmt: skip
    return path


def test_universal_files(tmp_path):
    pyuff = pytest.importorskip("pyuff")
    path = universal(pyuff, tmp_path / "d.uff")
    universal(pyuff, path, func_type=6)
    measured = rco.FrequencyResponse.from_uff(path)
    assert (measured.output_labels, measured.input_labels) == (("1:3", "2:3"), ("1:3",))
    np.testing.assert_allclose(measured.omega, 2 * np.pi * OMEGA, rtol=1e-5)
    np.testing.assert_allclose(measured.response[1, 0], 2 * lag(2 * np.pi * OMEGA), rtol=1e-4)
    np.testing.assert_allclose(measured.coherence, 0.8, rtol=1e-4)
    assert rco.FrequencyResponse.from_uff(path, [1]).output_labels == ("2:3",)
    with pytest.raises(rco.DataError, match="no frequency response"):
        rco.FrequencyResponse.from_uff(path, [7])
    with pytest.raises(rco.DataError, match="twice"):
        rco.FrequencyResponse.from_uff(universal(pyuff, path, rsp=(2,)))


@pytest.mark.parametrize("rsp", [(1,), (1, 2)])
def test_a_universal_file_that_lacks_a_number_is_damaged(tmp_path, rsp):
    path = universal(pytest.importorskip("pyuff"), tmp_path / "d.uff", rsp=rsp)
    number = path.read_text().splitlines()[13].split()[-1]
    path.write_text(path.read_text().replace(number, "", 1))
    with pytest.raises(rco.DataError, match=r"d\.uff.*damaged"):
        rco.FrequencyResponse.from_uff(path)


def test_a_universal_file_that_ends_early_is_damaged(tmp_path):
    """What is left of it would stand at the wrong frequencies."""
    path = universal(pytest.importorskip("pyuff"), tmp_path / "d.uff", rsp=(1,))
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:14], *lines[15:], ""]))  # 2 of the 10 values
    with pytest.raises(rco.DataError, match="data set 0 announces 10 values and holds fewer"):
        rco.FrequencyResponse.from_uff(path)


def test_modes_of_a_universal_file_are_no_response(tmp_path):
    pytest.importorskip("pyuff")
    lines = [
        "    -1",
        "    55",
        *["modes"] * 5,
        "         1         2         3         8         2         3",
        "    -1",
    ]
    with pytest.raises(rco.DataError, match=r"type 55 are modes.*modal_model"):
        rco.FrequencyResponse.from_uff(write(tmp_path / "modes.uff", "\n".join([*lines, ""])))
