"""Many records of many machines: each examined alone, wherever there is a worker, then all together."""

from .result import Survey
from .survey import survey

__all__ = ["Survey", "survey"]
