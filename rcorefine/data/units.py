"""Units in column headers, and times in seconds.

Other remarks in brackets are not taken for units.
"""

from __future__ import annotations

import re

from ..exceptions import DataError

__all__ = ["is_unit", "seconds_per", "split_unit"]

_PREFIXED = (
    "m", "s", "g", "N", "V", "A", "W", "J", "Pa", "K", "C", "Hz", "rad", "F", "H", "T", "Wb", "l", "L", "bar",
    "Ohm", "ohm", "Ω", "Nm", "VA", "Wh", "eV", "mol", "lx", "cd", "S", "gn",
)  # fmt: skip
_ALONE = (
    "°", "%", "‰", "°C", "°F", "degC", "degF", "deg", "rpm", "rps", "min", "h", "d", "psi", "in", "inch",
    "ft", "lb", "lbf", "kgf", "mph", "kph", "kn", "rev", "cnt", "cnts", "count", "counts", "ticks", "steps",
    "px", "dB", "sec", "secs", "seconds", "hr", "grad", "ppm", "Volt", "Volts", "volts", "Amp", "Amps",
    "Newton",
)  # fmt: skip
_KNOWN = frozenset(_ALONE) | {
    prefix + base for base in _PREFIXED for prefix in ("", *"kMGmuµμnpcd", "da", "h")
}
_SECONDS = {
    "s": 1.0, "sec": 1.0, "secs": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6,
    "ns": 1e-9, "min": 60.0, "h": 3600.0, "hr": 3600.0,
}  # fmt: skip
_BRACKETS = re.compile(r"(.*\S)\s*[\[(]([^\[\]()]+)[\])]|(.*\S) / (\S+)")


def is_unit(text: str) -> bool:
    """Return whether a text consists of unit symbols.

    Brackets around the text are allowed.

    Examples
    --------
    >>> [is_unit(text) for text in ("m/s^2", "[N m]", "°C", "-", "off", "n/a", "1")]
    [True, True, True, True, False, False, False]
    """
    text = re.sub("[²³⁻·]", " ", _bare(text))
    symbols = re.findall(r"°?[^\W\d_]+|[°%‰]", text)
    rest = re.sub(r"°?[^\W\d_]+|[°%‰]", "", text)
    if not symbols:
        return text == "-"
    return all(symbol in _KNOWN for symbol in symbols) and not re.search(r"[^\s/*.^\d()-]", rest)


def _bare(text: str) -> str:
    text = text.strip()
    return text[1:-1].strip() if text[:1] + text[-1:] in ("[]", "()", "<>", "{}") else text


def split_unit(cell: str) -> tuple[str, str]:
    """Split a header cell into name and unit.

    The unit is empty if there is none.

    Examples
    --------
    >>> split_unit("F [N]"), split_unit("speed / rpm"), split_unit("q(1)")
    (('F', 'N'), ('speed', 'rpm'), ('q(1)', ''))
    """
    found = _BRACKETS.fullmatch(cell)
    if found:
        name, unit = (found[1], found[2]) if found[1] is not None else (found[3], found[4])
        if is_unit(unit):
            return name, _bare(unit)
    return (cell, "") if not is_unit(cell) or cell[:1] not in "[(<{" else ("", _bare(cell))


def seconds_per(unit: str, column: str) -> float:
    """Seconds in a unit of time.

    Raises
    ------
    DataError
        If it is no unit of time that is known.
    """
    if unit not in _SECONDS:
        raise DataError(
            f"column {column!r} of times is in {unit!r}, not in one of {', '.join(_SECONDS)}; give dt in s "
            "instead of time="
        )
    return _SECONDS[unit]
