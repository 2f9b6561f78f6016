"""Every public callable that can be reached, with a valid call of it made from its signature.

Roots are the names of the public modules and the objects that the valid calls of `public_calls` make; what
those hold in public attributes is reached, too. No name is listed here: a new one is found by itself.
"""

from __future__ import annotations

import functools
import inspect
import re
import types
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import control as ct
import numpy as np
import public_calls as calls
from inner import Data
from numpydoc.docscrape import NumpyDocString

import rcorefine as rco

INNER = 4  # attributes in a row that are followed

#: Valid values by the name of a parameter: a new function that takes `model, data` is called by itself.
POOL: dict[str, Callable[[], Any]] = {
    "model": calls.model,
    "models": calls.model,
    "system": lambda: calls.model().system,
    "data": calls.record,
    "record": calls.record,
    "records": lambda: {"a": calls.record()},
    "measurement": calls.record,
    "response": calls.response,
    "effects": lambda: [calls.EFFECT],
    "candidates": lambda: [calls.EFFECT],
    "effect": lambda: calls.EFFECT,
    "coefficient": lambda: "stiffness",
    "name": lambda: "stiffness",
    "place": lambda: "link1",
    "kind": lambda: "stiffness",
    "places": lambda: ["link1"],
    "dt": lambda: calls.DT,
    "omega": lambda: [1.0, 2.0],
    "path": lambda: calls.folder() / "by_signature",
    "folder": lambda: calls.folder() / "by_signature.d",
    "executor": lambda: None,
    "rng": lambda: 1,
}
#: ... and by what it says that it takes.
BY_TYPE: dict[str, Callable[[], Any]] = {
    "bool": lambda: False,
    "int": lambda: 2,
    "float": lambda: 1.0,
    "str": lambda: "link1",
    "Measurement": calls.record,
    "PhysicalModel": calls.model,
    "Effect": lambda: calls.EFFECT,
    "Refinement": calls.refinement,
    "Diagnosis": calls.diagnosis,
    "ArrayLike": lambda: np.ones(2),
    "Sequence": lambda: [1.0, 2.0],
    "Mapping": dict,
}


@dataclass(frozen=True)
class Target:
    """A callable and a valid call of it, as far as its signature tells one."""

    name: str
    function: Callable[[], Callable[..., Any]]
    valid: Callable[[], Mapping[str, Any]]
    arguments: tuple[str, ...]
    work: str | None = None


def _is_ours(obj: object) -> bool:
    return type(obj).__module__.partition(".")[0] == "rcorefine" and not isinstance(obj, type)


def _value(item: inspect.Parameter) -> Any:
    if item.name in POOL:
        return POOL[item.name]()
    words = re.findall(r"\w+", str(item.annotation))
    return next((BY_TYPE[word]() for word in words if word in BY_TYPE), 1.0)


def _from_signature(function: Callable[..., Any]) -> Mapping[str, Any]:
    return {
        item.name: _value(item)
        for item in inspect.signature(function).parameters.values()
        if item.default is item.empty and item.kind in (item.POSITIONAL_OR_KEYWORD, item.KEYWORD_ONLY)
    }


def _target(name: str, function: Callable[[], Callable[..., Any]]) -> Target:
    listed = calls.CALLS.get(name)
    if listed is not None:
        return Target(name, listed.function, listed.valid, tuple(listed.arguments()), listed.work)
    names = tuple(
        item.name
        for item in inspect.signature(function()).parameters.values()
        if item.kind in (item.POSITIONAL_OR_KEYWORD, item.KEYWORD_ONLY)
    )
    return Target(name, function, lambda: _from_signature(function()), names)


def _exported() -> Iterator[tuple[str, Any]]:
    for module in (rco, *(getattr(rco, name) for name in rco.__all__)):
        if isinstance(module, types.ModuleType):
            for name in module.__all__:
                obj = getattr(module, name)
                raised = isinstance(obj, type) and issubclass(obj, BaseException)
                if callable(obj) and not raised:
                    yield ("" if module is rco else f"{module.__name__.rpartition('.')[2]}.") + name, obj


def public_attributes(obj: object) -> Iterator[tuple[str, Any]]:
    """Fields and properties, as a user sees them."""
    for name in dir(obj):
        if not name.startswith("_") and not inspect.isroutine(inspect.getattr_static(type(obj), name, None)):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    yield name, getattr(obj, name)
                except Exception:  # what it has not, it says elsewhere
                    continue


