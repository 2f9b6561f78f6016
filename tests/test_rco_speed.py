"""The whole loop against the literal one, interleaved in one process."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

import rcorefine as rco
from rcorefine.jit import NUMBA

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "stage_one.py"


@pytest.mark.benchmark
@pytest.mark.numba
@pytest.mark.skipif(not NUMBA, reason="numba is not installed or switched off")
def test_thirty_times_faster_than_the_literal_loop() -> None:
    """n_c = 30, p = 100, 123 coefficients, both stages."""
    spec = importlib.util.spec_from_file_location("stage_one", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    _, _, ratio, difference = module.compare(rco.examples.one_dof(), 500, 7)
    assert difference < 1e-8
    assert ratio > 30.0
