"""`control.StateSpace` in and out: arrays, conversion between timebases, canonical form, response.

The only part of the package that knows the inside of a `StateSpace`.
"""

from .canonical import characteristic_polynomial, observable_form
from .conversion import d2c, to_discrete
from .discretization import check_sampling_time, discretize
from .linear import LinearModel
from .response import bode_error, default_omega, frequency_response

__all__ = [
    "LinearModel",
    "bode_error",
    "characteristic_polynomial",
    "check_sampling_time",
    "d2c",
    "default_omega",
    "discretize",
    "frequency_response",
    "observable_form",
    "to_discrete",
]
