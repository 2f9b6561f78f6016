"""Frequency response of a structure, with exact sensitivities.

The frequencies are those of a measured response. It takes the place of `Engine` where data are frequency
responses: what is simulated, compared and fitted are real and imaginary parts over their noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.measurement import Measurement
from ..data.response_record import ResponseRecord, coded
from ..effects.formula import FormulaLaw
from ..exceptions import DivergenceError, ModelError
from ..models.operating_point import refuse_point
from ..models.ports import felt
from ..systems.linear import Array, LinearModel
from .engine import Engine, Trajectory
from .leading import leading_gain
from .line_balance import LineBalance, remembering
from .structure import Structure
from .substep import TINY_STEP, tiny_steps

Complex = NDArray[np.complex128]
_PHASES = 16  # of a period of a sine
_BATCH = 4_000_000  # complex numbers at once (64 MB)


def engine_on(
    structure: Structure,
    data: Measurement | ResponseRecord,
    *,
    substeps: int = 1,
    initial: Array | None = None,
) -> Engine | ResponseEngine:
    """Return the engine for a time record or for a frequency response."""
    if isinstance(data, ResponseRecord):
        return ResponseEngine(structure, data, substeps=substeps)
    return Engine(structure, data, substeps=substeps, initial=initial, lead=leading_gain(structure, data))


def is_linear(structure: Structure) -> bool:
    """Return whether the response to a sine is independent of amplitude.

    This is so with linear effects and delays alone.
    """
    channels = [*structure.input_statics, *structure.output_statics]
    return not structure.n_ports and all(structure.effects[index].spec.delays for index, _ in channels)


class ResponseEngine:
    """A structure at the frequencies of a measured response.

    Parameters
    ----------
    structure : Structure
        Model and effects.
    data : ResponseRecord
        Response; its channels stand in the order of the model's.
    substeps : int, optional
        Of no meaning here; kept.

    Raises
    ------
    ModelError
        If an effect is nonlinear and the amplitude of the sines is not known, or the model itself is.
    """

    lead: Array | None = None  #: no observer leads a response

    def __init__(self, structure: Structure, data: ResponseRecord, *, substeps: int = 1) -> None:
        self.structure, self.data, self.substeps = structure, data, substeps
        if structure.field is not None:
            raise ModelError(
                "a frequency response is that of a linear model with effects; give a linearization of the "
                "nonlinear one (Refinement.linearize, control.linearize)"
            )
        if structure.model.controller is not None:
            raise ModelError(
                "a frequency response is that of the model alone; leave the controller out, or close the "
                "loop with control.feedback"
            )
        drifting = [effect.label for effect in structure.effects if effect.spec.drifts]
        if drifting:
            raise ModelError(f"{drifting[0]} shows in records in time, and in no response; leave it out")
        self._balance = None if is_linear(structure) else _balanced(structure, data)

    def run(self, theta: Array, x0: Array | None = None, *, sensitivity: bool = True, **_: Any) -> Trajectory:
        """Return the response in rows as those of the data, with derivatives.

        There are no states and no observer.

        Parameters
        ----------
        theta : ndarray, shape (p,)
            Free coefficients.
        x0 : ndarray, optional
            Of no meaning here.
        sensitivity : bool
            Whether to carry derivatives by theta.

        Returns
        -------
        Trajectory
            `blew_up` is 0 where a pole lies on a frequency, or the matrices are no numbers; else -1.
        """
        noise = self.data.noise
        try:
            response, slopes = self.response(theta, derivatives=sensitivity)
        except DivergenceError:
            lost = np.full(self.data.outputs.shape, np.inf)
            free = self.structure.n_parameters if sensitivity else 0
            return Trajectory(lost, np.zeros((*lost.shape, free)), lost[:0], lost[:0], 0)
        rows = coded(response) / noise
        columns = np.empty((*rows.shape, len(slopes)))
        for k, slope in enumerate(slopes):
            columns[:, :, k] = coded(slope) / noise
        empty = np.zeros((0, rows.shape[1]))
        return Trajectory(rows, columns, empty, empty, -1 if np.isfinite(rows).all() else 0)

    def begin(self, other: ResponseEngine) -> None:
        """Start from the answers of a model without the last laws."""
        if self._balance is not None:
            self._balance.begin(other._balance)

    def judged(self, theta: Array) -> NDArray[np.bool_]:
        """No point is hidden."""
        return np.ones(self.data.outputs.shape, dtype=bool)

    def push(self, theta: Array, place: str) -> Complex | None:
        """Return the change of the response by a unit of complex stiffness.

        The stiffness acts at a place; the change has shape (n_y, n_w, n_omega). At a channel, the change is
        that by a unit of a factor on it. The result is None where `place` is neither.
        """
        s = self.structure
        labels = s.linear_model.input_labels, s.linear_model.output_labels
        if place in labels[0] or place in labels[1]:
            response = self.response(theta, derivatives=False)[0]
            through = np.zeros(response.shape, complex)
            where = np.s_[:, labels[0].index(place)] if place in labels[0] else np.s_[labels[1].index(place)]
            through[where] = response[where]
            return through
        port = next((port for port in s.model.ports if port.name == place), None)
        if port is None:
            return None
        m, n, nw = s.matrices(theta.astype(float)), s.n_states, s.n_inputs
        n0 = s.linear_model.n_states
        seen = "position" if port.has_position else "velocity"
        sense, direct = getattr(port, seen), getattr(port, f"{seen}_input")
        row, act = np.pad(sense, (0, n - n0))[None], np.pad(port.act, (0, n - n0))[:, None]
        out = felt(port, s.model.output_rate)
        points = 1j * self.data.omega
        to, _ = _transfer([(m.A, m.B[:, :nw], row, direct[None])], points)
        back, _ = _transfer([(m.A, act, m.C, out[:, None])], points)
        late = self._delayed(theta, np.ones((s.n_outputs, nw, points.size), complex), [])[0]
        return np.asarray(-back * to * late)

    # ------------------------------------------------------------------ linear
    def response(self, theta: Array, *, derivatives: bool = True) -> tuple[Complex, list[Complex]]:
        """Return the complex frequency response, and its derivatives.

        Its shape is (n_y, n_w, n_omega); there is one derivative for each free coefficient.

        Raises
        ------
        DivergenceError
            If the matrices are no numbers.
        """
        if self._balance is not None:
            return self._balance.response(theta, derivatives=derivatives)
        s, omega, data = self.structure, self.data.omega, self.data.measured
        columns = s.absorbed if derivatives else np.zeros(0, dtype=np.int64)
        sets = self._matrices(theta, columns)
        if not all(np.isfinite(block).all() for block in sets[0]):
            raise DivergenceError("the model with these effects is no number; start from other coefficients")
        sampled = data.dt > 0 and data.hold != "bandlimited"
        points = np.exp(1j * omega * data.dt) if sampled else 1j * omega
        G, found = _transfer(sets, points)
        slopes = [np.zeros(G.shape, complex)] * (s.n_parameters if derivatives else 0)
        for column, slope in zip(columns, found, strict=True):
            slopes[column] = slope
        return self._delayed(theta, G, slopes)

    def _matrices(self, theta: Array, columns: NDArray[np.int64]) -> list[tuple[Array, ...]]:
        """Return A, B, C, D of the response, then their derivatives.

        They are discrete-time if the response is sampled. The derivatives are by the given coefficients.
        """
        s, data = self.structure, self.data.measured
        nw = s.n_inputs
        if not data.dt or data.hold == "bandlimited":
            m = tiny_steps(s, theta, columns)
            blocks = m.A, m.B[:, :, :nw], m.C, m.D[:, :, :nw]
            slopes = zip(*(block[: columns.size].imag / TINY_STEP for block in blocks), strict=True)
            return [tuple(block[0].real for block in blocks), *slopes]
        disc = s.discretize(theta, data.dt, derivatives=columns.size > 0)
        n, drive = s.n_states, nw + 1
        found: list[tuple[Array, ...]] = []
        for M, O in zip((disc.M, *disc.dM), (disc.O, *disc.dO), strict=True):
            Phi, first, second = M[:, :n], M[:, n : n + nw], M[:, n + drive : n + drive + nw]
            C, D = O[:, :n], O[:, n : n + nw]
            if data.hold == "zoh":
                found.append((Phi, first + second, C, D))
            elif not found:  # x(k) = xi(k) + second w(k) takes the input ahead out of the state equation
                found.append((Phi, first + Phi @ second, C, D + C @ second))
                whole = Phi, second, C
            else:
                B = first + Phi @ whole[1] + whole[0] @ second
                found.append((Phi, B, C, D + C @ whole[1] + whole[2] @ second))
        return found

    def _delayed(self, theta: Array, G: Complex, slopes: list[Complex]) -> tuple[Complex, list[Complex]]:
        """With the delays of inputs and outputs."""
        s = self.structure
        late: list[tuple[int, Any]] = [(index, np.s_[:, channel]) for index, channel in s.input_statics]
        late += [(index, np.s_[channel]) for index, channel in s.output_delays]
        G, slopes = G.copy(), [one.copy() for one in slopes]
        for index, where in late:
            law = s.effects[index].spec
            assert isinstance(law, FormulaLaw)
            factor, slope = law.response(self.data.omega, s.law_values(theta, index)[0])
            column = s.position(index, s.effects[index].coefficients[0])
            if column >= 0 and slopes:
                slopes[column][where] = G[where] * slope
            for one in (G, *(other for k, other in enumerate(slopes) if k != column)):
                one[where] *= factor
        return G, slopes


def _balanced(structure: Structure, data: ResponseRecord) -> LineBalance:
    """The harmonic balance of nonlinear effects at the lines of a response.

    Raises
    ------
    ModelError
        If the amplitude is not known, a law remembers, or the points are those of held signals.
    """
    named = ", ".join(e.label for e in structure.effects if not e.spec.linear)
    if data.measured.amplitude is None:
        raise ModelError(
            f"{named}: the response depends on the amplitude of the sine; give the response amplitude="
        )
    if memory := remembering(structure):
        listed = ", ".join(memory)
        raise ModelError(f"{listed}: laws with memory take records in time, no frequency responses yet")
    if data.measured.dt and data.measured.hold != "bandlimited":
        raise ModelError(f"{named}: held inputs are no sines; give the response of continuous signals (dt=0)")
    refuse_point(structure.model, "a frequency response with nonlinear effects")
    return LineBalance(structure, data)


def _transfer(sets: list[tuple[Array, ...]], points: NDArray[Any]) -> tuple[Complex, list[Complex]]:
    """Return C (z - A)^-1 B + D at every point, and its derivatives.

    They follow from the derivatives of A, B, C, D.
    """
    A, B, C, D = sets[0]
    n, n_y, n_w = A.shape[0], *D.shape
    G = np.empty((n_y, n_w, points.size), complex)
    slopes = [np.empty(G.shape, complex) for _ in sets[1:]]
    batch = max(1, _BATCH // max(1, n * (n + n_w + n_y)))
    for start in range(0, points.size, batch):
        part = slice(start, start + batch)
        shifted = points[part, None, None] * np.eye(n) - A
        try:
            X = np.linalg.solve(shifted, np.broadcast_to(B.astype(complex), (len(shifted), n, n_w)))
            left = np.broadcast_to(C.T.astype(complex), (len(shifted), n, n_y))
            Z = np.swapaxes(np.linalg.solve(np.swapaxes(shifted, 1, 2), left), 1, 2)
        except np.linalg.LinAlgError:  # a pole lies on a point
            G[:, :, part] = np.nan
            for slope in slopes:
                slope[:, :, part] = np.nan
            continue
        G[:, :, part] = np.moveaxis(C @ X + D, 0, -1)
        for slope, (dA, dB, dC, dD) in zip(slopes, sets[1:], strict=True):
            changed = Z @ (dA @ X + dB) + dC @ X + dD
            slope[:, :, part] = np.moveaxis(changed, 0, -1)
    return G, slopes


def port_phasors(
    structure: Structure, theta: Array, data: ResponseRecord, place: str
) -> tuple[Complex, Complex]:
    """Return the phasors of displacement and velocity at a place.

    The inputs are sines; each result has shape (n_w n_omega,).
    """
    m, nw = structure.matrices(theta.astype(float)), structure.n_inputs
    port, added = structure.model.port(place), structure.n_states - structure.linear_model.n_states
    rows = np.pad(np.array([port.position, port.velocity]), ((0, 0), (0, added)))
    through = np.array([port.position_input, port.velocity_input])
    G, _ = _transfer([(m.A, m.B[:, :nw], rows, through)], 1j * data.omega)
    d, v = np.nan_to_num(G) * data.inputs[0, : data.omega.size]
    return d.ravel(), v.ravel()


def sampled(phasors: Complex) -> Array:
    """A period of each sine, one after the other."""
    turns = np.exp(2j * np.pi * np.arange(_PHASES) / _PHASES)
    return np.asarray(np.real(phasors[:, None] * turns).ravel())


def channel_signal(linear: LinearModel, data: ResponseRecord, place: str, at_input: bool) -> Array:
    """A period of each sine at an input or output."""
    peaks = data.inputs[0, : data.omega.size]
    if at_input:
        return sampled(peaks.astype(complex))
    points = data.measured.response[linear.output_labels.index(place)] * peaks
    return sampled(points.ravel())