def _made() -> Iterator[object]:
    """What the makers of `public_calls` make: its functions without an argument that must be given."""
    for name, maker in vars(calls).items():
        own = inspect.isroutine(inspect.unwrap(maker)) and maker.__module__ == calls.__name__
        if own and not name.startswith(("is_", "_", "or_")):
            if all(item.default is not item.empty for item in inspect.signature(maker).parameters.values()):
                yield maker()
    yield rco.explore(calls.model(), calls.record())
    yield calls.EFFECT


def _reached() -> dict[type, object]:
    """One object of each class that can be reached."""
    found: dict[type, object] = {}
    seen: set[int] = set()
    keep: list[object] = []  # no identity is used twice

    def follow(obj: object, depth: int) -> None:
        if isinstance(obj, Mapping):
            obj = tuple(obj.values())
        if isinstance(obj, list | tuple):
            for item in obj[:3]:
                follow(item, depth)
        if not _is_ours(obj) or id(obj) in seen or depth > INNER:
            return
        seen.add(id(obj))
        keep.append(obj)
        found.setdefault(type(obj), obj)
        for _, value in public_attributes(obj):
            follow(value, depth + 1)

    for made in _made():
        follow(made, 0)
    return found


def _is_result(obj: object) -> bool:
    """A class whose objects the toolbox makes: nobody calls it."""
    return isinstance(obj, type) and is_dataclass(obj) and not NumpyDocString(obj.__doc__ or "")["Parameters"]


def _told_of(obj: object) -> set[str]:
    """Words that a callable's documentation uses for what it returns or holds."""
    doc = NumpyDocString(inspect.getdoc(obj) or "")
    types_of = [item.type for part in ("Returns", "Attributes") for item in doc[part]]
    return {word for text in types_of for word in re.findall(r"\w+", text)}


@functools.cache
def targets() -> dict[str, Target]:
    """Every callable by its name."""
    exported = dict(_exported())
    found = {
        name: _target(name, lambda obj=obj: obj) for name, obj in exported.items() if not _is_result(obj)
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        owners = {kind.__name__: owner for kind, owner in _reached().items()}
    every = dict(owners)
    known = {kind for kind, owner in owners.items() if isinstance(owner, Data)}
    fresh = {word for obj in exported.values() for word in _told_of(obj)}
    while fresh := (fresh | known) & owners.keys():
        for kind in fresh:
            owner = owners.pop(kind)
            for method in dir(owner):
                raw = inspect.getattr_static(owner, method)
                if method.startswith("_") or not (inspect.isroutine(raw) or isinstance(raw, classmethod)):
                    continue
                bound = getattr(owner, method)
                name = f"{kind}.{method}"
                ours = (getattr(bound, "__module__", None) or "").startswith("rcorefine")
                if ours and inspect.isroutine(bound) and name not in found:
                    found[name] = _target(name, lambda bound=bound: bound)
        fresh = {word for kind in fresh for word in _told_of(type(every[kind]))}
    for name, call in calls.CALLS.items():  # further forms of a call
        found.setdefault(name, _target(name, call.function))
    return found


# ------------------------------------------------------------------ what stands in a result
def not_finite(obj: object, at: str = "", depth: int = 0) -> set[str]:
    """Places in a result where a number is NaN or infinite; indices are left out."""
    if isinstance(obj, float | complex | np.inexact):
        return set() if np.isfinite(obj) else {at}
    if isinstance(obj, np.ndarray):
        return {at} if obj.dtype.kind in "fc" and not np.isfinite(obj).all() else set()
    if depth > INNER or obj is None or isinstance(obj, str | bytes | int | type):
        return set()
    if isinstance(obj, Mapping):
        return set().union(*(not_finite(value, f"{at}[]", depth + 1) for value in obj.values()))
    if isinstance(obj, list | tuple):
        return set().union(*(not_finite(value, f"{at}[]", depth + 1) for value in obj[:50]))
    if isinstance(obj, ct.StateSpace):
        return set().union(*(not_finite(getattr(obj, key), f"{at}.{key}", depth + 1) for key in "ABCD"))
    if _is_ours(obj) and is_dataclass(obj):
        return set().union(
            *(
                not_finite(getattr(obj, item.name), f"{at}.{item.name}", depth + 1)
                for item in fields(obj)
                if not item.name.startswith("_")
            )
        )
    return set()
