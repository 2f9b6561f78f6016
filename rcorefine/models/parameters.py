"""The numbers that a model was built from."""

from __future__ import annotations

from dataclasses import dataclass

from ..arguments import as_flag, as_number, as_text
from ..exceptions import ModelError
from ..results import Row

__all__ = ["NominalParameter"]


@dataclass(frozen=True, slots=True)
class NominalParameter(Row):
    """A number in the initial model that an effect could correct.

    Parameters
    ----------
    name : str
        Name, such as ``"k2"``.
    value : float
        Value in the initial model; the corrected value is this plus the effect's
        coefficient (an ``"input_gain"`` has the value 1).
    unit : str
        Unit, ``""`` where it is unknown.
    kind : str
        Kind of the effect that changes it: ``"stiffness"``, ``"damping"``,
        ``"mass"``, ``"coefficient"``, ``"input_gain"``.
    place : str
        Place of that effect.
    physical : bool
        True if the value is a physical one that the builder was given, False if it
        was read out of the matrices (and may be relative to an unknown mass).
    """

    name: str
    value: float
    unit: str
    kind: str
    place: str
    physical: bool = True

    def __post_init__(self) -> None:
        for key in ("name", "unit", "kind", "place"):
            as_text(getattr(self, key), f"{key} of a parameter")
        as_number(self.value, f"value of parameter {self.name!r}", error=ModelError)
        as_flag(self.physical, f"physical of parameter {self.name!r}")
