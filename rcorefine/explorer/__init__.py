"""The loop by hand: a model and a record, effects added one by one, the error watched as it falls."""

from .exploration import Exploration, Step

__all__ = ["Exploration", "Step"]
