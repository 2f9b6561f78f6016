"""Natural sizes of coefficients, so that no tolerance depends on the units of a record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data.measurement import Measurement
from ..engine.structure import Structure
from ..models.units import parse_unit
from ..systems.linear import Array

__all__ = ["natural_sizes"]


def natural_sizes(structure: Structure, records: Sequence[Measurement]) -> Array:
    """What counts as one in each coefficient, whatever its units.

    Parameters
    ----------
    structure : Structure
        Model with effects.
    records : sequence of Measurement
        Records, for the levels of the signals.

    Returns
    -------
    ndarray, shape (p,)
        Products of the unit of the coefficient: the level of a signal, the period of the fastest mode
        over 2 pi for a time, the force that moves a port by one within it; else 1 (ratios, states).
    """
    linear = structure.linear_model
    levels = {
        label: float(np.sqrt(np.mean(np.concatenate([r[i] for r in rows]) ** 2))) or 1.0
        for labels, rows in (
            (linear.input_labels, [r.inputs for r in records]),
            (linear.output_labels, [r.outputs for r in records]),
        )
        for i, label in enumerate(labels)
    }
    ports = {port.name: port for port in structure.model.ports}
    rate = float(np.abs(np.linalg.eigvals(linear.A)).max(initial=0.0)) or 1.0
    sizes = np.ones(structure.n_parameters)
    for i, parameter in enumerate(structure.parameters):
        effect = structure.effects[parameter.effect]
        units = {coefficient.name: coefficient.unit_rule for coefficient in effect.spec.coefficients}
        one = {"s": 1.0 / rate, "signal": levels.get(effect.place, 1.0)}
        if (port := ports.get(effect.place)) is not None and port.act.any():
            one["velocity"] = 1.0 if port.kind == "first_order" else rate
            one["force"] = one["velocity"] * rate / float(np.abs(port.act).max())
        powers = parse_unit(units.get(parameter.name, ""))
        sizes[i] = np.prod([one.get(name, 1.0) ** power for name, power in powers.items()])
    return sizes
