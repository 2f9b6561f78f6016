"""Expected separation of candidate effects by a future record.

The present record explains these effects equally well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import control as ct
import numpy as np

from ..data.measurement import Measurement
from ..effects.effect import Effect
from ..engine.engine import Engine
from ..engine.observer import observer_gain
from ..engine.structure import Structure
from ..exceptions import DivergenceError
from ..gauss_newton import Rows, gauss_newton
from ..inference.assembly import windows
from ..inference.fitted import evaluated
from ..inference.levels import levels
from ..inference.problem import Problem
from ..inference.refinement import Refinement
from ..inference.whitening import Whitener
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array

_REFITS = 6  # Gauss-Newton steps of a rival towards what it is to imitate
_PLAIN = 100.0  # squared distance at which rivals are separate beyond doubt
_DRAWS = 4000
_KNOWN = 1e-10  # eigenvalue, relative, below which a direction of the coefficients is exactly known


class Contender(NamedTuple):
    """An explanation of the present record.

    Attributes
    ----------
    effect : Effect or None
        Its effect; None for "nothing is missing".
    refinement : Refinement
        Model with it, fitted.
    weight : float
        Its probability among the contenders; 0 for one that is only compared with.
    twice_log : float
        Twice its log-likelihood on the present record, up to a constant.
    """

    effect: Effect | None
    refinement: Refinement
    weight: float
    twice_log: float

    @property
    def surplus(self) -> int:
        """Number of coefficients beyond the first.

        `diagnose` penalizes each of them.
        """
        if self.effect is None:
            return 0
        return len([n for n in self.effect.coefficients if n not in self.effect.fixed]) - 1

    @property
    def label(self) -> str:
        """Name in tables."""
        return "nothing missing" if self.effect is None else self.effect.label


class Plan(NamedTuple):
    """A record to be taken.

    Attributes
    ----------
    record : Measurement
        Its inputs; the outputs do not matter.
    levels : ndarray, shape (n_y,)
        Noise of each sensor, standard deviation.
    whitener : Whitener
        Colour of the noise, in units of `levels`.
    sensor : tuple of (str, ndarray), or None
        Label and row of a sensor that the model does not have yet.
    joined : bool
        Whether the present record is judged together with it.
    before : int
        Values in the present record.
    """

    record: Measurement
    levels: Array
    whitener: Whitener
    sensor: tuple[str, Array] | None = None
    joined: bool = True
    before: int = 1


class Separation(NamedTuple):
    """Expected separation that a plan achieves.

    Attributes
    ----------
    probability : float
        That the true contender then stands alone, over all contenders by their weight.
    wrong : float
        That a wrong one then leads by as much.
    distances : ndarray, shape (k, k)
        Entry (i, j): squared distance over the noise that is left between the outputs of
        contender i and those of j refitted to them.
    failed : str
        Why the plan cannot be judged, empty where it can.
    """

    probability: float
    wrong: float
    distances: Array
    failed: str = ""


class _Side(NamedTuple):
    """Contender on a plan.

    It holds the structure, the coefficients with the information on them, and the starting values.
    """

    structure: Structure
    theta: Array
    root: Array  # (r, p): root' root is the information on theta from the present record
    start: Array
    substeps: int
    ratio: float


def separation(contenders: Sequence[Contender], plan: Plan, ratio: float = 0.0) -> Separation:
    """Compute how well a plan separates the contenders.

    Every contender is simulated on the plan. Every other one is refitted to it and compared.

    Parameters
    ----------
    contenders : sequence of Contender
        Explanations, two at least.
    plan : Plan
        Record to be taken.
    ratio : float
        Unmeasured force over the measured one that the observer allows for, 0 for none.

    Returns
    -------
    Separation

    Notes
    -----
    To first order, twice the log-likelihood of truth i over candidate j is normal with mean
    L + D and standard deviation 2 sqrt(D): D is the squared distance after the refit, in
    which what the present record says of the coefficients of j counts as a prior, and L
    is what the present record says already. So P = Phi((L + D - 9.2) / (2 sqrt(D))).
    Beyond that, the spread of the coefficients of i and the different freedom of the
    candidates enter through draws of the linearized statistic, all candidates at once.
    """
    # each contender as a structure with the information from the present record
    sides = [_side(c.refinement, plan, ratio) for c in contenders]
    steps = max(side.substeps for side in sides)
    k = len(sides)
    distances = np.zeros((k, k))
    right = wrong = 0.0
    samples = plan.record.n_samples * sides[0].structure.n_outputs
    # Schwarz's penalty: of the new record alone, or of what it adds
    price = np.log(samples) if not plan.joined else np.log1p(samples / max(plan.before, 1))
    decided = levels().rival
    # each contender in turn is the truth: simulate, refit the others, compare
    for i, truth in enumerate(sides):
        if contenders[i].weight == 0:
            continue
        try:
            record = _simulated(truth, plan, steps)
        except DivergenceError:
            label = contenders[i].label
            return Separation(0.0, 0.0, distances, f"the model with {label} runs away there")
        own = _Fit(truth, record, plan, steps)
        others = [j for j in range(k) if j != i]
        fits = [_Fit(sides[j], record, plan, steps).imitate() for j in others]
        distances[i, others] = [fit.distance for fit in fits]
        lead = np.zeros(k - 1)
        if plan.joined:
            lead = np.array([contenders[i].twice_log - contenders[j].twice_log for j in others])
        # present log-likelihoods and penalties are the start of the lead
        lead = lead + price * np.array([contenders[j].surplus - contenders[i].surplus for j in others])
        margins = _margins(own, fits) + lead
        # decided if the truth leads all others by `rival`
        right += contenders[i].weight * float(np.mean((margins > decided).all(axis=1)))
        wrong += contenders[i].weight * float(np.mean((margins < -decided).any(axis=1)))
    return Separation(right, wrong, distances)


def _side(refinement: Refinement, plan: Plan, ratio: float) -> _Side:
    structure, theta, steps = refinement.simulation_structure()
    if plan.sensor is not None:
        model = with_sensor(structure.model, *plan.sensor)
        structure = Structure(model, structure.effects, constants=structure.constants)
    root = _information_root(refinement.covariance) if plan.joined else np.zeros((0, theta.size))
    return _Side(structure, theta, root, refinement.initial_states[0], steps, ratio)


def _information_root(covariance: Array) -> Array:
    """Return R with R'R equal to the inverse of a covariance.

    It is zero where the record holds no information.
    """
    seen = np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0)
    sd = np.sqrt(np.diag(covariance)[seen])
    half = _inverse_root(covariance[np.ix_(seen, seen)] / np.outer(sd, sd), _KNOWN)
    root = np.zeros((half.shape[1], covariance.shape[0]))
    root[:, seen] = half.T / sd
    return root


def _inverse_root(gram: Array, least: float) -> Array:
    """Return R with R R' equal to the inverse of a matrix.

    Eigenvectors with an eigenvalue below a share of the largest are left out.
    """
    values, vectors = np.linalg.eigh(gram)
    keep = values > least * values.max(initial=0.0)
    return np.asarray(vectors[:, keep] / np.sqrt(values[keep]))


def _simulated(side: _Side, plan: Plan, steps: int) -> Measurement:
    """Return the record that this contender would produce, without noise."""
    # the contender's own response, sensor noise left out
    shell, structure = plan.record, side.structure
    ins, outs = structure.linear_model.input_labels, structure.linear_model.output_labels
    silent, hold = np.zeros((len(outs), shell.n_samples)), shell.hold
    blank = Measurement(shell.inputs, silent, dt=shell.dt, hold=hold, input_labels=ins, output_labels=outs)
    run = Engine(structure, blank, substeps=steps).run(side.theta, side.start, sensitivity=False)
    return replace(blank, outputs=run.outputs)


class _Fit:
    """Contender fitted to a noise-free record.

    The information from the present record is its prior.
    """

    def __init__(self, side: _Side, record: Measurement, plan: Plan, steps: int) -> None:
        self.side, self.whitener = side, plan.whitener
        pieces, _ = windows(side.structure.model, [record], None)
        self.problem = Problem(side.structure, pieces, 1.0 / plan.levels, substeps=steps)
        self.gain = None
        if side.ratio > 0:
            self.gain = observer_gain(side.structure, side.theta, record, side.ratio)
        # coefficients of the contender, initial states along its run
        self.point = self.problem.pack(side.theta, self._starts(pieces, record, steps))
        self.residual, self.slopes = self._rows(self.point)

    def _starts(self, pieces: Sequence[Measurement], record: Measurement, steps: int) -> Array:
        """Initial state of each window, along the contender's own run."""
        if len(pieces) == 1:
            return self.side.start[None]
        run = Engine(self.side.structure, record, substeps=steps).run(
            self.side.theta, self.side.start, sensitivity=False, histories=True, check=False
        )
        first = np.cumsum([0, *(piece.n_samples for piece in pieces[:-1])])
        return np.nan_to_num(run.states[:, first].T)

    def _rows(self, point: Array) -> tuple[Array, Array]:
        """Whitened residual and slopes, the prior's rows below them."""
        blocks = evaluated(self.problem, point, self.gain)
        side = self.side
        # data rows whitened, then the prior from the present record
        r = self.whitener.apply([block for block, _ in blocks])
        J = self.whitener.apply(self.problem.whole([jacobian for _, jacobian in blocks]))
        below = np.pad(side.root, ((0, 0), (0, self.problem.size - side.theta.size)))
        self.n_data = r.size
        return np.concatenate([r, side.root @ (point[: side.theta.size] - side.theta)]), np.vstack([J, below])

    @property
    def distance(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)

    def imitate(self) -> _Fit:
        """Fit the record, as exactly as the decision needs."""
        problem = self.problem

        def rows(box: Array) -> Rows:
            point = problem.coordinates.point(box)
            known = np.array_equal(point, self.point)
            residual, slopes = (self.residual, self.slopes) if known else self._rows(point)
            return Rows(residual, problem.coordinates.columns(slopes, point), (point, residual, slopes))

        # as exact as the decision needs: coarse where the distance is large
        def settled(cost: float, gain: float) -> bool:
            left = 2.0 * (cost - gain)
            return 2.0 * gain < 0.02 + (0.1 if left > _PLAIN else 0.003) * left

        low, high = problem.box()
        run = gauss_newton(
            rows, problem.coordinates.of(self.point), lower=low, upper=high, sizes=problem.sizes,
            evaluations=1 + _REFITS, settled=settled, damping=0.0,
        )  # fmt: skip
        if np.isfinite(run.cost):
            self.point, self.residual, self.slopes = run.rows.more
        return self

    def basis(self) -> Array:
        """Orthonormal basis of what this contender can absorb, data rows only."""
        # orthonormal basis by the eigenvectors of the normalized Gram matrix
        size = np.linalg.norm(self.slopes, axis=0)
        unit = self.slopes[:, size > 0] / size[size > 0]
        return np.asarray((unit @ _inverse_root(unit.T @ unit, 1e-12))[: self.n_data])


