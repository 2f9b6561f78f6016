"""Builders: usual models with their places, parameters and units."""

from .machines import dc_motor, quarter_car
from .networks import series_rlc, thermal_network, two_tanks
from .structures import mass_spring_damper, mechanical

__all__ = [
    "dc_motor",
    "mass_spring_damper",
    "mechanical",
    "quarter_car",
    "series_rlc",
    "thermal_network",
    "two_tanks",
]
