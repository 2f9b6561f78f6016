"""Single numbers: real, shares, whole, and flags."""

from __future__ import annotations

import math
import numbers
from typing import Any

import control as ct
import numpy as np

from .quoting import shown

__all__ = ["as_flag", "as_number", "as_share", "as_whole"]

_LARGEST = 1e150  # numbers are squared
_MOST = 2**31 - 1  # no count of samples, orders or windows is larger


def as_flag(value: Any, name: str) -> bool:
    """True or False, nothing else: "no" would count as true.

    Raises
    ------
    control.ControlArgument
        If it is anything else.
    """
    if not isinstance(value, bool | np.bool_):
        raise ct.ControlArgument(f"{name} must be True or False, not {shown(value)}")
    return bool(value)


def as_number(
    value: Any,
    name: str,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    below: float = math.inf,
    most: float = math.inf,
    infinite: bool = False,
    what: str = "a number",
    error: type[Exception] = ct.ControlArgument,
) -> float:
    """One finite number: above < value < below and least <= value <= most.

    Raises
    ------
    control.ControlArgument
        If it is no real number.
    error
        If it is not finite or out of range.
    """
    number = _real(value)
    if number is None:
        raise ct.ControlArgument(f"{name} must be {what}, not {shown(value)}")
    positive = "be positive" if above == 0 else f"be above {above:g}"
    endless = math.isnan(number) or (math.isinf(number) and not infinite)
    wrong = [
        (endless, "be positive and finite" if above == 0 else "be finite"),
        (number <= above > -math.inf, positive),
        (number < least, "not be negative" if least == 0 else f"be at least {least:g}"),
        (number >= below < math.inf, f"be below {below:g}"),
        (number > most, f"be at most {most:g}"),
        (0 < abs(number) < 1 / _LARGEST, "be of another unit: its square is zero to the computer"),
        (_LARGEST < abs(number) < math.inf, "be of another unit: its square is beyond floating point"),
    ]
    for broken, rule in wrong:
        if broken:
            raise error(f"{name} = {number:g} must {rule}")
    return number


def _real(value: Any) -> float | None:
    """Return a real number as a float, or None for anything else.

    An array without dimensions counts as a number, a flag does not.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0 and not np.ma.isMaskedArray(value):
        value = value[()]
    if isinstance(value, bool | np.bool_ | np.timedelta64) or not isinstance(value, numbers.Real):
        return None
    try:
        return float(value)
    except OverflowError:  # a whole number of more than 300 digits
        return math.inf if abs(value) == value else -math.inf


def as_share(value: Any, name: str, *, error: type[Exception] = ct.ControlArgument) -> float:
    """Return a probability or share strictly between 0 and 1.

    It must not be so small that its quantile is infinite.
    """
    number = _real(value)
    if number is None or not 1 / _LARGEST <= number < 1.0:
        problem = ct.ControlArgument if number is None else error
        least = f" (at least {1 / _LARGEST:g})" if number is not None and 0 < number < 1 else ""
        raise problem(f"{name} must be a number between 0 and 1{least}, not {shown(value)}")
    return number


def as_whole(
    value: Any,
    name: str,
    *,
    least: int = 0,
    most: int = _MOST,
    error: type[Exception] = ct.ControlArgument,
) -> int:
    """Whole number in a range.

    Raises
    ------
    control.ControlArgument
        If it is no whole number.
    error
        If it is out of range.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise ct.ControlArgument(f"{name} must be a whole number, not {shown(value)}")
    if not least <= value <= most:
        bound = f"at least {least}" if value < least else f"at most {most}"
        raise error(f"{name} must be {bound}, not {shown(value)}")
    return int(value)
