"""Continuous-time matrices of a model in feedback with effects.

Linear effects are absorbed exactly into A, B, C, D; the others act as forces at their places. Every entry is
an analytic function of the coefficients, so that a complex step gives exact derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..effects.law import AbsorbedLaw, Assembly, Site
from .point import act_scales, tangents

if TYPE_CHECKING:
    from .structure import Structure


@dataclass(frozen=True, slots=True, eq=False)
class Matrices:
    """Continuous-time matrices at one point, or stacked for several.

    A constant one drives the last column of B and D.
    """

    A: NDArray[Any]
    B: NDArray[Any]
    E: NDArray[Any]
    C: NDArray[Any]
    D: NDArray[Any]
    G: NDArray[Any]
    P: NDArray[Any]

    def __getitem__(self, which: int) -> Matrices:
        """One of a stack."""
        return Matrices(*(getattr(self, name)[which] for name in ("A", "B", "E", "C", "D", "G", "P")))


def site_of(structure: Structure, index: int) -> Site:
    """Return the site of an absorbed effect.

    It holds the rows, the channel or the matrix entry at which the effect acts.
    """
    effect, base, n = structure.effects[index], structure.linear_model, structure.n_states
    where = effect.spec.where
    rows, inputs = np.zeros((3, n)), [np.zeros(structure.n_inputs)] * 3
    channel, entry, output = -1, (0, 0), np.zeros(0)
    if "input" in where:
        channel = base.input_labels.index(effect.place)
    elif "output" in where:
        channel = base.output_labels.index(effect.place)
    elif "any" in where:
        entry = entry_among(structure, effect.place)
    else:
        # port: column of its force, rows of its displacement and velocity; zero for added states
        port = structure.model.port(effect.place)
        rows[:, : base.n_states] = port.act, port.position, port.velocity
        inputs = [port.position_input, port.velocity_input, port.acceleration_input]
        output = port.output
    added = enumerate(structure.added_states, structure.loop.stop)
    state = next((state for state, (owner, _) in added if owner == index), -1)
    (act, position, velocity), (d_w, v_w, a_w) = rows, inputs
    return Site(act, position, velocity, d_w, v_w, a_w, channel, entry, state, output)


def entry_among(structure: Structure, place: str) -> tuple[int, int]:
    """Return row and column of an entry of [A B; C D] with all effects.

    The effects may add states.
    """
    row, column = structure.model.entry(place)
    own = structure.linear_model.n_states
    more = structure.n_states - own
    return row + more * (row >= own), column + more * (column >= own)


def continuous_matrices(structure: Structure, points: NDArray[Any]) -> Matrices:
    """Return the matrices at several points, stacked along the first axis.

    `points`, shape (k, p), are real, or complex for derivatives.
    """
    model, n, nw, ny = structure.model, structure.n_states, structure.n_inputs, structure.n_outputs
    n0, field = structure.linear_model.n_states, structure.field
    scales = [act_scales(structure, theta) for theta in points]
    # linear effects go into A and B; the other forces enter by E and sense by P
    into = _stack([_assemble(structure, *at) for at in zip(points, scales, strict=True)])
    E, P = _ports(structure, into.A.dtype, scales)
    if field is not None:  # rows of the field act on the states, then on the outputs
        own = np.eye(n, n0 + ny)[:, field.rows]
        E = np.concatenate([E, np.repeat(own[None], len(E), axis=0)], axis=2)
        E[:, n0:] = 0.0
    Ux, lag_drive = _input_lags(into)

    # divide by the masses; lagged inputs are states
    A, Bu, constant = into.A, into.Bu, into.constant
    if structure.has_mass:
        whole = np.concatenate([A, Bu, E, constant[:, :, None]], axis=2)
        solved = np.linalg.solve(into.inertia, whole)
        A, Bu, E, constant = (
            solved[:, :, :n], solved[:, :, n : n + nw], solved[:, :, n + nw : -1], solved[:, :, -1],
        )  # fmt: skip
    # inputs after gains and lags: u = Uw w + Ux x
    B = Bu @ into.Uw
    B[:, :, nw] += constant
    A = A + Bu @ Ux
    for state, drive in lag_drive:
        B[:, state] += drive

    # outputs read states, rates of states (accelerometers) and inputs; lags and gains of the sensors follow
    Co, Cr, offset, Ca = _sensors(structure, into)
    C, D, G = Co + Cr @ Ux + Ca @ A, Cr @ into.Uw + Ca @ B, Ca @ E
    D[:, :, nw] += offset
    # forces that an output reads at once (accelerometers, force sensors)
    for j, index in enumerate(structure.port_effects):
        output = model.port(structure.effects[index].place).output
        G[:, : output.size, j] += output
    if field is not None:
        G[:, :, structure.n_ports :] += np.eye(ny, n0 + ny, n0)[:, field.rows]
    # lag at an output: its state obeys dy/dt = (C x + D w + G f - y) / lag
    for i, state, lag in into.output_lags:
        A[:, state] = C[:, i] / lag[:, None]
        A[:, state, state] -= 1.0 / lag
        B[:, state] = D[:, i] / lag[:, None]
        E[:, state] = G[:, i] / lag[:, None]
        C[:, i], D[:, i], G[:, i] = 0.0, 0.0, 0.0
        C[:, i, state] = 1.0
    # gain and offset of the sensors
    C, D, G = (rows * into.output_gain[:, :, None] for rows in (C, D, G))
    D[:, :, nw] += into.output_offset
    # what the places feel, by [x; w; 1]
    sense = np.concatenate([P[:, :n] + P[:, n:] @ Ux, P[:, n:] @ into.Uw], axis=2)
    # laws that take the flow into a store in place of a displacement
    for j in filter(structure.fills, range(structure.n_ports)):
        velocity = P[structure.n_ports + j, :n]
        sense[:, j] = velocity @ np.concatenate([A, B], axis=2) / -(E[:, :, j] @ velocity)[:, None]
    A, B, E = (into.pace[:, None, None] * part for part in (A, B, E))
    if model.operating_point is not None:
        _make_absolute(structure, points, into.output_gain, P, Matrices(A, B, E, C, D, G, sense))
    if field is not None:  # the field takes the states and the inputs after gains and lags
        states = np.repeat(np.eye(n0, n + nw + 1)[None], len(E), axis=0)
        taken = np.concatenate([states, np.concatenate([Ux, into.Uw], axis=2)], axis=1)
        sense = np.concatenate([sense, taken[:, field.signals]], axis=1)
    controller = model.controller
    if controller is not None:  # the commands of the controller are its last states
        held = slice(structure.loop.stop - len(controller.driven), structure.loop.stop)
        driven = np.array(controller.driven)
        A[:, :, held] += B[:, :, driven]
        C[:, :, held] += D[:, :, driven]
        sense[:, :, held] += sense[:, :, n + driven]
    return Matrices(A, B, E, C, D, G, sense)


def _make_absolute(
    structure: Structure, points: NDArray[Any], gain: NDArray[Any], P: NDArray[Any], at: Matrices
) -> None:
    """Make the signals of sensors and places absolute.

    States and inputs are still deviations from the operating point. The force of an effect at the point and
    its tangent there are in the model already: both are subtracted.
    """
    point, n, nw = structure.model.operating_point, structure.n_states, structure.n_inputs
    n0, m = structure.linear_model.n_states, structure.n_ports
    assert point is not None
    rest = np.array([tangents(structure, theta) for theta in points])[:, :, :, None]
    # force at the point and tangent of each law, by [x; w; 1]: subtract E and G times them
    known = rest[:, :, 1] * at.P[:, :m] + rest[:, :, 2] * at.P[:, m : 2 * m]
    known[:, :, n + nw] += rest[:, :, 0, 0]
    for by_state, by_input, pushes in ((at.A, at.B, at.E), (at.C, at.D, at.G)):
        by_state -= pushes[:, :, :m] @ known[:, :, :n]
        by_input -= pushes[:, :, :m] @ known[:, :, n:]
    at.P[:, :, n + nw] += P[:, :n0] @ point.states + P[:, n:] @ point.inputs
    at.D[:, :, nw] += (1.0 if structure.field is None else gain) * point.outputs


def _stack(parts: list[Assembly]) -> Assembly:
    """Stack the assemblies of several points along a new first axis."""
    found: dict[str, Any] = {}
    for name in (entry.name for entry in fields(Assembly)):
        same = [getattr(part, name) for part in parts]
        if name in ("input_lags", "output_lags"):
            lags = zip(*same, strict=True)
            found[name] = [(*each[0][:2], np.array([lag for _, _, lag in each])) for each in lags]
        elif isinstance(same[0], list):
            found[name] = [np.array(each) for each in zip(*same, strict=True)]
        else:
            found[name] = np.array(same)
    return Assembly(**found)


def _assemble(structure: Structure, theta: NDArray[Any], scales: dict[str, Any]) -> Assembly:
    """The model's own matrices, with the linear effects in them."""
    base, n, nw, ny = structure.linear_model, structure.n_states, structure.n_inputs, structure.n_outputs
    kind = theta.dtype if theta.size else np.dtype(float)
    rates = np.zeros((n, n + nw), kind)
    A, Bu = rates[:, :n], rates[:, n:]
    # A and Bu are views of one array, so that effects can write whole rows
    A[: base.n_states, : base.n_states], Bu[: base.n_states] = base.A, base.B
    Uw = np.eye(nw, nw + 1, dtype=kind)
    one, constant = np.eye(n, dtype=kind), np.zeros(n, kind)
    into = Assembly(rates, A, Bu, one, constant, Uw, np.ones(ny, kind), np.zeros(ny, kind))
    for index, site in structure.sites.items():
        effect = structure.effects[index]
        assert isinstance(effect.spec, AbsorbedLaw)
        values = [structure.value(theta, index, name) for name in effect.coefficients]
        if effect.place in scales:
            site = replace(site, act=scales[effect.place] * site.act)
        if not site.output.size:
            effect.spec.absorb(into, site, *values)
            continue
        # output that reads the force at once: what the effect adds to the force, times that output
        before = into.force(site.act)
        effect.spec.absorb(into, site, *values)
        into.felt.append(np.outer(site.output, into.force(site.act) - before))
    point = structure.model.operating_point
    # a nonlinear model is written in absolute values: changes of A and B act on the point, too
    if point is not None and point.field is not None:
        n0 = base.n_states
        into.constant[:n0] += (into.A[:n0, :n0] - base.A) @ point.states + (
            into.Bu[:n0] - base.B
        ) @ point.inputs
        into.Uw[:, nw] += into.Uw[:, :nw] @ point.inputs - point.inputs
        for read in into.felt:
            read[:, n + nw] += read[:, :n0] @ point.states + read[:, n : n + nw] @ point.inputs
    into.A = structure.adjusted_rates(into.A, theta)
    return into


