"""Models against a measured record: how much they differ, and where."""

from __future__ import annotations

from .black_box import black_box
from .compare import compare
from .failure_map.search import Failure, FailureMap
from .failure_map.state import ResidualForce, residual_force
from .model_error import ErrorResponse, HorizonError, horizon_error, model_error
from .responses import FrequencyComparison
from .result import Comparison
from .signals import Correlogram, correlogram, fit_percent, root_mean_square

__all__ = [
    "Comparison",
    "Correlogram",
    "ErrorResponse",
    "Failure",
    "FailureMap",
    "FrequencyComparison",
    "HorizonError",
    "ResidualForce",
    "black_box",
    "compare",
    "correlogram",
    "fit_percent",
    "horizon_error",
    "model_error",
    "residual_force",
    "root_mean_square",
]
