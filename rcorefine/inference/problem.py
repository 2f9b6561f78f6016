"""Estimation problem on records with priors, and its descent.

The unknowns are the coefficients and the initial states.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ..data.measurement import Measurement
from ..data.response_record import ResponseRecord
from ..data.signals import measured, spreads
from ..engine.amplitude_response import engine_on, is_linear
from ..engine.initial_state import added_states, brief_modes
from ..engine.structure import Structure
from ..gauss_newton import Bordered, Rows, gauss_newton, promised
from ..systems.linear import Array
from .whitening import RESOLUTION, Whitener


class Coordinates:
    """Coefficients and initial states, as a descent takes them.

    A coefficient that exceeds another becomes the excess. The size of a power of the motion becomes that at
    the usual motion: at unit motion, which may be far off, it changes by decades with the power, and a
    descent creeps along that valley.

    Attributes
    ----------
    ordered : list of (int, int)
        Columns of theta of which the first is never below the second.
    powers : list of (int, int, float)
        Columns of theta of a size and of its power, with the logarithm of the usual motion.
    """

    def __init__(self, structure: Structure) -> None:
        self.ordered: list[tuple[int, int]] = []
        self.powers: list[tuple[int, int, float]] = []
        # free pairs: the larger first, or a size with its power
        for index, effect in enumerate(structure.effects):
            for names in effect.spec.order:
                pair = structure.position(index, names[0]), structure.position(index, names[1])
                self.ordered += [pair] if min(pair) >= 0 else []
            # usual motion: its smoothing width over the share that this is of it
            usual = structure.constants.get(index, 0.0) / (effect.spec.width_share or np.inf)
            for names in effect.spec.powers if 0.0 < usual < np.inf else ():
                pair = structure.position(index, names[0]), structure.position(index, names[1])
                self.powers += [(*pair, float(np.log(usual)))] if min(pair) >= 0 else []

    def of(self, point: Array) -> Array:
        """The coordinates of a point."""
        # size * usual^power in place of the size, larger - smaller in place of the larger
        box = point.copy()
        for size, power, usual in self.powers:
            box[size] *= np.exp(usual * point[power])
        for larger, smaller in self.ordered:
            box[larger] -= point[smaller]
        return box

    def point(self, box: Array) -> Array:
        """The point of these coordinates."""
        # inverse, in opposite order
        point = box.copy()
        for larger, smaller in self.ordered:
            point[larger] += box[smaller]
        for size, power, usual in self.powers:
            point[size] *= np.exp(-usual * point[power])
        return point

    def columns(self, jacobian: Array, point: Array) -> Array:
        """Convert derivatives at a point into those by its coordinates.

        The shape is (rows, size).
        """
        if not self.ordered and not self.powers:
            return jacobian
        # chain rule: the power acts on the size at the usual motion, the smaller on the larger
        turned = jacobian.copy()
        for size, power, usual in self.powers:
            turned[:, power] -= usual * point[size] * jacobian[:, size]
            turned[:, size] *= np.exp(-usual * point[power])
        for larger, smaller in self.ordered:
            turned[:, smaller] += jacobian[:, larger]
        return turned


_LARGEST = 1e60
_ROUNDING = 1e-22  # share of the level below which a cost is rounding
_FAILED = 1e8  # residual of a simulation that diverged: large, but finite


class Priors(NamedTuple):
    """Normal priors of coefficients and initial states.

    Attributes
    ----------
    mean, sd : ndarray, shape (p,), or None
        Of the coefficients; sd = inf for none. None where no coefficient has one.
    added : bool
        Whether states that effects add start about as large as they become (`added_states`).
    """

    mean: Array | None = None
    sd: Array | None = None
    added: bool = False


class Problem:
    """Output errors or innovations of a structure on several records.

    The point is ``[theta / scale, x0 of record 1, x0 of record 2, ...]``.

    Parameters
    ----------
    structure : Structure
        Model with effects.
    records : sequence of Measurement
        Segments; each has an initial state of its own.
    weights : ndarray, shape (n_y,)
        One over the noise level of each output.
    priors : Priors
        Of coefficients, and of states that effects add; none by default.
    substeps : int
        Substeps per sampling interval.
    initial : ndarray of shape (n,), or None
        Known initial state; estimated per record where None, and of no meaning for frequency responses.
    hold_brief : bool
        Whether brief modes start as they move (`brief_modes`), to a prior in units of the noise: not where
        the weights are no noise levels.

    Attributes
    ----------
    in_time : bool
        Whether the records are signals in time, and no frequency responses.
    """

    def __init__(
        self,
        structure: Structure,
        records: Sequence[Measurement] | Sequence[ResponseRecord],
        weights: Array,
        *,
        priors: Priors = Priors(),  # noqa: B008
        substeps: int = 1,
        initial: Array | None = None,
        hold_brief: bool = True,
    ) -> None:
        self.structure, self.weights = structure, weights
        self.coordinates = Coordinates(structure)
        self.records: list[Any] = list(records)
        self.in_time: bool = self.records[0].in_time
        if not self.in_time:  # a response has no start
            initial = np.zeros(structure.n_states)
        p = structure.n_parameters
        self.priors, self.hold_brief = priors, hold_brief
        self.prior_mean: Array = np.zeros(p) if priors.mean is None else priors.mean
        self.prior_sd: Array = np.full(p, np.inf) if priors.sd is None else priors.sd
        self.initial, self.substeps = initial, substeps
        # one simulation engine for each record
        self.engines: list[Any] = [
            engine_on(structure, r, substeps=substeps, initial=initial) for r in records
        ]
        self.n_theta, self.n_states = p, structure.n_states
        self.free_start = initial is None
        self._cache: tuple[Array, Array | None, Evaluation] | None = None
        self.n_points = measured(record.outputs for record in self.records)

    def like(
        self, structure: Structure | None = None, records: Sequence[Any] | None = None, **changes: Any
    ) -> Problem:
        """Return a copy with another structure, other records or arguments."""
        structure = structure or self.structure
        given = {name: getattr(self, name) for name in ("weights", "priors", "substeps", "hold_brief")}
        if self.initial is not None:
            given["initial"] = np.pad(self.initial, (0, structure.n_states - self.initial.size))
        return Problem(structure, records or self.records, **{**given, **changes})

    def whitener(self, residuals: Sequence[Array], order: int | None = None) -> Whitener:
        """Filter of residuals, of at most the order `color`, or of a given order.

        No innovation is smaller than the resolution of an output: an exact record has no other noise.
        """
        # floor of the innovations: resolution of the outputs, in units of the noise
        outputs = np.hstack([record.outputs for record in self.records])
        resolved = RESOLUTION * (self.color != 0) * self.weights * spreads(outputs)
        return Whitener.fit(residuals, order=order, most=self.color, floor=resolved)

    @property
    def color(self) -> int | None:
        """Highest order of the noise filter, None for any."""
        orders: list[Any] = [record.color for record in self.records]
        return None if None in orders else max(orders)

    @property
    def stepped(self) -> bool:
        """Return whether the accuracy depends on the substeps."""
        return self.in_time and not self.structure.is_linear

    @property
    def dwells(self) -> bool:
        """Return whether each evaluation needs a harmonic balance.

        It does where nonlinear effects respond to sines.
        """
        return not self.in_time and not is_linear(self.structure)

    @property
    def precision(self) -> Array:
        """One over the prior variance of each unknown, 0 for none."""
        found = np.zeros(self.size)
        # inverse variance of the Gaussian priors
        held = np.isfinite(self.prior_sd) & (self.prior_sd > 0)
        found[: self.n_theta][held] = self.prior_sd[held] ** -2.0
        return found

    @cached_property
    def sizes(self) -> Array:
        """Return the natural sizes of the unknowns."""
        # sizes of the states from a run at the prior mean
        rest = np.zeros(self.size - self.n_theta)
        theta = self.inside(np.concatenate([self.prior_mean, rest]))[: self.n_theta]
        states = [one.state_sizes(theta) for one in self.engines if self.free_start]
        return np.concatenate([self._theta_sizes, *states])

    @cached_property
    def _theta_sizes(self) -> Array:
        return natural_sizes(self.structure, self.records)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.n_theta + (len(self.records) * self.n_states if self.free_start else 0)

    def pack(self, theta: Array, starts: Array) -> Array:
        """Join coefficients and initial states, shape (records, n)."""
        return np.concatenate([theta, starts.ravel()]) if self.free_start else theta.copy()

    def unpack(self, point: Array) -> tuple[Array, Array]:
        """Split a point into coefficients and initial states."""
        theta = point[: self.n_theta]
        if self.free_start:
            return theta, point[self.n_theta :].reshape(len(self.records), self.n_states)
        assert self.initial is not None
        return theta, np.tile(self.initial, (len(self.records), 1))

    def evaluate(self, point: Array, gain: Array | None = None) -> Evaluation:
        """Weighted residual (model minus record, then priors) and its Jacobian.

        With a gain (n, n_y) an observer corrects the state, and the residual holds its innovations.
        """
        if self._cache is not None and _equal((point, gain), self._cache[:2]):
            return self._cache[2]
        theta, starts = self.unpack(point)
        rows, blocks, places, gaps, finite = [], [], [], [], True
        judged = self.judged(theta)
        # simulation of each record with its sensitivities
        for i, engine in enumerate(self.engines):
            run = engine.run(theta, starts[i], initial_state=self.free_start, gain=gain, check=False)
            ok = run.blew_up < 0 and _is_bounded(run.outputs) and _is_bounded(run.sensitivity)
            finite &= ok
            width = run.sensitivity.shape[2]
            # residual = weight (model - record), and its Jacobian
            if ok:
                weights = self.weights[:, None] * judged[i]
                error = (weights * (run.outputs - engine.data.outputs)).ravel()
                block = (weights[:, :, None] * run.sensitivity).reshape(error.size, width)
            # diverged: a large finite residual without derivatives
            else:
                error = np.full(engine.data.outputs.size, _FAILED)
                block = np.zeros((error.size, width))
            # what was not measured costs nothing
            gaps.append(engine.data.there if engine.data.there is None else ~engine.data.there.ravel())
            if gaps[i] is not None:
                error[gaps[i]] = block[gaps[i]] = 0.0
            rows.append(error)
            blocks.append(block)
            places.append(self.felt_by(i))
        # priors as further rows: (unknown - mean) / standard deviation
        expected, prior = self.prior_rows(point)
        result = Evaluation(np.concatenate([*rows, expected]), blocks, places, gaps, prior, finite)
        self._cache = (point.copy(), gain, result)
        return result

    def prior_rows(self, point: Array) -> tuple[Array, Array]:
        """Return the distances of the unknowns from their priors.

        They are in standard deviations; their derivatives are the second value.
        """
        rows = self._prior
        return rows @ point - self._expected, rows

    @cached_property
    def _prior(self) -> Array:
        """Return the rows of the priors.

        First come the coefficients that have a prior, then the initial states of brief modes.
        """
        # Gaussian priors of the coefficients
        held = np.flatnonzero(np.isfinite(self.prior_sd))
        starts = []
        # priors of the initial states, for brief modes and for the states of effects
        if self.free_start:
            none = np.zeros((0, self.n_states))
            starts = [brief_modes(engine) if self.hold_brief else none for engine in self.engines]
            if self.priors.added and self.n_states > self.structure.linear_model.n_states:
                theta = self.inside(np.pad(self.structure.start(), (0, self.size - self.n_theta)))
                added = [added_states(engine, theta[: self.n_theta]) for engine in self.engines]
                starts = [np.vstack(pair) for pair in zip(starts, added, strict=True)]
        # one row for each prior
        return np.asarray(block_diag(np.eye(self.n_theta)[held] / self.prior_sd[held, None], *starts))

    @cached_property
    def _expected(self) -> Array:
        """Return the products of the prior rows with the prior means."""
        held = np.isfinite(self.prior_sd)
        expected = np.zeros(self._prior.shape[0])
        expected[: held.sum()] = self.prior_mean[held] / self.prior_sd[held]
        return expected

    def judged(self, theta: Array) -> list[Array]:
        """Return the weight (n_y, N) of the samples of each record.

        The weight is zero for samples that a delay hides, and NaN for those that were not measured.

        The weights of the others increase, so that no delay gains by hiding what does not fit, and
        sums of squares stay comparable.
        """
        found = []
        for engine in self.engines:
            # samples that the model cannot determine, behind a delay, have no weight
            seen = engine.judged(theta)
            found.append(seen / (1.0 if seen.all() else np.sqrt(seen.mean(axis=1, keepdims=True))))
            found[-1][np.isnan(engine.data.outputs)] = np.nan
        return found

    @cached_property
    def level(self) -> float:
        """Half the sum of squares of no model at all."""
        return 0.5 * sum(float(np.nansum((self.weights[:, None] * r.outputs) ** 2)) for r in self.records)

    def cost(self, point: Array) -> float:
        """Half the sum of squares."""
        residual = self.evaluate(point).residual
        return 0.5 * float(residual @ residual)

    def bounds(self) -> tuple[Array, Array]:
        """Bounds of the coordinates of a point; initial states are free."""
        lower, upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        # bounds of the coefficients
        for i, parameter in enumerate(self.structure.parameters):
            lower[i], upper[i] = parameter.lower, parameter.upper
        # the excess of an ordered pair is not negative
        for larger, _ in self.coordinates.ordered:
            lower[larger] = 0.0
        return lower, upper

    def box(self) -> tuple[Array, Array]:
        """The bounds, moved inward by a margin."""
        lower, upper = self.bounds()
        # margin that keeps a point off its bounds: tiny against size, bound and width
        own = np.pad(self._theta_sizes, (0, self.size - self.n_theta))
        margin = 1e-10 * np.maximum(own, np.minimum(np.abs(lower), 1e300))
        width = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
        margin = np.minimum(margin, 1e-6 * width)
        low = np.where(np.isfinite(lower), lower + margin, -np.inf)
        high = np.where(np.isfinite(upper), upper - margin, np.inf)
        return low, high

    def inside(self, point: Array) -> Array:
        """The point moved strictly inside its bounds."""
        low, high = self.box()
        # clip in coordinates, where every constraint is a bound
        return self.coordinates.point(np.clip(self.coordinates.of(point), low, high))

    def at_bound(self, point: Array, normal: Array) -> list[str]:
        """Return the labels of the coefficients that lie on a bound.

        A coefficient lies there if the way to the bound changes the residual by less than a thousandth of
        the noise. With a bound other than zero it must also be a thousandth of the bound at most.
        """
        # information matrix in coordinates; its diagonal is the squared effect on the residual
        turned = self.coordinates.columns(self.coordinates.columns(normal, point).T, point)
        felt = np.sqrt(np.maximum(np.diag(turned), 0.0))
        box, found = self.coordinates.of(point), []
        for bound, inner in zip(self.bounds(), self.box(), strict=True):
            for i, parameter in enumerate(self.structure.parameters):
                # distance that changes the residual by a thousandth of the noise
                size, near = abs(bound[i]), 1e-3 / max(felt[i], 1e-300)
                near = np.clip(near, 1e-6 * size, 1e-3 * size) if size else near * (felt[i] > 0)
                if np.isfinite(bound[i]) and abs(box[i] - bound[i]) <= max(
                    near, 2 * abs(inner[i] - bound[i])
                ):
                    found.append(parameter.label)
        return found

    def blocks(self, point: Array) -> list[tuple[Array, Array]]:
        """Residual (n_y, N) and Jacobian (n_y, N, p) of each window.

        They are NaN where nothing was measured.
        """
        residuals, jacobians, _ = zip(*self.own_blocks(point), strict=True)
        return list(zip(residuals, self.whole(jacobians), strict=True))

    def whole(self, jacobians: Sequence[Array]) -> list[Array]:
        """Expand the Jacobian of each record to columns for all unknowns.

        The given ones, (n_y, N, .), have a column for each unknown that affects the record.
        """
        found = []
        for i, own in enumerate(jacobians):
            # columns of other records' initial states stay zero
            found.append(np.zeros((*own.shape[:2], self.size)))
            found[-1][:, :, self.felt_by(i)] = own
        return found

    def own_blocks(
        self, point: Array, gain: Array | None = None
    ) -> list[tuple[Array, Array, NDArray[np.intp]]]:
        """Return residual, Jacobian and indices of the unknowns of each window.

        The Jacobian, (n_y, N, .), has a column for each unknown that affects the window. Both are NaN where
        nothing was measured.
        """
        return self.split(self.evaluate(point, gain))

    def split(self, evaluation: Evaluation) -> list[tuple[Array, Array, NDArray[np.intp]]]:
        """An evaluation as `own_blocks`."""
        # rows of each record, in its shape (n_y, N)
        every = range(len(self.records))
        return [(*evaluation.of_record(i, self.weights.size), evaluation.columns[i]) for i in every]

    def felt_by(self, record: int) -> NDArray[np.intp]:
        """Return the indices of the unknowns that affect a record.

        These are the coefficients, then the initial state of the record.
        """
        # columns: coefficients, then the states of this record
        own = np.arange(self.n_states if self.free_start else 0) + self.n_theta + record * self.n_states
        return np.concatenate([np.arange(self.n_theta), own])

    def sizes_at(self, point: Array) -> Array:
        """Return the natural sizes of the unknowns at a point.

        A coefficient that exceeds its natural size counts with its magnitude; an initial state does not.

        Otherwise the initial state of a body too light to affect the residual could drift ever further.
        """
        sizes = self.sizes.copy()
        # only coefficients grow with their value
        sizes[: self.n_theta] = np.maximum(sizes[: self.n_theta], np.abs(point[: self.n_theta]))
        return sizes


def _equal(one: Sequence[Array | None], other: Sequence[Array | None]) -> bool:
    """Return whether arrays are equal, pair by pair; None equals None only."""
    return all(
        a is b or (a is not None and b is not None and np.array_equal(a, b))
        for a, b in zip(one, other, strict=True)
    )


def _is_bounded(values: Array) -> bool:
    """Return whether the squares of all values are finite.

    A NaN is not finite.
    """
    return not values.size or bool(np.abs(values).max() < _LARGEST)


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
    # rms level of each input and output over all records
    levels = {
        label: float(np.sqrt(np.nanmean(np.concatenate([r[i] for r in rows]) ** 2))) or 1.0
        for labels, rows in (
            (structure.linear_model.input_labels, [r.inputs for r in records]),
            (structure.linear_model.output_labels, [r.outputs for r in records]),
        )
        for i, label in enumerate(labels)
    }
    # acceleration (rate) that a unit of force gives at each place
    pushes = {port.name: float(np.abs(port.act).max(initial=0.0)) for port in model.ports}
    sizes = np.ones(structure.n_parameters)
    for i, parameter in enumerate(structure.parameters):
        effect = structure.effects[parameter.effect]
        units = {coefficient.name: coefficient.unit_rule for coefficient in effect.spec.coefficients}
        unit = units.get(parameter.name, "")
        # offsets and limits: level of the signal
        if unit == "signal":
            sizes[i] = levels.get(effect.place, 1.0)
        # strength of a force: the one that gives a unit rate
        elif unit.startswith("force") and pushes.get(effect.place):
            sizes[i] = 1.0 / pushes[effect.place]
    return sizes


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Weighted residual and Jacobian at one point.

    Attributes
    ----------
    residual : ndarray, shape (rows,)
        Of one record after the other, then of the priors.
    blocks : list of ndarray
        Jacobian of the rows of each record, by what they feel alone.
    columns : list of ndarray of int
        Unknowns that these are: the coefficients and the initial state of that record.
    gaps : list of ndarray of bool, or None
        Rows of each record that were not measured, None for none. Residual and Jacobian are zero there.
    prior : ndarray, shape (., size)
        Jacobian of the rows of the priors.
    finite : bool
        Whether no simulation blew up.
    """

    residual: Array
    blocks: list[Array]
    columns: list[NDArray[np.intp]]
    gaps: list[NDArray[np.bool_] | None]
    prior: Array
    finite: bool

    @property
    def by_record(self) -> list[tuple[slice, Array]]:
        """Rows of each record, and its Jacobian by what it feels alone."""
        ends = np.cumsum([len(block) for block in self.blocks])
        return [(slice(int(end) - len(b), int(end)), b) for end, b in zip(ends, self.blocks, strict=True)]

    def of_record(self, record: int, n_outputs: int) -> tuple[Array, Array]:
        """Return residual (n_y, N) and Jacobian (n_y, N, .) of a record.

        They are NaN where nothing was measured.
        """
        (rows, block), gaps = self.by_record[record], self.gaps[record]
        residual = self.residual[rows]
        if gaps is not None:
            residual, block = np.where(gaps, np.nan, residual), np.where(gaps[:, None], np.nan, block)
        residual = residual.reshape(n_outputs, -1)
        return residual, block.reshape(*residual.shape, block.shape[1])

    def bordered(
        self, count: int, whitener: Whitener | None, turn: Callable[[Array], Array], kept: Any = ...
    ) -> Bordered:
        """Normal equations by records.

        Parameters
        ----------
        count : int
            Coefficients.
        whitener : Whitener or None
            Metric; the rows of the priors stay as they are.
        turn : callable
            Derivatives by the point into those by its coordinates.
        kept : ndarray of int, optional
            Coefficients that move; by default all.
        """
        # priors: those of the coefficients go with the first record, those of its states with each record
        tail = self.residual[sum(len(block) for block in self.blocks) :]
        common = ~self.prior[:, count:].any(axis=1)
        blocks, residuals = [], []
        for k, ((rows, block), columns) in enumerate(zip(self.by_record, self.columns, strict=True)):
            held = self.prior[:, columns[count:]].any(axis=1)
            held = held | common if k == 0 else held
            residual = self.residual[rows]
            # whiten the record; the priors have unit variance
            if whitener is not None:
                residual, block = (whitener.apply([x]) for x in self.of_record(k, len(whitener.filters)))
            # derivatives by the coordinates, then only the columns that move
            J = turn(np.concatenate([block, self.prior[np.ix_(held, columns)]]))
            blocks.append(np.hstack([J[:, :count][:, kept], J[:, count:]]))
            residuals.append(np.concatenate([residual, tail[held]]))
        # normal equations with a block for each record, bordered by the common coefficients
        return Bordered.of(blocks, residuals, blocks[0].shape[1] - self.columns[0].size + count)

    @cached_property
    def jacobian(self) -> Array:
        """All of the Jacobian, shape (rows, size)."""
        found = np.zeros((len(self.residual), self.prior.shape[1]))
        for (rows, block), columns in zip(self.by_record, self.columns, strict=True):
            found[rows, columns] = block
        found[len(found) - len(self.prior) :] = self.prior
        return found

    def normal(self, residual: Array | None = None) -> tuple[Array, Array]:
        """Return J'J, shape (size, size), and J'r of all rows.

        With a residual of the records alone the rows of the priors are left out.
        """
        tail = self.prior if residual is None else self.prior[:0]
        r = self.residual if residual is None else residual
        # J'J and J'r: priors, then one record after the other
        normal, slope = tail.T @ tail, tail.T @ r[len(r) - len(tail) :]
        for (rows, block), columns in zip(self.by_record, self.columns, strict=True):
            normal[np.ix_(columns, columns)] += block.T @ block
            slope[columns] += block.T @ r[rows]
        return normal, slope


