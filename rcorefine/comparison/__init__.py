"""Models against a measured record: how much they differ, and where."""

from __future__ import annotations

from .black_box import black_box
from .compare import compare
from .correlation import Correlogram, correlogram
from .failure_map.residual_force import ResidualForce, residual_force
from .failure_map.search import Failure, FailureMap
from .horizon import HorizonError, horizon_error
from .metrics import fit_percent, root_mean_square
from .model_error import ModelError, model_error
from .nonlinear_dependence import higher_order_correlation
from .residual_tests import (
    ResidualTest,
    TestTable,
    free_run_tests,
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
    "black_box",
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
