"""File format of refiners and monitors: plain arrays and JSON.

A file is written completely or not at all, and nothing is executed on reading. It may hold what a fresh
object of the same settings holds, grown where growth is allowed. Kernels trust shapes and counters, so
nothing from a file reaches one before it was held against its counterpart.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from types import MappingProxyType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import control as ct
import numpy as np

from ..arguments import as_mapping, as_path
from ..effects.effect import ARGUMENTS, Effect, import_path, law_here
from ..effects.given import Custom, Table
from ..exceptions import DataError, ModelError
from ..models.parameters import NominalParameter
from ..models.physical_model import PhysicalModel
from ..models.ports import Port
from ..systems.linear import LinearModel
from ..writing import damaged, read_archive, replacing

SCHEMA = 2  # of the file; raised when an older reader could misread it
_META = "meta"
_KINDS: dict[str, Any] = {
    kind.__name__: kind for kind in (LinearModel, PhysicalModel, NominalParameter, Port, Table)
}
_NOT_STORED = {"kernel"}  # made anew from the other fields


def storable(*kinds: type) -> None:
    """Enter dataclasses and named tuples that files may hold."""
    _KINDS.update({kind.__name__: kind for kind in kinds})


def write_file(path: str | os.PathLike[str], content: Any) -> None:
    """Write a tree of arrays, numbers, text and known classes.

    Parameters
    ----------
    path : path-like
        File to write; replaced in one step, so that a reader sees the old one or the new one.
    content : object
        Tree to write.
    """
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    # the tree as JSON; arrays beside it under keys a0, a1, ...
    meta = json.dumps({"schema": SCHEMA, "content": _encode(content, arrays)})
    with replacing(path) as stream:
        np.savez(stream, allow_pickle=False, **{_META: np.array(meta)}, **arrays)


def read_file(
    path: str | os.PathLike[str], laws: Mapping[str, Callable[..., Any]] | None = None, what: str = "refiner"
) -> Any:
    """Read what `write_file` wrote.

    Raises
    ------
    DataError
        If the file holds something else, is damaged, or comes from a newer version.
    """
    path = as_path(path)
    known = as_mapping(laws, "laws", "functions")
    try:
        # C order: kernels are compiled for one layout of arrays
        arrays = {key: np.array(value, order="C") for key, value in read_archive(path).items()}
        meta = json.loads(str(arrays.pop(_META)))
    except OSError:
        raise
    except Exception as error:
        raise DataError(f"{os.fspath(path)!r} is not a saved {what}, or it is damaged") from error
    schema = meta.get("schema") if isinstance(meta, dict) else None
    if schema != SCHEMA:
        raise DataError(
            f"{os.fspath(path)!r} has schema version {schema!r}, this version reads {SCHEMA}: an estimator "
            "of another version is not continued. Load it with the version of rcorefine that wrote it, or "
            "begin anew from its refined model"
        )
    with damaged(path):
        content = _decode(meta["content"], arrays, known)
        if not isinstance(content, dict) or content.get("what") != what:
            raise DataError(f"{os.fspath(path)!r} holds no {what}; it was saved by something else")
        return content


def parts_of(value: Any) -> dict[str, Any]:
    """Fields of a dataclass or named tuple by name."""
    names = value._fields if hasattr(value, "_fields") else [field.name for field in fields(value)]
    return {name: getattr(value, name) for name in names}


#: What is no array and no class of `_KINDS`: how it is written, its parts by `encode`.
_FORMS: dict[type, Callable[[Any, Callable[[Any], Any]], Any]] = {
    np.generic: lambda value, encode: value.item(),
    # models and effects of the user by what makes them again
    ct.StateSpace: lambda value, encode: {"statespace": encode(LinearModel.from_statespace(value))},
    Effect: lambda value, encode: {"effect": encode(_arguments(value)), "port": value._domain},
    tuple: lambda value, encode: {"tuple": [*map(encode, value)]},
    list: lambda value, encode: {"list": [*map(encode, value)]},
    # pairs, as keys may be other than text
    Mapping: lambda value, encode: {"map": [[encode(k), encode(v)] for k, v in value.items()]},
}


def _encode(value: Any, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    # leaves: numbers and text as they are, arrays by their key
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        key = f"a{len(arrays)}"
        arrays[key] = value
        return {"array": key}
    # dataclasses and named tuples by name and fields; what is compiled is made anew
    kind, encode = type(value).__name__, partial(_encode, arrays=arrays)
    if _KINDS.get(kind) is type(value):
        parts = {n: encode(part) for n, part in parts_of(value).items() if n not in _NOT_STORED}
        return {"kind": kind, "fields": parts}
    for one, form in _FORMS.items():
        if isinstance(value, one):
            return form(value, encode)
    if hasattr(value, "physical_model"):
        return encode(value.physical_model)
    raise ModelError(f"a {kind} cannot be saved; hand over a StateSpace or a PhysicalModel")


def _arguments(effect: Effect) -> dict[str, Any]:
    # a function is saved as its import path, never as code
    given = {name: getattr(effect, name) for name in ARGUMENTS}
    return given | {"law": effect.law if isinstance(effect.law, Table) else import_path(effect)}


def _decode(tree: Any, arrays: dict[str, Any], laws: Mapping[str, Callable[..., Any]]) -> Any:
    decode = partial(_decode, arrays=arrays, laws=laws)
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "statespace" in tree:
        return decode(tree["statespace"]).to_statespace()
    if "effect" in tree:
        return _effect_of(decode(tree["effect"]), laws).at_port(tree["port"])
    # dataclasses: each field must fit its declared type before the class is called
    if "kind" in tree:
        kind = _KINDS[tree["kind"]]
        parts = {name: decode(part) for name, part in tree["fields"].items()}
        for name, hint in get_type_hints(kind).items():
            if name in parts and not fits(parts[name], hint):
                raise DataError(f"{tree['kind']}.{name} is {parts[name]!r:.60}: the file is damaged")
        return kind(**parts)
    if "map" in tree:
        return {decode(k): decode(v) for k, v in tree["map"]}
    return tuple(map(decode, tree["tuple"])) if "tuple" in tree else [*map(decode, tree["list"])]


def _effect_of(arguments: dict[str, Any], laws: Mapping[str, Callable[..., Any]]) -> Effect:
    """Effect of saved arguments.

    A function is found from its import path, or in `laws` by its label.
    """
    path = arguments.pop("law", "")
    if isinstance(path, Table):
        arguments["law"] = path
    elif path or arguments["kind"] == Custom.name:
        label = arguments["name"] or f"{arguments['kind']} at {arguments['place']}"
        if label not in laws and not path:
            raise ModelError(
                f"the law of {label!r} is a function that no name leads to, and no file holds it; "
                f"pass laws={{{label!r}: function}}"
            )
        arguments["law"] = laws[label] if label in laws else law_here(path, label)
    return Effect(**arguments)


_WORDS = {int: "a whole number", bool: "true or false", str: "a text", type(None): "nothing"}
_MOST = 2**53  # of any count: beyond it floats skip whole numbers
_NOTHING: Mapping[str, str] = MappingProxyType({})


def check_like(found: Any, fresh: Any, where: str, grown: Mapping[str, str] = _NOTHING) -> None:
    """Hold what a file held against what a fresh object holds in its place.

    Types, names, dtypes and shapes must be the same, whole numbers not negative, and floats finite
    where the fresh ones are.

    Parameters
    ----------
    found : object
        From the file.
    fresh : object
        Its counterpart: a tree of dataclasses, named tuples, mappings, tuples, arrays, numbers and texts.
    where : str
        Name of the part, for the message.
    grown : mapping, optional
        Arrays, by the name of their field, that may have more rows than fresh ones, and a word: those
        with the same word have as many rows as each other.

    Raises
    ------
    DataError
        Where they differ.

    Examples
    --------
    >>> check_like({"x": np.ones(3)}, {"x": np.zeros(3)}, "state")
    >>> check_like({"x": np.ones(4)}, {"x": np.zeros(3)}, "state")
    Traceback (most recent call last):
    rcorefine.exceptions.DataError: state.x has shape (4,) and must have (3,): the file is damaged
    """
    # arrays: dtype and shape of a fresh object, more rows only where samples are kept
    if isinstance(fresh, np.ndarray):
        _check_array(found, fresh, where, where.rpartition(".")[2] in grown)
    # mappings and dataclasses: the same names, then part by part
    elif isinstance(fresh, Mapping):
        same = isinstance(found, Mapping) and set(found) == set(fresh)
        _require(same, where, found, f"of {', '.join(map(str, fresh))}")
        _check_parts(found, fresh, where, grown)
    elif is_dataclass(fresh) or hasattr(fresh, "_fields"):
        _require(type(found) is type(fresh), where, found, f"a {type(fresh).__name__}")
        _check_parts(parts_of(found), parts_of(fresh), where, grown)
    elif isinstance(fresh, tuple):
        _require(isinstance(found, tuple) and len(found) == len(fresh), where, found, f"{len(fresh)} parts")
        for index, (part, other) in enumerate(zip(found, fresh, strict=True)):
            check_like(part, other, f"{where}[{index}]", grown)
    # numbers: finite where the fresh one is
    elif isinstance(fresh, float):
        _require(type(found) in (float, int), where, found, "a number")
        _require(math.isfinite(found) or not math.isfinite(fresh), where, found, "finite")
    # all else by its type; counters neither negative nor beyond what a float can count
    else:
        _require(type(found) is type(fresh), where, found, _WORDS.get(type(fresh), type(fresh).__name__))
        if type(fresh) is int:
            check_range(found, min(0, fresh), _MOST, where)


def check_schema(found: Any, kind: type, sizes: dict[str, int], where: str) -> None:
    """Hold a dataclass of a file against the shapes that its fields declare.

    A field is declared as ``Annotated[Array, "n ny", low, high]``: its axes, letters or numbers, and the
    range of its values, if any.

    Parameters
    ----------
    found : object
        From the file.
    kind : type
        Dataclass that it must be.
    sizes : dict
        Length of each axis by its letter; takes those that the file alone tells.
    where : str
        Name of the part, for the message.

    Raises
    ------
    DataError
        Where they differ.
    """
    _require(type(found) is kind, where, found, f"a {kind.__name__}")
    # fields without a declared shape are checked by their callers
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if get_origin(hint) is not Annotated:
            continue
        value, inside = getattr(found, name), f"{where}.{name}"
        # letters of the shape are bound at their first array, and equal from then on
        form, axes, *limits = get_args(hint)
        if get_origin(form) is np.ndarray:
            shape = []
            for axis, letter in enumerate(axes.split()):
                told = np.shape(value)[axis] if axis < np.ndim(value) else 0
                shape.append(int(letter) if letter.isdigit() else sizes.setdefault(letter, told))
            whole = get_args(get_args(form)[1])[0] is np.int64
            _check_array(value, np.zeros(shape, dtype=np.int64 if whole else float), inside, False)
        if limits:
            check_range(value, limits[0], limits[1], inside)


def check_course(found: Any, rows: Any, n_outputs: int) -> None:
    """Check the history of a file.

    It is compared with an empty record, and the shape of its outputs is checked.

    Parameters
    ----------
    found : list of (record, ndarray)
        From the file.
    rows : object
        A record of no sample.
    n_outputs : int
        Outputs.

    Raises
    ------
    DataError
        Where they differ.
    """
    # an empty record of one row, NaN: any number of rows and values not finite are allowed
    unknown = {name: np.full(part.shape[1:], np.nan)[None] for name, part in parts_of(rows).items()}
    unknown["outputs"] = np.full((1, n_outputs), np.nan)
    _require(isinstance(found, list), "history", found, "a list")
    for index, (record, outputs) in enumerate(found):
        where = f"history[{index}]"
        _require(type(record) is type(rows), where, record, f"a {type(rows).__name__}")
        block = {**parts_of(record), "outputs": outputs}
        check_like(block, unknown, where, dict.fromkeys(unknown, "samples"))


def fits(value: Any, hint: Any) -> bool:
    """Return whether a value from a file has the declared type.

    Only the types that are named under `hint` are checked.

    Parameters
    ----------
    value : object
        From the file.
    hint : type
        Declared type; of others than texts, numbers, arrays and tuples or unions of them anything passes.

    Returns
    -------
    bool

    Examples
    --------
    >>> fits(("N", "m"), tuple[str, ...]), fits(("N", 3), tuple[str, ...]), fits(None, str | None)
    (True, False, True)
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(fits(value, one) for one in arguments)
    if origin is np.ndarray:
        return isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
    # tuples: (float, float) by position, (float, ...) for any length
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        each = arguments[:1] * len(value) if arguments[-1:] == (...,) else arguments
        return len(each) == len(value) and all(map(fits, value, each))
    if origin is Annotated:
        return fits(value, arguments[0])
    # a whole number may stand for a float, but a bool for neither
    if hint is float:
        return type(value) in (float, int)
    if hint is int:
        return type(value) is int and abs(value) <= _MOST
    return type(value) is hint if hint in (str, int, bool, type(None)) else True


