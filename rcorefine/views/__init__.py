"""Tables and pictures of results."""

from __future__ import annotations

from .bode import bode_comparison
from .tables import html_table, text_table

__all__ = ["bode_comparison", "html_table", "text_table"]
