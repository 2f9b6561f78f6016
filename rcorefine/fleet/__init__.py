"""Survey of many records of many machines.

Each record is examined alone, on any worker; then all are compared.
"""

from .result import Survey
from .survey import survey

__all__ = ["Survey", "survey"]
