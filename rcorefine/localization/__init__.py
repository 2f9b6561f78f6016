"""Damage localization: changed links, their sizes and detection limits.

A detection limit is the smallest change that the record would have shown.
"""

from .damage_map import DamageMap, DamageRow, HypothesisRow, NuisanceRow
from .localize import localize_damage

__all__ = ["DamageMap", "DamageRow", "HypothesisRow", "NuisanceRow", "localize_damage"]
