"""Retrospective cost optimization on a stream of samples.

It implements the two stages of the paper.
"""

from __future__ import annotations

from .history import History
from .rcmr.setup import Scales
from .refiner import RCORefiner

__all__ = ["History", "RCORefiner", "Scales"]
