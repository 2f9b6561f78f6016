"""Models against a measured record: how much they differ."""

from __future__ import annotations

from .compare import compare
from .failure_map import Failure, FailureMap
from .metrics import fit_percent, root_mean_square
from .result import Comparison

__all__ = ["Comparison", "Failure", "FailureMap", "compare", "fit_percent", "root_mean_square"]
