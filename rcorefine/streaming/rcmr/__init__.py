"""Retrospective cost model refinement by the paper's equations.

Both stages work on arrays.
"""
