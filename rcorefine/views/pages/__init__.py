"""Reports: one HTML file each."""

from . import comparison, diagnosis, models

__all__ = ["comparison", "diagnosis", "models"]
