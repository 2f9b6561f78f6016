"""Models against a measured record: how much they differ, and where."""

from __future__ import annotations

from .compare import compare
from .failure_map.search import Failure, FailureMap, ResidualForce, residual_force
from .horizon import HorizonError, horizon_error
from .metrics import fit_percent, root_mean_square
from .model_error import ModelError, model_error
from .residual_tests import (
    Correlogram,
    ResidualTest,
    TestTable,
    correlogram,
    free_run_tests,
    higher_order_correlation,
    input_correlation,
    whiteness,
)
from .responses import FrequencyComparison
from .result import Comparison

__all__ = [
    "Comparison",
    "Correlogram",
    "Failure",
    "FailureMap",
    "FrequencyComparison",
    "HorizonError",
    "ModelError",
    "ResidualForce",
    "ResidualTest",
    "TestTable",
    "compare",
    "correlogram",
    "fit_percent",
    "free_run_tests",
    "higher_order_correlation",
    "horizon_error",
    "input_correlation",
    "model_error",
    "residual_force",
    "root_mean_square",
    "whiteness",
]
