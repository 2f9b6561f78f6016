"""Results as data: plain objects for strict JSON, and tables for pandas."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..comparison.failure_map.search import FailureMap
from ..data.measurement import Measurement
from ..effects.effect import Effect
from ..exceptions import needed
from ..inference.refinement import Refinement
from ..models.physical_model import PhysicalModel
from ..results import Data, Result, Row
from ..systems.linear import LinearModel
from .content import content, fields


def as_dict(result: Any) -> dict[str, Any]:
    """Return what was found as plain objects for strict JSON."""
    found = content(result).data
    return {name: plain(value) for name, value in (found() if found else fields(result)).items()}


def plain(value: Any) -> Any:
    """Convert a value to plain objects for strict JSON.

    The result holds lists, dicts, numbers and text. Values that are not finite become None. A complex number
    becomes a dict with "re" and "im".

    Examples
    --------
    >>> plain({"fit": np.array([1.0, np.nan]), "effect": rco.Effect("damping", "link1")})
    {'fit': [1.0, None], 'effect': {'kind': 'damping', 'place': 'link1'}}
    """
    if isinstance(value, complex | np.ndarray | np.generic):
        if np.iscomplexobj(value):
            return {"re": plain(value.real), "im": plain(value.imag)}
        return plain(np.asarray(value).tolist())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, Effect):
        return {"kind": value.kind, "place": value.place}
    if isinstance(value, Measurement):
        return {"name": value.name, "samples": value.n_samples, "dt": value.dt}
    if isinstance(value, LinearModel | PhysicalModel):
        return value.name
    if isinstance(value, Refinement | FailureMap | Row):
        return as_dict(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type | Result):
        return plain(fields(value))
    return str(value)


#: The rows of a result, where it has several tables.
_MAIN = ("rows", "ranking", "steps", "parameters", "estimates", "options")


def as_frame(result: Data) -> Any:
    """Return the main content of a result as a pandas table.

    The table holds the rows that the result is about, else its columns, else one row of its values.
    """
    pd = needed("pandas", "pandas", "to_dataframe")
    if (columns := content(result).columns) is not None:
        values, *index = columns()
        return pd.DataFrame(values, index=pd.Index(index[0], name=index[1]) if index else None)
    found = result.to_dict()
    return pd.DataFrame([_flat(found)] if isinstance(result, Row) else _main(found))


def _main(found: Mapping[str, Any]) -> Any:
    """Return the rows of a result, else its columns, else its values."""
    for name in (*(name for name in _MAIN if name in found), *found):
        rows = found[name]
        if isinstance(rows, list) and rows and isinstance(rows[0], dict):
            return [_flat(row) for row in rows]
    series = {name: v for name, v in found.items() if isinstance(v, list) and v and _are_numbers(v)}
    size = max(map(len, series.values()), default=0)
    return {name: v for name, v in series.items() if len(v) == size} if size > 1 else [_flat(found)]


def _flat(row: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Flatten a row to one level, without the lists in it.

    An effect gives kind and place; each coefficient gets a column.
    """
    found: dict[str, Any] = {}
    for key, value in row.items():
        if isinstance(value, Mapping):
            found |= _flat(value, "" if key == "effect" else f"{above}{key}.")
        elif not isinstance(value, list):
            found[f"{above}{key}"] = value
    return found


def _are_numbers(values: list[Any]) -> bool:
    return all(value is None or isinstance(value, int | float) for value in values)
