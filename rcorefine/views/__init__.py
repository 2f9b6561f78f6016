"""Tables, pictures and reports of results.

Each view registers itself for the class that it shows.
"""

from . import comparison, damage_map, data, diagnosis, measurement, models, reports, streaming, survey  # noqa: F401
from .bode import bode_comparison
from .tables import html_table, text_table

__all__ = ["bode_comparison", "html_table", "text_table"]
