"""Tables, pictures and reports of results.

`content` describes a result of each class; text, HTML, data and report are made from that.
"""

from . import damage_map, diagnosis, measurement, models, reports, streaming, survey  # noqa: F401
from .content import as_html, as_text, content, draw, report
from .data import as_dict, as_frame
from .reports import refinement_script

__all__ = [
    "as_dict",
    "as_frame",
    "as_html",
    "as_text",
    "content",
    "draw",
    "refinement_script",
    "report",
]
