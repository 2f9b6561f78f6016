"""Damage localization: which link changed, by how much, and what would have been seen."""

from .damage_map import DamageMap, DamageRow, HypothesisRow, NuisanceRow
from .localize import localize_damage

__all__ = ["DamageMap", "DamageRow", "HypothesisRow", "NuisanceRow", "localize_damage"]
