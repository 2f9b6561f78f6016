"""Checks of arguments with precise error messages.

A message tells what is wrong, in which argument, and what to give instead.

All of them take the value and the name of the argument, and return the value in the form
that the work needs. A wrong type raises `control.ControlArgument`, a wrong size
`control.ControlDimension`, and a value out of range the class handed over as `error`.
"""

from __future__ import annotations

import math
import numbers
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar
from unicodedata import category

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..exceptions import DataError

Array = NDArray[np.float64]
T = TypeVar("T")

_HIDDEN = ("Cc", "Cs", "Zl", "Zp")  # control characters, surrogates, separators of lines and paragraphs
_TURNING = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"  # the direction of what follows
_SHOWN = 80  # characters of a bad value in a message
_LARGEST = 1e150  # numbers are squared
_MOST = 2**31 - 1  # no count of samples, orders or windows is larger


def shown(value: Any) -> str:
    """A value as a message quotes it: whole where it is short."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 256:
        return f"a whole number of {value.bit_length()} bits"  # Python refuses to write out the longest
    text = " ".join(repr(value).split())
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def printable(text: str) -> str:
    r"""Return text with its control characters spelled out.

    The name of a signal can then not control a terminal.

    Examples
    --------
    >>> print(printable("red \x1b[31m"))
    red \x1b[31m
    """
    if text.isprintable():
        return text
    return "".join(repr(one)[1:-1] if one in _TURNING or category(one) in _HIDDEN else one for one in text)


def as_text(value: Any, name: str, *, empty: bool = True) -> str:
    """Text; `empty` tells whether it may be."""
    if not isinstance(value, str):
        raise ct.ControlArgument(f"{name} must be a text, not {shown(value)}")
    if not empty and not value.strip():
        raise ct.ControlArgument(f"{name} must not be empty")
    return str(value)


def as_choice(value: Any, name: str, choices: Iterable[str]) -> str:
    """One of a few words."""
    choices = list(choices)
    if not isinstance(value, str) or value not in choices:
        raise ct.ControlArgument(f"{name} must be one of {', '.join(map(repr, choices))}, not {shown(value)}")
    return str(value)


def as_list(values: Any, name: str, of: str) -> list[Any]:
    """Return the entries of a list in their order.

    A tuple, an array or an iterator is accepted as well; `of` describes the entries in the error message.
    """
    listed = isinstance(values, Iterable) and getattr(values, "ndim", 1) == 1
    if not listed or isinstance(values, str | bytes | bytearray | memoryview | Mapping | set | frozenset):
        raise ct.ControlArgument(f"{name} must be a list of {of}, not {shown(values)}")
    return list(values)


def as_texts(values: Any, name: str, count: int | None = None) -> tuple[str, ...]:
    """Texts from one or a list of them.

    Raises
    ------
    control.ControlArgument
        If an entry is no text.
    control.ControlDimension
        If there are not `count` of them.
    """
    texts = [values] if isinstance(values, str) else as_list(values, name, "strings")
    for text in texts:
        if not isinstance(text, str):
            raise ct.ControlArgument(f"{name} must hold strings, not {shown(text)}")
    if count is not None and len(texts) != count:
        raise ct.ControlDimension(f"{name}: {len(texts)} given for {count} signal(s)")
    return tuple(map(str, texts))


def as_labels(
    values: Any, name: str, default: Sequence[str], *, error: type[Exception] = DataError
) -> tuple[str, ...]:
    """Names of signals, each another; the default ones where None is given.

    Raises
    ------
    control.ControlArgument
        If an entry is no text.
    control.ControlDimension
        If the number does not fit.
    error
        If a name is empty or stands there twice.
    """
    if values is None:
        return tuple(default)
    labels = as_texts(values, name)
    if len(labels) != len(default):
        raise ct.ControlDimension(
            f"{name} has {len(labels)} names for {len(default)} signal(s) ({', '.join(default)})"
        )
    for label in labels:
        if not label:
            raise error(f"{name} holds an empty name; name every signal")
        if labels.count(label) > 1:
            raise error(f"{name} must be unique, but names {label!r} twice")
    return labels


def as_mapping(value: Any, name: str, of: str) -> dict[str, Any]:
    """Copy of a mapping whose keys are texts; None is an empty one."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise ct.ControlArgument(f"{name} must be a mapping from names to {of}, not {shown(value)}")
    for key in value:
        if not isinstance(key, str):
            raise ct.ControlArgument(f"{name} must have names as keys, not {shown(key)}")
    return dict(value)


def as_flag(value: Any, name: str) -> bool:
    """True or False, nothing else: "no" would count as true.

    Raises
    ------
    control.ControlArgument
        If it is anything else.
    """
    if not isinstance(value, bool | np.bool_):
        raise ct.ControlArgument(f"{name} must be True or False, not {shown(value)}")
    return bool(value)


def as_number(
    value: Any,
    name: str,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    below: float = math.inf,
    most: float = math.inf,
    infinite: bool = False,
    what: str = "a number",
    error: type[Exception] = ct.ControlArgument,
) -> float:
    """One finite number: above < value < below and least <= value <= most.

    Raises
    ------
    control.ControlArgument
        If it is no real number.
    error
        If it is not finite or out of range.
    """
    number = _real(value)
    if number is None:
        raise ct.ControlArgument(f"{name} must be {what}, not {shown(value)}")
    positive = "be positive" if above == 0 else f"be above {above:g}"
    endless = math.isnan(number) or (math.isinf(number) and not infinite)
    wrong = [
        (endless, "be positive and finite" if above == 0 else "be finite"),
        (number <= above > -math.inf, positive),
        (number < least, "not be negative" if least == 0 else f"be at least {least:g}"),
        (number >= below < math.inf, f"be below {below:g}"),
        (number > most, f"be at most {most:g}"),
        (0 < abs(number) < 1 / _LARGEST, "be of another unit: its square is zero to the computer"),
        (_LARGEST < abs(number) < math.inf, "be of another unit: its square is beyond floating point"),
    ]
    for broken, rule in wrong:
        if broken:
            raise error(f"{name} = {number:g} must {rule}")
    return number


def _real(value: Any) -> float | None:
    """Return a real number as a float, or None for anything else.

    An array without dimensions counts as a number, a flag does not.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0 and not np.ma.isMaskedArray(value):
        value = value[()]
    if isinstance(value, bool | np.bool_ | np.timedelta64) or not isinstance(value, numbers.Real):
        return None
    try:
        return float(value)
    except OverflowError:  # a whole number of more than 300 digits
        return math.inf if abs(value) == value else -math.inf


def as_share(value: Any, name: str, *, error: type[Exception] = ct.ControlArgument) -> float:
    """Return a probability or share strictly between 0 and 1.

    It must not be so small that its quantile is infinite.
    """
    number = _real(value)
    if number is None or not 1 / _LARGEST <= number < 1.0:
        problem = ct.ControlArgument if number is None else error
        least = f" (at least {1 / _LARGEST:g})" if number is not None and 0 < number < 1 else ""
        raise problem(f"{name} must be a number between 0 and 1{least}, not {shown(value)}")
    return number


def as_whole(
    value: Any,
    name: str,
    *,
    least: int = 0,
    most: int = _MOST,
    error: type[Exception] = ct.ControlArgument,
) -> int:
    """Whole number in a range.

    Raises
    ------
    control.ControlArgument
        If it is no whole number.
    error
        If it is out of range.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise ct.ControlArgument(f"{name} must be a whole number, not {shown(value)}")
    if not least <= value <= most:
        bound = f"at least {least}" if value < least else f"at most {most}"
        raise error(f"{name} must be {bound}, not {shown(value)}")
    return int(value)


def as_array(
    values: Any,
    name: str,
    *,
    finite: bool = True,
    flags: bool = False,
    error: type[Exception] = DataError,
) -> Array:
    """Independent array of real numbers, of any shape.

    Raises
    ------
    control.ControlArgument
        If the values are complex, text, dates, objects, or (unless `flags`) True and False.
    control.ControlDimension
        If rows have unequal lengths.
    error
        If a value is masked or (unless `finite` is False) not finite.
    """
    if np.ma.isMaskedArray(values) and np.ma.getmaskarray(values).any():
        place = tuple(np.argwhere(np.ma.getmaskarray(values))[0].tolist())
        raise error(f"{name} is masked at index {place}; repair or leave out the gap")
    array = _any_array(values, name)
    if array.dtype.kind == "c":
        raise ct.ControlArgument(f"{name} is complex; give real numbers")
    if not array.size:  # an empty list of anything
        return np.zeros(array.shape)
    if array.dtype.kind not in ("fiub" if flags else "fiu"):
        raise ct.ControlArgument(
            f"{name} must hold real numbers, not {array.dtype} such as {shown(array.flat[0])}; "
            "convert it first"
        )
    if finite and not np.isfinite(array).all():
        index = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
        where = f"{name}[{', '.join(map(str, index))}]" if index else name
        raise error(f"{where} is not finite ({array[index]}); give finite numbers")
    return array.astype(np.float64)


def _any_array(values: Any, name: str) -> NDArray[Any]:
    """Return an independent array of anything but bytes."""
    if isinstance(values, bytes | bytearray | memoryview):
        raise ct.ControlArgument(f"{name} must hold real numbers, not {shown(values)}")
    try:
        return np.array(values)
    except (ValueError, TypeError, RecursionError) as reason:
        if isinstance(values, list | tuple):
            raise ct.ControlDimension(f"{name} holds rows of unequal lengths; give all the same") from reason
        raise ct.ControlArgument(f"{name} must hold real numbers, not {shown(values)}") from reason


def as_vector(
    values: Any,
    name: str,
    size: int | None = None,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    error: type[Exception] = DataError,
) -> Array:
    """Finite numbers in a row, from one or a list of them.

    Raises
    ------
    control.ControlArgument
        If they are no real numbers.
    control.ControlDimension
        If there are not `size` of them, or more dimensions.
    error
        If there is none, or one is not finite or out of range.
    """
    array = np.atleast_1d(as_array(values, name, finite=False, error=error))
    if array.size == 0:
        raise error(f"{name} is empty; give at least one {'positive ' if above == 0 else ''}number")
    if array.ndim != 1:
        raise ct.ControlDimension(f"{name} must be a list of numbers, not an array of shape {array.shape}")
    if size is not None and array.size != size:
        raise ct.ControlDimension(f"{name} has {array.size} entries, expected {size}")
    for index, number in enumerate(array.tolist()):
        where = name if array.size == 1 else f"{name}[{index}]"
        as_number(number, where, above=above, least=least, error=error)
    return array


def as_state(value: Any, size: int | None = None) -> Array | None:
    """Return the initial state of a simulation.

    It is None for "estimate", zeros for "zero", or the given state.

    Raises
    ------
    control.ControlArgument
        If it is neither of the words nor an array of numbers.
    control.ControlDimension
        If there are not `size` numbers.
    DataError
        If one is not finite.
    """
    if isinstance(value, str) and value in ("estimate", "zero"):
        return None if value == "estimate" else np.zeros(size or 0)
    if value is None or isinstance(value, str | bool | np.bool_ | Mapping):
        raise ct.ControlArgument(f"x0 must be 'estimate', 'zero' or an array, not {shown(value)}")
    state = as_array(value, "x0")
    if state.ndim != 1 or size not in (None, state.size):
        raise ct.ControlDimension(f"x0 has shape {state.shape}; the model has {size or 'other'} states")
    return state


def as_noise(value: Any, n_outputs: int) -> Array | None:
    """Return the standard deviations of the sensor noise, one per output.

    The result is None where they are not known.
    """
    if value is None:
        return None
    level = as_vector(value, "noise (standard deviations)", above=0.0, error=ct.ControlArgument)
    if level.size not in (1, n_outputs):
        raise ct.ControlDimension(
            f"noise has {level.size} entries; give one standard deviation, or one for each of the "
            f"{n_outputs} outputs"
        )
    return np.broadcast_to(level, (n_outputs,))


def as_instance(value: Any, kind: type[T], name: str) -> T:
    """An object of one class.

    Raises
    ------
    control.ControlArgument
        If it is of another.
    """
    if not isinstance(value, kind):
        raise ct.ControlArgument(f"{name} must be of class {kind.__name__}, not {shown(value)}")
    return value


def as_path(value: Any, name: str = "path") -> Path:
    """Path of a file, as it was given.

    Raises
    ------
    control.ControlArgument
        If it is no text or path, or one that no file can have.
    """
    if not isinstance(value, str | os.PathLike):
        raise ct.ControlArgument(f"{name} must be the path of a file, not {shown(value)}")
    text = os.fspath(value)
    try:
        usable = isinstance(text, str) and bool(text) and b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        usable = False
    if not usable:
        raise ct.ControlArgument(
            f"{name} must be the path of a file; no file can have the name {shown(value)}"
        )
    return Path(text)


def as_generator(value: Any) -> np.random.Generator:
    """Generator of random numbers, or a new one from a seed."""
    if isinstance(value, np.random.Generator):
        return value
    try:
        return np.random.default_rng(as_whole(value, "rng"))
    except ct.ControlArgument as reason:
        said = f"rng must be a numpy.random.Generator or a seed from 0, not {shown(value)}"
        raise ct.ControlArgument(said) from reason


def as_mapper(executor: Any) -> Callable[..., Any]:
    """Return the `map` of an executor, or the built-in one for None.

    For a dask client, it is the `map` of its executor.

    Raises
    ------
    control.ControlArgument
        If it is anything else.
    """
    if executor is None:
        return map
    if callable(getattr(executor, "get_executor", None)):  # a Client's own map returns futures
        executor = executor.get_executor()
    mapper: Callable[..., Any] | None = getattr(executor, "map", None)
    if mapper is not None and callable(mapper) and not isinstance(executor, type):
        return mapper
    raise ct.ControlArgument(
        "executor must be a concurrent.futures.Executor such as ProcessPoolExecutor(4), or a "
        f"dask.distributed.Client, not {shown(executor)}"
    )
