"""How a ladder splits its records: what is fitted can be tested, and something is left to judge by."""

from __future__ import annotations

import numpy as np
import pytest

import rcorefine as rco
from rcorefine.diagnosis.case import split_in_parts


def record(n: int) -> rco.Measurement:
    return rco.Measurement(np.zeros(n), np.arange(float(n)), dt=1.0, name="run 3")


@pytest.mark.parametrize(
    ("n", "sizes"),
    [(1000, (600, 200, 200)), (140, (84, 28, 28)), (60, (36, 12, 12))],
)
def test_a_record_is_split_in_three(n: int, sizes: tuple[int, int, int]) -> None:
    """Three fifths to fit, one to choose and one to judge by, in the order of time."""
    parts = split_in_parts([record(n)], None)
    pieces = [parts.fit[0], parts.choose[0], parts.judge[0]]
    assert tuple(piece.n_samples for piece in pieces) == sizes
    assert np.array_equal(np.concatenate([piece.outputs[0] for piece in pieces]), np.arange(float(n)))
    assert parts.learn[0].n_samples == sizes[0] + sizes[1]


@pytest.mark.parametrize(("n", "sizes"), [(1000, (750, 250)), (48, (36, 12))])
def test_with_another_record_to_judge_by_all_is_split_in_two(n: int, sizes: tuple[int, int]) -> None:
    parts = split_in_parts([record(n)], record(100))
    assert (parts.fit[0].n_samples, parts.choose[0].n_samples) == sizes
    assert parts.judge[0].n_samples == 100


@pytest.mark.parametrize(("n", "validation"), [(59, None), (47, record(100))])
def test_too_short_a_record_says_what_is_needed(n: int, validation: rco.Measurement | None) -> None:
    with pytest.raises(rco.DataError, match=f"'run 3' of {n} samples .* give at least {n + 1}"):
        split_in_parts([record(n)], validation)


@pytest.mark.parametrize("validation", [None, record(100)])
def test_many_records_are_split_as_wholes(validation: rco.Measurement | None) -> None:
    """The ends of five step responses are settled: they cannot choose between dynamic effects."""
    records = [record(200 + k) for k in range(7)]
    parts = split_in_parts(records, validation)
    lengths = {name: [r.n_samples for r in getattr(parts, name)] for name in ("fit", "choose", "judge")}
    if validation is None:
        assert lengths == {"fit": [200, 202, 203, 205], "choose": [201, 206], "judge": [204]}
    else:
        assert lengths == {"fit": [200, 202, 203, 204, 205], "choose": [201, 206], "judge": [100]}
    assert sorted(r.n_samples for r in parts.learn) == sorted(lengths["fit"] + lengths["choose"])
