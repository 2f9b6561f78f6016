"""Effects: their laws, places, coefficients and forces.

Each law is a class in one of these files.

A law of your own is a subclass of `PortLaw`, `InputLaw` or `OutputLaw`: hand it to ``Effect(law=...)``,
or enter it into the catalogue with `register`.
"""

from .formula import InputLaw, OutputLaw, PortLaw
from .law import KINDS, Coefficient, register

# the order in which laws are listed to people
from . import springs, dampers, friction, bodies, products, channels, given, right_hand_side  # noqa: F401, isort: skip
from .given import Table  # isort: skip

__all__ = ["KINDS", "Coefficient", "InputLaw", "OutputLaw", "PortLaw", "Table", "register"]
