"""Laws as functions that kernels call by address.

All have one signature, so no kernel is recompiled for a new law.

A law is written as its formula, ``law(d, v, ...)`` with the names of what it takes. Here it becomes
a function of one signature that writes the force, the inner state and their derivatives into
a row of numbers. Built-in laws and those of a user work in the same way and cost the same.
"""

from __future__ import annotations

import ctypes
import math
import sys
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final

import numpy as np

from ..exceptions import RCOWarning, warn
from ..jit import NUMBA, address_of, call_at, compiled, compiled_law

__all__ = [
    "COUNT",
    "MAX_COEFFICIENTS",
    "address",
    "code_of",
    "evaluate",
    "forces_along",
    "raise_pending",
    "through",
]

MAX_COEFFICIENTS: Final = 4
COUNT: Final = 18  # numbers that a law writes, before the derivatives by the inputs
# where a law writes the derivatives of its force and of its inner state by what it takes
_SLOTS: Final = {"d": (1, 6), "v": (2, 17), "d_start": (3, 7), "z_start": (4, 8)}
_FOREVER: Final = 1e200  # s: a signal that has stood at its first value
_STEP = "1e-6 * max(abs({x}), 1e-3)"

_PLAIN: dict[int, Callable[..., None]] = {}  # laws by code, where nothing is compiled
_PENDING: list[BaseException] = []  # raised by laws that numba cannot compile, inside a kernel

if NUMBA:

    @compiled
    def evaluate(code, d, v, d_start, z_start, values, i, width, w, out):  # type: ignore[no-untyped-def]
        """Evaluate a law at the end of a step.

        Parameters
        ----------
        code : int
            Address of the law, as `address` gives it.
        d, v : float
            Displacement and velocity; of a law at an input or output its signal and whether it is held.
        d_start, z_start : float
            Displacement and inner state at the start of the step.
        values, i
            Coefficients and constants: row i of an array.
        width : float
            Scale over which a jump is smoothed; of a law at an input the length of the step.
        w : ndarray, shape (n_w,)
            Inputs.
        out : ndarray
            Row i on return: f, its derivatives by d, v, d_start, z_start; z, its derivatives by d,
            d_start, z_start; derivatives of f and of z by four coefficients each; of z by v; of f by w.
        """
        call_at(
            code, d, v, d_start, z_start, values.ctypes.data + 8 * i * values.shape[1], width,
            w.ctypes.data, w.shape[0], out.ctypes.data + 8 * i * out.shape[1],
        )  # fmt: skip

else:

    def evaluate(code, d, v, d_start, z_start, values, i, width, w, out):  # type: ignore[no-untyped-def]
        """Evaluate a law at the end of a step, see above."""
        _PLAIN[code](d, v, d_start, z_start, values[i], width, w, w.shape[0], out[i])


def address(
    law: Callable[..., Any],
    slopes: Callable[..., Any] | None,
    arguments: Sequence[str],
    signals: dict[str, str],
    values: Sequence[str],
    *,
    memory: bool,
    scaled: bool = False,
    by_name: Collection[str] = (),
    label: str = "law",
) -> tuple[int, Any]:
    """Code of a law for the kernels.

    Parameters
    ----------
    law : callable
        Formula: the force, or with memory the force and the inner state at the end of the step.
    slopes : callable or None
        The same with the derivatives by each argument behind: ``(f, f_by_first, ...)``, with memory a
        pair of such tuples. Without it derivatives are central differences.
    arguments : sequence of str
        What they take, in order.
    signals : dict
        What each name that is no coefficient stands for.
    values : sequence of str
        Coefficients and constants in the order of their row.
    memory : bool
        Whether the law has an inner state.
    scaled : bool
        Whether the force is the first value times what `law` returns.
    by_name : sequence of str
        Arguments to be handed over by name.
    label : str
        For messages.

    Returns
    -------
    code : int
        What `evaluate` takes.
    keep : object
        To be kept as long as the code is used.
    """
    source = _source(arguments, signals, values, slopes is not None, memory, scaled, by_name)
    plain = _defined(source, {"law": law, "slopes": slopes, "carray": lambda w, n: w}, law)
    if not NUMBA:
        return code_of(plain)
    try:
        names = {"law": compiled_law(law), "slopes": None if slopes is None else compiled_law(slopes)}
        return code_of(plain, _defined(source, {**names, "carray": None}, law), cache=_importable(law))
    except TypeError as error:
        warn(
            f"{label} cannot be compiled and is called in Python, which is some hundred times slower: "
            f"{str(error).strip().splitlines()[0]}",
            RCOWarning,
        )
    return code_of(plain)


