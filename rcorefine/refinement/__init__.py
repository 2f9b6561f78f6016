"""Batch estimation: effects, physical parameters, and how sure they are."""

from ..inference.refinement import EstimatedParameter, Refinement
from .refine import refine

__all__ = ["EstimatedParameter", "Refinement", "refine"]
