"""Words of each domain, and kinds of effects by their key or printed name."""

from __future__ import annotations

import re
from collections.abc import Mapping
from difflib import get_close_matches
from string import Formatter
from types import MappingProxyType
from typing import Any

import control as ct

from .law import KINDS

#: Words of a domain, which the words of a law ask for; a law that asks for more keeps its own.
DOMAINS: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        # motion in a line: the words of the laws themselves
        "mechanical": {},
        "rotational": {
            "force": "torque",
            "linear": "viscous friction",
            "store": "inertia",
            "spring": "torsional stiffness",
            "constant": "constant torque",
        },
        # a state of unknown kind
        "first_order": {
            "force": "flow",
            "state": "state",
            "loss": "loss",
            "linear": "loss in proportion",
            "store": "storage",
            "constant": "constant loss",
        },
        # electrical analogies: voltage as the force on a current, current as the force on a voltage
        "current": {
            "force": "voltage",
            "state": "current",
            "loss": "voltage drop",
            "linear": "series resistance",
            "store": "inductance",
            "spring": "inverse capacitance",
            "elastic": "inverse capacitance",
            "moved": "charge",
            "resonance": "resonant circuit",
            "constant": "constant voltage",
        },
        "voltage": {
            "force": "current",
            "state": "voltage",
            "loss": "leakage",
            "linear": "leak conductance",
            "store": "capacitance",
            "constant": "constant current",
        },
        # thermal and hydraulic: flow as the force on a temperature or a level
        "thermal": {
            "force": "heat flow",
            "state": "temperature",
            "loss": "heat loss",
            "linear": "heat loss",
            "store": "heat capacity",
            "constant": "constant heat loss",
        },
        "hydraulic": {
            "force": "flow",
            "state": "level",
            "loss": "outflow",
            "linear": "outflow in proportion",
            "store": "tank area",
            "constant": "constant leak",
        },
    }
)
# domain by the first word of a port's name
_OF_NAME = {
    "speed": "mechanical",
    "velocity": "mechanical",
    "omega": "rotational",
    "rpm": "rotational",
    "temperature": "thermal",
    "temp": "thermal",
    "level": "hydraulic",
    "current": "current",
    "voltage": "voltage",
}
# domain by the unit of a first-order state
_OF_STATE = {
    "A": "current",
    "V": "voltage",
    "K": "thermal",
    "degC": "thermal",
    "°C": "thermal",
    "m": "hydraulic",
    "m/s": "mechanical",  # speed without a position among the states
    "km/h": "mechanical",
}


def domain_of(kind: str, velocity_unit: str, name: str = "") -> str:
    """Field that a port belongs to.

    Parameters
    ----------
    kind : {"mechanical", "first_order"}
        Kind of the port.
    velocity_unit : str
        Unit of what it senses.
    name : str
        Name of the port; its first word counts if there is no unit (``"level1"``).

    Returns
    -------
    str
        A key of `DOMAINS`; the kind itself where unit and name say no more.

    Examples
    --------
    >>> domain_of("first_order", "K"), domain_of("mechanical", "rad/s"), domain_of("mechanical", "m/s")
    ('thermal', 'rotational', 'mechanical')
    >>> domain_of("first_order", "", "level2"), domain_of("first_order", "", "x1")
    ('hydraulic', 'first_order')
    """
    # angular velocity
    if velocity_unit == "rpm" or velocity_unit in [f"{angle}/s" for angle in ("rad", "rev", "deg")]:
        return "rotational"
    if kind == "mechanical":
        # a charge whose rate is a current
        return "current" if velocity_unit == "A" else kind
    # the name counts only without a unit
    first = re.split(r"[^a-z]", name.lower())[0] if not velocity_unit else ""
    return _OF_NAME.get(first) or _OF_STATE.get(velocity_unit, kind)


def worded(template: str, domain: str) -> str:
    """Fill a template with the words of a domain.

    The result is empty if the domain lacks one of the words.

    Parameters
    ----------
    template : str
        Text with words to fill in, such as ``"quadratic {loss}"``; ``"{place}"`` stays.
    domain : str
        Key of `DOMAINS`.

    Returns
    -------
    str

    Examples
    --------
    >>> worded("quadratic {loss}", "thermal"), worded("quadratic {loss}", "mechanical")
    ('quadratic heat loss', '')
    """
    words = DOMAINS[domain]
    # words that the template asks for
    asked = {name for _, name, _, _ in Formatter().parse(template) if name} - {"place"}
    return template.format(place="{place}", **words) if asked and asked <= set(words) else ""


def kind_named(name: Any) -> str:
    """Return the kind of effect of a key or of a printed name.

    Parameters
    ----------
    name : str
        Key of `KINDS`, or the name in the words of a domain; upper case and spaces do not matter.

    Returns
    -------
    str
        Key of `KINDS`.

    Raises
    ------
    control.ControlArgument
        If there is no such kind; the three most similar names come first.

    Examples
    --------
    >>> kind_named("Coulomb friction"), kind_named("series resistance"), kind_named("quadratic outflow")
    ('coulomb_friction', 'damping', 'quadratic_damping')
    >>> kind_named("friction")
    Traceback (most recent call last):
    ...
    control.exception.ControlArgument: unknown kind of effect 'friction'; near it: coulomb_friction, ...
    """
    if isinstance(name, str) and name in KINDS:
        return name
    message = f"unknown kind of effect {name!r}"
    if isinstance(name, str) and name.strip():
        words, known = _plain(name), _kinds_by_name()
        if words in known:
            return known[words]
        # names that contain these words, else those spelled like it
        near = [each for each in known if words in each] or get_close_matches(words, known)
        near = list(dict.fromkeys(known[each] for each in near))[:3]
        message += f"; near it: {', '.join(near)}" if near else ""
    raise ct.ControlArgument(f"{message}; the kinds are {', '.join(KINDS)}")


def _kinds_by_name() -> dict[str, str]:
    """Return the kind of each key and of each name in the words of a domain."""
    # keys first; a printed name never replaces one
    known = {_plain(kind): kind for kind in KINDS}
    for kind, law in KINDS.items():
        printed = (_plain(worded(law.words[0], domain)) for domain in DOMAINS)
        known |= {text: kind for text in printed if text and text not in known}
    return known


def _plain(name: str) -> str:
    """Return a name in lower case, with single spaces between its words."""
    return " ".join(name.lower().replace("_", " ").split())
