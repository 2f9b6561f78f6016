"""Results as data: plain objects for strict JSON, and tables for pandas."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
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
        value = np.asarray(value).tolist()
    for kinds, make in _PLAIN:
        if isinstance(value, kinds):
            return make(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type | Result):
        return plain(fields(value))
    return str(value)


#: How values of each class become plain; the first class that fits counts.
_PLAIN: tuple[tuple[Any, Callable[[Any], Any]], ...] = (
    (float, lambda value: value if np.isfinite(value) else None),
    ((type(None), str, int), lambda value: value),
    (Mapping, lambda value: {str(key): plain(item) for key, item in value.items()}),
    ((list, tuple, set, frozenset), lambda value: [plain(item) for item in value]),
    (Effect, lambda effect: {"kind": effect.kind, "place": effect.place}),
    (Measurement, lambda data: {"name": data.name, "samples": data.n_samples, "dt": data.dt}),
    ((LinearModel, PhysicalModel), lambda model: model.name),
    ((Refinement, FailureMap, Row), as_dict),
)

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
    lists = {name: value for name, value in found.items() if isinstance(value, list) and value}
    for name in (*_MAIN, *found):
        if name in lists and isinstance(lists[name][0], dict):
            return [_flat(row) for row in lists[name]]
    # the longest lists of numbers are columns
    series = {name: v for name, v in lists.items() if all(isinstance(x, int | float | None) for x in v)}
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
