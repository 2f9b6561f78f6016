"""Tables, pictures and reports of results.

`content` describes a result of each class; text, HTML, data and report are made from that.
"""

from . import damage_map, diagnosis, measurement, models, reports, streaming, survey  # noqa: F401
from .bode import bode_comparison
from .content import as_html, as_text, content, draw, report
from .data import as_dict, as_frame
from .reports import refinement_script
from .tables import html_table, text_table

__all__ = [
    "as_dict",
    "as_frame",
    "as_html",
    "as_text",
    "bode_comparison",
    "content",
    "draw",
    "html_table",
    "refinement_script",
    "report",
    "text_table",
]
