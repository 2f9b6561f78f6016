"""Parameters of a fit: nominal value, prior, bounds and estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..effects.effect import Effect
from ..engine.structure import Structure
from ..models.parameters import natural_size
from ..results import Row, estimate
from ..systems.linear import Array
from .problem import Priors

_LOOSE = 30.0  # relative prior standard deviation of a free linear parameter
_CHANGE = 1.0  # relative prior standard deviation of a change: of equally good ones the smaller is preferred


@dataclass(frozen=True, slots=True)
class EstimatedParameter(Row):
    """One row of `Refinement.parameters`.

    Attributes
    ----------
    name : str
        Name of the physical parameter (``"k2"``) or of the effect's coefficient.
    kind, place : str
        Effect that it belongs to.
    initial, value : float
        Value in the initial model (0 for what was not there) and estimate, in `unit`.
    coefficient : float
        Coefficient of the effect: value minus initial.
    std : float
        Standard deviation of value and coefficient alike.
    unit : str
        Unit, "" where unknown.
    role : str
        "effect" (asked for), "linear" (parameter of the model), "offset" (nuisance), or "change"
        (of an element, where damage is sought).
    expected, prior : float
        Mean and standard deviation of the Gaussian prior of the value, in `unit`; inf without a prior.
    lower, upper : float
        Bounds of the value.
    weak : bool
        Whether the prior only settles what the record cannot; `std` does not count it.
    """

    name: str
    kind: str
    place: str
    initial: float
    value: float
    coefficient: float
    std: float
    unit: str
    role: str
    expected: float = np.nan
    prior: float = np.inf
    lower: float = -np.inf
    upper: float = np.inf
    weak: bool = False

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval."""
        return self.value - 1.96 * self.std, self.value + 1.96 * self.std

    @property
    def is_known(self) -> bool:
        """True if something is known about the value beforehand."""
        return bool(np.isfinite(self.prior)) and not self.weak

    @property
    def cells(self) -> list[str]:
        """The row as text: name, effect, place, initial, value, std, unit."""
        figures = (f"{self.initial:.5g}", *estimate(self.value, self.std))
        return [self.name, self.kind if self.name != self.kind else "", self.place, *figures, self.unit]


def parameter_table(
    structure: Structure, roles: Sequence[str], tolerance: float = 0.0
) -> tuple[EstimatedParameter, ...]:
    """Return the parameters of a structure, at their nominal values.

    Parameters
    ----------
    structure : Structure
        Model with its effects.
    roles : sequence of str
        Role of each effect.
    tolerance : float
        Relative standard deviation of the linear parameters; 0 if they float freely.

    Returns
    -------
    tuple of EstimatedParameter
        In the order of the coefficients; the standard deviations of the estimates are not known yet.
    """
    rows = []
    for parameter in structure.parameters:
        effect, role = structure.effects[parameter.effect], roles[parameter.effect]
        name, nominal = _nominal(structure, effect, role) or (parameter.name, 0.0)
        # the user's prior comes first
        mean, sd, weak = parameter.mean, parameter.sd, False
        # linear parameter: declared tolerance, or a wide prior of 30 times its size
        if np.isinf(sd) and role in ("linear", "change"):
            size = nominal_size(structure, effect)
            wide = _CHANGE if role == "change" else tolerance or _LOOSE
            sd = wide * size if size > 0 else np.inf
            # a wide prior only decides what the record cannot, such as two scales that cancel
            weak = role == "change" or tolerance == 0
        rows.append(
            EstimatedParameter(
                name, effect.kind, effect.place, nominal, nominal, 0.0, np.nan, structure.unit(parameter),
                role, nominal + mean, sd, nominal + parameter.lower, nominal + parameter.upper, weak,
            )
        )  # fmt: skip
    return tuple(rows)


def _nominal(structure: Structure, effect: Effect, role: str) -> tuple[str, float] | None:
    """Return the name and value of what an effect changes.

    None for what was not there.
    """
    # parameter that the model names
    for q in structure.model.parameters:
        if (q.kind, q.place) == (effect.kind, effect.place):
            return q.name, q.value
    # mass at a place whose motion is one state; or the gain of a channel
    if effect.spec.inertial and np.count_nonzero(structure.model.port(effect.place).velocity) == 1:
        return f"m[{effect.place}]", structure.inertia(effect.place)
    if effect.spec.relative and role == "linear":
        return f"gain[{effect.place}]", 1.0
    return None


def estimated(
    table: Sequence[EstimatedParameter], theta: Array, spread: Array
) -> tuple[EstimatedParameter, ...]:
    """Return the table with estimates and their standard deviations."""
    return tuple(
        replace(row, value=row.initial + float(change), coefficient=float(change), std=float(std))
        for row, change, std in zip(table, theta, spread, strict=True)
    )


def priors(table: Sequence[EstimatedParameter]) -> Priors:
    """Return the prior mean and standard deviation of every coefficient."""
    # priors of the coefficient: value less nominal value
    rows = np.array([(row.expected - row.initial, row.prior) for row in table]).reshape(-1, 2)
    return Priors(rows[:, 0], rows[:, 1])


def weak_priors(table: Sequence[EstimatedParameter]) -> NDArray[np.bool_]:
    """Return which priors are no part of the error bars.

    They only settle what the record cannot.
    """
    return np.array([row.weak for row in table], dtype=bool)


def nominal_size(structure: Structure, effect: Effect) -> float:
    """Return the size of the model parameter that an effect changes.

    A parameter that is zero has the natural size of its place, such as the critical damping. The size is 0 if
    the model has no such parameter.
    """
    if effect.spec.relative:
        return 1.0
    # parameter of the model, or the inertia at the place
    for q in structure.model.parameters:
        if (q.kind, q.place) == (effect.kind, effect.place):
            return abs(q.value) or natural_size(structure.model, q)
    return structure.inertia(effect.place) if effect.spec.inertial else 0.0
