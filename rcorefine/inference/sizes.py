"""Natural sizes of coefficients.

They make every tolerance independent of the units of a record.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..data.measurement import Measurement
from ..engine.structure import Structure
from ..systems.linear import Array

__all__ = ["natural_sizes"]


def natural_sizes(structure: Structure, records: Sequence[Measurement]) -> Array:
    """Return the natural size of each coefficient.

    This is the value that counts as one, whatever the unit.

    Parameters
    ----------
    structure : Structure
        Model with effects.
    records : sequence of Measurement
        Records, for the levels of the signals.

    Returns
    -------
    ndarray, shape (p,)
        The force that makes a unit rate at a port, the level of a signal for an offset or a
        limit of it, else 1 (seconds, ratios, states).
    """
    model = structure.model
    levels = {
        label: float(np.sqrt(np.mean(np.concatenate([r[i] for r in rows]) ** 2))) or 1.0
        for labels, rows in (
            (structure.linear_model.input_labels, [r.inputs for r in records]),
            (structure.linear_model.output_labels, [r.outputs for r in records]),
        )
        for i, label in enumerate(labels)
    }
    pushes = {port.name: float(np.abs(port.act).max(initial=0.0)) for port in model.ports}
    sizes = np.ones(structure.n_parameters)
    for i, parameter in enumerate(structure.parameters):
        effect = structure.effects[parameter.effect]
        units = {coefficient.name: coefficient.unit_rule for coefficient in effect.spec.coefficients}
        unit = units.get(parameter.name, "")
        if unit == "signal":
            sizes[i] = levels.get(effect.place, 1.0)
        elif unit.startswith("force") and pushes.get(effect.place):
            sizes[i] = 1.0 / pushes[effect.place]
    return sizes
