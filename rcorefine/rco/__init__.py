"""Retrospective cost optimization: the paper's two stages on a stream of samples."""

from __future__ import annotations

from .history import History
from .refiner import RCORefiner
from .scaling import Scales

__all__ = ["History", "RCORefiner", "Scales"]
