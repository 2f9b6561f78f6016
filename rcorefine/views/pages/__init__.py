"""Reports: one HTML file each."""

from . import comparison, diagnosis, models, survey

__all__ = ["comparison", "diagnosis", "models", "survey"]
