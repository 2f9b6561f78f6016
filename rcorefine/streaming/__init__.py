"""Retrospective cost optimization on a stream of samples.

It implements the two stages of the paper.
"""

from __future__ import annotations

from .history import History
from .refiner import RCORefiner
from .scales import Scales

__all__ = ["History", "RCORefiner", "Scales"]