def check_range(values: Any, low: Any, high: Any, where: str) -> None:
    """Refuse values of a file outside of the allowed range.

    A kernel or a loop must not receive other values.

    Parameters
    ----------
    values : array_like
        Numbers.
    low, high : array_like
        Least and largest.
    where : str
        Name of the part, for the message.

    Raises
    ------
    DataError
        If one lies outside, or is not a number.
    """
    given = np.asarray(values)
    inside = (given >= low) & (given <= high)
    if not inside.all():
        raise DataError(
            f"{where} holds {np.broadcast_to(given, inside.shape)[~inside].flat[0]}, which must lie between "
            f"{np.broadcast_to(low, inside.shape)[~inside].flat[0]} and "
            f"{np.broadcast_to(high, inside.shape)[~inside].flat[0]}: the file is damaged"
        )


def _check_parts(
    found: Mapping[str, Any], fresh: Mapping[str, Any], where: str, grown: Mapping[str, str]
) -> None:
    # arrays that grow together have the same number of rows
    rows: dict[str, int] = {}
    for name, value in fresh.items():
        check_like(found[name], value, f"{where}.{name}", grown)
        if name not in grown or not isinstance(value, np.ndarray):
            continue
        count = rows.setdefault(grown[name], len(found[name]))
        _require(len(found[name]) == count, f"{where}.{name}", found[name], f"of {count} rows")


def _check_array(found: Any, fresh: np.ndarray[Any, Any], where: str, grown: bool) -> None:
    _require(isinstance(found, np.ndarray), where, found, "an array")
    if found.dtype != fresh.dtype:
        raise DataError(f"{where} is of type {found.dtype} and must be {fresh.dtype}: the file is damaged")
    # the first axis may differ where it counts samples
    if found.ndim != fresh.ndim or found.shape[grown:] != fresh.shape[grown:]:
        wanted = f"(any, {', '.join(map(str, fresh.shape[1:]))})" if grown else str(fresh.shape)
        raise DataError(f"{where} has shape {found.shape} and must have {wanted}: the file is damaged")
    if found.dtype.kind == "f" and np.isfinite(fresh).all() and not np.isfinite(found).all():
        raise DataError(f"{where} holds what is not finite: the file is damaged")
    if found.dtype.kind in "iu":
        check_range(found, min(0, int(fresh.min(initial=0))), _MOST, where)


def _require(fits: bool, where: str, found: Any, wanted: str) -> None:
    if not fits:
        shown = f"of shape {found.shape}" if isinstance(found, np.ndarray) else f"{found!r:.60}"
        raise DataError(f"{where} is {shown} and must be {wanted}: the file is damaged")
