"""Results as data: plain dicts for strict JSON, tables for pandas.

By the fields of a result, but for those whose fields hold more than what was found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ..comparison.failure_map.search import Failure, FailureMap
from ..comparison.result import Comparison, failures_of
from ..data.frequency_response import FrequencyResponse
from ..data.measurement import Measurement
from ..diagnosis.open_law import HiddenForce
from ..diagnosis.result import Diagnosis, Improvement, RankedEffect, Step, next_step
from ..effects.effect import Effect
from ..engine.amplitude_response import AmplitudeResponse
from ..exceptions import needed
from ..fleet.result import Survey
from ..inference.f_tests import FTest
from ..inference.parameters import EstimatedParameter
from ..inference.refinement import Refinement
from ..models.physical_model import PhysicalModel
from ..results import Data, Result, Row, shows
from ..streaming import RCORefiner
from ..streaming.monitor import Monitor
from ..systems.linear import LinearModel

#: The rows of a result, where it has several tables.
_MAIN = ("rows", "ranking", "steps", "parameters", "estimates", "options")


def plain(value: Any) -> Any:
    """Convert a value to plain objects for strict JSON.

    The result holds lists, dicts, numbers and text. Values that are not finite become None. A complex number
    becomes a dict with "re" and "im".

    Examples
    --------
    >>> plain({"fit": np.array([1.0, np.nan]), "effect": rco.Effect("damping", "link1")})
    {'fit': [1.0, None], 'effect': {'kind': 'damping', 'place': 'link1'}}
    """
    if isinstance(value, np.ndarray | np.generic):  # numbers of numpy, too
        if np.iscomplexobj(value):
            return {"re": plain(value.real), "im": plain(value.imag)}
        return plain(value.tolist())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, complex):
        return {"re": plain(value.real), "im": plain(value.imag)}
    if value is None or isinstance(value, str | bool | int):
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
        return value.to_dict()
    if dataclasses.is_dataclass(value) and not isinstance(value, type | Result):
        return plain(_fields(value))
    return str(value)


def _fields(value: Any, *names: str) -> dict[str, Any]:
    """Fields by name; all public ones without names."""
    asked = names or tuple(f.name for f in dataclasses.fields(value) if not f.name.startswith("_"))
    return {name: getattr(value, name) for name in asked}


def _dict(kind: type) -> Callable[[Callable[[Any], dict[str, Any]]], Callable[[Any], dict[str, Any]]]:
    """Enter what a class of results is as a dict."""

    def enter(content: Callable[[Any], dict[str, Any]]) -> Callable[[Any], dict[str, Any]]:
        shows(kind, "to_dict")(lambda result: plain(content(result)))
        return content

    return enter


@_dict(Data)
def _any(result: Data) -> dict[str, Any]:
    return _fields(result)


@_dict(FrequencyResponse)
def _response(measured: FrequencyResponse) -> dict[str, Any]:
    return {
        "name": measured.name,
        "inputs": measured.input_labels,
        "outputs": measured.output_labels,
        "response": measured.frdata,
        **_fields(measured, "omega", "coherence", "std", "amplitude", "n_averages", "dt", "hold"),
    }


def _shown(kind: type, names: str) -> None:
    """Register the fields that rows of this class show.

    The other fields hold more than the findings.
    """
    shows(kind, "to_dict")(lambda row: plain(_fields(row, *names.split())))


_shown(Failure, "role dimension where measure statistic p_value share sentence")
_shown(FTest, "name statistic dof p_value")
_shown(RankedEffect, "effect beside same coefficients std fit_before fit_after p_value probability")
_shown(EstimatedParameter, "name kind place role initial prior value coefficient std lower upper unit")
_shown(Step, "action effect coefficients std train_rmse choice_rmse validation_rmse rivals")


@_dict(Comparison)
def _comparison(result: Comparison) -> dict[str, Any]:
    models = []
    for index, name in enumerate(result.names):
        bias = (result.data.outputs - result.runs[index]).mean(axis=1)
        one = result.select(index)
        keys = ("name", "unit", "fit", "rmse", "bias")
        rows = zip(result.data.output_labels, result.data.output_units, one.fit, one.rmse, bias, strict=True)
        outputs = [dict(zip(keys, row, strict=True)) for row in rows]
        models.append({"name": name, "outputs": outputs, "failures": tuple(failures_of(result, index))})
    return {"models": models}


@_dict(FailureMap)
def _map(found: FailureMap) -> dict[str, Any]:
    return {"name": found.name, "rows": tuple(found), "notes": found.notes}


@_dict(Diagnosis)
def _diagnosis(found: Diagnosis) -> dict[str, Any]:
    told = ("verdict", "ranking", "none_of_these", "places", "ambiguous", "parameters", "tests")
    more = ("winner_tests", "detectable", "significance", "notes", "checks")
    return {**_fields(found, *told, *more), "next_step": next_step(found)}


@_dict(Improvement)
def _improvement(improvement: Improvement) -> dict[str, Any]:
    told = _fields(improvement, "verdict", "message", "steps", "checks")
    return {**told, "next_step": next_step(improvement), **_model(improvement.refinement)}


@_dict(Refinement)
def _refinement(found: Refinement) -> dict[str, Any]:
    names = ("fit", "rmse", "initial_fit", "success", "message", "warnings")
    return {**_model(found), **_fields(found, *names)}


def _model(found: Refinement) -> dict[str, Any]:
    return {
        "parameters": found.parameters,
        "hold": found.hold,
        "system": _system(LinearModel.from_statespace(found.system)),
    }


def _system(model: LinearModel) -> dict[str, Any]:
    labels = {"inputs": model.input_labels, "outputs": model.output_labels, "states": model.state_labels}
    return {**{key: getattr(model, key) for key in "ABCD"}, **labels}


@_dict(PhysicalModel)
def _physical(model: PhysicalModel) -> dict[str, Any]:
    names = ("input_units", "output_units", "state_units", "parameters", "ports")
    return {"name": model.name, "system": _system(model.linear), **_fields(model, *names)}


@_dict(RCORefiner)
def _refiner(refiner: RCORefiner) -> dict[str, Any]:
    system = _system(LinearModel.from_statespace(refiner.system))
    return {"n_samples": refiner.n_samples, "n_learned": refiner.n_learned, "system": system}


@_dict(Monitor)
def _monitor(monitor: Monitor) -> dict[str, Any]:
    return {"n_samples": monitor.n_samples, "alarm": monitor.alarm, "rows": monitor.ranking}


@_dict(Survey)
def _survey(found: Survey) -> dict[str, Any]:
    names = ("task", "mode", "significance")
    return {
        **_fields(found, *names),
        "summary": found.sentences(),
        **_fields(found, "rows", "effects", "trends"),
    }


def _frame(columns: Any, index: Any = None, name: str | None = None) -> Any:
    pd = needed("pandas", "pandas", "to_dataframe")
    return pd.DataFrame(columns, index=None if index is None else pd.Index(index, name=name))


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


@shows(Data, "to_dataframe")
def _table(result: Data) -> Any:
    """Return the main content of a result as a pandas table.

    The table holds the rows that the result is about, else its columns, else one row of its values.
    """
    content = result.to_dict()
    order = (*(name for name in _MAIN if name in content), *content)
    rows = next((content[name] for name in order if _are_rows(content[name])), None)
    if rows is None:
        columns = {name: v for name, v in content.items() if isinstance(v, list) and v and _are_numbers(v)}
        size = max((len(v) for v in columns.values()), default=0)
        if size > 1:
            return _frame({name: v for name, v in columns.items() if len(v) == size})
        rows = [content]
    return _frame([_flat(row) for row in rows])


@shows(Row, "to_dataframe")
def _line(row: Row) -> Any:
    return _frame([_flat(row.to_dict())])


def _are_rows(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _are_numbers(values: list[Any]) -> bool:
    return all(value is None or isinstance(value, int | float) for value in values)


@shows(Comparison, "to_dataframe")
def _fits(result: Comparison) -> Any:
    models = result.to_dict()["models"]
    return _frame(
        [
            {"model": model["name"], "output": row["name"], **{k: v for k, v in row.items() if k != "name"}}
            for model in models
            for row in model["outputs"]
        ]
    )


@shows(Measurement, "to_dataframe")
def _signals(data: Measurement) -> Any:
    labels = [*data.input_labels, *data.output_labels]
    columns = dict(zip(labels, np.vstack([data.inputs, data.outputs]), strict=True))
    return _frame(columns, data.timepts, "time")


@shows(HiddenForce, "to_dataframe")
def _force(found: HiddenForce) -> Any:
    return _frame(_fields(found, "d", "v", "force", "std"), found.timepts, "time")


@shows(FrequencyResponse, "to_dataframe")
def _points(measured: FrequencyResponse) -> Any:
    columns = {
        f"{output}/{given}": measured.frdata[i, j]
        for i, output in enumerate(measured.output_labels)
        for j, given in enumerate(measured.input_labels)
    }
    return _frame(columns, measured.omega, "omega")


@shows(AmplitudeResponse, "to_dataframe")
def _levels(curve: AmplitudeResponse) -> Any:
    response = np.asarray(curve.response)
    grid = [
        {"omega": omega, "amplitude": level, "output": label, "response": response[k, i, j]}
        for k, level in enumerate(np.ravel(curve.amplitude))
        for i, label in enumerate(curve.output_labels)
        for j, omega in enumerate(curve.omega)
    ]
    return _frame(grid)
