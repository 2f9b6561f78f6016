"""Force laws at a place, over the displacement or the velocity there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...models.ports import Port
from ...systems.linear import Array

__all__ = ["ForceLaw", "laws_at"]

_QUANTILES = (0.3, 0.5, 0.65, 0.8, 0.9)
_LEVELS = (0.5, 0.7, 0.85, 0.95)  # quantiles of a first-order state

_MEANINGS = {
    "dry": "jumps where the motion reverses, like dry friction",
    "dry by direction": "jumps where the motion reverses, by a different amount in each direction, like "
    "worn guides",
    "odd velocity": "grows more than proportionally to speed, like drag",
    "one side of velocity": "depends on the direction of motion",
    "root": "follows the square root, like an outflow",
    "beyond": "sets in beyond a limit, like a stop or a hardening spring",
    "beyond, one side": "sets in beyond a limit on one side only, like a stop",
    "odd displacement": "grows more than proportionally to displacement, like a hardening spring",
    "even displacement": "is larger on one side, like an asymmetric spring",
    "one side": "differs between the two sides, like a crack or a loose contact",
}
_OF_STORES = {
    "dry": "changes sign with the state and has nearly constant size",
    "dry by direction": "jumps where the state changes sign, by a different amount on each side",
    "odd velocity": "grows more than proportionally to the state, like radiation or a turbulent leak",
    "beyond": "sets in beyond a limit, like an overflow",
}


@dataclass(frozen=True, slots=True, eq=False)
class ForceLaw:
    """Force law with open coefficients, and the region where it is nonzero.

    Attributes
    ----------
    name : str
        Law.
    where : str
        Region in words.
    dof : int
        Numbers that it takes, the place of a kink counted.
    n_forces : int
        Forces of which it is a combination.
    linear : bool
        Whether the model could hold it.
    code : int
        Its number in the loop with the motion; -1 where it is not run in it.
    size : float
        Size by which displacement or velocity is divided there, or the kink.
    values : dict
        The region as numbers.
    """

    name: str
    where: str
    dof: int = 1
    n_forces: int = 1
    linear: bool = False
    code: int = -1
    size: float = 1.0
    values: dict[str, Any] = field(default_factory=dict)

    @property
    def meaning(self) -> str:
        """Description of a force of this law."""
        of_store = self.values.get("axis") == "x"
        return _OF_STORES.get(self.name, _MEANINGS[self.name]) if of_store else _MEANINGS[self.name]


def laws_at(place: Port, d: Array, v: Array) -> list[tuple[ForceLaw, list[Array]]]:
    """Laws at a place and their forces along a motion, those that vary on it.

    Parameters
    ----------
    place : Port
        Where.
    d, v : ndarray of shape (N,)
        Displacement and velocity there.
    """
    proposed = [*(_over_velocity(place, v) if np.ptp(v) > 0 else ())]
    proposed += _over_displacement(place, d) if np.ptp(d) > 0 else ()
    return [
        (law, forces)
        for law, forces in proposed
        if all(np.all(np.isfinite(f)) and np.ptp(f) > 0 for f in forces)
    ]


def _over_velocity(place: Port, v: Array) -> Iterator[tuple[ForceLaw, list[Array]]]:
    first = place.kind == "first_order"
    letter = "x" if first else "v"
    axis, large, spread = {"axis": letter}, f"at large |{letter}|", float(v.std())
    yield ForceLaw("linear velocity", "everywhere", linear=True), [v]
    if v.min() < -0.05 * spread and v.max() > 0.05 * spread:
        width, turn = 0.005 * spread, {"low": 0.0, "high": 0.0, **axis}
        step, near = np.tanh(v / width), f"near {letter} = 0"
        yield ForceLaw("dry", near, code=0, size=width, values=turn), [step]
        sides = [np.maximum(step, 0.0), np.minimum(step, 0.0)]
        yield ForceLaw("dry by direction", near, 2, 2, values=turn), sides
    yield ForceLaw("odd velocity", large, code=3, values=axis), [v * np.abs(v)]
    yield ForceLaw("odd velocity", large, code=4, size=spread, values=axis), [v**3 / spread**2]
    if first:
        yield ForceLaw("root", f"as the root of {letter}", values=axis), [np.sign(v) * np.sqrt(np.abs(v))]
        for g in map(float, np.quantile(v, _LEVELS)):
            where = f"{letter} > {_sized(g, place.velocity_unit)}"
            yield ForceLaw("beyond", where, 2, values={"low": g, **axis}), [np.maximum(v - g, 0.0)]
    elif v.min() < 0 < v.max():
        yield ForceLaw("one side of velocity", f"one sign of {letter}", code=9, values=axis), [np.abs(v)]


def _over_displacement(place: Port, d: Array) -> Iterator[tuple[ForceLaw, list[Array]]]:
    axis, spread = {"axis": "d"}, float(d.std())
    yield ForceLaw("linear displacement", "everywhere", linear=True), [d]
    odd = ForceLaw("odd displacement", "at large |d|", code=2, size=spread, values=axis)
    yield odd, [d**3 / spread**2]
    even = ForceLaw("even displacement", "larger for one sign of d", code=6, size=spread, values=axis)
    yield even, [d * d / spread]
    for g in map(float, np.quantile(np.abs(d), _QUANTILES)):
        text, edge = _sized(g, place.position_unit), {"low": g, **axis}
        both = ForceLaw("beyond", f"|d| > {text}", 2, code=1, size=g, values=edge)
        yield both, [np.sign(d) * np.maximum(np.abs(d) - g, 0.0)]
        above = ForceLaw("beyond, one side", f"d > {text}", 2, code=7, size=g, values={**edge, "side": 1})
        yield above, [np.maximum(d - g, 0.0)]
        below = ForceLaw("beyond, one side", f"d < -{text}", 2, code=8, size=g, values={**edge, "side": -1})
        yield below, [np.minimum(d + g, 0.0)]
    yield ForceLaw("one side", "d > 0 and d < 0 differ", code=5, values={"low": 0.0, **axis}), [np.abs(d)]


def _sized(number: float, unit: str) -> str:
    return f"{number:.3g} {unit}".rstrip()
