"""The initial model in feedback with physical effects.

A *port* is a place in the model, an *effect* is a law at a place.
"""

from .effects import Effect, describe_effects
from .kinds import KINDS, Coefficient, Kind
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
    "describe_effects",
    "ports",
]
