"""The structure as a `control.NonlinearIOSystem`, for simulation by python-control."""

from __future__ import annotations

from typing import Any

import control as ct
import numpy as np

from ..effects.kernel import evaluate_law
from ..effects.law import InputLaw, OutputLaw
from ..exceptions import ModelError
from ..systems.linear import Array
from .engine import _custom
from .structure import Structure

__all__ = ["nonlinear_system"]


def nonlinear_system(structure: Structure, theta: Array, name: str | None = None) -> ct.NonlinearIOSystem:
    """Continuous-time nonlinear system of a structure.

    Parameters
    ----------
    structure : Structure
        Model and effects.
    theta : ndarray, shape (p,)
        Coefficients.
    name : str, optional
        Name of the system.

    Returns
    -------
    NonlinearIOSystem
        States of the linear part, then one per law with memory.

    Raises
    ------
    ModelError
        If an input or output delay is among the effects: a delay has no finite state.

    Notes
    -----
    `control.input_output_response` interpolates inputs linearly: it agrees with
    rcorefine for records with ``hold="foh"``.
    """
    delays = [e.label for e in structure.effects if e.spec.delays]
    if delays:
        raise ModelError(
            f"{delays[0]} has no state equation; simulate with Refinement.simulate, or replace the delay "
            "by control.pade"
        )
    matrices = structure.matrices(theta.astype(float))
    codes, values, _, widths = structure.laws(theta)
    laws = [structure.effects[index].spec for index in structure.port_effects]
    memory = [i for i, law in enumerate(laws) if law.inner_states]
    customs = structure.custom_laws
    evaluate: Any = evaluate_law
    n, m = structure.n_states, structure.n_ports

    def force(i: int, d: float, v: float, z: float) -> float:
        if codes[i] < 0:
            law, names = customs[-codes[i] - 1]
            return float(_custom(law, len(names), d, v, tuple(values[i]))[0])
        if laws[i].inner_states:
            return float(values[i, 0] * z)
        return float(evaluate(codes[i], d, v, d, z, *values[i], widths[i])[0])

    def drive(u: Any) -> Array:
        w = np.append(np.atleast_1d(np.asarray(u, dtype=float)), 1.0)
        for index, channel in structure.input_statics:
            effect = structure.effects[index]
            level = structure.value(theta, index, effect.coefficients[0])
            assert isinstance(effect.spec, InputLaw)
            w[channel] = effect.spec.through(w[channel], level)[0]
        return w

    def forces(x: Array, w: Array) -> tuple[Array, Array]:
        sense = matrices.P @ np.concatenate([x[:n], w])
        inner = dict(zip(memory, x[n:], strict=True))
        return np.array([force(i, sense[i], sense[m + i], inner.get(i, 0.0)) for i in range(m)]), sense

    def update(t: float, x: Any, u: Any, params: Any) -> Array:
        x, w = np.asarray(x, dtype=float), drive(u)
        f, sense = forces(x, w)
        rate = matrices.A @ x[:n] + matrices.B @ w + matrices.E @ f
        inner = []
        for j, i in enumerate(memory):
            speed = sense[m + i]
            inner.append((speed - abs(speed) * x[n + j]) / values[i, 1])
        return np.concatenate([rate, inner])

    def output(t: float, x: Any, u: Any, params: Any) -> Array:
        x, w = np.asarray(x, dtype=float), drive(u)
        f, _ = forces(x, w)
        y = matrices.C @ x[:n] + matrices.D @ w + matrices.G @ f
        for index, channel, _ in structure.output_statics:
            effect = structure.effects[index]
            assert isinstance(effect.spec, OutputLaw)
            y[channel] = effect.spec.through(
                y[channel], structure.value(theta, index, effect.coefficients[0])
            )
        return np.asarray(y)

    linear = structure.linear_model
    labels = structure.state_labels() + [f"memory{j + 1}" for j in range(len(memory))]
    return ct.nlsys(
        update,
        output,
        inputs=list(linear.input_labels),
        outputs=list(linear.output_labels),
        states=labels,
        name=name or linear.name,
    )
