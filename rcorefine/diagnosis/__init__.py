"""Which physical effect is missing from a model."""

from ..inference.f_tests import FTest
from .diagnose import diagnose
from .result import Detectable, Diagnosis, RankedEffect

__all__ = ["Detectable", "Diagnosis", "FTest", "RankedEffect", "diagnose"]
