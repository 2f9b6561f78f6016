"""Three examples of the paper: circuit, transmissibility, structure.

Each gives an initial (wrong) model, the true one, a sampling time and the
settings that the paper uses. What the paper leaves open (sampling times,
excitation, record length) or misprints is decided here and said in the
description of the example. Reference: *Damage localization for structural
health monitoring using retrospective cost model refinement*, sections V to
VII.
"""

from .paper import Example, one_dof, rlc, rlc_parameters, two_dof

__all__ = ["Example", "one_dof", "rlc", "rlc_parameters", "two_dof"]
