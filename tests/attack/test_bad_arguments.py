"""Every argument of every public callable against the usual bad values.

A bad value ends in an error of ours or of python-control that names the argument, never
in one of numpy's, and never goes through where the documentation excludes it.
"""

from __future__ import annotations

import contextlib
import decimal
import fractions
import importlib
import pathlib
import signal
import tempfile
import warnings
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import control as ct
import matplotlib.pyplot as plt
import numpy as np
import pytest
from public_calls import CALLS, Call
from test_public_api import CALLABLES, WITH_METHODS

import rcorefine as rco

OURS = (
    rco.RCOError,
    ct.ControlArgument,
    ct.ControlDimension,
    OSError,  # a path that is not there, as everywhere in Python
)
LONGEST = 5  # seconds of work that a call may take


class _Object:
    def __repr__(self) -> str:
        return "<an object>"


def _endless() -> list[Any]:
    found: list[Any] = []
    found.append(found)
    return found


VALUES: dict[str, Callable[[], Any]] = {
    "None": lambda: None,
    "True": lambda: True,
    "False": lambda: False,
    "numpy False": lambda: np.False_,
    "nan": lambda: float("nan"),
    "inf": lambda: float("inf"),
    "-inf": lambda: -float("inf"),
    "-1": lambda: -1,
    "-1.5": lambda: -1.5,
    "0": lambda: 0,
    "1.5": lambda: 1.5,
    "10**400": lambda: 10**400,
    "2**62": lambda: 2**62,
    "-2**70": lambda: -(2**70),
    "1e308": lambda: 1e308,
    "5e-324": lambda: 5e-324,
    "complex": lambda: 1 + 2j,
    "numpy complex": lambda: np.complex64(1j),
    "float16 nan": lambda: np.float16("nan"),
    "int8": lambda: np.int8(-1),
    "uint8": lambda: np.uint8(0),
    "datetime": lambda: np.datetime64("2020-01-01"),
    "Decimal nan": lambda: decimal.Decimal("nan"),
    "Decimal": lambda: decimal.Decimal("1.5"),
    "Fraction": lambda: fractions.Fraction(1, 3),
    "''": lambda: "",
    "' '": lambda: " ",
    "'x'": lambda: "x",
    "'no'": lambda: "no",
    "nul": lambda: "a\0b",
    "surrogate": lambda: "\ud800",
    "'nan'": lambda: "nan",
    "numpy str": lambda: np.str_("x"),
    "bytes": lambda: b"x",
    "object": _Object,
    "lambda": lambda: lambda *_: None,
    "class": lambda: int,
    "Ellipsis": lambda: ...,
    "[]": list,
    "()": tuple,
    "{}": dict,
    "{'x': 1}": lambda: {"x": 1},
    "{'x': nan}": lambda: {"x": float("nan")},
    "{'x': None}": lambda: {"x": None},
    "{1: 'x'}": lambda: {1: "x"},
    "{(1, 2): 'x'}": lambda: {(1, 2): "x"},
    "{('a', []): 1}": lambda: {("a", 1): []},
    "set()": set,
    "{'a', 'b'}": lambda: {"a", "b"},
    "generator": lambda: (i for i in range(3)),
    "iter of str": lambda: iter(["x"]),
    "range(0)": lambda: range(0),
    "[None]": lambda: [None],
    "[nan]": lambda: [float("nan")],
    "[[]]": lambda: [[]],
    "[1.0] * 7": lambda: [1.0] * 7,
    "[1.0, nan]": lambda: [1.0, float("nan")],
    "[1, 'x']": lambda: [1, "x"],
    "['x', 'x']": lambda: ["x", "x"],
    "['x', 1]": lambda: ["x", 1],
    "['']": lambda: [""],
    "seven names": lambda: list("abcdefg"),
    "[['x']]": lambda: [["x"]],
    "[{}]": lambda: [{}],
    "[10**400]": lambda: [10**400],
    "[True, False]": lambda: [True, False],
    "ragged": lambda: [[1.0, 2.0], [3.0]],
    "deep": lambda: [[[[[1.0]]]]],
    "endless": _endless,
    "(0, 1, 2)": lambda: (0, 1, 2),
    "(-1, 'x')": lambda: (-1, "x"),
    "empty array": lambda: np.empty(0),
    "0-d array": lambda: np.array(1.0),
    "0-d nan": lambda: np.array(float("nan")),
    "2-D array": lambda: np.ones((2, 3)),
    "3-D array": lambda: np.ones((2, 2, 2)),
    "column": lambda: np.ones((7, 1)),
    "array with nan": lambda: np.array([1.0, np.nan, 2.0]),
    "complex array": lambda: np.ones(3) * 1j,
    "object array": lambda: np.array([None, object()], dtype=object),
    "text array": lambda: np.array(["a", "b"]),
    "date array": lambda: np.array(["2020-01-01", "2020-01-02"], dtype="datetime64[D]"),
    "structured array": lambda: np.zeros(2, dtype=[("a", float), ("b", int)]),
    "masked array": lambda: np.ma.masked_array([1.0, 2.0, 3.0], mask=[0, 1, 0]),
    "memoryview": lambda: memoryview(b"abc"),
    "path": lambda: pathlib.Path("x"),
    "folder": lambda: pathlib.Path(tempfile.mkdtemp()),
    "exception": lambda: ValueError("x"),
    "transfer function": lambda: ct.tf([1.0], [1.0, 1.0]),
    "random generator": lambda: np.random.default_rng(0),
    "a whole module": lambda: np,
}