def _sensors(structure: Structure, into: Assembly) -> tuple[NDArray[Any], ...]:
    """Return the output matrices for x, r, 1 and dx/dt."""
    model, n, nw = structure.model, structure.n_states, structure.n_inputs
    n0 = structure.linear_model.n_states
    rows = np.zeros((len(into.A), structure.n_outputs, 2 * n + nw + 1), into.A.dtype)
    rows[:, :, :n0], rows[:, :, n : n + nw] = model.output_state, model.output_input
    rows[:, :, n + nw + 1 : n + nw + 1 + n0] = model.output_rate
    for more in into.felt:
        rows += more
    return rows[:, :, :n], rows[:, :, n : n + nw], rows[:, :, n + nw], rows[:, :, n + nw + 1 :]


def _ports(
    structure: Structure, kind: np.dtype[Any], scales: list[dict[str, Any]]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the matrices of places where nonlinear forces act.

    The forces enter by a matrix of shape (k, n, m); they sense by one of shape (2 m, n + n_w).
    """
    n, m, n0 = structure.n_states, structure.n_ports, structure.linear_model.n_states
    E, P = np.zeros((len(scales), n, m), kind), np.zeros((2 * m, n + structure.n_inputs), kind)
    for row, index in enumerate(structure.port_effects):
        port = structure.model.port(structure.effects[index].place)
        E[:, :n0, row] = np.outer([one.get(port.name, 1.0) for one in scales], port.act)
        if not structure.fills(row):
            P[row, :n0], P[row, n:] = port.position, port.position_input
        P[m + row, :n0], P[m + row, n:] = port.velocity, port.velocity_input
    return E, P


def _input_lags(into: Assembly) -> tuple[NDArray[Any], list[tuple[int, NDArray[Any]]]]:
    """Return the matrix of lagged inputs, and the drives of their states.

    A lagged input is a state; the rows of the matrix select it.
    """
    points, nw, _ = into.Uw.shape
    Ux = np.zeros((points, nw, into.A.shape[-1]), into.A.dtype)
    drives = []
    for i, state, lag in into.input_lags:
        # lag at an input: dx/dt = (Uw w - x) / lag, u = x
        Ux[:, i, state] = 1.0
        into.A[:, state, state] = -1.0 / lag
        drives.append((state, into.Uw[:, i] / lag[:, None]))
        into.Uw[:, i] = 0.0
    return Ux, drives
