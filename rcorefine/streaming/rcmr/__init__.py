"""Retrospective cost model refinement by the paper's equations: both stages on arrays."""
