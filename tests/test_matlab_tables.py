"""MATLAB tables and timetables by way of mat-io and a data frame, as the how-to page says."""

import warnings

import numpy as np
import pytest

import rcorefine as rco

matio = pytest.importorskip("matio", reason="the extra formats is not installed")
pd = pytest.importorskip("pandas")


@pytest.mark.parametrize("version", ["v7", "v7.3"])
@pytest.mark.filterwarnings("ignore")  # of the writer
def test_a_timetable_brings_its_time(tmp_path, version):
    t = np.arange(200) * 0.05
    frame = pd.DataFrame({"force": np.sin(t), "position": t}, index=pd.to_timedelta(t, unit="s"))
    table = pd.DataFrame({"t": t, "force": np.sin(t), "position": t})
    path = tmp_path / "run.mat"
    matio.save_to_mat(str(path), {"run": frame.rename_axis("Time"), "plain": table}, version=version)
    read = matio.load_from_mat(str(path))
    data = rco.Measurement.from_frame(read["run"], inputs="force", outputs="position")
    assert data.dt == pytest.approx(0.05, rel=1e-9)
    np.testing.assert_allclose(data.outputs[0], t, rtol=1e-15)
    other = rco.Measurement.from_frame(read["plain"], inputs="force", outputs="position", time="t")
    np.testing.assert_array_equal(other.inputs, data.inputs)


def test_an_index_of_numbers_plays_no_part():
    frame = pd.DataFrame({"u": [1.0, 0, 1], "y": [0.0, 1, 2]}, index=[0.0, 0.1, 0.2])
    with pytest.raises(rco.DataError, match="no time"):
        rco.Measurement.from_frame(frame, "u", "y")


@pytest.mark.parametrize("given", [{"dt": 0.5}, {"time": "t"}])
def test_a_time_that_is_given_outweighs_the_index(given):
    frame = pd.DataFrame({"t": [0.0, 0.5, 1], "u": [1.0, 0, 1], "y": [0.0, 1, 2]})
    frame.index = pd.to_timedelta([0.0, 0.1, 0.2], unit="s")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert rco.Measurement.from_frame(frame, "u", "y", **given).dt == 0.5
