"""The face: what `import rcorefine` offers, and where it stands. Read by __init__.py, too."""

from . import examples, exercises
from .comparison import Comparison, black_box, compare
from .data.frequency_response import FrequencyResponse
from .data.measurement import Measurement
from .data.reading import read_record
from .diagnosis import Diagnosis, diagnose
from .diagnosis.check import check
from .diagnosis.check_rows import Check, CheckRow
from .diagnosis.confirm import Confirmation, confirm
from .diagnosis.improve import improve
from .diagnosis.result import Improvement
from .effects.effect import Effect
from .effects.given import Table
from .engine.amplitude_response import AmplitudeResponse, frequency_response_at
from .engine.simulation import Simulation, simulate
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
from .explorer.serving import explore
from .fleet import Survey, survey
from .localization import DamageMap, localize_damage
from .models.builders import (
    dc_motor,
    mass_spring_damper,
    mechanical,
    quarter_car,
    series_rlc,
    thermal_network,
    two_tanks,
)
from .models.controller import Controller
from .models.conversion import physical, ports
from .models.library import describe_effects, effect_library
from .models.modal_files import modal_model
from .models.parameters import NominalParameter
from .models.physical_model import PhysicalModel
from .models.ports import Port
from .models.reading import read_model
from .refinement import EstimatedParameter, Refinement, refine
from .streaming import RCORefiner
from .streaming.monitor import Monitor
from .streaming.naming import Alarm
from .systems import d2c
from .version import __version__ as __version__

__all__ = [
    "Alarm",
    "AmplitudeResponse",
    "Check",
    "CheckRow",
    "Comparison",
    "Confirmation",
    "Controller",
    "ConversionWarning",
    "DamageMap",
    "DataError",
    "Diagnosis",
    "DivergenceError",
    "Effect",
    "EstimatedParameter",
    "ExcitationWarning",
    "FrequencyResponse",
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
    "Survey",
    "Table",
    "black_box",
    "check",
    "compare",
    "confirm",
    "d2c",
    "dc_motor",
    "describe_effects",
    "diagnose",
    "effect_library",
    "examples",
    "exercises",
    "explore",
    "frequency_response_at",
    "improve",
    "localize_damage",
    "mass_spring_damper",
    "mechanical",
    "modal_model",
    "physical",
    "ports",
    "quarter_car",
    "read_model",
    "read_record",
    "refine",
    "series_rlc",
    "simulate",
    "survey",
    "thermal_network",
    "two_tanks",
]
