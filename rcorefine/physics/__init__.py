"""The initial model in feedback with physical effects.

A *port* is a place in the model, an *effect* is a law at a place.
"""

from .builders import (
    dc_motor,
    mass_spring_damper,
    mechanical,
    quarter_car,
    series_rlc,
    thermal_network,
    two_tanks,
)
from .effects import Effect, describe_effects
from .kinds import KINDS, Coefficient, Kind
from .library import effect_library
from .physical_model import NominalParameter, PhysicalModel, as_physical
from .ports import Port, ports

__all__ = [
    "KINDS",
    "Coefficient",
    "Effect",
    "Kind",
    "NominalParameter",
    "PhysicalModel",
    "Port",
    "as_physical",
    "dc_motor",
    "describe_effects",
    "effect_library",
    "mass_spring_damper",
    "mechanical",
    "ports",
    "quarter_car",
    "series_rlc",
    "thermal_network",
    "two_tanks",
]
