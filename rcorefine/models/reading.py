"""Models from files: TOML, .npz and .mat.

A TOML file holds matrices or the parameters of a builder. The others hold A, B, C and D.
"""

from __future__ import annotations

import inspect
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import control as ct
import numpy as np
from scipy.sparse import coo_matrix, issparse

from ..arguments import as_path
from ..data.formats import read_apart, read_matlab
from ..exceptions import ModelError
from ..systems.linear import Array
from ..writing import array_of, read_archive
from . import builders
from .conversion import physical
from .physical_model import PhysicalModel

SUFFIXES = (".csv", ".mtx", ".npy")
#: Table of a TOML file that holds matrices; the others are named like the builders.
MATRICES = "state_space"
_LABELS = ("inputs", "outputs", "states")
_KNOWN = ("links", "units", "parameters", "operating_point")  # arguments of `physical`
_IN_FILES = {MATRICES: ("A", "B", "C", "D"), builders.mechanical.__name__: ("M", "C", "K", "force_map")}
_MAPS = ("force", "force_map")  # a list of lists is a matrix there
_MOST_STATES = 1000  # most states of a model in a file
_RULE = "must be numbers in rows of equal length"


def read_matrix(path: Path, where: str) -> Any:
    """Matrix of a file.

    Parameters
    ----------
    path : Path
        ``.csv`` (rows of numbers between commas, semicolons or blanks, ``#`` before remarks), ``.mtx``
        (Matrix Market, of which a symmetric one holds a half) or ``.npy``.
    where : str
        Who asks, for messages.

    Returns
    -------
    ndarray or sparse array
        As the file has it, numbers unchecked; sparse where a ``.mtx`` is.

    Raises
    ------
    ModelError
        If it is not there, or holds no matrix.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ModelError(
            f"{where}: a matrix is rows of numbers or a {', '.join(SUFFIXES)} file, not {path.name!r}"
        )
    try:
        if suffix == ".csv":
            return _from_text(path)
        if suffix == ".npy":
            return array_of(path.read_bytes(), path.name)
        # in a process of its own, since a damaged file can crash the reader
        found = read_apart(path, "mtx", "Matrix Market file that scipy")
        if "shape" not in found:
            return found["data"]
        return coo_matrix((found["data"], (found["row"], found["col"])), shape=tuple(found["shape"]))
    except OSError as error:
        raise ModelError(f"{where}: {path} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # the parser of a header may raise anything
        raise ModelError(f"{where}: {path} holds no matrix: {error}") from error


def _from_text(path: Path) -> Array:
    # remarks are cut off; semicolons mean decimal commas
    text = re.sub(r"#.*", "", path.read_text(encoding="utf-8-sig"))
    if not text.strip():
        raise ValueError("it is empty")
    if ";" in text:  # commas are decimal
        text = text.replace(",", ".")
    mark = next((mark for mark in ",;" if mark in text), None)
    return np.loadtxt([line for line in text.splitlines() if line.strip()], delimiter=mark, ndmin=2)


def builder_names() -> tuple[str, ...]:
    """Tables that a TOML file can hold besides `MATRICES`.

    Returns
    -------
    tuple of str
        Names of the builders.
    """
    return tuple(builders.__all__)


def read_model(path: str | PathLike[str]) -> ct.StateSpace | PhysicalModel:
    r"""Read a model from a file.

    Parameters
    ----------
    path : str or path
        ``.toml``: one table, ``[state_space]`` with A, B, C, D (and dt, inputs, outputs, states, name,
        and links, units, parameters, operating_point as in `physical`), or a table named like a builder
        (``[mass_spring_damper]``, ``[series_rlc]``, ...) with its parameters. Matrices of these (A, B,
        C, D; M, C, K and force_map of ``[mechanical]``) may stand in files of their own,
        ``A = "A.csv"``: .csv, .mtx (Matrix Market) or .npy, beside the TOML file. ``.npz`` or ``.mat``:
        arrays A, B, C, and D, dt, inputs, outputs, states, name where they are not 0 and not the
        default names.

    Returns
    -------
    StateSpace or PhysicalModel
        Matrices give a `StateSpace`; with links, units, parameters or an operating point, and from
        builders, a `PhysicalModel`.

    Raises
    ------
    ModelError
        If the file is not one of these, or its model has more than 1000 states; file, table and
        key are named.
    DataError
        If an ``.npz`` or ``.mat`` file is damaged.
    OSError
        If it cannot be read.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "circuit.toml"
    >>> _ = path.write_text("[series_rlc]\nR = 250.0\nL = 0.055\nC = 23.5e-6\n")
    >>> read_model(path).linear.input_labels
    ('voltage',)
    """
    file = as_path(path)
    suffix = file.suffix.lower()
    # TOML: matrices, or a builder with its parameters
    if suffix == ".toml":
        return _from_toml(file)
    if suffix not in (".npz", ".mat"):
        raise ModelError(
            f"{file}: a model is a .toml, .npz or .mat file, not {suffix or 'without a suffix'!r}"
        )
    # NumPy or MATLAB file: variables A, B, C, D and labels
    variables: dict[str, Any] = read_archive(file) if suffix == ".npz" else read_matlab(file)
    values: dict[str, Any] = {key: variables[key] for key in ("A", "B", "C", "D") if key in variables}
    for key in (*_LABELS, "name"):
        if key in variables:
            values[key] = _texts(variables[key], f"{file}, {key}")
    if "name" in values:
        values["name"] = " ".join(values["name"])
    if "dt" in variables:
        size = np.asarray(variables["dt"])
        if size.size != 1 or size.dtype.kind not in "fiub":
            raise ModelError(
                f"{file}: dt must be one number (0 for continuous time), not {variables['dt']!r}"
            )
        values["dt"] = float(size.ravel()[0])
    return _state_space(values, str(file), f"the file holds {', '.join(variables) or 'nothing'}", file)


@contextmanager
def _within(where: str) -> Iterator[None]:
    """Name the place in the file in errors."""
    try:
        yield
    except (ModelError, ct.ControlDimension, ct.ControlArgument) as error:
        raise ModelError(f"{where}: {error}") from error
    except (TypeError, ValueError, ArithmeticError, LookupError, AttributeError) as error:
        # text in place of a number, for example
        raise ModelError(f"{where}: a value is of the wrong kind: {error}") from error


def _from_toml(file: Path) -> ct.StateSpace | PhysicalModel:
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:  # invalid TOML, UTF-8 or number
        raise ModelError(f"{file} is not TOML: {error}") from error
    except RecursionError as error:
        raise ModelError(f"{file} is not TOML of a model: its brackets are nested too deeply") from error
    known = ", ".join(f"[{name}]" for name in (MATRICES, *builder_names()))
    if len(content) != 1:
        found = ", ".join(content) or "nothing"
        raise ModelError(f"{file} must hold one table, one of {known}; it holds {found}")
    # one table, named like the builder
    [(kind, table)] = content.items()
    if kind not in (MATRICES, *builder_names()):
        raise ModelError(f"{file}: no model is called {kind!r}; there are {known}")
    if not isinstance(table, dict):
        raise ModelError(f"{file}: {kind} must be a table, [{kind}] on a line of its own")
    where = f"{file}, [{kind}]"
    # matrices in files of their own, beside the TOML file
    for key in _IN_FILES.get(kind, ()):
        if isinstance(table.get(key), str):
            table[key] = _from_file(file.parent / table[key], f"{where}, {key}", whole="n_modes" not in table)
    if kind != MATRICES:
        return _call_builder(getattr(builders, kind), table, where)
    holds = f"the table holds {', '.join(table) or 'nothing'}"
    # declarations make it a physical model
    declared = {key: table.pop(key) for key in _KNOWN if key in table}
    plain = _state_space(table, where, holds, file)
    with _within(where):
        return physical(plain, **declared) if declared else plain


def _from_file(path: Path, where: str, *, whole: bool) -> Any:
    """Return the matrix of a file, after checks of its size and entries.

    A .npy file of one dimension stays one row or column.
    """
    found = read_matrix(path, where)
    if issparse(found):
        if not whole:  # stays sparse for modal reduction
            return found
        _check_size(max(found.shape, default=0), where)
        found = found.toarray()
    matrix = _matrix(found, f"{where}: {path}")
    return matrix[0] if np.ndim(found) == 1 else matrix


def _call_builder(builder: Any, table: Mapping[str, Any], where: str) -> PhysicalModel:
    """Return the model of a builder from the parameters in a table."""
    # arguments that the builder takes, and those that it needs
    parameters = inspect.signature(builder).parameters
    unknown = [key for key in table if key not in parameters]
    if unknown:
        raise ModelError(f"{where}: no parameter {', '.join(unknown)}; there are {', '.join(parameters)}")
    needed = [k for k, p in parameters.items() if p.default is inspect.Parameter.empty and k not in table]
    if needed:
        raise ModelError(f"{where}: {', '.join(needed)} missing; it must be given")
    for key, value in table.items():
        _check_size(2 * len(value) if isinstance(value, (list, dict)) else 0, f"{where}, {key}")
    with _within(where):
        model: PhysicalModel = builder(**{key: _argument(key, value) for key, value in table.items()})
        _ = model.system  # raises if python-control refuses a name
    return model


def _check_size(n_states: int, where: str) -> None:
    if n_states > _MOST_STATES:
        raise ModelError(
            f"{where}: a model of {n_states} states; from a file at most {_MOST_STATES} are read. Reduce it, "
            "by its first modes for instance"
        )


def _argument(key: str, value: Any) -> Any:
    """A TOML value as the builder takes it."""
    if key in ("resistances", "links"):
        if not isinstance(value, dict):
            raise ModelError(f'{key} must be a table, such as {{"1-2" = 0.5, "2-0" = 2.0}}')
        if key == "links":
            return {name: _link(ends) for name, ends in value.items()}
        return {_pair(name): size for name, size in value.items()}
    if key in _MAPS and isinstance(value, list) and value and isinstance(value[0], list):
        return _matrix(value, key)
    return tuple(value) if key == "heat" and isinstance(value, list) else value


def _link(ends: Any) -> Any:
    """Two numbers of masses, or a vector."""
    two = len(ends) == 2 and all(isinstance(end, int) for end in ends)
    return tuple(ends) if two else np.array(ends, dtype=float)


def _pair(name: str) -> tuple[int, ...]:
    if not re.fullmatch(r"\s*\d+\s*-\s*\d+\s*", name):
        raise ModelError(f'{name!r} must name two nodes, such as "1-2" (0 is the surroundings)')
    return tuple(int(end) for end in name.split("-"))


def _state_space(values: Mapping[str, Any], where: str, holds: str, file: Path) -> ct.StateSpace:
    """Return the model of matrices and labels.

    One row or column may be written as a plain list.
    """
    allowed = ("A", "B", "C", "D", "dt", *_LABELS, "name")
    unknown = [key for key in values if key not in allowed]
    if unknown:
        raise ModelError(f"{where}: no key {', '.join(unknown)}; there are {', '.join(allowed + _KNOWN)}")
    missing = [key for key in ("A", "B", "C") if key not in values]
    if missing:
        raise ModelError(f"{where}: {', '.join(missing)} missing; {holds}")
    # D is zero where it is missing
    matrices = _matrices({"D": 0.0, **values}, where)
    dt = values.get("dt", 0)
    if isinstance(dt, bool) or not isinstance(dt, (int, float)) or not 0 <= dt < 1e300:
        raise ModelError(f"{where}: dt must be a time in s, or 0 for continuous time, not {dt!r}")
    sizes = zip(_LABELS, (*matrices[3].shape[::-1], len(matrices[0])), strict=True)
    labels = {key: _labels(values[key], count, f"{where}: {key}") for key, count in sizes if key in values}
    # python-control separates system and signal by a dot
    name = values.get("name", file.stem.replace(".", "_"))
    if not isinstance(name, str) or not name:
        raise ModelError(f"{where}: name must be text, not {name!r}")
    try:
        return ct.ss(*matrices, dt, name=name, **labels)
    except (ValueError, ct.ControlDimension, ct.ControlArgument) as error:  # a name that is not allowed
        raise ModelError(f"{where}: {error}") from error


def _labels(given: Any, count: int, where: str) -> list[str]:
    """Return as many labels as signals.

    A single one may be written without a list.
    """
    texts = given if isinstance(given, list) else [given]
    if len(texts) != count or not all(isinstance(text, str) for text in texts):
        raise ModelError(f"{where} must be {count} name(s), not {given!r}")
    return texts


def _matrices(values: Mapping[str, Any], where: str) -> list[Array]:
    """A, B, C and D of sizes that fit."""
    # a plain list is a row or a column, as the sizes ask
    A, B, C, D = (_matrix(values[key], f"{where}, {key}") for key in "ABCD")
    n = len(A)
    if np.ndim(values["B"]) == 1 and n != 1:
        B = B.T  # one input
    if np.ndim(values["C"]) == 1 and n == 1:
        C = C.T
    if np.ndim(values["D"]) == 1 and B.shape[1] == 1:
        D = D.T
    if D.shape == (1, 1) and D[0, 0] == 0:
        D = np.zeros((len(C), B.shape[1]))
    shapes = {"A": (n, n), "B": (n, B.shape[1]), "C": (len(C), n), "D": (len(C), B.shape[1])}
    for (key, (rows, columns)), matrix in zip(shapes.items(), (A, B, C, D), strict=True):
        if matrix.shape != (rows, columns):
            raise ModelError(
                f"{where}: {key} is {matrix.shape[0]} x {matrix.shape[1]}; with A {n} x {A.shape[1]}, "
                f"B {B.shape[0]} x {B.shape[1]}, C {C.shape[0]} x {C.shape[1]} it must be {rows} x {columns}"
            )
    return [A, B, C, D]


def _matrix(value: Any, where: str) -> Array:
    """Numbers as a 2-D array of finite floats."""
    try:
        given = np.array(value, ndmin=2)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{where} {_RULE}: {error}") from error
    if given.dtype.kind == "c":
        raise ModelError(f"{where} is complex; a model is real, in modal form too: write it with real blocks")
    if given.dtype.kind not in "fiub":
        raise ModelError(f"{where} {_RULE}, not {value!r:.60}")
    _check_size(max(given.shape), where)
    matrix = given.astype(float)
    if matrix.ndim != 2 or not matrix.size:
        raise ModelError(f"{where} must be rows of numbers, not an array of shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        row, column = np.argwhere(~np.isfinite(matrix))[0]
        raise ModelError(f"{where} is not finite in row {row + 1}, column {column + 1}")
    return matrix


def _texts(value: Any, where: str) -> list[str]:
    """Return the names in a text array of NumPy or MATLAB.

    The array of MATLAB is a char array or a cell array.
    """
    found: list[str] = []
    for item in np.asarray(value).ravel():
        inner: Sequence[Any] = [item] if isinstance(item, str) else list(np.asarray(item).ravel())
        if not all(isinstance(text, str) for text in inner):
            raise ModelError(f"{where} must be text, not {value!r}")
        found += [str(text).strip() for text in inner]
    return found
