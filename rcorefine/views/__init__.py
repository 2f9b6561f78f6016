"""Tables, pictures and reports of results.

`content` describes a result of each class; text, HTML, data and report are made from that.
"""

from . import damage_map, diagnosis, measurement, models, reports, streaming, survey  # noqa: F401
from .bode import bode_comparison
from .content import as_html, as_text, draw, report
from .data import as_dict, as_frame
from .tables import html_table, text_table

__all__ = [
    "as_dict",
    "as_frame",
    "as_html",
    "as_text",
    "bode_comparison",
    "draw",
    "html_table",
    "report",
    "text_table",
]
