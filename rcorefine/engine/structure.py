"""Structure: the initial model in feedback with effects.

It determines which coefficients are free and where each effect enters.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, TypeVar

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..effects.compiled import MAX_COEFFICIENTS
from ..effects.effect import Effect
from ..effects.formula import FormulaLaw, InputLaw, OutputLaw, PortLaw
from ..effects.law import AbsorbedLaw, Site
from ..effects.right_hand_side import Field, ModelParameter
from ..exceptions import ModelError
from ..models.conversion import as_physical
from ..models.operating_point import refuse_point
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array, LinearModel
from .controlled import open_loop
from .linear import Substep
from .matrices import Matrices, continuous_matrices, site_of
from .point import about_point
from .setting import discretized

_KEPT = 8  # results per structure that depend on the coefficients
_Made = TypeVar("_Made")


class Kept:
    """The last few things that were made, for who asks again.

    Parameters
    ----------
    most : int
        How many are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._made: dict[Hashable, Any] = {}

    def __call__(self, key: Hashable, make: Callable[[], _Made]) -> _Made:
        """Return the value stored under a key, or make it if it is missing."""
        found: _Made | None = self._made.get(key)
        if found is None:
            found = make()
            for oldest in list(self._made)[: 1 - self._most]:
                self._made.pop(oldest, None)
            self._made[key] = found
        return found


@dataclass(frozen=True, slots=True)
class Parameter:
    """One free coefficient: its effect, its name there, bounds and prior."""

    effect: int
    name: str
    label: str
    lower: float
    upper: float
    mean: float = 0.0
    sd: float = np.inf


