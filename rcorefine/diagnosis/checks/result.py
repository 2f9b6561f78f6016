"""Result of `check`."""

from __future__ import annotations

from dataclasses import dataclass

from ...results import Result
from ..result import Detectable
from .row import LOOK, STOP, CheckRow

__all__ = ["Check"]


@dataclass(frozen=True, slots=True, eq=False)
class Check(Result):
    """Check of a record and a model before anything is concluded.

    Attributes
    ----------
    rows : tuple of CheckRow
        All that was looked at.
    detectable : tuple of Detectable
        Smallest coefficient of each effect and parameter that this record would show with 95 %
        probability, the model being otherwise right.
    """

    rows: tuple[CheckRow, ...]
    detectable: tuple[Detectable, ...] = ()

    @property
    def looks(self) -> tuple[CheckRow, ...]:
        """Rows that ask for attention, those that say stop first."""
        return tuple(row for status in (STOP, LOOK) for row in self.rows if row.status == status)

    @property
    def stops(self) -> bool:
        """Return whether something must be corrected first."""
        return any(row.status == STOP for row in self.rows)