@dataclass(frozen=True, slots=True, eq=False)
class Descent:
    """Result of a minimization.

    Attributes
    ----------
    point : ndarray
        Best point.
    cost : float
        Half the sum of squares there, inf where the simulation blows up.
    evaluation : Evaluation
        Plain weighted residual there, and its derivatives.
    converged : bool
        Whether the last step changed the cost by less than the tolerance.
    lack : float
        How much the next full step would lower the cost (half g' H^-1 g): small only at a minimum.
    problem, gain
        What was descended.
    """

    point: Array
    cost: float
    evaluation: Evaluation
    converged: bool
    lack: float = np.inf
    problem: Problem | None = None
    gain: Array | None = None

    def known(self, problem: Problem, gain: Array | None) -> Evaluation | None:
        """Its evaluation, if it is one of this problem led by this gain."""
        return self.evaluation if self.problem is problem and _equal((gain,), (self.gain,)) else None

    def blocks(self, problem: Problem) -> list[tuple[Array, Array]]:
        """Return the residual and the Jacobian of each record.

        The shapes are (n_y, N) and (n_y, N, .); the Jacobian has a column for each unknown that affects the
        record.
        """
        return [(r, j) for r, j, _ in problem.split(self.evaluation)]

    def at_bound(self, problem: Problem) -> list[str]:
        """Labels of the coefficients that stand on a bound there."""
        return problem.at_bound(self.point, self.evaluation.normal()[0])