def code_of(
    plain: Callable[..., None], fast: Callable[..., None] | None = None, *, cache: bool = False
) -> tuple[int, Any]:
    """Return the code by which `evaluate` calls a function.

    The second value must be kept as long as the code is used.

    Parameters
    ----------
    plain : callable
        The function in Python.
    fast : callable, optional
        The same for numba to compile; without it, where kernels are compiled, they call Python.
    cache : bool
        Whether numba may keep it beside its file.

    Raises
    ------
    TypeError
        If numba cannot compile it.
    """
    if not NUMBA:
        code = len(_PLAIN) + 1
        _PLAIN[code] = plain
        return code, plain
    return _callback(plain) if fast is None else address_of(fast, cache=cache)


def _source(
    arguments: Sequence[str],
    signals: dict[str, str],
    values: Sequence[str],
    has_slopes: bool,
    memory: bool,
    scaled: bool,
    by_name: Collection[str],
) -> str:
    """Text of the function that writes the row of numbers."""
    lines = ["def evaluate(_d, _v, _d_start, _z_start, _p, _width, _w, _nw, _out):"]
    add = lines.append
    for name in arguments:
        if name in values:
            add(f"    {name} = _p[{values.index(name)}]")
        elif signals[name] == "w":
            add(f"    {name} = carray(_w, _nw)")
        else:
            add(f"    {name} = _{signals[name]}")
    given = ", ".join(f"{name}={name}" if name in by_name else name for name in arguments)
    scale = "_p[0] * " if scaled else ""
    slots = {name: _SLOTS[signals[name]] for name in arguments if signals.get(name) in _SLOTS}
    slots |= {name: (9 + values.index(name), 13 + values.index(name)) for name in arguments if name in values}
    smooth = [name for name in arguments if name in slots]
    if has_slopes:
        add(f"    {'_f, _z' if memory else '_f'} = slopes({given})")
        add("    _out[0] = _f[0]")
        if memory:
            add("    _out[5] = _z[0]")
        for k, name in enumerate(arguments):
            if name in slots:
                add(f"    _out[{slots[name][0]}] = _f[{k + 1}]")
                if memory:
                    add(f"    _out[{slots[name][1]}] = _z[{k + 1}]")
        return "\n".join(lines)
    pair = "{0}f, {0}z" if memory else "{0}f"
    add(f"    {pair.format('_')} = law({given})")
    add(f"    _out[0] = {scale}_f")
    if scaled:
        add("    _out[9] = _f")
    if memory:
        add("    _out[5] = _z")
    for name in smooth:
        add(f"    _at, _h = {name}, {_STEP.format(x=name)}")
        add(f"    {name} = _at + _h")
        add(f"    {pair.format('_up_')} = law({given})")
        add(f"    {name} = _at - _h")
        add(f"    {pair.format('_low_')} = law({given})")
        add(f"    {name} = _at")
        add(f"    _out[{slots[name][0]}] = {scale}(_up_f - _low_f) / (2.0 * _h)")
        if memory:
            add(f"    _out[{slots[name][1]}] = (_up_z - _low_z) / (2.0 * _h)")
    for name in arguments:
        if signals.get(name) == "w":
            add("    for _j in range(_nw):")
            add(f"        _at, _h = {name}[_j], {_STEP.format(x=name + '[_j]')}")
            for side, sign in (("up", "+"), ("low", "-")):
                add(f"        {name}[_j] = _at {sign} _h")
                add(f"        {pair.format(f'_{side}_')} = law({given})")
            add(f"        {name}[_j] = _at")
            add(f"        _out[{COUNT} + _j] = {scale}(_up_f - _low_f) / (2.0 * _h)")
    return "\n".join(lines)


