"""Equations of a refined model, independent of any language.

They consist of matrices, and of functions for the force laws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..arguments import Array
from ..exceptions import ModelError

if TYPE_CHECKING:
    from ..engine.structure import Structure


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


#: Signals that the formula of a law takes, by what they are called in the equations.
_AT_PLACE = {"d": "d", "v": "v", "d_start": "d", "z_start": "z"}
_AT_CHANNEL = dict.fromkeys("s w w_start y y_start".split(), "s")


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
    structure = structure.with_equations("an export")
    linear, matrices = structure.linear_model, structure.matrices(theta.astype(float))
    _, _, _, widths = structure.laws(theta)

    def term(index: int, channel: int, signals: dict[str, str], width: float = 1.0) -> Term:
        effect, law = structure.effects[index], law_of(index)
        if law.feels_inputs:
            raise ModelError(
                f"{effect.label}: its formula takes the array of inputs; it has no other language"
            )
        values = dict(zip(law.row, structure.law_values(theta, index), strict=True))
        taken: dict[str, Any] = values | {"width": float(width)} | signals
        scale = values[law.row[0]] if law.scaled else 1.0
        given: tuple[tuple[str, Any], ...] = tuple((name, taken[name]) for name in law.arguments)
        return Term(effect.label, law.law, given, channel, scale, law.inner_states > 0)

    def law_of(index: int) -> Any:  # with state equations each is a formula
        return structure.effects[index].spec

    ports, rates = [], []
    for channel, index in enumerate(structure.port_effects):
        ports.append(term(index, channel, _AT_PLACE, float(widths[channel])))
        law = law_of(index)
        if law.inner_states and law.rate is not None:
            found = structure.law_values(theta, index)[: len(law.coefficients)]
            given: tuple[tuple[str, Any], ...]
            given = (*((key, key) for key in "dvz"), *zip(law.coefficient_names, found, strict=True))
            rates.append(Term(structure.effects[index].label, law.rate, given, channel))
    A, B, C, D, E, G, P = (getattr(matrices, key) for key in "ABCDEGP")
    return Equations(
        A, B, C, D, E, G, P,
        tuple(ports),
        tuple(term(index, channel, _AT_CHANNEL) for index, channel in structure.input_statics),
        tuple(term(index, channel, _AT_CHANNEL) for index, channel in structure.output_statics),
        tuple(rates),
        tuple(linear.input_labels),
        tuple(linear.output_labels),
        (*structure.state_labels(), *(f"memory{j + 1}" for j in range(len(rates)))),
        linear.name,
        tuple(remarks),
    )  # fmt: skip
