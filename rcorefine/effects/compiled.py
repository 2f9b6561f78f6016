"""Laws as functions that kernels call by address.

All have one signature, so no kernel is recompiled for a new law.

A law is written as its formula, ``law(d, v, ...)`` with the names of what it takes. Here it becomes
a function of one signature that writes the force, the inner state and their derivatives into
a row of numbers. Built-in laws and those of a user work in the same way and cost the same.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ..exceptions import RCOWarning, warn
from ..jit import NUMBA, address_of, call_at, compiled, compiled_law
from .expressions import Number, Tape, Untraceable, as_numbers, in_python, read_by, tracing

if TYPE_CHECKING:
    from .formula import FormulaLaw

MAX_COEFFICIENTS: Final = 4
COUNT: Final = 18  # numbers that a law writes, before the derivatives by the inputs
# where a law writes the derivatives of its force and of its inner state by what it takes
_SLOTS: Final = {"d": (1, 6), "v": (2, 17), "d_start": (3, 7), "z_start": (4, 8)}
_FOREVER: Final = 1e200  # seconds for which a signal had its first value before the record

_PLAIN: dict[int, Callable[..., None]] = {}  # laws by code, where nothing is compiled
_PENDING: list[BaseException] = []  # exceptions of laws that are called in Python from a kernel

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
        # addresses of the rows of the arrays, 8 bytes a number
        call_at(
            code, d, v, d_start, z_start, values.ctypes.data + 8 * i * values.shape[1], width,
            w.ctypes.data, w.shape[0], out.ctypes.data + 8 * i * out.shape[1],
        )  # fmt: skip

else:

    def evaluate(code, d, v, d_start, z_start, values, i, width, w, out):  # type: ignore[no-untyped-def]
        """Evaluate a law at the end of a step, see above."""
        _PLAIN[code](d, v, d_start, z_start, values[i], width, w, w.shape[0], out[i])


def address(of: FormulaLaw, made: dict[str | bytes, tuple[int, Any]]) -> int:
    """Code of a law as it is now, for the kernels.

    Derivatives are those of its `slopes`. Without these they are exact if the formula can be traced, and
    central differences otherwise.

    Parameters
    ----------
    of : FormulaLaw
        The law.
    made : dict
        Codes made before, each with what must be kept as long as it is used, by all that it holds of the law:
        the text of the traced formula, or what numba reads. A new code is added. The key b"" is that of
        code that calls the law as it stands. Only the first one may be kept on disk.

    Returns
    -------
    int
        What `evaluate` takes.
    """
    # traced formula: its text has all numbers that the law reads now
    if of.slopes is None:
        with suppress(Exception):  # the user's code may raise anything when it gets symbols
            source = _exact(of)
            if source not in made:
                made[source] = _of_text(source, of, cache=not made)
            return made[source][0]
    # otherwise the law's own slopes, or central differences
    read = read_by(of.law, of.slopes)
    if read not in made:
        made[read] = _as_written(of, read, cache=not made)
    return made[read][0]


def _as_written(of: FormulaLaw, read: bytes, cache: bool) -> tuple[int, Any]:
    """Return code that calls the law.

    It is compiled where it is known what the law reads, and in Python otherwise.
    """
    law, slopes = of.law, of.slopes
    source = _by_differences(of) if slopes is None else _by_slopes(of)
    plain = _define(source, {"law": law, "slopes": slopes, "carray": lambda w, n: w}, law)
    # numba compiles it; a law that it cannot compile is called in Python, and so are all without numba
    if NUMBA:
        try:
            if not read:
                raise TypeError("it reads more than numbers, arrays and functions, which may change unseen")
            names = {"law": compiled_law(law), "slopes": None if slopes is None else compiled_law(slopes)}
            return code_of(plain, _define(source, {**names, "carray": None}, law, read), cache=cache)
        except TypeError as error:
            warn(
                f"{of.name} cannot be compiled and is called in Python, which is some hundred times slower: "
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


def _lines_before(of: FormulaLaw) -> list[str]:
    """Return the first lines of the function that writes the row of numbers."""
    lines = ["def evaluate(_d, _v, _d_start, _z_start, _p, _width, _w, _nw, _out):"]
    # arguments of the law: from the row of coefficients, or from the signals
    for name in of.arguments:
        where = "carray(_w, _nw)" if of.signals.get(name) == "w" else f"_{of.signals.get(name)}"
        lines.append(f"{name} = " + (f"_p[{of.row.index(name)}]" if name in of.row else where))
    return lines


def _slots(of: FormulaLaw) -> dict[str, tuple[int, int]]:
    """Return the places of the derivatives of force and inner state."""
    # signals first, then coefficients
    slots = {name: _SLOTS[of.signals[name]] for name in of.arguments if of.signals.get(name) in _SLOTS}
    return slots | {
        name: (9 + at, 13 + at) for at, name in enumerate(of.row) if name in of.arguments or of.scaled
    }


def _call(of: FormulaLaw, function: str = "law") -> str:
    given = ", ".join(f"{name}={name}" if name in of.by_name else name for name in of.arguments)
    return f"{function}({given})"


def _by_slopes(of: FormulaLaw) -> str:
    """Text of the function whose derivatives the law itself computes."""
    slots, pair = _slots(of), ("_f", "_z")[: 1 + of.inner_states]
    lines = [*_lines_before(of), f"{', '.join(pair)} = {_call(of, 'slopes')}"]
    for which, row in enumerate(pair):
        lines.append(f"_out[{5 * which}] = {row}[0]")
        for k, name in enumerate(of.arguments, 1):
            if name in slots:
                lines.append(f"_out[{slots[name][which]}] = {row}[{k}]")
    return "\n    ".join(lines)


def _by_differences(of: FormulaLaw) -> str:
    """Text of the function whose derivatives are central differences."""
    lines, slots, memory = _lines_before(of), _slots(of), of.inner_states > 0
    scale = "_p[0] * " if of.scaled else ""
    pair = "{0}f, {0}z" if memory else "{0}f"
    lines += [f"{pair.format('_')} = {_call(of)}", f"_out[0] = {scale}_f"]
    lines += ["_out[9] = _f"] * of.scaled + ["_out[5] = _z"] * memory

    def differences(name: str, by_f: str, by_z: str, indent: str = "") -> list[str]:
        # step of 1e-6 of the argument, central difference
        found = [f"_at, _h = {name}, 1e-6 * max(abs({name}), 1e-3)"]
        for side, sign in (("up", "+"), ("low", "-")):
            found += [f"{name} = _at {sign} _h", f"{pair.format(f'_{side}_')} = {_call(of)}"]
        found += [f"{name} = _at", f"_out[{by_f}] = {scale}(_up_f - _low_f) / (2.0 * _h)"]
        found += [f"_out[{by_z}] = (_up_z - _low_z) / (2.0 * _h)"] * (memory and by_z != "")
        return [indent + line for line in found]

    for name in of.arguments:
        if name in slots:
            lines += differences(name, *map(str, slots[name]))
        elif of.signals.get(name) == "w":
            lines += ["for _j in range(_nw):", *differences(f"{name}[_j]", f"{COUNT} + _j", "", "    ")]
    return "\n    ".join(lines)


def _exact(of: FormulaLaw) -> str:
    """Text of the function with exact derivatives.

    Raises
    ------
    Exception
        Whatever comes of a formula that cannot be traced.
    """
    # a symbol for each argument of the law
    tape, traced, slots = Tape(), tracing(of.law), _slots(of)
    given = {name: tape.symbol(f"a_{name}") for name in (*of.arguments, *slots)}
    placed = [given[name] for name in of.arguments if name not in of.by_name]
    symbols = [given[name] for name in slots]
    first, *read = _lines_before(of)
    read = [f"a_{line}" for line in read] + [f"a_{of.row[0]} = _p[0]"] * of.scaled

    def formula() -> list[Number]:
        found = as_numbers(traced(*placed, **{name: given[name] for name in of.by_name}))
        return [given[of.row[0]] * found[0]] if of.scaled else found

    # code of force and inner state, then of their derivatives by each argument
    def written(found: list[Number], done: set[int]) -> list[str]:
        if len(found) != 1 + of.inner_states:
            raise Untraceable(f"{len(found)} values")
        lines, entries = tape.code(found, done), []
        for which, one in enumerate(found):
            slopes = tape.derivatives(one, symbols)
            lines += tape.code(slopes, done)
            entries.append(f"_out[{5 * which}] = {tape.name(one)}")
            pairs = zip(slots.values(), slopes, strict=True)
            entries += [f"_out[{slot[which]}] = {tape.finite(slope, one)}" for slot, slope in pairs]
        return lines + entries

    return "\n    ".join([first, *read, *tape.branches(formula, written)])


def _of_text(source: str, of: FormulaLaw, cache: bool) -> tuple[int, Any]:
    """Code of the text of a traced law, checked against the law."""
    plain = in_python(lambda functions: _define(source, {"math": functions}, of.law))
    # safeguard against a wrong trace: compare with the formula
    if not _agrees(plain, of):
        raise Untraceable("the code gives other values than the formula")
    return code_of(plain, _define(source, {}, of.law), cache=cache)


def _agrees(plain: Callable[..., None], of: FormulaLaw) -> bool:
    """Return whether the code of a law agrees with its formula."""
    # random points
    points, agreed = np.random.default_rng(0).normal(size=(8, 2, MAX_COEFFICIENTS)), False
    for signals, numbers in points:
        point, row = dict(zip(_SLOTS, signals.tolist(), strict=True)), np.abs(numbers)
        given = {name: float(row[of.row.index(name)]) for name in of.arguments if name in of.row}
        given |= {n: point.get(of.signals[n], 1.0) for n in of.arguments if n not in given}
        placed = [given[name] for name in of.arguments if name not in of.by_name]
        out = np.zeros(COUNT)
        plain(*point.values(), row, 1.0, np.zeros(0), 0, out)
        try:
            expected = np.ravel(of.law(*placed, **{name: given[name] for name in of.by_name})).astype(float)
        except (ArithmeticError, ValueError):
            continue
        found = out[[9]] if of.scaled else out[[0, 5][: expected.size]]
        if not np.allclose(found, expected, rtol=1e-9, atol=1e-12, equal_nan=True):
            return False
        agreed = True
    return agreed


def _define(
    source: str, names: dict[str, Any], law: Callable[..., Any], key: bytes = b""
) -> Callable[..., None]:
    """Return the function that a source text defines.

    It is placed in the file of its law, so that numba caches it there. Numba's cache does not look at
    constants; so the function's name has a digest of its text and of `key`, all that it reads beside.
    """
    # line numbers of the law, so that error messages and caches point to it
    code = getattr(getattr(law, "py_func", law), "__code__", None)
    file, line = ("<law>", 1) if code is None else (code.co_filename, code.co_firstlineno)
    scope = {"math": math, **names}
    exec(compile("\n" * (line - 1) + source, file, "exec"), scope)
    function: Callable[..., None] = scope["evaluate"]
    function.__module__ = getattr(law, "__module__", __name__)
    digest = sha256(source.encode() + key).hexdigest()[:16]
    function.__qualname__ = f"{getattr(law, '__qualname__', 'law')}.evaluate_{digest}"
    return function


_ROW = ctypes.POINTER(ctypes.c_double)
_PROTOTYPE = ctypes.CFUNCTYPE(None, *[ctypes.c_double] * 4, _ROW, ctypes.c_double, _ROW, ctypes.c_int64, _ROW)


def _callback(plain: Callable[..., None]) -> tuple[int, Any]:
    """Return the code of a law that is called in Python.

    Its exceptions are stored, and `raise_pending` raises them.
    """

    def call(*given: Any) -> None:
        *taken, w, n, out = given
        try:
            plain(*taken, np.array([w[j] for j in range(n)]), n, out)
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
        # before the first sample the signal stood at its first value
        lasts = _FOREVER if k < settled else step
        evaluate(code, signal[k], held, last, z, values, 0, lasts, nothing, out)
        value[k] = out[0, 0]
        # derivatives by the coefficients, carried on through the inner state
        for c in range(own.shape[0]):
            own[c, k] = out[0, 9 + c] + out[0, 4] * own_z[c]
            own_z[c] = out[0, 13 + c] + out[0, 8] * own_z[c]
        # chain rule: by the signal now, the signal before and the inner state
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
        # derivative by a coefficient: the force per unit of it
        for c in range(found.shape[0]):
            found[c, k] = out[0, 9 + c]
