"""Units of signals, and unit conversions between record and model.

A factor between record and model may look like such a conversion.
"""

from __future__ import annotations

import re
from itertools import permutations
from typing import NamedTuple

import numpy as np

#: Size of each unit of a quantity, by the names that messages use.
_SIZES = {
    "rate": {"rad/s": 1.0, "rpm": 2 * np.pi / 60, "Hz": 2 * np.pi},
    "angle": {"radians": 1.0, "degrees": np.pi / 180},
    "velocity": {"m/s": 1.0, "km/h": 1 / 3.6},
    "acceleration": {"m/s^2": 1.0, "g": 9.80665},
    "length": {"millimeters": 1.0, "inches": 25.4},
    "force": {"newtons": 1.0, "pounds": 4.44822},
    "temperature": {"Celsius": 1.0, "Fahrenheit": 1 / 1.8},
    "": {"per second": 1.0, "per minute": 1 / 60},
    "share": {"shares of 1": 1.0, "percent": 0.01},
    "prefix": {"units": 1.0, "thousandths": 1e-3, "millionths": 1e-6},
}
_ANY = ("", "share", "prefix")  # of whatever quantity
#: What labs write for them: (quantity, size, name in a message).
_WRITTEN = {
    written: (quantity, _SIZES[quantity][name], name)
    for quantity, name, spelled in (
        ("rate", "rad/s", "rad/s rad/sec 1/s s^-1"), ("rate", "rpm", "rpm 1/min rev/min U/min"),
        ("rate", "Hz", "Hz rps rev/s"),
        ("angle", "radians", "rad"), ("angle", "degrees", "deg ° degrees"),
        ("velocity", "km/h", "km/h kph"), ("length", "inches", "in inch"),
        ("acceleration", "g", "g gn"), ("force", "pounds", "lbf lb"),
    )
    for written in spelled.split()
} | {written: ("rate", np.pi / 180, "deg/s") for written in ("deg/s", "°/s")}  # fmt: skip
_METRIC = {
    "m": ("length", 1e3), "m/s": ("velocity", 1.0), "m/s^2": ("acceleration", 1.0),
    "m/s²": ("acceleration", 1.0), "N": ("force", 1.0), "rad": ("angle", 1.0), "V": ("voltage", 1.0),
    "A": ("current", 1.0), "Pa": ("pressure", 1.0), "W": ("power", 1.0), "Nm": ("torque", 1.0),
    "N m": ("torque", 1.0),
}  # fmt: skip
_PREFIXES = {"": 1.0, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "c": 1e-2, "k": 1e3, "M": 1e6}
#: Quantities that a signal's name speaks of.
_NAMED = (
    (r"speed|veloc|omega|rate|rpm|freq", ("rate", "velocity")),
    (r"acc", ("acceleration",)),
    (r"angle|theta|phi|posi|disp|travel", ("angle", "length")),
    (r"temp", ("temperature",)),
    (r"force|load", ("force",)),
)
_FAR, _ABOUT = 5.0, 0.5  # a factor that parameters seldom make; the log by which a unit may then be missed
_NEAR = 0.1  # most that a factor which parameters do make may be missed by
_SURE = 4.0  # standard deviations within which a factor is met
_FINE = 0.01  # of a gain: how well it must be known for a unit to be certain
_ROUND = 1e-3  # share that simulation and rounding may cost
_MOST = 3  # units that a sentence lists


class _Known(NamedTuple):
    """Declared unit; its quantity is "?" if it is not known here."""

    quantity: str
    size: float
    name: str


def between(record: str, model: str) -> float | None:
    """Return the factor between record and model from declared units.

    None is returned where the units do not determine it.
    """
    one, other = _known(record), _known(model)
    if one is None or other is None or one.quantity != other.quantity or one.quantity == "?":
        return None
    return other.size / one.size


def likely(value: float, std: float, label: str, record: str, model: str) -> tuple[str, bool]:
    """Guess the unit of a record from its size relative to the model.

    Parameters
    ----------
    value, std : float
        Size of the record over that of the free run, positive, with its standard deviation.
    label : str
        Name of the signal.
    record, model : str
        Units that are declared; "" for none.

    Returns
    -------
    words : str
        The conversion that the size looks like; empty where it looks like none.
    certain : bool
        Whether one factor is met within a standard deviation that leaves room for no other.
    """
    # parameters that are off make a gain of 1.3 and not of 60
    within = _ABOUT if abs(np.log(value)) > np.log(_FAR) else min(max(3.0 * std / value, 0.01), _NEAR)
    given, declared = _known(record), _known(model)
    if record == model:
        given = None  # that was taken over, or is what is in doubt
    near = []
    for quantity, sizes in _SIZES.items():
        rank = _rank(quantity, label, given or declared)
        for (here, one), (there, other) in permutations(sizes.items(), 2):
            fits = all(unit is None or unit.name == name for unit, name in ((given, here), (declared, there)))
            if rank is None or (quantity not in _ANY and not fits):
                continue
            factor = other / one
            if (far := abs(float(np.log(value / factor)))) <= within:
                near.append((rank, far, factor, f"{here} where the model has {there}"))
    near.sort()
    met = {round(f, 6) for *_, f, _ in near if abs(value - f) <= max(_SURE * std, _ROUND * value)}
    certain = len(met) == 1 and _SURE * std <= _FINE * value
    said = [words for *_, f, words in near if not certain or round(f, 6) in met]
    return ", or ".join(said[:_MOST]), certain


def _known(unit: str) -> _Known | None:
    if unit in _WRITTEN:
        return _Known(*_WRITTEN[unit])
    for prefix, size in _PREFIXES.items():
        base = unit.removeprefix(prefix)
        if unit.startswith(prefix) and base in _METRIC:
            quantity, whole = _METRIC[base]
            sizes = {size: name for name, size in reversed(_SIZES.get(quantity, {}).items())}
            return _Known(quantity, size * whole, sizes.get(size * whole, unit))
    return _Known("?", 1.0, unit) if unit else None


def _rank(quantity: str, label: str, declared: _Known | None) -> int | None:
    """Rank how well a quantity suits a signal.

    The rank is 0 for what suits it, 1 for what it may be, and None for what it is not.
    """
    if declared is not None and quantity not in _ANY:
        return 0 if declared.quantity == quantity else None
    spoken = [q for pattern, quantities in _NAMED if re.search(pattern, label.lower()) for q in quantities]
    if quantity in _ANY or not spoken:
        return 1
    return 0 if quantity in spoken else None
