"""The benchmark of the two stages runs, and what it times agrees with the literal loop.

The ratio of the times is for the benchmark to print: machines are shared and noisy.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from inner import NUMBA

import rcorefine as rco

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "stage_one.py"


@pytest.mark.numba
@pytest.mark.skipif(not NUMBA, reason="numba is not installed or switched off")
def test_what_is_timed_is_the_same() -> None:
    """n_c = 30, p = 100, 123 coefficients, both stages."""
    spec = importlib.util.spec_from_file_location("stage_one", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    *_, difference = module.compare(rco.examples.one_dof(), 500, 7)
    assert difference < 1e-8
