"""One more sensor: where it could sit, and the model that has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import control as ct
import numpy as np

from ...models.physical_model import PhysicalModel
from ...systems.linear import Array

__all__ = ["sensor_rows", "with_sensor"]


def with_sensor(model: PhysicalModel, label: str, row: Array) -> PhysicalModel:
    """The model with one output more, which reads states.

    Parameters
    ----------
    model : PhysicalModel
        Model.
    label : str
        Name of the new output; it must not be one of the model's.
    row : ndarray, shape (n,)
        What it reads.

    Returns
    -------
    PhysicalModel
    """
    linear = model.linear
    blank = np.zeros((1, linear.n_inputs))
    state = int(np.flatnonzero(row)[0])
    unit = model.state_units[state] if model.state_units and np.count_nonzero(row) == 1 else ""
    units = (*model.output_units, unit) if model.output_units else ()
    C, D = np.vstack([linear.C, row]), np.vstack([linear.D, blank])
    return replace(
        model,
        linear=linear.with_arrays(C=C, D=D, output_labels=(*linear.output_labels, label)),
        output_state=np.vstack([model.output_state, row]),
        output_rate=np.vstack([model.output_rate, np.zeros_like(row)[None]]),
        output_input=np.vstack([model.output_input, blank]),
        output_units=units,
    )


def sensor_rows(model: PhysicalModel, names: Sequence[str] | None = None) -> list[tuple[str, str, Array]]:
    """Sensors that a model lacks.

    Parameters
    ----------
    model : PhysicalModel
        Model.
    names : sequence of str, optional
        States or ports (their displacement, or their velocity where they have none). By
        default every state that no output reads: displacements where the present sensors
        read displacements, velocities otherwise, and every first-order state.

    Returns
    -------
    list of (str, str, ndarray of shape (n,))
        Name of the place, label of the new output, row.
    """
    states = model.linear.state_labels
    found = []
    for name in _unread(model) if names is None else names:
        if name in states:
            row = np.eye(len(states))[states.index(name)]
        else:
            known = [port.name for port in model.ports]
            if name not in known:
                raise ct.ControlArgument(
                    f"sensors names {name!r}; there are the states {', '.join(states)} and the ports "
                    f"{', '.join(known)}"
                )
            port = model.port(name)
            row = np.array(port.position if port.has_position else port.velocity)
        label = name
        while label in model.linear.output_labels:
            label += "_sensor"
        found.append((name, label, row))
    return found


def _unread(model: PhysicalModel) -> list[str]:
    """Return the states that are worth a sensor.

    No output reads them yet, and they are of the kind that the present sensors measure.
    """
    mechanical = [port for port in model.ports if port.kind == "mechanical"]
    n = model.linear.n_states
    places, rates = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    for port in mechanical:
        places |= np.asarray(port.position) != 0
        rates |= np.asarray(port.velocity) != 0
    rates &= ~places
    reads = model.output_state != 0
    alone = [int(np.flatnonzero(row)[0]) for row in reads if np.count_nonzero(row) == 1]
    wanted = ~(places | rates)  # first-order states
    wanted |= places if (reads & places).any() else rates
    return [model.linear.state_labels[i] for i in np.flatnonzero(wanted) if i not in alone]
