"""Parameters of a model, their units, and independent ones among them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..arguments import as_flag, as_number, as_text
from ..effects.bodies import Entry
from ..effects.channels import InputGain
from ..effects.dampers import Damping
from ..effects.law import KINDS
from ..effects.springs import Stiffness
from ..exceptions import ModelError
from ..results import Row
from ..systems.linear import Array, entry_of
from .ports import sensor_row

if TYPE_CHECKING:
    from .physical_model import PhysicalModel


# usual names of derived units
_ALIASES = {
    "N s^2/m": "kg",
    "W s/K": "J/K",
    "V/A": "Ohm",
    "V s/A": "H",
    "V/C": "1/F",
    "N m s^2/rad": "kg m^2",
}
_FACTOR = re.compile(r"([^\s^*/()]+)(?:\^(-?\d+(?:\.\d+)?))?")
# shares of the influence of a parameter that no other one has, in the order of asking; below
# the last one it is redundant
_SHARES = (0.5, 0.2, 0.05, 1e-6)
_POINTS = 4  # evaluation points in the complex plane per state


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


def rate_at(A: Array, act: Array, velocity: Array) -> float:
    """Return the rate [1/s] at which what a force moves at a place comes back.

    Parameters
    ----------
    A : ndarray, shape (n, n)
        State matrix.
    act, velocity : ndarray, shape (n,)
        What a force changes there, and the row that reads the velocity.

    Returns
    -------
    float
        The natural frequency of a mass on its springs, or the damping rate where that is larger. The same in
        all units of the states. It is 0 if nothing brings back what the force moves.
    """
    # rate at which the velocity decays, and square root of the spring's: v A act, v A^2 act
    moved, once = float(velocity @ act), A @ act
    if moved == 0.0:
        return 0.0
    return float(max(abs(velocity @ once / moved), abs(velocity @ A @ once / moved) ** 0.5))


def natural_size(model: PhysicalModel, q: NominalParameter) -> float:
    """Return the size of a change of a parameter that is zero.

    Parameters
    ----------
    model : PhysicalModel
        Model.
    q : NominalParameter
        One of its parameters.

    Returns
    -------
    float
        The critical damping at its place, or the stiffness that goes with the rate there. It is 0 where the
        place has no rate, and for parameters of other kinds.
    """
    if q.kind not in (Damping.name, Stiffness.name):
        return 0.0
    port = model.port(q.place)
    rate = rate_at(model.linear.A, port.act, port.velocity)
    if not rate:
        return 0.0
    # 1/m is the velocity per force; critical damping 2 m omega, stiffness m omega^2
    return (2.0 * rate if q.kind == Damping.name else rate**2) / abs(float(port.velocity @ port.act))


def combine_units(rule: str, units: Mapping[str, str]) -> str:
    """Unit of a coefficient from the units of a place.

    Parameters
    ----------
    rule : str
        Product of names such as ``"force s/velocity^2"``; names that are
        keys of `units` are replaced, all others are units themselves. Only
        what follows a slash up to the next blank is divided by.
    units : mapping of str to str
        Unit of each quantity; ``""`` means unknown.

    Returns
    -------
    str
        Unit, ``""`` where one that is needed is unknown and ``"1"`` for a
        pure number.

    Examples
    --------
    >>> combine_units("force/velocity", {"force": "N", "velocity": "m/s"})
    'N s/m'
    >>> combine_units("force/velocity", {"force": "V", "velocity": "A"})
    'Ohm'
    """
    # exponents of the base units: product of the factors
    powers: dict[str, float] = {}
    for name, power in parse_unit(rule).items():
        unit = units.get(name, name)
        if not unit:
            return ""
        for base, exponent in parse_unit(unit).items():
            powers[base] = powers.get(base, 0) + power * exponent
    text = _format({base: power for base, power in powers.items() if power})
    return _ALIASES.get(text, text)


def parse_unit(text: str) -> dict[str, float]:
    """Exponents of the factors of ``"N s/m^2"``; ``"1"`` has none."""
    powers: dict[str, float] = {}
    for match in _FACTOR.finditer(text):
        base, exponent = match.group(1), float(match.group(2) or 1)
        # a slash before a parenthesis divides all that is inside
        opening = text.rfind("(", 0, match.start())  # opening parenthesis, perhaps after a slash
        inside = opening > 0 and ")" not in text[opening : match.start()]
        divided = any(text[:at].rstrip().endswith("/") for at in (match.start(), *[opening] * inside))
        if base != "1":
            powers[base] = powers.get(base, 0) + (-exponent if divided else exponent)
    return powers


def _format(powers: Mapping[str, float]) -> str:
    upper, lower = (
        " ".join(
            base if abs(power) == 1 else f"{base}^{abs(power):g}"
            for base, power in powers.items()
            if sign * power > 0
        )
        for sign in (1, -1)
    )
    below = f"({lower})" if " " in lower else lower
    return f"{upper or '1'}/{below}" if lower else upper or "1"


@lru_cache(maxsize=8)  # cached by identity, since every fit of a model needs them
def independent_parameters(model: PhysicalModel) -> tuple[NominalParameter, ...]:
    """Return the parameters of a model without the redundant ones.

    A parameter is redundant if other parameters have the same influence.

    Parameters
    ----------
    model : PhysicalModel
        Model; where it holds no entries of B, C and D, all its parameters are what is returned.

    Returns
    -------
    tuple of NominalParameter
        Left out are those of C where those of B are free and a single signal passes, or the gain of an
        input all of whose weights are free: judged by what they change in the transfer function.
    """
    entries = {q.name: entry_of(model.linear, q.place) for q in model.parameters if q.kind == Entry.name}
    # redundancy arises only with entries of B, C and D
    if not any(max(entry) >= model.linear.n_states for entry in entries.values()):
        return model.parameters
    responses = _Responses(model)
    basis: list[Array] = []
    kept, waiting = set(), list(model.parameters)
    # those that are well apart first (pivots, but in their order); last, losses that the model does not have,
    # for they cannot be negative
    for share, zero in (*((share, False) for share in _SHARES), (_SHARES[-1], True)):
        for q in (q for q in waiting if zero or q.value):
            column = responses.change(q)
            size = float(np.linalg.norm(column))
            # Gram-Schmidt orthogonalization
            for _ in range(2):  # twice, against rounding
                for known in basis:
                    column = column - (known @ column) * known
            left = float(np.linalg.norm(column))
            # masses are never free beside gains and must not replace free parameters
            if KINDS[q.kind].inertial:
                kept.add(q.name)
            # the part that no parameter before it explains
            elif left > share * size:
                basis.append(column / left)
                kept.add(q.name)
        waiting = [q for q in waiting if q.name not in kept]
    return tuple(q for q in model.parameters if q.name in kept)


class _Responses:
    """Influence of parameters on the transfer function.

    It is evaluated at points away from the poles.
    """

    def __init__(self, model: PhysicalModel) -> None:
        linear, self.model = model.linear, model
        # points in the complex plane around the poles
        n = linear.n_states
        sizes = np.abs(np.linalg.eigvals(linear.A))
        low, high = sizes[sizes > 0].min(initial=np.inf), sizes.max(initial=0.0)
        low, high = (low, high) if high > 0 else (1.0, 1.0)
        s = np.geomspace(0.1 * low, 10 * high, _POINTS * (n + 1)) * np.exp(1j * np.pi / 3)
        away = [at * np.eye(n) - linear.A for at in s]
        # (s I - A)^-1 B and C (s I - A)^-1
        states = np.array([np.linalg.solve(M, linear.B) for M in away])  # (k, n, n_w): of the inputs
        read = np.array([np.linalg.solve(M.T, linear.C.T).T for M in away]) + model.output_rate
        ones = np.ones((s.size, 1, 1))
        self.outputs = np.concatenate([read, ones * np.eye(linear.n_outputs)], axis=2)
        self.inputs = np.concatenate([states, ones * np.eye(linear.n_inputs)], axis=1)
        self.whole = linear.C @ states + linear.D
        size = np.sqrt(np.mean(np.abs(self.whole) ** 2, axis=0))
        self.scale = 1.0 / np.where(size > 0, size, np.inf)  # all channels count equally

    def change(self, q: NominalParameter) -> NDArray[np.float64]:
        """By a relative change of one number, real and imaginary parts in a row."""
        linear = self.model.linear
        # a gain scales the column of its input
        if q.kind == InputGain.name:
            changed = self.whole * (np.array(linear.input_labels) == q.place)
        else:
            if q.kind == Entry.name:
                row, column = entry_of(linear, q.place)
                act = np.eye(linear.n_states + linear.n_outputs)[row]
                sense = np.eye(linear.n_states + linear.n_inputs)[column]
            else:
                port = self.model.port(q.place)
                felt = port.output if port.output.size else np.zeros(linear.n_outputs)
                act = np.concatenate([port.act, felt])
                sense = sensor_row(port, spring=q.kind == Stiffness.name)
            # dG = C (s I - A)^-1 act * sense (s I - A)^-1 B
            changed = (q.value or 1.0) * (self.outputs @ act)[:, :, None] * (sense @ self.inputs)[:, None, :]
        flat = (changed * self.scale).reshape(-1)
        return np.concatenate([flat.real, flat.imag])
