"""The initial model with its places: what the builders return."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_array, as_choice, as_instance, as_list, as_text, as_texts, shown
from ..data import HOLDS
from ..data.measurement import Measurement
from ..data.records import as_record
from ..effects.bodies import Entry
from ..effects.effect import Effect
from ..exceptions import ModelError
from ..results import Result
from ..systems.linear import Array, LinearModel, entry_of
from .controller import JoinedController
from .operating_point import OperatingPoint
from .parameters import NominalParameter, combine_units
from .ports import Port


@dataclass(frozen=True, slots=True, eq=False)
class PhysicalModel(Result):
    """A linear model that knows its places, parameters and units.

    Made by the builders (`mass_spring_damper`, `series_rlc`, ...), or from a plain `StateSpace` by
    `from_statespace`. The output is split so that a force of an effect reaches an accelerometer::

        y = output_state @ x + output_rate @ dx/dt + output_input @ w

    Parameters
    ----------
    linear : LinearModel
        Matrices and labels, in continuous time.
    output_state : ndarray of shape (n_y, n)
        Part of the output that reads states.
    output_rate : ndarray of shape (n_y, n)
        Part of the output that reads rates of states (accelerometers).
    output_input : ndarray of shape (n_y, n_w)
        Direct part of the inputs.
    ports : tuple of Port
        Places where a force can act.
    parameters : tuple of NominalParameter
        Numbers that the initial model was built from.
    input_units, output_units, state_units : tuple of str
        Units, ``""`` where they are unknown.
    hold : {"zoh", "foh", "bandlimited"}, optional
        How the inputs run between samples, where that is not as the records declare.
    operating_point : OperatingPoint, optional
        Point about which the model is linear (see `physical`).
    controller : JoinedController, optional
        What closes the loop in which the model is simulated (``controller=`` of `refine`).

    Attributes
    ----------
    system : StateSpace
        The linear model, built anew at each call.

    Raises
    ------
    control.ControlDimension
        If sizes do not fit.
    ModelError
        If the output parts do not add up to C and D, names are not
        unique, or the model is not in continuous time.

    Examples
    --------
    >>> model = PhysicalModel.from_statespace(
    ...     ct.ss([[0, 1], [-4, -1]], [[0], [2]], [[1, 0]], 0, states=["q", "v"])
    ... )
    >>> print(model.port("q").description)
    displacement q, velocity v; mass 0.5 from the input u[0]
    """

    # matrices, and the split of the outputs
    linear: LinearModel
    output_state: Array
    output_rate: Array
    output_input: Array
    # places and parameters
    ports: tuple[Port, ...]
    parameters: tuple[NominalParameter, ...] = ()
    # units
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    state_units: tuple[str, ...] = ()
    # how the model is driven and simulated
    hold: str | None = None
    operating_point: OperatingPoint | None = None
    controller: JoinedController | None = None

    def __post_init__(self) -> None:
        linear = self.linear
        if not isinstance(linear, LinearModel):
            raise ct.ControlArgument(f"linear must be a LinearModel, not {shown(linear)}")
        if not linear.is_continuous:
            raise ModelError(
                f"model {linear.name!r} has dt = {linear.dt}, but a physical model is in continuous time; "
                "use PhysicalModel.from_statespace, which converts it"
            )
        # sizes, sum of the output parts, places
        _check_sizes(self)
        _check_outputs(self)
        _check_places(self)
        if self.hold is not None:
            as_choice(self.hold, "hold, where there is one,", HOLDS)

    @property
    def system(self) -> ct.StateSpace:
        """The linear model as a `control.StateSpace`, built anew."""
        return self.linear.to_statespace()

    @property
    def name(self) -> str:
        """Name of the system."""
        return self.linear.name

    @property
    def places(self) -> tuple[str, ...]:
        """Names of all places: ports, inputs and outputs."""
        names = (port.name for port in self.ports)
        return tuple(dict.fromkeys((*names, *self.linear.input_labels, *self.linear.output_labels)))

    @classmethod
    def from_statespace(cls, sys: ct.StateSpace, *, dt: float | None = None) -> PhysicalModel:
        """Find ports and parameters in a plain `control.StateSpace`.

        Parameters
        ----------
        sys : StateSpace
            Linear model, the states in physical coordinates and in any order. A
            discrete-time model is converted to continuous time by `d2c`.
        dt : float, optional
            Sampling time [s], for a discrete-time model with ``dt=True``.

        Returns
        -------
        PhysicalModel
            Model with the ports found.

        Raises
        ------
        ModelError
            If the sampling time of a discrete-time model is unknown.

        Notes
        -----
        *Displacements.* A state whose derivative is another state is a displacement, and gives
        a mechanical port named after it. So does a state whose derivative is a difference of
        two states, or a state minus an input (an elongation), if a spring acts
        back. Chains of three or more integrators that close on themselves and companion
        (canonical) forms are not mechanical, and their states are taken as
        first-order ones.

        *Links.* Masses whose rows of A are coupled both ways are linked. Their mass ratio
        follows from the symmetry of the stiffness matrix, A_ij / A_ji = m_j / m_i. A pair that no
        choice of masses makes symmetric is not a link and gives none. The rank-one factors of
        stiffness and damping are the directions of the links: ``"x1-x2"``, ``"0.2*th1-th2"`` (a gear),
        ``"z-1.2*theta-zf"`` (a suspension). Where there is more than one factorization,
        the description of the displacements says so, and `physical` takes the links by hand.

        *Modes.* In modal coordinates (blocks of two states, inputs and outputs that share them) each
        mode is a place, with a stiffness (its frequency) and a damping.

        *Masses.* The mass is 1/B where exactly one input drives exactly one velocity (so forces are
        in units of that input). Otherwise forces are per unit mass. An input
        with -1 on every mass is the acceleration of the base.

        *First order.* Every other state is a port of its own. Two that exchange something
        (both off-diagonal entries positive, as between two temperatures) give ``"T1-T2"``, and a
        one-way flow gives ``"h1->h2"``.

        In arbitrary coordinates (after a similarity transformation) no displacement
        can be recognized, and the effects left are those on states, entries of A
        and channels; use a builder, or give the model in physical coordinates.

        Examples
        --------
        >>> sys = ct.ss([[0, 1], [-4, -1]], [[0], [1]], [[1, 0]], 0, states=["q", "v"])
        >>> [(item.name, float(item.value)) for item in PhysicalModel.from_statespace(sys).parameters]
        [('k[q]', 4.0), ('c[q]', 1.0), ('gain[u[0]]', 1.0)]
        """
        from .detection import recognize

        return recognize(cls, sys, dt)

    def held(self, data: Measurement) -> Measurement:
        """The record as this model takes its inputs between the samples.

        Parameters
        ----------
        data : Measurement
            Record.

        Returns
        -------
        Measurement
            The record itself, unless `hold` says otherwise.
        """
        data = as_record(data)
        return data if self.hold is None else data.with_hold(self.hold)

    def port(self, name: str) -> Port:
        """Port of a given name.

        Parameters
        ----------
        name : str
            Name of the place.

        Returns
        -------
        Port

        Raises
        ------
        ModelError
            If there is none; the message lists the names that exist.
        """
        as_text(name, "name")
        for port in self.ports:
            if port.name == name:
                return port
        # an entry of A or B serves as a place, too
        if name[:2] in ("A[", "B["):
            return self._port_of_entry(name)
        known = ", ".join(port.name for port in self.ports) or "none"
        raise ModelError(f"model {self.name!r} has no port {name!r}; its ports are: {known}")

    def _port_of_entry(self, place: str) -> Port:
        """Return an entry of A or B as a port.

        It acts on the state of its row, senses the signal of its column as a velocity, and as a displacement
        that of the mass, or else the state on which it acts.
        """
        row, column = self.entry(place)
        n, unit = self.linear.n_states, np.eye(self.linear.n_states + self.linear.n_inputs)
        units = (*self.state_units, *self.input_units)
        # displacement of the mass whose rate the entry changes
        alone = (p for p in self.ports if p.has_position and (np.flatnonzero(p.act) == [row]).all())
        moved = next(alone, None)
        return Port(
            place,
            "first_order",
            unit[row, :n],
            moved.position if moved else unit[row, :n],
            unit[column, :n],
            position_input=moved.position_input if moved else unit[row, n:],
            velocity_input=unit[column, n:],
            position_unit=moved.position_unit if moved else units[row],
            velocity_unit=units[column],
            force_unit=combine_units("row/s", {"row": units[row]}),
            description=f"entry {place} of the matrices",
        )

    def entry(self, place: str) -> tuple[int, int]:
        """Return row and column of an entry of [A B; C D].

        Such an entry is the place of a `coefficient` effect.

        Parameters
        ----------
        place : str
            ``"A[1,0]"``, ``"D[0,0]"``, counted from 0 in each matrix, or with labels, ``"A[v1,x1]"``,
            ``"B[v1,force]"``.

        Returns
        -------
        row, column : int
            Of the four matrices as one, where inputs follow the states and outputs their rates.

        Raises
        ------
        ModelError
            If the text is not of this form or the entry does not exist.
        """
        return entry_of(self.linear, place)

    def check(self, effect: Effect) -> Effect:
        """Check that an effect makes sense at its place in this model.

        Parameters
        ----------
        effect : Effect
            Effect to check.

        Returns
        -------
        Effect
            The same, worded for its place.

        Raises
        ------
        ModelError
            If the place does not exist, the kind cannot sit there, or the place senses
            nothing that the law needs (a stiffness where there is no
            displacement).
        """
        _check_type(effect)
        # laws with places of their own, such as entries
        where = effect.spec.where
        if effect.spec.sits(self, effect.place):
            return effect
        # laws at inputs and outputs
        for channel, labels in (("input", self.linear.input_labels), ("output", self.linear.output_labels)):
            if channel in where:
                if effect.place not in labels:
                    raise ModelError(
                        f"{effect.kind} sits at an {channel}, and {effect.place!r} is none of them: "
                        f"{', '.join(labels)}"
                    )
                return effect
        # laws at ports: the kind must fit, and the signals must be there
        port = self.port(effect.place)
        if port.kind not in where:
            raise ModelError(
                f"{effect.kind} cannot sit at {port.name}, a {port.kind.replace('_', '-')} port; "
                f"it needs a {' or '.join(sorted(where - {'any'})).replace('_', '-')} one"
            )
        for need, there in (("position", port.has_position), ("velocity", port.has_velocity)):
            if need in effect.spec.needs and not there:
                raise ModelError(f"{effect.label}: there is no {need} at {port.name} ({port.description})")
        return effect.at_port(port.domain)

    def unit(self, effect: Effect, coefficient: str) -> str:
        """Unit of a coefficient of an effect in this model.

        Parameters
        ----------
        effect : Effect
            Effect at a place of this model.
        coefficient : str
            Name of the coefficient.

        Returns
        -------
        str
            Unit, ``""`` where it is unknown, ``"1"`` for a pure number.
        """
        _check_type(effect)
        if as_text(coefficient, "coefficient") not in effect.coefficients:
            raise ct.ControlArgument(
                f"{effect.label} has no coefficient {coefficient!r}, only {', '.join(effect.coefficients)}"
            )
        rule = effect.spec.coefficient(coefficient).unit_rule
        if not rule:
            return ""  # the unit of a custom law is unknown
        where = effect.spec.where
        # entry of the matrices: unit of its row over that of its column
        if effect.kind == Entry.name:
            row, column = self.entry(effect.place)
            units = {"row": (*self.state_units, *self.output_units)[row]}
            units["column"] = (*self.state_units, *self.input_units)[column]
            return combine_units("row/(column s)" if row < self.linear.n_states else "row/column", units)
        # channel: unit of the signal
        for channel in ("input", "output"):
            if channel in where:
                index = getattr(self.linear, f"{channel}_labels").index(effect.place)
                return combine_units(rule, {"signal": getattr(self, f"{channel}_units")[index]})
        # port: units of position, velocity and force
        return combine_units(rule, self.port(effect.place).units)


def _check_type(effect: Any) -> None:
    if not isinstance(effect, Effect):
        raise ct.ControlArgument(f"an effect must be an Effect, not {type(effect).__name__}")


def _check_sizes(model: PhysicalModel) -> None:
    """Bring arrays and units of a model under construction into shape."""
    # names that python-control accepts
    linear, store = model.linear, object.__setattr__
    for name in (linear.name, *linear.input_labels, *linear.output_labels, *linear.state_labels):
        if "." in name:
            raise ModelError(
                f"python-control allows no '.' in a name; {name!r} can be {name.replace('.', '_')!r}"
            )
    # read-only arrays of the right shape
    for key, width in (
        ("output_state", linear.n_states),
        ("output_rate", linear.n_states),
        ("output_input", linear.n_inputs),
    ):
        array = np.atleast_2d(as_array(getattr(model, key), key, error=ModelError))
        if array.shape != (linear.n_outputs, width):
            raise ct.ControlDimension(f"{key} has shape {array.shape}, expected {(linear.n_outputs, width)}")
        array.setflags(write=False)
        store(model, key, array)
    # one unit for each signal, empty where unknown
    for what, size in (("input", linear.n_inputs), ("output", linear.n_outputs), ("state", linear.n_states)):
        units = as_texts(getattr(model, f"{what}_units"), f"{what}_units") or ("",) * size
        if len(units) != size:
            raise ct.ControlDimension(f"{what}_units has {len(units)} entries for {size} {what}s")
        store(model, f"{what}_units", units)
    for key, kind in (("operating_point", OperatingPoint), ("controller", JoinedController)):
        if getattr(model, key) is not None:
            as_instance(getattr(model, key), kind, f"{key}, where there is one,")
    store(model, "ports", tuple(as_list(model.ports, "ports", "Port objects")))
    store(model, "parameters", tuple(as_list(model.parameters, "parameters", "nominal parameters")))


def _check_outputs(model: PhysicalModel) -> None:
    """Check that the parts of the output add up to C and D."""
    linear = model.linear
    for name, key, other in (("C", "output_state", "A"), ("D", "output_input", "B")):
        whole, direct = getattr(linear, name), getattr(model, key)
        # C = output_state + output_rate A, D = output_input + output_rate B
        rate = model.output_rate @ getattr(linear, other)
        scale = np.abs(whole) + np.abs(direct) + np.abs(rate)
        limit = 1e-9 * scale.max(axis=1, keepdims=True, initial=0.0)
        wrong = np.argwhere(np.abs(direct + rate - whole) > limit)
        if wrong.size:
            raise ModelError(
                f"{name} of output {linear.output_labels[wrong[0][0]]!r} is not its row of "
                f"{key} + output_rate @ {other}; the parts must add up"
            )


def _check_places(model: PhysicalModel) -> None:
    """Check ports against the matrices, and names for uniqueness.

    Ports that were made without inputs get rows of the right length.
    """
    # rows of the ports have the sizes of the model
    ports = tuple(_complete_port(port, model.linear) for port in model.ports)
    object.__setattr__(model, "ports", ports)
    for item in model.parameters:
        if not hasattr(item, "kind") or not hasattr(item, "place"):
            raise ct.ControlArgument(f"parameters must hold NominalParameter, not {shown(item)}")
    # names are unique
    for what, items in (("port", ports), ("parameter", model.parameters)):
        labels = Counter(item.name for item in items)
        twice = sorted(label for label, count in labels.items() if count > 1)
        if twice:
            raise ModelError(f"{what} names must be unique, but {twice[0]!r} occurs more than once")


def _complete_port(port: Any, linear: LinearModel) -> Port:
    if not isinstance(port, Port):
        raise ct.ControlArgument(f"ports must hold Port, not {type(port).__name__}")
    sizes = port.act.size, port.velocity_input.size, port.output.size
    if sizes[0] != linear.n_states:
        raise ct.ControlDimension(
            f"port {port.name!r} is for {sizes[0]} states, the model has {linear.n_states}"
        )
    if sizes[2] not in (0, linear.n_outputs):
        raise ct.ControlDimension(
            f"output of port {port.name!r} has {sizes[2]} entries for {linear.n_outputs} outputs"
        )
    if sizes[1] == linear.n_inputs:
        return port
    if port.velocity_input.any() or port.position_input.any() or port.acceleration_input.any():
        raise ct.ControlDimension(
            f"port {port.name!r} is for {sizes[1]} inputs, the model has {linear.n_inputs}"
        )
    # ports without inputs get zero rows
    none = np.zeros(linear.n_inputs)
    return replace(port, position_input=none, velocity_input=none, acceleration_input=none)
