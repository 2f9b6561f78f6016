"""Products: entries of the matrices, and stores, that depend on the state.

They are one family ``phi(x) z`` with ``phi(x) = slope x + curvature x^2``. It is zero at x = 0, where the
model's own entry is right. `z` is an input, another state, or the rate of the state itself.
"""

from __future__ import annotations

from typing import Any

from .formula import PortLaw
from .law import PORTS, Coefficient, register

_LEAST = 0.02  # least share of the store at any state


class _EntryProduct(PortLaw):
    """Entry that depends on a state.

    d is the state on which it acts, v the signal of its column.
    """

    where = frozenset(["entry"])
    coefficients = (
        Coefficient("slope", "force/(position velocity)", explanation="change of the entry per state"),
        Coefficient(
            "curvature", "force/(position^2 velocity)", explanation="change of the entry per squared state"
        ),
    )
    matrix: str

    @staticmethod
    def law(d, v, slope, curvature):  # type: ignore[no-untyped-def]
        """Formula."""
        return (slope + curvature * d) * d * v

    def sits(self, model: Any, place: str) -> bool:
        """At an entry of its matrix, and not on the diagonal of A: that is a loss."""
        row, column = model.entry(place)
        return bool(place.startswith(self.matrix) and row != column)


@register
class StateDependentGain(_EntryProduct):
    """Input whose gain depends on the state: valves, heaters, magnets."""

    matrix = "B"
    formula = "dx_i/dt = ... + (a d + b d^2) w_j, d the displacement of that mass, else x_i"
    explanation = "The gain {place} of an input depends on the state on which it acts: a valve, a heater."


@register
class ProductOfStates(_EntryProduct):
    """Coupling that depends on the state: transport, bilinear exchange."""

    matrix = "A"
    formula = "dx_i/dt = ... + (a d + b d^2) x_j, d the displacement of that mass, else x_i"
    explanation = "The coupling {place} depends on the state on which it acts: a product of two states."


@register
class StateDependentStore(PortLaw):
    """Store whose size depends on its state: L(i), C(v), the area of a tank.

    What fills it is all but the forces of other nonlinear effects.
    """

    where = PORTS
    coefficients = (
        Coefficient("slope", "1/velocity", explanation="share by which the store grows per state"),
        Coefficient("curvature", "1/velocity^2", explanation="share by which it grows per squared state"),
    )
    formula = "(1 + a v + b v^2) m dv/dt = F, m the store of the model, F what fills it"
    explanation = "What {place} stores is not in proportion to its state: the store depends on the state."
    words = ("state-dependent {store}", "The {store} at {place} depends on the {state}.")
    domains = frozenset(["first_order", "current", "voltage", "thermal", "hydraulic"])
    needs = frozenset(["velocity"])
    senses = frozenset({"velocity", "acceleration"})
    belongs_to = "mass"

    @staticmethod
    def law(d, v, slope, curvature):  # type: ignore[no-untyped-def]
        """Formula; d is what fills the store."""
        return d - d / max(1.0 + (slope + curvature * v) * v, _LEAST)
