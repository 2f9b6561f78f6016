"""Batch estimation: effects, physical parameters, and how sure they are."""

from ..inference.parameters import EstimatedParameter
from ..inference.refinement import Refinement
from .refine import refine

__all__ = ["EstimatedParameter", "Refinement", "refine"]
