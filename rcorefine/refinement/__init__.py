"""Batch estimation: effects, physical parameters, and how sure they are."""

from .refine import refine
from .refinement import EstimatedParameter, Refinement

__all__ = ["EstimatedParameter", "Refinement", "refine"]
