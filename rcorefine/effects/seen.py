"""Properties of a record at a place, for initial guesses of a law."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ..systems.linear import Array

__all__ = ["Seen", "delays"]


class Seen(Protocol):
    """Properties of a record at a place, for initial guesses of coefficients."""

    dt: float

    @property
    def signal(self) -> Array:
        """Record of the channel, shape (N,)."""

    @property
    def d(self) -> Array:
        """Displacement at the port."""

    @property
    def v(self) -> Array:
        """Velocity at the port."""

    @property
    def peaks(self) -> Array:
        """Frequencies [rad/s] of the highest peaks of the output residuals."""

    @property
    def lag(self) -> float:
        """Lag [s] of the outputs behind the simulation, in whole samples."""

    @property
    def drifts(self) -> Sequence[float]:
        """Growth of the lag of the outputs behind the simulation, if seen.

        It is a share of the elapsed time.
        """

    @property
    def pull(self) -> float:
        """Rms force that accelerates the port, 1 where it moves nothing."""

    @property
    def mobility(self) -> float:
        """Largest acceleration per force at the port."""


def delays(seen: Seen) -> list[dict[str, float]]:
    """Return initial guesses of a delay.

    From zero delay, a descent does not pass the first minimum of an oscillating signal.
    """
    late = [seen.lag] if seen.lag > 8.0 * seen.dt else []
    return [{"delay": value} for value in [*late, *(q * seen.dt for q in (0.5, 2.5, 6.0))]]
