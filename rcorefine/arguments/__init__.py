"""Checks of arguments with precise error messages.

A message tells what is wrong, in which argument, and what to give instead.

All of them take the value and the name of the argument, and return the value in the form
that the work needs. A wrong type raises `control.ControlArgument`, a wrong size
`control.ControlDimension`, and a value out of range the class handed over as `error`.
"""

from __future__ import annotations

from .arrays import as_array, as_noise, as_state, as_vector
from .numbers import as_flag, as_number, as_share, as_whole
from .objects import as_generator, as_instance, as_mapper, as_path
from .quoting import printable, shown
from .texts import as_choice, as_labels, as_list, as_mapping, as_text, as_texts

__all__ = [
    "as_array",
    "as_choice",
    "as_flag",
    "as_generator",
    "as_instance",
    "as_labels",
    "as_list",
    "as_mapper",
    "as_mapping",
    "as_noise",
    "as_number",
    "as_path",
    "as_share",
    "as_state",
    "as_text",
    "as_texts",
    "as_vector",
    "as_whole",
    "printable",
    "shown",
]
