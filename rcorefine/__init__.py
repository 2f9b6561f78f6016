"""Find out why a linear model and a measured record disagree, and mend the model.

The toolbox stands on python-control: `control.StateSpace` goes in and comes
out. The estimator is retrospective cost model refinement (D'Amato et al.).
"""

from . import examples
from .comparison import Comparison, compare
from .diagnosis import Diagnosis, diagnose
from .diagnosis.confirmation import Confirmation
from .diagnosis.improve import improve
from .diagnosis.ledger import Improvement
from .diagnosis.records import confirm
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
from .localization import DamageMap, localize_damage
from .measurement import Measurement
from .monitoring import Alarm, Monitor
from .physics import (
    Effect,
    NominalParameter,
    PhysicalModel,
    Port,
    dc_motor,
    describe_effects,
    effect_library,
    mass_spring_damper,
    mechanical,
    ports,
    quarter_car,
    series_rlc,
    thermal_network,
    two_tanks,
)
from .physics.amplitude_response import AmplitudeResponse, frequency_response_at
from .physics.simulation import Simulation, simulate
from .rco import RCORefiner
from .refinement import EstimatedParameter, Refinement, refine
from .systems import d2c

__version__ = "0.1.0"

__all__ = [
    "Alarm",
    "AmplitudeResponse",
    "Comparison",
    "Confirmation",
    "ConversionWarning",
    "DamageMap",
    "DataError",
    "Diagnosis",
    "DivergenceError",
    "Effect",
    "EstimatedParameter",
    "ExcitationWarning",
    "IdentifiabilityWarning",
    "Improvement",
    "Measurement",
    "MissingExtraError",
    "ModelError",
    "Monitor",
    "NominalParameter",
    "PhysicalModel",
    "Port",
    "RCOError",
    "RCORefiner",
    "RCOWarning",
    "Refinement",
    "Simulation",
    "compare",
    "confirm",
    "d2c",
    "dc_motor",
    "describe_effects",
    "diagnose",
    "effect_library",
    "examples",
    "frequency_response_at",
    "improve",
    "localize_damage",
    "mass_spring_damper",
    "mechanical",
    "ports",
    "quarter_car",
    "refine",
    "series_rlc",
    "simulate",
    "thermal_network",
    "two_tanks",
]