def _defined(source: str, names: dict[str, Any], law: Callable[..., Any]) -> Callable[..., None]:
    """Return the function that a source text defines.

    It is placed in the file of its law, so that numba caches it there.
    """
    code = getattr(getattr(law, "py_func", law), "__code__", None)
    file, line = ("<law>", 1) if code is None else (code.co_filename, code.co_firstlineno)
    scope = {"math": math, **names}
    exec(compile("\n" * (line - 1) + source, file, "exec"), scope)
    function: Callable[..., None] = scope["evaluate"]
    function.__module__ = getattr(law, "__module__", __name__)
    function.__qualname__ = f"{getattr(law, '__qualname__', 'law')}.evaluate"
    return function


def _importable(function: Any) -> bool:
    """Return whether a function can be found by its name.

    Otherwise it may be a closure, whose variables are in no key of a cache.
    """
    found: Any = sys.modules.get(getattr(function, "__module__", None) or "")
    for part in getattr(function, "__qualname__", "<none>").split("."):
        found = getattr(found, part, None)
    return found is not None and found is function


_ROW = ctypes.POINTER(ctypes.c_double)
_PROTOTYPE = ctypes.CFUNCTYPE(None, *[ctypes.c_double] * 4, _ROW, ctypes.c_double, _ROW, ctypes.c_int64, _ROW)


def _callback(plain: Callable[..., None]) -> tuple[int, Any]:
    """Return the code of a law that is called in Python.

    Its exceptions are stored, and `raise_pending` raises them.
    """

    def call(
        d: float, v: float, d0: float, z0: float, p: Any, width: float, w: Any, n: int, out: Any
    ) -> None:
        try:
            plain(d, v, d0, z0, p, width, np.array([w[j] for j in range(n)]), n, out)
        except BaseException as error:
            _PENDING.append(error)
            out[0] = math.nan

    found = _PROTOTYPE(call)
    return int(ctypes.cast(found, ctypes.c_void_p).value or 0), found


def raise_pending() -> None:
    """Raise what a law that is called in Python raised inside a kernel.

    Raises
    ------
    Exception
        The first one.
    """
    if _PENDING:
        error = _PENDING[0]
        _PENDING.clear()
        raise error


@compiled
def through(code, values, signal, slopes, value, own, step, held, settled):  # type: ignore[no-untyped-def]
    """Pass a signal (N,) through a law.

    `step` is the time [s] from one value to the next.

    `slopes` (q, N), its derivatives by something, become those of `value`; `own` (4, N) takes the
    derivatives by the law's coefficients.
    """
    q = slopes.shape[0]
    out, nothing = np.zeros((1, COUNT)), np.zeros(0)
    z, last = 0.0, signal[0]
    own_z, before_z, before = np.zeros(own.shape[0]), np.zeros(q), slopes[:, 0].copy()
    for k in range(signal.size):
        lasts = _FOREVER if k < settled else step
        evaluate(code, signal[k], held, last, z, values, 0, lasts, nothing, out)
        value[k] = out[0, 0]
        for c in range(own.shape[0]):
            own[c, k] = out[0, 9 + c] + out[0, 4] * own_z[c]
            own_z[c] = out[0, 13 + c] + out[0, 8] * own_z[c]
        for r in range(q):
            now = slopes[r, k]
            slopes[r, k] = out[0, 1] * now + out[0, 3] * before[r] + out[0, 4] * before_z[r]
            before_z[r] = out[0, 6] * now + out[0, 7] * before[r] + out[0, 8] * before_z[r]
            before[r] = now
        z, last = out[0, 5], signal[k]


@compiled
def forces_along(code, d, v, w, values, width, found):  # type: ignore[no-untyped-def]
    """Compute the force per unit of each coefficient along a motion.

    The motion is d, v (N,) with inputs w (N, n_w). The result is written to `found` (4, N).
    """
    out = np.zeros((1, COUNT + w.shape[1]))
    z, last = 0.0, d[0]
    for k in range(d.size):
        evaluate(code, d[k], v[k], last, z, values, 0, width, w[k], out)
        z, last = out[0, 5], d[k]
        for c in range(found.shape[0]):
            found[c, k] = out[0, 9 + c]
