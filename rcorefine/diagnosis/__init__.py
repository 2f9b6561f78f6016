"""Which physical effect is missing from a model."""

from .diagnose import diagnose
from .result import Detectable, Diagnosis, RankedEffect
from .whitening import FTest

__all__ = ["Detectable", "Diagnosis", "FTest", "RankedEffect", "diagnose"]
