"""Equations as a program in another language.

The lines are the same, in the syntax of each language.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from os import PathLike
from typing import TYPE_CHECKING, Any

from ..arguments import Array, as_path, printable
from ..writing import replacing
from .equations import Equations, Term, equations_of
from .functions import translated, word

if TYPE_CHECKING:
    from ..engine.structure import Structure


_Lines = list[tuple[str, str]]


def _sum(coefficients: Iterable[float], names: list[str]) -> str:
    """Sum of products, zeros left out."""
    terms = [f"({float(c)!r}) * {name}" for c, name in zip(coefficients, names, strict=True) if c != 0.0]
    return " + ".join(terms) or "0.0"


def _lines(e: Equations, at: Callable[[str, int], str]) -> tuple[_Lines, list[str], list[str]]:
    """Return the shared lines, the state derivatives, and the outputs.

    State derivatives and outputs need the shared lines. `at` writes an entry of x or u.
    """
    n, m, n_w = len(e.A), len(e.ports), len(e.input_labels)
    order = [*e.ports, *e.inputs, *e.outputs, *e.rates]

    def call(term: Term, signals: dict[str, str]) -> str:
        given = (
            signals[value] if isinstance(value, str) else repr(float(value)) for _, value in term.arguments
        )
        scale = "" if term.scale == 1.0 else f"({term.scale!r}) * "
        return f"{scale}law{order.index(term) + 1}({', '.join(given)})"

    drive = [at("u", i) for i in range(n_w)]
    common: _Lines = []
    for term in e.inputs:
        name = f"w{term.channel + 1}"
        common.append((f"{name}_{len(common) + 1}", call(term, {"s": drive[term.channel]})))
        drive[term.channel] = common[-1][0]
    states = [at("x", i) for i in range(n)]
    memory = {term.channel: at("x", n + j) for j, term in enumerate(e.rates)}
    known = [*states, *drive, "1.0"]
    places = []
    for i, term in enumerate(e.ports):
        places.append({"d": f"d{i + 1}", "v": f"v{i + 1}", "z": memory.get(i, "0.0")})
        common += [(places[i]["d"], _sum(e.P[i], known)), (places[i]["v"], _sum(e.P[m + i], known))]
        common.append((f"f{i + 1}", call(term, places[i])))
    forces = [f"f{i + 1}" for i in range(m)]
    rates = [_sum([*a, *b, *f], [*known, *forces]) for a, b, f in zip(e.A, e.B, e.E, strict=True)] + [
        call(term, places[term.channel]) for term in e.rates
    ]
    outputs = [_sum([*c, *d, *g], [*known, *forces]) for c, d, g in zip(e.C, e.D, e.G, strict=True)]
    for term in e.outputs:
        outputs[term.channel] = call(term, {"s": f"({outputs[term.channel]})"})
    return common, rates, outputs


def _laws(e: Equations, language: str) -> list[str]:
    terms = [*e.ports, *e.inputs, *e.outputs, *e.rates]
    return [
        translated(term.function, f"law{k + 1}", language, term.label, term.pair, dict(term.arguments))
        for k, term in enumerate(terms)
    ]


def _head(e: Equations, mark: str) -> list[str]:
    """Return the comments at the head of a program.

    They name the model, the estimates with their errors, and the signal of each entry.
    """
    listed = [
        f"{what}: {', '.join(f'{name} ({k + 1})' for k, name in enumerate(names))}"
        for what, names in (
            ("inputs u", e.input_labels),
            ("outputs y", e.output_labels),
            ("states x", e.state_labels),
        )
    ]
    lines = [f"Model {e.name}, refined on a measured record by rcorefine.", *e.remarks, *listed]
    return [f"{mark} {printable(line)}" for line in lines]


def _identifier(e: Equations, language: str) -> str:
    name = re.sub(r"[^A-Za-z0-9_]", "_", e.name)
    return word(name if re.match(r"[A-Za-z]", name) else f"model_{name}", language)


def _python(e: Equations) -> str:
    common, rates, outputs = _lines(e, lambda name, i: f"{name}[{i}]")
    shared = [f"    {name} = {value}" for name, value in common]
    laws = [line for law in _laws(e, "Python") for line in (law, "", "")]
    labels = {
        "inputs": list(e.input_labels),
        "outputs": list(e.output_labels),
        "states": list(e.state_labels),
        "name": e.name,
    }
    body = []
    for which, values in (("update", rates), ("output", outputs)):
        body += [f"def {which}(t, x, u, params):", *shared, "    return np.array(["]
        body += [*(f"        {value}," for value in values), "    ])", "", ""]
    named = [*(f"    {key}={value!r}," for key, value in labels.items()), ")"]
    body += ["system = ct.nlsys(", "    update,", "    output,", *named]
    needs = ["import math", ""] if "math." in "\n".join(laws) else []
    linear = []
    if not (laws or e.B[:, -1].any() or e.D[:, -1].any()):
        linear = ["", "# the same as matrices", "linear = ct.ss("]
        linear += [f"    {M.tolist()!r}," for M in (e.A, e.B[:, :-1], e.C, e.D[:, :-1])]
        linear += named
    return "\n".join(
        [
            *_head(e, "#"),
            *needs,
            "import control as ct",
            "import numpy as np",
            "",
            "",
            *laws,
            *body,
            *linear,
            "",
        ]
    )


def _c(e: Equations) -> str:
    name = _identifier(e, "C")
    common, rates, outputs = _lines(e, lambda name, i: f"{name}[{i}]")
    shared = [f"    const double {key} = {value};" for key, value in common]
    shared += [f"    (void){key};" for key in ("t", "x", "u", *(key for key, _ in common))]
    functions = []
    for which, target, values in (("rhs", "dx", rates), ("output", "y", outputs)):
        functions += [
            f"void {name}_{which}(double t, const double x[], const double u[], double {target}[])",
            "{", *shared, *(f"    {target}[{i}] = {value};" for i, value in enumerate(values)), "}", "",
        ]  # fmt: skip
    sizes = {"STATES": len(rates), "INPUTS": len(e.input_labels), "OUTPUTS": len(outputs)}
    enum = ", ".join(f"{name.upper()}_{key} = {size}" for key, size in sizes.items())
    laws = [line for law in _laws(e, "C") for line in (law, "")]
    return "\n".join([*_head(e, "//"), "#include <math.h>", "", f"enum {{ {enum} }};", "", *laws, *functions])


def _matlab(e: Equations) -> str:
    name = _identifier(e, "MATLAB")
    common, rates, outputs = _lines(e, lambda name, i: f"{name}({i + 1})")
    lines = [
        f"function [dx, y] = {name}(t, x, u)", *_head(e, "%"),
        f"% [t, x] = ode45(@(t, x) {name}(t, x, u(t)), [0 10], zeros({len(rates)}, 1));",
        *(f"{key} = {value};" for key, value in common),
        f"dx = zeros({len(rates)}, 1);", *(f"dx({i + 1}) = {value};" for i, value in enumerate(rates)),
        f"y = zeros({len(outputs)}, 1);", *(f"y({i + 1}) = {value};" for i, value in enumerate(outputs)),
        "end", "", *(line for law in _laws(e, "MATLAB") for line in (law, "")),
        "function result = pick(test, yes, no)",
        "if test", "    result = yes;", "else", "    result = no;", "end", "end", "",
        "function result = flip(size, sign)", "result = abs(size) * (1 - 2 * (sign < 0));", "end", "",
    ]  # fmt: skip
    return "\n".join(lines)


PROGRAMS: dict[str, Callable[[Equations], str]] = {
    "Python": _python,
    "C": _c,
    "MATLAB": _matlab,
}


class CodeExports:
    """Methods of `Refinement` that give its code."""

    __slots__ = ()

    if TYPE_CHECKING:
        parameters: tuple[Any, ...]

        def simulation_structure(self) -> tuple[Structure, Array, int]: ...  # noqa: D102

    def to_python(self, path: str | PathLike[str] | None = None) -> str:
        """Write the refined model as a file that python-control alone runs.

        Parameters
        ----------
        path : str or path, optional
            File to write.

        Returns
        -------
        str
            The code: `system`, a `control.NonlinearIOSystem` with every
            effect (and `linear`, a `control.StateSpace`, where all are
            linear); the estimates with their standard deviations stand in
            comments.

        Raises
        ------
        ModelError
            If an effect has no state equation (a delay: use `control.pade`), or the source of
            a law is not to be had.

        Notes
        -----
        It starts at rest unless told otherwise, as `control.input_output_response` does, which runs
        inputs along straight lines between samples.

        Examples
        --------
        >>> model, w = rco.mass_spring_damper(1.0, 0.8, 25.0), np.sin(0.3 * np.arange(200.0))
        >>> data = rco.Measurement(w, ct.forced_response(model.system.sample(0.05), U=w).outputs, dt=0.05)
        >>> better = rco.refine(model, data, [rco.Effect("stiffness", "link1")], offset=False)
        >>> space = {}
        >>> exec(better.to_python(), space)
        >>> bool(np.allclose(space["linear"].A, better.system.A))
        True
        """
        return self._program("Python", path)

    def to_c(self, path: str | PathLike[str] | None = None) -> str:
        """Write the refined model as functions in C99.

        Parameters
        ----------
        path : str or path, optional
            File to write.

        Returns
        -------
        str
            Functions ``NAME_rhs(t, x, u, dx)`` and ``NAME_output(t, x, u, y)``, sizes in an enumeration;
            the estimates with their standard deviations stand in comments.

        Raises
        ------
        ModelError
            As `to_python`, or a law holds what has no words in C here (it is named).

        Examples
        --------
        >>> model, w = rco.mass_spring_damper(1.0, 0.8, 25.0), np.sin(0.3 * np.arange(200.0))
        >>> data = rco.Measurement(w, ct.forced_response(model.system.sample(0.05), U=w).outputs, dt=0.05)
        >>> better = rco.refine(model, data, [rco.Effect("stiffness", "link1")], offset=False)
        >>> "void chain_rhs(double t" in better.to_c()
        True
        """
        return self._program("C", path)

    def to_matlab(self, path: str | PathLike[str] | None = None) -> str:
        """Write the refined model as a function of MATLAB or Octave.

        Parameters
        ----------
        path : str or path, optional
            File to write; MATLAB wants it to have the name of the function.

        Returns
        -------
        str
            Function ``[dx, y] = NAME(t, x, u)`` for `ode45`; the estimates with their standard deviations
            stand in comments.

        Raises
        ------
        ModelError
            As `to_c`.

        Examples
        --------
        >>> model, w = rco.mass_spring_damper(1.0, 0.8, 25.0), np.sin(0.3 * np.arange(200.0))
        >>> data = rco.Measurement(w, ct.forced_response(model.system.sample(0.05), U=w).outputs, dt=0.05)
        >>> better = rco.refine(model, data, [rco.Effect("stiffness", "link1")], offset=False)
        >>> better.to_matlab().splitlines()[0]
        'function [dx, y] = chain(t, x, u)'
        """
        return self._program("MATLAB", path)

    def _program(self, language: str, path: str | PathLike[str] | None) -> str:
        target = None if path is None else as_path(path)
        structure, theta, _ = self.simulation_structure()
        remarks = [
            f"{row.name} at {row.place}: {row.value:.6g} +- {row.std:.2g} {row.unit}".rstrip()
            + (f" (was {row.initial:.6g})" if row.initial else "")
            for row in self.parameters
        ]
        text = PROGRAMS[language](equations_of(structure, theta, remarks))
        if target is not None:
            with replacing(target) as stream:
                stream.write(text.encode())
        return text
