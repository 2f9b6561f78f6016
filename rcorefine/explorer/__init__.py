"""Interactive exploration: add effects one by one and watch the error.

It starts from a model and a record.
"""

from .exploration import Exploration, ExplorationStep

__all__ = ["Exploration", "ExplorationStep"]
