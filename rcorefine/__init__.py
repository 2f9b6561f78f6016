"""Find out why a linear model and a measured record disagree, and mend the model.

The toolbox stands on python-control: `control.StateSpace` goes in and comes
out. The estimator is retrospective cost model refinement (D'Amato et al.).
"""

from . import examples
from .exceptions import (
    ConversionWarning,
    DataError,
    DivergenceError,
    ExcitationWarning,
    IdentifiabilityWarning,
    MissingExtraError,
    ModelError,
    RCOError,
    RCOWarning,
)
from .measurement import Measurement
from .physics import Effect, NominalParameter, PhysicalModel, Port, describe_effects, ports
from .systems import d2c

__version__ = "0.1.0"

__all__ = [
    "ConversionWarning",
    "DataError",
    "DivergenceError",
    "Effect",
    "ExcitationWarning",
    "IdentifiabilityWarning",
    "Measurement",
    "MissingExtraError",
    "ModelError",
    "NominalParameter",
    "PhysicalModel",
    "Port",
    "RCOError",
    "RCOWarning",
    "d2c",
    "describe_effects",
    "examples",
    "ports",
]
