"""Builders: usual models with their places, parameters and units."""

from .chain import mass_spring_damper
from .electrical import series_rlc
from .general import mechanical
from .hydraulic import two_tanks
from .motor import dc_motor
from .thermal import thermal_network
from .vehicle import quarter_car

__all__ = [
    "dc_motor",
    "mass_spring_damper",
    "mechanical",
    "quarter_car",
    "series_rlc",
    "thermal_network",
    "two_tanks",
]
