"""Retrospective cost optimization: the paper's two stages on a stream of samples."""

from __future__ import annotations

from .rcmr.history import History
from .rcmr.scaling import Scales
from .refiner import RCORefiner

__all__ = ["History", "RCORefiner", "Scales"]
