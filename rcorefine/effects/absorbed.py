"""Laws that enter the matrices of the model: linear ones, and constants."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array
from .law import Law

__all__ = ["AbsorbedLaw", "Assembly", "Site", "nominal_is_left"]


@dataclass(slots=True, eq=False)
class Assembly:
    """Matrices of the model while the linear effects enter them.

    Attributes
    ----------
    rates : ndarray, shape (n, n + n_w)
        [A, Bu], of which `A` and `Bu` are views.
    A, Bu, inertia, constant : ndarray
        dx/dt = inertia^-1 (A x + Bu r + constant), with r what the inputs become.
    Uw : ndarray, shape (n_w, n_w + 1)
        r = Uw [w; 1].
    output_gain, output_offset : ndarray, shape (n_y,)
    input_lags, output_lags : list of (channel, state, time constant)
    felt : list of ndarray, shape (n_y, 2 n + n_w + 1)
        What sensors read of the forces of effects beside what those do to the states: rows on x, r, 1 and
        dx/dt.
    pace : float or complex
        Time that passes over the time that the record says.
    """

    rates: NDArray[Any]
    A: NDArray[Any]
    Bu: NDArray[Any]
    inertia: NDArray[Any]
    constant: NDArray[Any]
    Uw: NDArray[Any]
    output_gain: NDArray[Any]
    output_offset: NDArray[Any]
    input_lags: list[tuple[int, int, Any]] = field(default_factory=list)
    output_lags: list[tuple[int, int, Any]] = field(default_factory=list)
    felt: list[NDArray[Any]] = field(default_factory=list)
    pace: Any = 1.0

    def force(self, act: NDArray[Any]) -> NDArray[Any]:
        """The force that has entered along `act`, as a row on x, r, 1 and dx/dt."""
        entered = np.hstack([self.rates, self.constant[:, None], -self.inertia])
        return np.asarray(act @ entered / (act @ act))


@dataclass(frozen=True, eq=False)
class Site:
    """Place of an effect in the states of the model with all effects.

    Attributes
    ----------
    act, position, velocity : ndarray, shape (n,)
        Of the port.
    position_input, velocity_input, acceleration_input : ndarray, shape (n_w,)
        What it senses of the inputs.
    channel : int
        Of the input or output, -1 elsewhere.
    entry : tuple of int
        Row and column of an entry of [A B; C D].
    state : int
        First of the states that the effect adds.
    output : ndarray, shape (n_y,) or (0,)
        What the sensors read of its force beside that; empty for nothing.
    """

    act: Array
    position: Array
    velocity: Array
    position_input: Array
    velocity_input: Array
    acceleration_input: Array
    channel: int
    entry: tuple[int, int]
    state: int
    output: Array

    @cached_property
    def by_displacement(self) -> Array:
        """Rates by a resisting force of unit stiffness at the port, (n, n + n_w)."""
        return np.outer(self.act, np.concatenate([self.position, self.position_input]))

    @cached_property
    def by_velocity(self) -> Array:
        """Rates by a resisting force of unit damping at the port, (n, n + n_w)."""
        return np.outer(self.act, np.concatenate([self.velocity, self.velocity_input]))


class AbsorbedLaw(Law):
    """A law that enters the matrices of the model.

    Attributes
    ----------
    states : tuple of str
        What the states that it adds are called.
    """

    states: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def absorb(self, into: Assembly, site: Site, *values: Any) -> None:
        """Add it to the matrices.

        Parameters
        ----------
        into : Assembly
            Matrices, changed in place.
        site : Site
            Where it sits.
        *values : complex or float
            Coefficients in their order; complex for derivatives.
        """


def nominal_is_left(kind: str, structure: Any, place: str) -> tuple[float, float]:
    """Bounds of a change that leaves the parameter of the model positive."""
    values = [q.value for q in structure.model.parameters if (q.kind, q.place) == (kind, place)]
    return max((-value for value in values if value > 0), default=-inf), inf
