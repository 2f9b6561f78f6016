"""Just enough unit algebra to print the unit of a coefficient."""

from __future__ import annotations

import re
from collections.abc import Mapping

__all__ = ["combine_units", "parse_unit"]

# what people write instead of the quotient
_ALIASES = {
    "N s^2/m": "kg",
    "W s/K": "J/K",
    "V/A": "Ohm",
    "V s/A": "H",
    "V/C": "1/F",
    "N m s^2/rad": "kg m^2",
}
_FACTOR = re.compile(r"([^\s^*/()]+)(?:\^(-?\d+(?:\.\d+)?))?")


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
        opening = text.rfind("(", 0, match.start())  # of a parenthesis that may follow a slash
        inside = opening > 0 and ")" not in text[opening : match.start()]
        divided = any(text[:at].rstrip().endswith("/") for at in (match.start(), *[opening] * inside))
        if base != "1":
            powers[base] = powers.get(base, 0) + (-exponent if divided else exponent)
    return powers


def _format(powers: Mapping[str, float]) -> str:
    upper = [_power(base, power) for base, power in powers.items() if power > 0]
    lower = [_power(base, -power) for base, power in powers.items() if power < 0]
    if not lower:
        return " ".join(upper) or "1"
    below = lower[0] if len(lower) == 1 else "(" + " ".join(lower) + ")"
    return f"{' '.join(upper) or '1'}/{below}"


def _power(base: str, power: float) -> str:
    return base if power == 1 else f"{base}^{power:g}"
