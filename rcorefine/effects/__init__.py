"""Effects: laws at places, their coefficients, their forces. A law is one class in one of these files."""

# the order in which laws are listed to people
from . import springs, dampers, bodies, flows, entries, input_path, output_path, custom  # noqa: F401, isort: skip