class _Begun(BaseException):
    """The checks are over: the work begins."""


def _begin(*_: Any, **__: Any) -> None:
    raise _Begun


@contextlib.contextmanager
def _stopped(call: Call, *, whole: bool) -> Iterator[None]:
    """Stop where the work begins, unless the whole call is asked for: figures are work, too."""
    with contextlib.ExitStack() as stack:
        if not whole:
            stack.enter_context(mock.patch.object(plt, "subplots", _begin))
            stack.enter_context(mock.patch.object(plt, "figure", _begin))
            if call.work is not None:
                module, name = call.work.rsplit(".", 1)
                stack.enter_context(mock.patch.object(importlib.import_module(module), name, _begin))
        yield


@contextlib.contextmanager
def _in_time() -> Iterator[None]:
    def late(*_: Any) -> None:
        raise TimeoutError(f"took longer than {LONGEST} s")

    if not hasattr(signal, "SIGPROF"):
        yield
        return
    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def _outcome(call: Call, argument: str, value: Any, *, whole: bool) -> Exception | None:
    """Error that a call with one bad argument ends in, None where it goes through."""
    function = call.function()
    arguments = {**call.valid(), argument: value}
    with warnings.catch_warnings(), _stopped(call, whole=whole), _in_time():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", rco.RCOWarning)
        try:
            function(**arguments)
        except _Begun:
            return None
        except Exception as error:
            return error
    return None


def _may_pass(call: Call, argument: str, value: Any) -> bool:
    """Whether the documentation leaves room for a value."""
    default = call.default(argument)
    if value is default or (value is None and default is None):
        return True
    kind = call.kinds.get(argument)
    return kind is None or bool(kind(value))


def tried(
    name: str, argument: str, *, whole: bool, values: dict[str, Callable[[], Any]] = VALUES
) -> list[str]:
    """What is wrong with a callable's handling of one argument, a line per value."""
    call = CALLS[name]
    wrong = []
    for what, make in values.items():
        error = _outcome(call, argument, make(), whole=whole)
        plt.close("all")
        if error is None:
            if not _may_pass(call, argument, make()):
                wrong.append(f"{argument}={what}: taken without a word")
        elif not isinstance(error, OURS) or isinstance(error, TimeoutError):
            wrong.append(f"{argument}={what}: {type(error).__name__}: {error}")
        elif not str(error):
            wrong.append(f"{argument}={what}: {type(error).__name__} without a message")
    return wrong


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is written under a bad name goes to a folder that is thrown away."""
    monkeypatch.chdir(tmp_path)


def test_every_public_callable_is_tried():
    import dataclasses

    made_by_us = {
        name for name, obj in CALLABLES.items() if isinstance(obj, type) and dataclasses.is_dataclass(obj)
    } - {"Measurement", "Port", "PhysicalModel", "NominalParameter"}
    assert set(WITH_METHODS) - made_by_us - set(CALLS) == set()


@pytest.mark.parametrize("name", CALLS)
def test_valid_call_goes_through(name):
    """The call that the bad values are put into is a good one."""
    call = CALLS[name]
    with warnings.catch_warnings(), _stopped(call, whole=False), contextlib.suppress(_Begun):
        warnings.simplefilter("ignore")
        call.function()(**call.valid())


@pytest.mark.parametrize("name", CALLS)
def test_bad_values_are_refused(name):
    _demand(name, whole=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLS)
def test_bad_values_do_not_surface_in_the_work(name):
    """As above, and what is taken is worked with to the end."""
    _demand(name, whole=True)


def _demand(name: str, *, whole: bool) -> None:
    wrong = [line for argument in CALLS[name].arguments() for line in tried(name, argument, whole=whole)]
    assert not wrong, f"{name}: {len(wrong)} bad calls\n" + "\n".join(wrong)