def _margins(own: _Fit, fits: Sequence[_Fit]) -> Array:
    """Draw the log-likelihood ratio of the truth over each contender.

    Twice the ratio is returned, shape (draws, contenders). The data are u = noise + effect of the spread of
    the true coefficients. Each fit leaves the part of its residual a that it cannot explain: |a|^2 + 2 a'u +
    |u|^2 - |Q'u|^2.
    """
    n, side = own.n_data, own.side
    # spread of the true coefficients under the present information
    spread = np.zeros((n, 0))
    if side.root.shape[0]:
        spread = own.slopes[:n, : side.theta.size] @ _inverse_root(side.root.T @ side.root, 1e-14)
    Q = own.basis()
    parts = [Q, *(fit.basis() for fit in fits), np.column_stack([fit.residual[:n] for fit in fits])]
    widths = np.cumsum([0, *(part.shape[1] for part in parts)])
    # all needed inner products are Gaussian with covariance B'B: draw them directly
    B = np.concatenate(parts, axis=1)
    values, vectors = np.linalg.eigh(B.T @ B)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    rng = np.random.default_rng(0)  # the same draws for every plan: options differ by what they are
    along = rng.standard_normal((_DRAWS, B.shape[1])) @ root.T
    along += rng.standard_normal((_DRAWS, spread.shape[1])) @ (B.T @ spread).T
    # energy that each contender absorbs from noise and spread
    absorbed = [np.sum(along[:, a:b] ** 2, axis=1) for a, b in pairwise(widths[:-1])]
    crossed = along[:, widths[-2] :]
    return np.column_stack(
        [fit.distance + 2 * crossed[:, j] + absorbed[0] - absorbed[j + 1] for j, fit in enumerate(fits)]
    )


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
    # unit of the state, if the sensor reads a single one
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
    # states of the kind that is measured: positions or velocities, and first-order states
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
