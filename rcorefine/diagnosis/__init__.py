"""Which physical effect is missing from a model."""

from ..inference.f_tests import FTest
from .check_rows import Detectable
from .diagnose import diagnose
from .result import Diagnosis, RankedEffect

__all__ = ["Detectable", "Diagnosis", "FTest", "RankedEffect", "diagnose"]
