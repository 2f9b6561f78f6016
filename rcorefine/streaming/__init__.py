"""Retrospective cost optimization on a stream of samples.

It implements the two stages of the paper.
"""

from __future__ import annotations

from .rcmr.history import History
from .rcmr.scaling import Scales
from .refiner import RCORefiner

__all__ = ["History", "RCORefiner", "Scales"]
