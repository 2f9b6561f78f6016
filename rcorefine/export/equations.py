"""Equations of a refined model, independent of any language.

They consist of matrices, and of functions for the force laws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ..effects.formula import FormulaLaw
from ..engine.controlled import open_loop
from ..engine.nonlinear import nonlinear_system
from ..engine.structure import Structure
from ..exceptions import ModelError
from ..models.operating_point import refuse_point
from ..systems.linear import Array


@dataclass(frozen=True, slots=True)
class Term:
    """One use of a law.

    Parameters
    ----------
    label : str
        The effect, for comments.
    function : callable
        Formula in Python.
    arguments : tuple of (str, object)
        What it takes: the name of a signal (``"d"``, ``"v"``, ``"z"``, ``"s"``: the signal of a
        channel) or a number.
    channel : int
        Of its port, input or output.
    scale : float
        Factor of what the formula returns.
    pair : bool
        Whether it returns its inner state too.
    """

    label: str
    function: Callable[..., Any]
    arguments: tuple[tuple[str, str | float], ...]
    channel: int
    scale: float = 1.0
    pair: bool = False


@dataclass(frozen=True, slots=True)
class Equations:
    """State equations of a refined model with its nonlinear forces.

    They are dx = A x + B [w; 1] + E f, y = C x + D [w; 1] + G f, with f at places that sense P [x; w; 1].
    `ports`, `inputs` and `outputs` hold the terms at places, before the inputs and behind the outputs;
    `rates` holds those of inner states, at the place `channel`.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    E: Array
    G: Array
    P: Array
    ports: tuple[Term, ...]
    inputs: tuple[Term, ...]
    outputs: tuple[Term, ...]
    rates: tuple[Term, ...]
    input_labels: tuple[str, ...]
    output_labels: tuple[str, ...]
    state_labels: tuple[str, ...]
    name: str
    remarks: tuple[str, ...]


def equations_of(structure: Structure, theta: Array, remarks: Sequence[str]) -> Equations:
    """Equations of a model with its effects.

    Parameters
    ----------
    structure : Structure
        Model and effects.
    theta : ndarray, shape (p,)
        Coefficients.
    remarks : sequence of str
        Lines for the head of the code.

    Returns
    -------
    Equations

    Raises
    ------
    ModelError
        If an effect has no state equation (a delay, a memory without `rate`).
    """
    structure = open_loop(structure)
    refuse_point(structure.model, "an export")
    nonlinear_system(structure, theta)  # refuses what has no state equation
    linear, matrices = structure.linear_model, structure.matrices(theta.astype(float))
    _, _, _, widths = structure.laws(theta)
    places = {"d": "d", "v": "v", "d_start": "d", "z_start": "z"}

    def term(index: int, channel: int, signals: dict[str, str], width: float = 1.0) -> Term:
        effect, law = structure.effects[index], structure.effects[index].spec
        assert isinstance(law, FormulaLaw)
        values: dict[str, Any] = dict(zip(law.row, structure.law_values(theta, index), strict=True))
        taken: dict[str, Any] = values | {"width": float(width)} | signals
        if law.feels_inputs:
            raise ModelError(
                f"{effect.label}: its formula takes the array of inputs; it has no other language"
            )
        given: tuple[tuple[str, Any], ...] = tuple((name, taken[name]) for name in law.arguments)
        scale = values[law.row[0]] if law.scaled else 1.0
        return Term(effect.label, law.law, given, channel, scale, law.inner_states > 0)

    ports, rates = [], []
    for channel, index in enumerate(structure.port_effects):
        ports.append(term(index, channel, places, float(widths[channel])))
        law = structure.effects[index].spec
        if isinstance(law, FormulaLaw) and law.inner_states and law.rate is not None:
            found = structure.law_values(theta, index)[: len(law.coefficients)]
            given: tuple[tuple[str, Any], ...] = (
                ("d", "d"),
                ("v", "v"),
                ("z", "z"),
                *zip(law.coefficient_names, found, strict=True),
            )
            rates.append(Term(structure.effects[index].label, law.rate, given, channel))
    held = {name: "s" for name in ("w", "w_start", "y", "y_start")}
    A, B, C, D, E, G, P = (getattr(matrices, key) for key in "ABCDEGP")
    return Equations(
        A, B, C, D, E, G, P,
        tuple(ports),
        tuple(term(index, channel, held) for index, channel in structure.input_statics),
        tuple(term(index, channel, held) for index, channel in structure.output_statics),
        tuple(rates),
        tuple(linear.input_labels),
        tuple(linear.output_labels),
        (*structure.state_labels(), *(f"memory{j + 1}" for j in range(len(rates)))),
        linear.name,
        tuple(remarks),
    )  # fmt: skip
