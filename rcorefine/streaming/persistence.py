"""File format of a refiner: plain arrays and JSON.

A file is written completely or not at all, and nothing is executed on reading.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

import control as ct
import numpy as np

from ..archives import read_archive
from ..arguments import as_mapping, as_path
from ..data.apart import damaged
from ..effects.custom import Custom
from ..effects.effect import ARGUMENTS, Effect
from ..effects.origin import import_path, law_here
from ..effects.tabulated import Table
from ..exceptions import DataError, ModelError
from ..models.parameters import NominalParameter
from ..models.physical_model import PhysicalModel
from ..models.ports import Port
from ..systems.linear import LinearModel
from ..writing import replacing
from .coefficients.memory import CoefficientMemory
from .coefficients.packed import CoefficientRecord
from .filter_bank import FilterBankMemory, Frozen
from .rcmr.arrays import Design, Plant, Record, Stage
from .rcmr.memory import Memory, Tuned
from .rcmr.scaling import Scales
from .restoring import fits

__all__ = ["SCHEMA", "read_file", "storable", "write_file"]

SCHEMA = 1  # of the file; raised when an older reader could misread it
_META = "meta"
_KINDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        LinearModel, PhysicalModel, NominalParameter, Port, CoefficientMemory, CoefficientRecord,
        Design, Plant, Record, Stage, Memory, Tuned, Scales, Frozen, FilterBankMemory, Table,
    )
}  # fmt: skip
_KINDS["RaceMemory"] = FilterBankMemory  # its name in files of version 0.1
_NOT_STORED = {"kernel"}  # made anew from the other fields


def storable(*kinds: type) -> None:
    """Enter dataclasses, or named tuples, that files may hold."""
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
    meta = json.dumps({"schema": SCHEMA, "content": _encoded(content, arrays)})
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
        arrays = {key: np.array(value, order="C") for key, value in read_archive(path).items()}
        meta = json.loads(str(arrays.pop(_META)))
    except OSError:
        raise
    except Exception as error:
        raise DataError(f"{os.fspath(path)!r} is not a saved {what}, or it is damaged") from error
    schema = meta.get("schema") if isinstance(meta, dict) else None
    if schema != SCHEMA:
        raise DataError(
            f"{os.fspath(path)!r} has schema version {schema!r}, this version reads {SCHEMA}; "
            "load it with the version of rcorefine that wrote it"
        )
    with damaged(path):
        content = _decoded(meta["content"], arrays, known)
        if not isinstance(content, dict) or content.get("what") != what:
            raise DataError(f"{os.fspath(path)!r} holds no {what}; it was saved by something else")
        return content


def _encoded(value: Any, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        key = f"a{len(arrays)}"
        arrays[key] = value
        return {"array": key}
    if isinstance(value, ct.StateSpace):
        return {"statespace": _encoded(LinearModel.from_statespace(value), arrays)}
    if isinstance(value, Effect):
        return {"effect": _encoded(_arguments(value), arrays), "port": value._domain}
    kind = type(value).__name__
    if _KINDS.get(kind) is type(value):
        names = value._fields if hasattr(value, "_fields") else [f.name for f in fields(value)]
        parts = {n: _encoded(getattr(value, n), arrays) for n in names if n not in _NOT_STORED}
        return {"kind": kind, "fields": parts}
    if isinstance(value, list | tuple):
        return {"tuple" if isinstance(value, tuple) else "list": [_encoded(item, arrays) for item in value]}
    if isinstance(value, Mapping):
        return {"map": [[_encoded(k, arrays), _encoded(v, arrays)] for k, v in value.items()]}
    if hasattr(value, "physical_model"):
        return _encoded(value.physical_model, arrays)
    raise ModelError(f"a {type(value).__name__} cannot be saved; hand over a StateSpace or a PhysicalModel")


def _arguments(effect: Effect) -> dict[str, Any]:
    given = {name: getattr(effect, name) for name in ARGUMENTS}
    return given | {"law": effect.law if isinstance(effect.law, Table) else import_path(effect)}


def _decoded(tree: Any, arrays: dict[str, Any], laws: Mapping[str, Callable[..., Any]]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "statespace" in tree:
        return _decoded(tree["statespace"], arrays, laws).to_statespace()
    if "effect" in tree:
        arguments = _decoded(tree["effect"], arrays, laws)
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
        return Effect(**arguments).at_port(tree["port"])
    if "kind" in tree:
        kind = _KINDS[tree["kind"]]
        parts = {name: _decoded(part, arrays, laws) for name, part in tree["fields"].items()}
        for name, hint in get_type_hints(kind).items():
            if name in parts and not fits(parts[name], hint):
                raise DataError(f"{tree['kind']}.{name} is {parts[name]!r:.60}: the file is damaged")
        assert is_dataclass(kind) or hasattr(kind, "_fields")
        return kind(**parts)
    if "tuple" in tree:
        return tuple(_decoded(item, arrays, laws) for item in tree["tuple"])
    if "list" in tree:
        return [_decoded(item, arrays, laws) for item in tree["list"]]
    return {_decoded(k, arrays, laws): _decoded(v, arrays, laws) for k, v in tree["map"]}
