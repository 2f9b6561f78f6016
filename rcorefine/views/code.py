"""Python code that reproduces the content of a report.

Models, records and calls are written as text.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..data.frequency_response import FrequencyResponse
from ..effects.effect import Effect, import_path, module_of
from ..effects.given import Table
from ..inference.refinement import Refinement
from ..models.conversion import as_physical
from ..models.parameters import NominalParameter
from ..models.physical_model import PhysicalModel
from ..models.ports import Port
from ..systems.linear import LinearModel
from .page import fingerprint, response_facts

_INFINITE = {"nan": "np.nan", "inf": "np.inf", "-inf": "-np.inf"}
_MOST_POINTS = 4000  # of a measured response
_LARGEST = 30  # states of a model that is listed in full


def literal(value: Any, indent: int = 0) -> str:
    """A value as Python code that makes an equal one.

    Parameters
    ----------
    value : object
        Numbers, text, arrays, sequences, mappings, effects, and the parts of a model.
    indent : int
        Columns by which broken lines are set in.

    Returns
    -------
    str

    Raises
    ------
    TypeError
        For anything else.

    Examples
    --------
    >>> import numpy as np
    >>> literal(np.array([[1.0, -2.5]])), literal(("a", float("inf")))
    ('np.array([[1.0, -2.5]])', '("a", np.inf)')
    """
    for kinds, write in _WRITTEN:
        if isinstance(value, kinds):
            return write(value, indent)
    raise TypeError(f"{type(value).__name__} cannot be written as code")


def _sequence(value: list[Any] | tuple[Any, ...], indent: int) -> str:
    """On one line where it fits."""
    left, right = "[]" if isinstance(value, list) else "()"
    items = [literal(item, indent + 4) for item in value]
    comma = "," if isinstance(value, tuple) and len(items) == 1 else ""
    line = left + ", ".join(items) + comma + right
    if len(line) + indent <= 100 and "\n" not in line:
        return line
    pad = " " * (indent + 4)
    return left + "\n" + "".join(f"{pad}{item},\n" for item in items) + " " * indent + right


def comment(text: str) -> str:
    r"""Return a text as one line of comment.

    A line break in a name must not begin a line of code.

    Parameters
    ----------
    text : str
        Names of files, models and signals included.

    Returns
    -------
    str

    Examples
    --------
    >>> comment("ready\nimport os")
    '# ready\\nimport os'
    """
    return "# " + "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii") for letter in text
    )


def _effect(effect: Effect) -> str:
    path = f"rco.{effect.law!r}" if isinstance(effect.law, Table) else import_path(effect)
    if (effect.law is not None and not path) or path.startswith("__main__"):
        raise TypeError(f"the force law of {effect.label} is a function of yours")
    given = {"start": effect.start, "fixed": effect.fixed, "prior": effect.prior, "name": effect.name}
    parts = [literal(effect.kind), literal(effect.place)]
    parts += [f"{key}={literal(value)}" for key, value in given.items() if value]
    parts += [f"law={path.replace(':', '.')}"] if path else []
    return f"rco.Effect({', '.join(parts)})"


def _object(value: Any, indent: int) -> str:
    """Write an array, or a part of a model with its fields, as a call."""
    if isinstance(value, np.ndarray):
        if value.size > 1 and not value.any():
            return f"np.zeros({literal(value.shape if value.ndim > 1 else value.shape[0])})"
        return f"np.array({literal(value.tolist(), indent)})"
    fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    own = "" if isinstance(value, LinearModel) else "rco."
    return ("\n" + " " * indent).join(_call(own + type(value).__name__, [], fields, indent))


#: How values of each class are written; the first class that fits counts.
_WRITTEN: tuple[tuple[Any, Callable[[Any, int], str]], ...] = (
    (type(None), lambda value, _: "None"),
    ((bool, np.bool_), lambda value, _: repr(bool(value))),
    (str, lambda text, _: '"' + text.encode("unicode_escape").decode("ascii").replace('"', '\\"') + '"'),
    ((int, np.integer), lambda value, _: repr(int(value))),
    ((float, np.floating), lambda value, _: _INFINITE.get(repr(float(value)), repr(float(value)))),
    ((complex, np.complexfloating), lambda value, _: repr(complex(value))),
    (Effect, lambda effect, _: _effect(effect)),
    ((np.ndarray, LinearModel, PhysicalModel, Port, NominalParameter), _object),
    (Mapping, lambda value, _: f"{{{', '.join(f'{literal(k)}: {literal(v)}' for k, v in value.items())}}}"),
    ((list, tuple), _sequence),
)


def _call(name: str, values: Sequence[Any], keywords: Mapping[str, Any], indent: int = 0) -> list[str]:
    """Return the lines of a call with an argument on each line."""
    every = [("", value) for value in values] + [(f"{key}=", value) for key, value in keywords.items()]
    return [f"{name}(", *(f"    {key}{literal(value, indent + 4)}," for key, value in every), ")"]


def names_of(name: str, several: Sequence[Any]) -> list[str]:
    """Names of variables for one thing, or numbered for several."""
    return [name] if len(several) == 1 else [f"{name}{i + 1}" for i in range(len(several))]


def model_code(model: Any, name: str = "model") -> list[str]:
    """Lines that define a model.

    Parameters
    ----------
    model : LinearModel or PhysicalModel
        What to write down.
    name : str
        Name of the variable.

    Returns
    -------
    list of str
        Starting with a comment instead where the model is too large to be listed.
    """
    linear = model.linear if isinstance(model, PhysicalModel) else model
    if linear.n_states > _LARGEST:
        return [
            f"# {name}: {linear.n_states} states, too large to be listed here. It is the one with",
            *(f"#   sha256 of {key}: {fingerprint(getattr(linear, key))}" for key in "ABCD"),
            f"{name} = ...",
        ]
    if isinstance(model, PhysicalModel) and not _plain(model):
        return ["from rcorefine.systems.linear import LinearModel", "", f"{name} = {literal(model)}"]
    labels = {
        "inputs": list(linear.input_labels),
        "outputs": list(linear.output_labels),
        "states": list(linear.state_labels),
    }
    matrices = [getattr(linear, key) for key in "ABCD"]
    return _call(f"{name} = ct.ss", [*matrices, linear.dt], labels | {"name": linear.name})


def _plain(model: PhysicalModel) -> bool:
    """Return whether the matrices alone define the same places."""
    again = as_physical(model.system)
    return (
        model.hold is None
        and [p.name for p in again.ports] == [p.name for p in model.ports]
        and again.parameters == model.parameters
    )


def effects_code(effects: Sequence[Effect]) -> str:
    """Return a list of effects as code.

    An effect whose force law only the user has becomes a comment.
    """
    lines = []
    for effect in effects:
        try:
            lines.append(f"    {literal(effect)},\n")
        except TypeError as error:
            lines.append(f"    ...,  {comment(str(error))}\n")
    return "[\n" + "".join(lines) + "]" if lines else "[]"


def record_code(records: Sequence[Any]) -> list[str]:
    """Return code that reads the records from files and verifies them.

    Parameters
    ----------
    records : sequence of Measurement, or of FrequencyResponse
        What the result rests on; responses are listed.

    Returns
    -------
    list of str
    """
    names = names_of("data", records)
    listed = [] if len(records) == 1 else [f"data = [{', '.join(names)}]"]
    if not records[0].in_time:
        every = [line for one, name in zip(records, names, strict=True) for line in response_code(one, name)]
        return [*every, *listed]
    lines = ["# the record: put the name of your file here"]
    for data, name, file in zip(records, names, names_of("record", records), strict=True):
        known = {
            "inputs": list(data.input_labels), "outputs": list(data.output_labels), "dt": data.dt,
            "hold": data.hold, "input_units": list(data.input_units) if any(data.input_units) else None,
            "output_units": list(data.output_units) if any(data.output_units) else None, "name": data.name,
        }  # fmt: skip
        known = {key: value for key, value in known.items() if value is not None}
        lines += _call(f"{name} = rco.Measurement.from_npz", [f"{file}.npz"], known)
        lines += [
            f"assert sha256({name}.{what}.tobytes()).hexdigest() == {literal(fingerprint(values))}"
            for what, values in (("inputs", data.inputs), ("outputs", data.outputs))
        ]
    return [*lines, *listed]


def response_code(measured: FrequencyResponse, name: str = "measured") -> list[str]:
    """Return code that defines a measured response.

    It lists all points of a response that has at most a few thousand.
    """
    if measured.response.size > _MOST_POINTS:
        facts = [comment(f"{what}: {value}") for what, value in response_facts(measured)]
        return ["# the measured response is too long to be listed here", *facts, f"{name} = ..."]
    known = {
        "std": measured.std, "coherence": measured.coherence, "amplitude": measured.amplitude,
        "input_labels": list(measured.input_labels), "output_labels": list(measured.output_labels),
        "dt": measured.dt, "hold": measured.hold, "name": measured.name,
    }  # fmt: skip
    known = {key: value for key, value in known.items() if value is not None}
    return _call(f"{name} = rco.FrequencyResponse", [measured.response, measured.omega], known)


def script(*blocks: Sequence[str]) -> str:
    """Blocks of lines under the imports that they need."""
    body = "\n\n".join("\n".join(block) for block in blocks if block)
    model = "from rcorefine.systems.linear import LinearModel"
    own = ["import rcorefine as rco", *([model] if model in body else [])]
    body = body.replace(f"{model}\n\n", "")
    own += sorted({f"import {module_of(path)}" for path in re.findall(r"\blaw=(?!rco\.)([\w.]+)", body)})
    known = {"import control as ct": "ct.", "import numpy as np": "np."}
    standard = ["from hashlib import sha256"] if "sha256(" in body else []
    outside = [line for line, sign in known.items() if sign in body]
    heads = ["\n".join(lines) for lines in (standard, outside, own) if lines]
    return "\n\n".join([*heads, body]) + "\n"


def refinement_code(refinement: Refinement, horizon: float | None = None) -> list[str]:
    """Lines that fit a refinement again, from its own estimates.

    Parameters
    ----------
    refinement : Refinement
        What was found.
    horizon : float, optional
        Length of the free runs.

    Returns
    -------
    list of str
    """
    structure, theta, _ = refinement.simulation_structure()
    asked, floating = [], []
    for index, (effect, role) in enumerate(zip(refinement.effects, refinement.roles, strict=True)):
        free = [name for name in effect.coefficients if structure.position(index, name) >= 0]
        found = {name: float(structure.value(theta, index, name)) for name in free}
        if role == "effect":
            asked.append(effect.replace(start=found))
        elif role == "linear":
            floating.append(effect)
    options = {"offset": "offset" in refinement.roles, "free": floating, "horizon": horizon}
    said = "# the linear parameters below were re-estimated; give tolerance= too if you gave it"
    return [
        *([said] if floating else []),
        f"effects = {effects_code(asked)}",
        f"better = rco.refine(model, data, effects{call_options(options)})",
    ]


#: Defaults of the options of a call, as code.
_DEFAULTS = {
    "free": ("()", "[]"), "tolerance": ("0.0", "0"), "offset": ("True",), "noise": ("None",),
    "horizon": ("None",), "significance": ("0.01",),
}  # fmt: skip


def call_options(options: Mapping[str, Any]) -> str:
    """Keywords of a call as text, those at their defaults left out."""
    text = ""
    for key, value in options.items():
        try:
            code = literal(value)
        except TypeError as error:
            text += f", {key}=...  {comment(str(error))}\n"
            continue
        text += "" if code in _DEFAULTS.get(key, ()) else f", {key}={code}"
    return text