def descend(
    problem: Problem,
    point: Array,
    *,
    gain: Array | None = None,
    whitener: Whitener | None = None,
    free: NDArray[np.bool_] | None = None,
    evaluations: int = 6,
    tolerance: float = 1e-4,
    unnoticed: float = 0.01,
    known: Evaluation | None = None,
) -> Descent:
    """Lower the cost from a point by damped Gauss-Newton steps.

    Parameters
    ----------
    problem : Problem
        Estimation problem.
    point : ndarray
        Start; moved inside the bounds.
    gain : ndarray, shape (n, n_y), optional
        Observer gain; the free run without it.
    whitener : Whitener, optional
        Metric: generalized least squares with this filter.
    free : ndarray of bool, shape (size,), optional
        Unknowns that move, where not all do.
    evaluations : int
        Simulations at most.
    tolerance : float
        Relative decrease of the cost below which the descent ends.
    unnoticed : float
        Increase of the log likelihood below which it ends as well.
    known : Evaluation, optional
        What is known at the start.

    Returns
    -------
    Descent
    """
    # end of the descent: relative decrease, or a negligible change of the log-likelihood
    tolerance = max(tolerance, 2.0 * unnoticed / problem.n_points)
    low, high = problem.box()
    begin = problem.coordinates.of(point)
    if free is not None:  # held unknowns have equal bounds
        low, high = (np.where(free, bound, np.clip(begin, low, high)) for bound in (low, high))

    def rows(box: Array) -> Rows:  # coordinates in which every constraint is a bound
        here = problem.coordinates.point(box)
        if known is not None and np.array_equal(here, point):
            return _rows(problem, known, here, whitener)
        return _rows(problem, problem.evaluate(here, gain), here, whitener)

    # damped Gauss-Newton (Levenberg-Marquardt) within bounds
    run = gauss_newton(
        rows,
        begin,
        lower=low,
        upper=high,
        sizes=problem.sizes_at,
        evaluations=evaluations,
        settled=lambda cost, gain: gain <= tolerance * cost or cost <= _ROUNDING * problem.level,
    )
    # predicted decrease of a further step
    sizes = problem.sizes_at(run.point)
    lack = promised(run.rows, run.point, low, high, sizes) if np.isfinite(run.cost) else np.inf
    place = problem.coordinates.point(run.point)
    return Descent(place, run.cost, run.rows.more, run.converged, lack, problem, gain)


def _rows(problem: Problem, evaluation: Evaluation, point: Array, whitener: Whitener | None) -> Rows:
    """Return the whitened residual of an evaluation and its derivatives.

    The rows of the priors are not filtered.
    """
    if not evaluation.finite:
        # diverged: infinite cost, the step is rejected
        return Rows(np.full(1, np.inf), evaluation.prior, evaluation)
    # whiten the rows of the records, not those of the priors
    residual, parts = evaluation.residual, problem.split(evaluation)
    if whitener is not None:
        tail = residual[len(residual) - len(evaluation.prior) :]
        residual = np.concatenate([*(whitener.apply([r]) for r, _, _ in parts), tail])
    turn = problem.coordinates.columns
    # one record: its Jacobian as it is
    if len(parts) == 1:
        J = evaluation.jacobian
        if whitener is not None:
            J = np.concatenate([whitener.apply([parts[0][1]]), evaluation.prior])
        return Rows(residual, turn(J, point), evaluation)
    # several records: normal equations, initial states eliminated
    normal = evaluation.bordered(problem.n_theta, whitener, lambda J: turn(J, point))
    return Rows(residual, normal, evaluation)
