"""The initial model in feedback with effects, as matrices of the coefficients.

Linear effects are absorbed exactly into A, B, C, D; the others keep a port of
their own. Everything is an analytic function of the coefficients, so that exact
derivatives follow from a complex step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..effects.absorbed import AbsorbedLaw, Assembly, Site
from ..effects.compiled import MAX_COEFFICIENTS
from ..effects.effect import Effect
from ..effects.formula import FormulaLaw, InputLaw, OutputLaw, PortLaw
from ..models.conversion import as_physical
from ..models.physical_model import PhysicalModel
from ..systems.discretization import power_of_two
from ..systems.exponential import exponential
from ..systems.linear import Array, LinearModel

__all__ = ["Discrete", "Matrices", "Parameter", "Structure"]

_TINY_STEP = 1e-30


@dataclass(frozen=True, slots=True)
class Parameter:
    """One free coefficient: the effect that it belongs to and its name there."""

    effect: int
    name: str
    label: str
    lower: float
    upper: float


@dataclass(frozen=True, slots=True, eq=False)
class Matrices:
    """Continuous-time matrices; the last column of B and D drives a constant one."""

    A: NDArray[Any]
    B: NDArray[Any]
    E: NDArray[Any]
    C: NDArray[Any]
    D: NDArray[Any]
    G: NDArray[Any]
    P: NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class Discrete:
    """One substep, with derivatives for the parameters listed in `linear`."""

    M: Array
    dM: Array
    O: Array
    dO: Array
    P: Array
    dP: Array
    linear: NDArray[np.int64]


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
        self,
        model: Any,
        effects: Sequence[Effect] = (),
        *,
        constants: Mapping[int, float] | None = None,
    ) -> None:
        self.model: PhysicalModel = as_physical(model)
        self.effects: tuple[Effect, ...] = tuple(effects)
        self.constants = dict(constants or {})
        self.linear_model: LinearModel = self.model.linear
        base = self.linear_model
        self.n_inputs, self.n_outputs = base.n_inputs, base.n_outputs
        self.parameters: list[Parameter] = []
        self._position: dict[tuple[int, str], int] = {}
        self._extra: list[tuple[int, str]] = []  # (effect, what) of the added states
        self._port_effects: list[int] = []
        self._input_statics: list[int] = []
        self._output_statics: list[int] = []
        self._delayed_outputs: list[int] = []
        for index, effect in enumerate(self.effects):
            self._register(index, effect)
        self.n_states = base.n_states + len(self._extra)
        self.n_ports = len(self._port_effects)
        self._sites = {
            index: self._site(index)
            for index, effect in enumerate(self.effects)
            if isinstance(effect.spec, AbsorbedLaw)
        }

    # ------------------------------------------------------------- registration
    def _register(self, index: int, effect: Effect) -> None:
        self.model.check(effect)
        for name in effect.coefficients:
            self._add_parameter(index, effect, name)
        law = effect.spec
        if isinstance(law, AbsorbedLaw):
            self._extra += [(index, what) for what in law.states]
        elif isinstance(law, InputLaw):
            self._input_statics.append(index)
        elif isinstance(law, OutputLaw):
            (self._delayed_outputs if law.delays else self._output_statics).append(index)
        else:
            self._port_effects.append(index)

    def _add_parameter(self, index: int, effect: Effect, name: str) -> None:
        if name in effect.fixed:
            return
        low, high = effect.bounds(name)
        least, most = effect.spec.bounds_in(self, effect.place)
        low, high = max(low, least), min(high, most)
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
        label = effect.label if single else f"{effect.label}: {name}"
        self.parameters.append(Parameter(index, name, label, low, high))

    @property
    def ordered(self) -> list[tuple[int, int]]:
        """Pairs of columns of theta of which the first is never below the second."""
        pairs = [
            (self.position(index, larger), self.position(index, smaller))
            for index, effect in enumerate(self.effects)
            for larger, smaller in effect.spec.order
        ]
        return [pair for pair in pairs if min(pair) >= 0]

    # ------------------------------------------------------------------- values
    @property
    def n_parameters(self) -> int:
        """Number of free coefficients."""
        return len(self.parameters)

    def inertia(self, place: str) -> float:
        """Force per acceleration that a port feels, infinite where it moves nothing."""
        port = self.model.port(place)
        answer = -float(port.velocity @ port.act)
        return 1.0 / answer if answer > 0 else np.inf

    def unit(self, parameter: Parameter) -> str:
        """Unit of a coefficient, "" where unknown."""
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
            given = effect.start.get(parameter.name)
            if given is None:
                given = effect.start_of(parameter.name)
            theta[where] = 0.0 if given is None else given
        return theta

    # ----------------------------------------------------------------- matrices
    def _site(self, index: int) -> Site:
        """Where an absorbed effect sits."""
        effect, base, n = self.effects[index], self.linear_model, self.n_states
        where = effect.spec.where
        rows, inputs = [np.zeros(n)] * 3, [np.zeros(self.n_inputs)] * 3
        channel, entry = -1, (0, 0)
        if "input" in where:
            channel = base.input_labels.index(effect.place)
        elif "output" in where:
            channel = base.output_labels.index(effect.place)
        elif "any" in where:
            entry = self.model.entry(effect.place)
        else:
            port = self.model.port(effect.place)
            rows = [np.pad(row, (0, n - row.size)) for row in (port.act, port.position, port.velocity)]
            inputs = [port.position_input, port.velocity_input, port.acceleration_input]
        states = [base.n_states + i for i, (owner, _) in enumerate(self._extra) if owner == index]
        (act, position, velocity), (d_w, v_w, a_w) = rows, inputs
        state = states[0] if states else -1
        return Site(act, position, velocity, d_w, v_w, a_w, channel, entry, state)

    def matrices(self, theta: NDArray[Any]) -> Matrices:
        """Continuous-time matrices at `theta` (real, or complex for derivatives)."""
        model, base = self.model, self.linear_model
        n0, n, nw, ny, m = base.n_states, self.n_states, self.n_inputs, self.n_outputs, self.n_ports
        kind_of = theta.dtype if theta.size else np.dtype(float)
        A = np.zeros((n, n), kind_of)
        A[:n0, :n0] = base.A
        Bu = np.zeros((n, nw), kind_of)
        Bu[:n0] = base.B
        constant = np.zeros(n, kind_of)
        inertia = np.eye(n, dtype=kind_of)
        E = np.zeros((n, m), kind_of)
        P = np.zeros((2 * m, n + nw), kind_of)
        Ux = np.zeros((nw, n), kind_of)
        Uw = np.hstack([np.eye(nw, dtype=kind_of), np.zeros((nw, 1), kind_of)])
        into = Assembly(A, Bu, inertia, constant, Uw, np.ones(ny, kind_of), np.zeros(ny, kind_of), [], [])
        port_row = 0
        for index, effect in enumerate(self.effects):
            law = effect.spec
            if isinstance(law, AbsorbedLaw):
                values = [self.value(theta, index, name) for name in effect.coefficients]
                law.absorb(into, self._sites[index], *values)
            elif index in self._port_effects:
                port = model.port(effect.place)
                E[:n0, port_row] = port.act
                P[port_row, :n0], P[port_row, n:] = port.position, port.position_input
                P[m + port_row, :n0], P[m + port_row, n:] = port.velocity, port.velocity_input
                port_row += 1

        lag_drive = []
        for i, state, lag in into.input_lags:
            Ux[i, state] = 1.0
            A[state, state] = -1.0 / lag
            lag_drive.append((state, Uw[i] / lag))
            Uw[i] = 0.0

        A = self.adjusted_rates(A, theta)
        right = np.hstack([A, Bu, E, constant[:, None]])
        solved = np.linalg.solve(inertia, right) if self._has_mass else right
        A, Bu, E, constant = solved[:, :n], solved[:, n : n + nw], solved[:, n + nw : -1], solved[:, -1]
        B = Bu @ Uw
        B[:, nw] += constant
        A = A + Bu @ Ux
        for state, drive in lag_drive:
            B[state] += drive
        Co = np.zeros((ny, n), kind_of)
        Co[:, :n0] = model.output_state
        Ca = np.zeros((ny, n), kind_of)
        Ca[:, :n0] = model.output_rate
        C = Co + model.output_input @ Ux + Ca @ A
        D = model.output_input @ Uw + Ca @ B
        G = Ca @ E
        for i, state, lag in into.output_lags:
            A[state] = C[i] / lag
            A[state, state] -= 1.0 / lag
            B[state] = D[i] / lag
            E[state] = G[i] / lag
            C[i], D[i], G[i] = 0.0, 0.0, 0.0
            C[i, state] = 1.0
        C = C * into.output_gain[:, None]
        D = D * into.output_gain[:, None]
        G = G * into.output_gain[:, None]
        D[:, nw] += into.output_offset
        A, B, E = into.pace * A, into.pace * B, into.pace * E
        sense = np.hstack([P[:, :n] + P[:, n:] @ Ux, P[:, n:] @ Uw])
        return Matrices(A, B, E, C, D, G, sense)

    def adjusted_rates(self, A: NDArray[Any], theta: NDArray[Any]) -> NDArray[Any]:
        """State matrix before masses are divided by: a place for rules that tie its entries together."""
        return A

    @property
    def _has_mass(self) -> bool:
        return any(effect.spec.inertial for effect in self.effects)

    @property
    def absorbed(self) -> NDArray[np.int64]:
        """Columns of theta that enter the matrices."""
        skip = set(self._port_effects) | set(self._input_statics)
        skip |= set(self._output_statics) | set(self._delayed_outputs)
        return np.array([i for i, q in enumerate(self.parameters) if q.effect not in skip], dtype=np.int64)

    def _inner_scale(self, A: NDArray[Any]) -> Array:
        """Powers of two that bring the states of effects, in units of a signal, to those of the model."""
        scale = np.ones(self.n_states)
        for j in range(self.linear_model.n_states, self.n_states):
            others = np.arange(self.n_states) != j
            up, down = np.abs(A[others, j]).max(initial=0.0), np.abs(A[j, others]).max(initial=0.0)
            if up > 0 or down > 0:
                scale[j] = np.sqrt(up / down) if up > 0 and down > 0 else up or 1.0 / down
        return power_of_two(scale)

    def discretize(self, theta: Array, step: float, *, derivatives: bool = True) -> Discrete:
        """One substep of length `step` seconds, exact for the linear part.

        Inputs and port forces run linearly over the substep; a held input is the
        special case of equal ends.
        """
        linear = self.absorbed if derivatives else np.zeros(0, dtype=np.int64)
        points = [theta.astype(float)]
        for column in linear:
            shifted = theta.astype(complex)
            shifted[column] += 1j * _TINY_STEP
            points.append(shifted)
        sets = [self.matrices(point) for point in points]
        n, drive = self.n_states, self.n_inputs + 1 + self.n_ports
        size = n + 2 * drive
        blocks = np.zeros((len(sets), size, size), complex if len(linear) else float)
        # units of inputs, outputs and forces must not cost digits of A
        states = self._inner_scale(sets[0].A)[:, None]
        pushes = [states * np.hstack([matrices.B, matrices.E]) for matrices in sets]
        columns = power_of_two(np.abs(pushes[0]).max(axis=0, initial=0.0))
        for block, matrices, push in zip(blocks, sets, pushes, strict=True):
            block[:n, :n] = states * matrices.A / states.T * step
            block[:n, n : n + drive] = push / columns * step
            block[n : n + drive, n + drive :] = np.eye(drive)
        with np.errstate(over="ignore", invalid="ignore"):  # the engine says so where a model blows up
            exponentials = exponential(blocks)[:, :n, :] / states
            Phi = exponentials[:, :, :n] * states.T
            second = exponentials[:, :, n + drive :] * columns
            first = exponentials[:, :, n : n + drive] * columns - second
        nw = self.n_inputs + 1
        M = np.concatenate(
            [Phi, first[:, :, :nw], second[:, :, :nw], first[:, :, nw:], second[:, :, nw:]], axis=2
        )
        outputs = [np.hstack([s.C, s.D, s.G]) for s in sets]
        dM = np.imag(M[1:]) / _TINY_STEP
        dO = np.array([np.imag(o) / _TINY_STEP for o in outputs[1:]]).reshape(len(linear), *outputs[0].shape)
        dP = np.array([np.imag(s.P) / _TINY_STEP for s in sets[1:]]).reshape(len(linear), *sets[0].P.shape)
        if not dP.any():
            dP = np.zeros((0, *sets[0].P.shape))
        real = np.ascontiguousarray
        return Discrete(
            real(np.real(M[0])),
            real(dM),
            real(np.real(outputs[0])),
            real(dO),
            real(sets[0].P),
            real(dP),
            linear,
        )

    # ------------------------------------------------------------ nonlinear parts
    def laws(self, theta: Array) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], Array]:
        """Codes, coefficients, their columns in theta, and widths of the port laws, as `march` takes them."""
        m = self.n_ports
        codes = np.zeros(m, dtype=np.int64)
        values = np.zeros((m, MAX_COEFFICIENTS + 2))
        columns = np.full((m, MAX_COEFFICIENTS), -1, dtype=np.int64)
        widths = np.ones(m)
        for row, index in enumerate(self._port_effects):
            law = self.effects[index].spec
            assert isinstance(law, PortLaw)
            codes[row] = law.code
            found = self.law_values(theta, index)
            values[row, : len(found)] = found
            values[row, MAX_COEFFICIENTS:] = law.feels_inputs, law.jumps
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
        """Codes, coefficients and their columns of the laws of the sensors, as `march` takes them."""
        ny = self.n_outputs
        codes, values = np.zeros(ny, dtype=np.int64), np.zeros((ny, MAX_COEFFICIENTS))
        columns = np.full((ny, MAX_COEFFICIENTS), -1, dtype=np.int64)
        for index, channel in self.output_statics:
            law, found = self.effects[index].spec, self.law_values(theta, index)
            assert isinstance(law, OutputLaw)
            codes[channel] = law.code
            values[channel, : len(found)] = found
            columns[channel, : len(law.coefficients)] = self.law_columns(index)
        return codes, values, columns

    @property
    def remembers(self) -> bool:
        """Whether the law of a sensor has an inner state."""
        return any(self.effects[index].spec.inner_states for index in self._output_statics)

    @property
    def port_effects(self) -> tuple[int, ...]:
        """Indices of the effects that keep a port of their own."""
        return tuple(self._port_effects)

    @property
    def jumps(self) -> bool:
        """Whether a force jumps with the sign of a velocity."""
        return any(self.effects[index].spec.jumps for index in self._port_effects)

    @property
    def port_columns(self) -> NDArray[np.int64]:
        """Columns of theta that scale the port laws (their first free coefficients)."""
        found = [self.position(index, self.effects[index].coefficients[0]) for index in self._port_effects]
        return np.array([column for column in found if column >= 0], dtype=np.int64)

    @property
    def input_statics(self) -> list[tuple[int, int]]:
        """(effect, channel) of dead zones, saturations and delays at inputs."""
        labels = self.linear_model.input_labels
        return [(index, labels.index(self.effects[index].place)) for index in self._input_statics]

    @property
    def output_statics(self) -> list[tuple[int, int]]:
        """(effect, channel) of the sensors' own laws."""
        labels = self.linear_model.output_labels
        return [(index, labels.index(self.effects[index].place)) for index in self._output_statics]

    @property
    def output_delays(self) -> list[tuple[int, int]]:
        """(effect, channel) of delays at outputs."""
        labels = self.linear_model.output_labels
        return [(index, labels.index(self.effects[index].place)) for index in self._delayed_outputs]

    @property
    def is_linear(self) -> bool:
        """Whether every effect is absorbed into A, B, C, D."""
        others = self._port_effects + self._input_statics + self._output_statics + self._delayed_outputs
        return not others

    def state_labels(self) -> list[str]:
        """State names, those that effects add included."""
        names = list(self.linear_model.state_labels)
        for index, what in self._extra:
            names.append(f"{self.effects[index].label} {what}".replace(" ", "_").replace(".", "_"))
        return names

    def system(self, theta: Array, name: str | None = None) -> ct.StateSpace:
        """The model with its linear effects, as a continuous `StateSpace`."""
        matrices = self.matrices(theta.astype(float))
        nw = self.n_inputs
        return self.linear_model.with_arrays(
            A=matrices.A,
            B=matrices.B[:, :nw],
            C=matrices.C,
            D=matrices.D[:, :nw],
            state_labels=tuple(self.state_labels()),
        ).to_statespace(name)
