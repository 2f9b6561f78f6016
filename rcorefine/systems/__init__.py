"""Linear systems: arrays, conversion, canonical form and response.

`control.StateSpace` models go in and come out. The conversion is between timebases. No other part of the
package reads the fields of a `StateSpace`.
"""

from .conversion import characteristic_polynomial, d2c, observable_form, to_discrete
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
