"""What a record tells about a place, for the starts of a law."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ..systems.linear import Array

__all__ = ["Seen", "delays"]


class Seen(Protocol):
    """What a record tells about a place, for the starts of a law's coefficients."""

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
        """Frequencies in rad/s of the highest peaks of what the model leaves of the outputs."""

    @property
    def lag(self) -> float:
        """Time [s] by which the outputs follow the free run, as a whole number of samples."""

    @property
    def drifts(self) -> Sequence[float]:
        """Share of the time by which the lag of the outputs behind the free run grows, where it is seen."""

    @property
    def pull(self) -> float:
        """Rms force that accelerates the port, 1 where it moves nothing."""

    @property
    def mobility(self) -> float:
        """Largest acceleration per force at the port."""


def delays(seen: Seen) -> list[dict[str, float]]:
    """Starts of a delay: from none, a descent does not get past the first minimum of what oscillates."""
    late = [seen.lag] if seen.lag > 8.0 * seen.dt else []
    return [{"delay": value} for value in [*late, *(q * seen.dt for q in (0.5, 2.5, 6.0))]]