class Structure:
    """A physical model in feedback with effects.

    Parameters
    ----------
    model : StateSpace or PhysicalModel
        Initial model, continuous time.
    effects : sequence of Effect
        What is added. Coefficients in `Effect.fixed` are held.
    constants : mapping, optional
        ``{index of the effect: width}`` for laws that need a small scale
        (``sgn(v)``, ``sqrt``).

    Raises
    ------
    ModelError
        If a place does not exist, or a kind does not fit it.
    """

    def __init__(
        self, model: Any, effects: Sequence[Effect] = (), *, constants: Mapping[int, float] | None = None
    ) -> None:
        self.model: PhysicalModel = as_physical(model)
        self.effects: tuple[Effect, ...] = tuple(effects)
        self.constants = dict(constants or {})
        self.linear_model: LinearModel = self.model.linear
        base = self.linear_model
        self.n_inputs, self.n_outputs = base.n_inputs, base.n_outputs
        # free coefficients, the columns of theta; then effects by where they enter
        self.parameters: list[Parameter] = []
        self._position: dict[tuple[int, str], int] = {}
        self.added_states: list[tuple[int, str]] = []  # (effect, what) of the added states
        self._port_effects: list[int] = []
        self._input_statics: list[int] = []
        self._output_statics: list[int] = []
        self._delayed_outputs: list[int] = []
        self._numbers: list[int] = []  # parameters of a nonlinear model
        for index, effect in enumerate(self.effects):
            self._register(index, effect)
        # states of a controller stand between those of the model and those of effects
        n_loop = 0 if self.model.controller is None else self.model.controller.n_states
        self.loop = slice(base.n_states, base.n_states + n_loop)
        self.n_states = self.loop.stop + len(self.added_states)
        self.n_ports = len(self._port_effects)
        self.kept = Kept(_KEPT)

    # ------------------------------------------------------------- registration
    def _register(self, index: int, effect: Effect) -> None:
        self.model.check(effect)
        if self.model.operating_point is not None and getattr(effect.spec, "feels_inputs", False):
            raise ModelError(
                f"{effect.label}: its formula takes the inputs, which stand as what they have above the "
                "operating point; give the model without one and the record's `deviation`"
            )
        # each coefficient that is not held is a column of theta
        for name in effect.coefficients:
            self._add_parameter(index, effect, name)
        # an effect enters the matrices, an input, an output, the field of the model, or as a force at a port
        law = effect.spec
        if isinstance(law, AbsorbedLaw):
            self.added_states += [(index, what) for what in law.states]
        elif isinstance(law, InputLaw):
            self._input_statics.append(index)
        elif isinstance(law, OutputLaw):
            (self._delayed_outputs if law.delays else self._output_statics).append(index)
        elif isinstance(law, ModelParameter):
            self._numbers.append(index)
        else:
            self._port_effects.append(index)

    def _add_parameter(self, index: int, effect: Effect, name: str) -> None:
        if name in effect.fixed:
            return
        # bounds of the law, narrowed by those of the model
        low, high = effect.bounds(name)
        least, most = effect.spec.bounds_in(self, effect.place)
        low, high = max(low, least), min(high, most)
        # ordered pair of coefficients: one that is held bounds the other
        for larger, smaller in effect.spec.order:
            if name == larger and smaller in effect.fixed:
                low = max(low, effect.fixed[smaller])
            if name == smaller and larger in effect.fixed:
                high = min(high, effect.fixed[larger])
        widths = effect.spec.coefficient(name).widths
        if widths and index in self.constants and "width" not in effect.fixed:
            # the width is a share of the motion
            low = max(low, widths[0] * self.constants[index])
            high = min(high, widths[1] * self.constants[index])
        self._position[index, name] = len(self.parameters)
        single = len(effect.coefficients) == 1
        label = effect.label if single else f"{name} of {effect.label}"
        # normal prior, where the effect has one
        sd = effect.prior.get(name, np.inf)
        mean = effect.start.get(name, 0.0) if name in effect.prior else 0.0
        self.parameters.append(Parameter(index, name, label, low, high, mean, sd))

    @cached_property
    def sites(self) -> dict[int, Site]:
        """Return where each linear effect enters A, B, C and D, by its index."""
        return {
            index: site_of(self, index)
            for index, effect in enumerate(self.effects)
            if isinstance(effect.spec, AbsorbedLaw)
        }

    # ------------------------------------------------------------------- values
    @property
    def n_parameters(self) -> int:
        """Number of free coefficients."""
        return len(self.parameters)

    def inertia(self, place: str) -> float:
        """Return the effective inertia (force per acceleration) at a place.

        It is infinite where a force moves nothing.
        """
        # acceleration per unit of the resisting force
        port = self.model.port(place)
        answer = -float(port.velocity @ port.act)
        return 1.0 / answer if answer > 0 else np.inf

    def unit(self, parameter: Parameter) -> str:
        """Unit of a coefficient, "" where unknown."""
        if parameter.name not in self.effects[parameter.effect].coefficients:
            return ""
        return self.model.unit(self.effects[parameter.effect], parameter.name)

    def position(self, index: int, name: str) -> int:
        """Column of a coefficient in theta, -1 where it is held."""
        return self._position.get((index, name), -1)

    def value(self, theta: NDArray[Any], index: int, name: str) -> Any:
        """Coefficient `name` of effect `index`: from theta, or held."""
        where = self.position(index, name)
        return theta[where] if where >= 0 else self.effects[index].fixed[name]

    def start(self) -> Array:
        """Starting values: the user's, else those at which the effect is absent."""
        theta = np.zeros(self.n_parameters)
        for where, parameter in enumerate(self.parameters):
            effect = self.effects[parameter.effect]
            # the user's value, else the one at which the effect is absent
            given = effect.start.get(parameter.name)
            if given is None:
                given = effect.start_of(parameter.name)
            theta[where] = 0.0 if given is None else given
        return theta

    # ----------------------------------------------------------------- matrices
    def matrices(self, theta: NDArray[Any]) -> Matrices:
        """Continuous-time matrices at `theta` (real, or complex for derivatives)."""
        return self.matrix_stack(theta[None])[0]

    def matrix_stack(self, points: NDArray[Any]) -> Matrices:
        """Return the matrices at several points, stacked along the first axis.

        `points` has shape (k, p).
        """
        return continuous_matrices(self, points)

    def adjusted_rates(self, A: NDArray[Any], theta: NDArray[Any]) -> NDArray[Any]:
        """Return the state matrix before the division by masses.

        A subclass can add rules that tie its entries together.
        """
        return A

    @property
    def has_mass(self) -> bool:
        """Return whether an effect adds mass.

        The matrices are divided by it.
        """
        return any(effect.spec.inertial for effect in self.effects)

    @cached_property
    def absorbed(self) -> NDArray[np.int64]:
        """Columns of theta that enter the matrices."""
        skip = set(self._port_effects) | set(self._input_statics)
        skip |= set(self._output_statics) | set(self._delayed_outputs)
        if self.balanced:  # at an operating point the tangents of port effects enter them
            skip -= set(self._port_effects)
        return np.array([i for i, q in enumerate(self.parameters) if q.effect not in skip], dtype=np.int64)

    def discretize(
        self, theta: Array, step: float, *, derivatives: bool = True, pieces: bool = False
    ) -> Substep:
        """Return one substep of `step` seconds, exact for the linear part.

        With `pieces` also a quarter of it and a quarter of that, for forces that jump within.

        The result is kept because it is needed again.
        """
        # only absorbed coefficients change the matrices: they are the key
        key = theta[self.absorbed].tobytes()
        make = partial(discretized, self, theta, step, derivatives=derivatives, pieces=pieces)
        return self.kept((key, step, derivatives, pieces), make)

    # ------------------------------------------------------------ nonlinear parts
    @property
    def balanced(self) -> bool:
        """Return whether the operating point already contains the forces.

        The forces are those of the effects at that point.
        """
        point = self.model.operating_point
        return point is not None and point.field is None

    @property
    def field(self) -> Field | None:
        """Return the nonlinear field of the model, or None if there is none."""
        point = self.model.operating_point
        return None if point is None else point.field

    @property
    def n_forces(self) -> int:
        """Return the number of forces in the matrices.

        The forces at places come first, then the rows of the nonlinear field.
        """
        return self.n_ports + (0 if self.field is None else self.field.n_rows)

    def laws(self, theta: Array) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], Array]:
        """Return the force laws at places as arguments of `march`.

        These are codes, coefficients, their columns in theta, and widths.
        """
        m = self.n_ports
        codes = np.zeros(m, dtype=np.int64)
        values = np.zeros((m, MAX_COEFFICIENTS + 3))
        columns = np.full((m, MAX_COEFFICIENTS), -1, dtype=np.int64)
        widths = np.ones(m)
        # one row for each port: coefficients, then three flags
        for row, index in enumerate(self._port_effects):
            law = self.effects[index].spec
            assert isinstance(law, PortLaw)
            # read once: a law of the user is looked through each time
            codes[row] = self.kept(("code", index), partial(getattr, law, "code"))
            found = self.law_values(theta, index)
            values[row, : len(found)] = found
            values[row, MAX_COEFFICIENTS:] = law.feels_inputs, law.jumps, law.remembers
            columns[row, : len(law.coefficients)] = self.law_columns(index)
            widths[row] = self.constants.get(index, 1.0)
        return codes, values, columns, widths

    def law_values(self, theta: Array, index: int) -> list[float]:
        """Coefficients and constants of a law that is a formula, in its order."""
        effect, law = self.effects[index], self.effects[index].spec
        names = law.row if isinstance(law, FormulaLaw) else law.coefficient_names
        constants = effect.constants
        return [
            float((constants[name] or 0.0) if name in constants else self.value(theta, index, name))
            for name in names
        ]

    def law_columns(self, index: int) -> list[int]:
        """Columns of theta of a law's coefficients, -1 where one is held."""
        return [self.position(index, name) for name in self.effects[index].coefficients]

    def output_laws(self, theta: Array) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
        """Return the effects at the sensors as arguments of `march`.

        These are codes, coefficients, and their columns in theta.
        """
        ny = self.n_outputs
        codes, values = np.zeros(ny, dtype=np.int64), np.zeros((ny, MAX_COEFFICIENTS))
        columns = np.full((ny, MAX_COEFFICIENTS), -1, dtype=np.int64)
        # one row for each output; code 0 stands for no law
        for index, channel in self.output_statics:
            law, found = self.effects[index].spec, self.law_values(theta, index)
            assert isinstance(law, OutputLaw)
            codes[channel] = law.code
            values[channel, : len(found)] = found
            columns[channel, : len(law.coefficients)] = self.law_columns(index)
        return codes, values, columns

    @property
    def remembers(self) -> bool:
        """Return whether an effect at a sensor has an inner state."""
        return any(self.effects[index].spec.inner_states for index in self._output_statics)

    @property
    def port_effects(self) -> tuple[int, ...]:
        """Indices of the effects that keep a port of their own."""
        return tuple(self._port_effects)

    def fills(self, row: int) -> bool:
        """Return whether a force law takes what fills a store.

        It takes that in place of a displacement.
        """
        return "acceleration" in self.effects[self._port_effects[row]].spec.senses

    @cached_property
    def jumps(self) -> bool:
        """Return whether a force jumps with the sign of a velocity."""
        return any(self.effects[index].spec.jumps for index in self._port_effects)

    @cached_property
    def stages(self) -> int:
        """Return at how many points of a substep forces are found.

        They are found at its middle, too, unless one of them jumps or remembers.
        """
        # the Lobatto formula needs smooth forces: jumps and inner states take one stage
        laws = [self.effects[index].spec for index in self._port_effects]
        straight = not self.n_forces or any(isinstance(s, PortLaw) and (s.jumps or s.remembers) for s in laws)
        return 1 if straight else 2

    @property
    def port_columns(self) -> NDArray[np.int64]:
        """Return the columns of theta that scale the force laws.

        These are the first coefficients of the force laws, where they are free.
        """
        found = [self.position(index, self.effects[index].coefficients[0]) for index in self._port_effects]
        return np.array([column for column in found if column >= 0], dtype=np.int64)

    @property
    def number_effects(self) -> tuple[int, ...]:
        """Indices of the effects that change a parameter of a nonlinear model."""
        return tuple(self._numbers)

    @cached_property
    def input_statics(self) -> list[tuple[int, int]]:
        """(effect, channel) of dead zones, saturations and delays at inputs."""
        labels = self.linear_model.input_labels
        return [(index, labels.index(self.effects[index].place)) for index in self._input_statics]

    @cached_property
    def output_statics(self) -> list[tuple[int, int]]:
        """(effect, channel) of the sensors' own laws."""
        labels = self.linear_model.output_labels
        return [(index, labels.index(self.effects[index].place)) for index in self._output_statics]

    @cached_property
    def output_delays(self) -> list[tuple[int, int]]:
        """(effect, channel) of delays at outputs."""
        labels = self.linear_model.output_labels
        return [(index, labels.index(self.effects[index].place)) for index in self._delayed_outputs]

    @cached_property
    def drifts(self) -> list[tuple[int, str]]:
        """(effect, coefficient) of clocks that run apart."""
        return [(index, name) for index, effect in enumerate(self.effects) for name in effect.spec.drifts]

    @cached_property
    def is_linear(self) -> bool:
        """Return whether all effects are absorbed into A, B, C, D."""
        others = self._port_effects + self._input_statics + self._output_statics + self._delayed_outputs
        return not others and self.field is None and not self.drifts

    def with_equations(self, what: str = "") -> Structure:
        """Return the open loop, where each effect has a state equation.

        Parameters
        ----------
        what : str
            What supports no operating point, for messages; empty where it does.

        Raises
        ------
        ModelError
            If an effect has no state equation: a delay has no finite state, and an inner state that is
            updated sample by sample has no rate.
        """
        structure = open_loop(self)
        if what:
            refuse_point(structure.model, what)
        for effect in structure.effects:
            law = effect.spec
            if law.delays or law.drifts:
                raise ModelError(
                    f"{effect.label} has no state equation; simulate with Refinement.simulate, or replace "
                    "the delay by control.pade"
                )
            if isinstance(law, FormulaLaw) and law.inner_states and (law.at_channel or law.rate is None):
                raise ModelError(
                    f"{effect.label}: its inner state has no differential equation; simulate with "
                    "Refinement.simulate, or give its law a `rate`"
                )
        return structure

    def state_labels(self) -> list[str]:
        """Return the names of the states.

        States that effects add are included; those of a controller are not.
        """
        names = list(self.linear_model.state_labels)
        for index, what in self.added_states:
            names.append(f"{self.effects[index].label} {what}".replace(" ", "_").replace(".", "_"))
        return names

    def system(self, theta: Array, name: str | None = None) -> ct.StateSpace:
        """Return the model with its linear effects as a `StateSpace`.

        It is continuous, and without the controller.
        """
        # linearization about the operating point, without the column of the constant input
        A, B, C, D = about_point(open_loop(self), theta.astype(float))
        nw = self.n_inputs
        return self.linear_model.with_arrays(
            A=A, B=B[:, :nw], C=C, D=D[:, :nw], state_labels=tuple(self.state_labels())
        ).to_statespace(name)
