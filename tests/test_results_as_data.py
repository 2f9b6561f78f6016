"""Results as data: strict JSON and tables, with the numbers of the result itself."""

from __future__ import annotations

import json

import numpy as np
import pytest

import rcorefine as rco
from tests import public_calls


def test_signals_keep_their_names_and_times():
    data = public_calls.record()
    frame = data.to_dataframe()
    assert list(frame.columns) == [*data.input_labels, *data.output_labels]
    assert frame.index.to_numpy() == pytest.approx(data.timepts)
    assert frame[data.output_labels[0]].to_numpy() == pytest.approx(data.outputs[0])
    measured = public_calls.response()
    points = measured.to_dataframe()
    assert np.allclose(points.iloc[:, 0].to_numpy(), measured.frdata[0, 0])
    response = measured.to_dict()["response"]
    assert np.allclose(np.array(response["re"]) + 1j * np.array(response["im"]), measured.frdata)


def test_rows_are_those_of_the_result():
    found = public_calls.diagnosis()
    frame = found.to_dataframe()
    assert found.to_dict()["ranking"] == [row.to_dict() for row in found.ranking]
    alone = found.best.to_dataframe()
    assert alone.iloc[0].to_dict() == frame.iloc[0][alone.columns].to_dict()
    assert list(frame["kind"]) == [row.effect.kind for row in found.ranking]
    assert list(frame["place"]) == [row.effect.place for row in found.ranking]
    first = found.ranking[0]
    ((name, value),) = first.coefficients.items()
    assert frame[f"coefficients.{name}"][0] == pytest.approx(value)
    refined = public_calls.refinement().to_dataframe()
    assert list(refined["name"]) == [row.name for row in public_calls.refinement().parameters]
    compared = public_calls.comparison()
    assert compared.to_dataframe()["fit"].to_numpy() == pytest.approx(np.ravel(compared.fit))
    rows = public_calls.damage_map().to_dataframe()
    assert list(rows["place"]) == [row.place for row in public_calls.damage_map().rows]


def test_what_is_not_finite_is_null():
    wide = public_calls.curve().to_dict()
    assert json.dumps(wide, allow_nan=False)
    data = rco.examples.rlc().record(50, rng=0)
    missing = rco.compare(rco.examples.rlc().initial, data).to_dict()
    assert json.dumps(missing, allow_nan=False)
