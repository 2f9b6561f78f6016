"""The tests that a residual must pass, each for its own sort of fault."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ..data.measurement import Measurement
from ..data.response_record import ResponseRecord, coded
from ..data.signals import over_time
from ..effects.effect import Effect
from ..engine.amplitude_response import ResponseEngine
from ..inference.f_tests import (
    Basis,
    FTest,
    apart_test,
    f_test,
    in_own_units,
    lengths,
    project,
    projected_test,
)
from ..inference.fitted import FittedModel
from ..inference.free_form import Curve
from ..inference.levels import Levels
from ..inference.sensitivities import (
    Candidate,
    force_responses,
    generic_forces,
    parameter_columns,
    slow_forces,
)
from ..inference.starts import Motion
from ..inference.whitening import Whitener, huber_weights
from ..systems.linear import Array

_LAGS = 41
_POWER_LAGS = {2: 21, 3: 6}
_VALUES_PER_COLUMN = 5  # fewer say nothing about that many columns
_SHOWN = ("other laws", "changes with time")  # in front of the other tests
_MOST = 6  # tests that count
_TOGETHER = 16  # candidates whose columns are white at a time: they take the most room


class TestedResidual:
    """Whitened residual of a fitted model.

    The fitted parameters are already projected out.

    Parameters
    ----------
    fitted : FittedModel
        Model at its minimum.
    ratio : float
        Observer ratio: 0 for the free run (sensor noise only), more where an
        unmeasured force acts.
    whitener : Whitener, optional
        Common filter; by default fitted to this residual.
    """

    def __init__(self, fitted: FittedModel, ratio: float = 0.0, whitener: Whitener | None = None) -> None:
        self.fitted, self.ratio = fitted, ratio
        # innovations, whitened; columns of the fit to be projected out
        blocks = fitted.blocks(ratio)
        self.whitener = whitener or fitted.problem.whitener([r for r, _ in blocks])
        self.residual = self.whitener.apply([r for r, _ in blocks])
        self._judged = fitted.problem.judged(fitted.theta)
        p, sizes = fitted.problem.n_theta, fitted.problem.sizes
        lead = [r[:, :, None][:, :, :0] for r, _ in blocks] if ratio else fitted.lead_columns
        common, own = [], []
        for i, (_, j) in enumerate(blocks):
            count = j.shape[2]
            columns = np.concatenate([j * sizes[fitted.problem.felt_by(i)], lead[i]], axis=2)
            white = self.whitener.apply([columns])
            common.append(np.hstack([white[:, :p], white[:, count:]]))
            own.append(white[:, p:count])
        self.basis = replace(Basis.of(common, own), more=sum(self.whitener.orders))
        self.left = project(self.residual, self.basis)
        self._weighted: tuple[Array, Array, Basis] | None = None
        self._outputs = self.whitener.outputs([r for r, _ in blocks])
        # Huber's weights where a few samples are much noisier
        weights = huber_weights(self.left, self._outputs)
        if weights is not None:
            # skewed noise has no mean of zero once it is weighted: each output's level stays open
            levels = (self._outputs[:, None] == np.unique(self._outputs)).astype(float)
            basis = self.basis.weighted(weights, levels)
            self._weighted = weights, project(weights * self.left, basis), basis

    def test(self, name: str, blocks: Sequence[Array]) -> FTest:
        """F-test of columns given as blocks (n_y, N, k) per record."""
        return self.of_white(name, self.whiten(blocks))

    def test_apart(self, name: str, blocks: Sequence[Sequence[Array]]) -> FTest:
        """Return the F-test of columns that each act on one output.

        The columns have the shape (N, k), per output of each record.
        """
        # whiten the columns of each output by its own filter
        white = [
            np.concatenate(
                [
                    self.whitener.of_output(i, judged[i, :, None] * columns[i])
                    for judged, columns in zip(self._judged, blocks, strict=True)
                ]
            )
            for i in range(len(blocks[0]))
        ]
        parts = [(np.flatnonzero(self._outputs == i), columns) for i, columns in enumerate(white)]
        test = apart_test(name, self.left, parts, self.basis)

        def weighted(weights: Array, left: Array, basis: Basis) -> FTest:
            heavy = [(rows, weights[rows, None] * columns) for rows, columns in parts]
            return apart_test(name, left, heavy, basis)

        return self._both(test, weighted)

    def of_white(self, name: str, white: Array) -> FTest:
        """F-test of columns that are white already."""
        return self._beside(f_test(name, self.left, white, self.basis), white)

    def _beside(self, test: FTest, white: Array) -> FTest:
        """The test of white columns with the weighted one beside it."""
        return self._both(test, lambda w, left, basis: f_test(test.name, left, w[:, None] * white, basis))

    def _both(self, test: FTest, weighted: Callable[[Array, Array, Basis], FTest]) -> FTest:
        """Combine a test with its weighted version.

        The weighted version exists where the samples are unequally noisy.
        """
        if self._weighted is None or not test.dof:
            return test
        # Bonferroni over the weighted and the plain test
        other = weighted(*self._weighted)
        return replace(test, p_value=min(1.0, 2.0 * min(test.p_value, other.p_value)))

    def whiten(self, blocks: Sequence[Array]) -> Array:
        """Return columns that are whitened like the residual.

        The columns have the shape (n_y, N, k) per record. They are zero where the residual is not judged.
        """
        judged = [weight[:, :, None] * block for weight, block in zip(self._judged, blocks, strict=True)]
        return self.whitener.apply(judged)

    def each(self, candidates: Sequence[Candidate]) -> list[FTest]:
        """F-test of each candidate on its own."""
        tests = []
        # whiten and project many candidates at once
        for some in (candidates[i : i + _TOGETHER] for i in range(0, len(candidates), _TOGETHER)):
            columns = [c.columns[self.ratio] for c in some]
            joined = [np.concatenate(parts, axis=2) for parts in zip(*columns, strict=True)]
            white = in_own_units(self.whiten(joined))
            size, left, first = lengths(white), project(white, self.basis), 0
            for candidate, parts in zip(some, columns, strict=True):
                mine = slice(first, first + parts[0].shape[2])
                name, first = candidate.effect.label, mine.stop
                test = projected_test(name, self.left, left[:, mine], size[mine], self.basis)
                tests.append(self._beside(test, white[:, mine]))
        return tests

    @cached_property
    def generic(self) -> tuple[list[str], list[Array]]:
        """Return the places of generic forces and the responses to them.

        The forces follow no force law of the library. The responses have the shape (n_y, N, k) per record,
        with one place per column.
        """
        gain, names, blocks = self.fitted.gain(self.ratio), [], []
        for i in range(len(self.fitted.problem.records)):
            forces = generic_forces(self.fitted, self.ratio, i)
            names = [name for name, _ in forces]
            blocks.append(force_responses(self.fitted, i, forces, gain))
        return names, blocks

    @property
    def log_likelihood(self) -> float:
        """Gaussian log-likelihood of the innovations, up to a constant."""
        return self.whitener.log_likelihood(self.fitted.residuals(self.ratio))


def run_tests(
    tested: TestedResidual,
    candidates: Sequence[Candidate],
    motions: Sequence[Motion],
    left_out: int = 0,
    others: Sequence[FTest] | None = None,
) -> list[FTest]:
    """The tests of the gate, each with a p-value of its own.

    Parameters
    ----------
    tested : TestedResidual
        Residual under test.
    candidates : sequence of Candidate
        Library, with columns at the ratio of the tested.
    motions : sequence of Motion
        Estimated motion on each record.
    left_out : int, optional
        Candidates that were left out by what the residual says: they count as tried.
    others : sequence of FTest, optional
        Those without the library, where they are known.

    Returns
    -------
    list of FTest
        ``library`` (Bonferroni over the candidates), ``other laws``, ``changes with
        time``, ``parameters``, ``input``, ``powers of the input``.
    """
    # library first, then the tests with a name, then the others
    known = {test.name: test for test in (_others(tested, motions) if others is None else others)}
    first = [known.pop(name) for name in _SHOWN if name in known]
    return [_library(tested, candidates, left_out), *first, *known.values()]


def passed_without_library(
    tested: TestedResidual, motions: Sequence[Motion], significance: float
) -> list[FTest] | None:
    """Return the tests without candidates if they pass, otherwise None.

    The tests must pass together. They end at the first one that fails for certain.
    """
    tests = []
    for test in _others(tested, motions):
        if test.dof and test.p_value * _MOST < significance:  # however many count beside it
            return None
        tests.append(test)
    return tests if overall(tests) >= significance else None


def _others(tested: TestedResidual, motions: Sequence[Motion]) -> Iterator[FTest]:
    """The tests without the library, those that cost little first."""
    fitted, ratio = tested.fitted, tested.ratio
    records = fitted.problem.records
    # parameters, response patterns, inputs at lags, changes with time, generic forces
    yield _parameters(tested, motions[0])
    if not fitted.problem.in_time:
        yield from response_tests(tested)
        return
    at_once = _at_once(fitted)
    for name, powers in (("input", {1: _LAGS}), ("powers of the input", _POWER_LAGS)):
        columns = sum(powers.values()) * records[0].n_inputs
        share = min(1.0, sum(r.n_samples for r in records) / max(_VALUES_PER_COLUMN * columns, 1))
        lags = {power: max(int(share * most), 2) for power, most in powers.items()}
        yield tested.test_apart(name, [_lagged(r, at_once, lags) for r in records])
    gain = fitted.gain(ratio)
    slow = [force_responses(fitted, i, slow_forces(fitted, ratio, i), gain) for i in range(len(records))]
    yield tested.test("changes with time", slow)
    yield tested.test("other laws", tested.generic[1])


def _library(tested: TestedResidual, candidates: Sequence[Candidate], left_out: int) -> FTest:
    tests = [t for t in tested.each([c for c in candidates if tested.ratio in c.columns]) if t.dof]
    if not tests:
        return FTest("library", 0.0, 0, 1.0, 0.0, 1.0)
    best = most_significant(tests, len(tests) + left_out)
    return replace(best, name=f"library (most: {best.name})")


def most_significant(tests: Sequence[FTest], count: int) -> FTest:
    """Return the most significant test, with Bonferroni's correction."""
    best = min(tests, key=lambda t: t.p_value)
    p_value, p_equal = (min(1.0, count * p) for p in (best.p_value, min(t.p_equal for t in tests)))
    return replace(best, p_value=p_value, p_equal=p_equal)


def _parameters(tested: TestedResidual, motion: Motion) -> FTest:
    """Test whether the parameters of the model itself fit."""
    # score test of the declared parameters that are not fitted
    fitted = tested.fitted
    held = {(e.kind, e.place) for e in fitted.structure.effects}
    effects = [
        Effect(q.kind, q.place) for q in fitted.structure.model.parameters if (q.kind, q.place) not in held
    ]
    if not effects:
        return FTest("parameters", 0.0, 0, 1.0, 0.0, 1.0)
    return tested.test("parameters", parameter_columns(fitted, effects, motion, tested.ratio))


def _at_once(fitted: FittedModel) -> NDArray[np.bool_]:
    """Return whether an output can show an input in the same sample.

    The result has the shape (n_y, n_w). A held input needs a direct path for that. Where there is none, the
    input of the same sample says nothing about the model, and under feedback it is made of the noise of that
    sample.
    """
    records = [engine.data for engine in fitted.problem.engines]  # with the hold of the model
    # direct path through D that is seen above rounding
    direct = fitted.structure.matrices(fitted.theta).D[:, : records[0].n_inputs].real
    moved = np.hstack([r.inputs for r in records]).std(axis=1)
    shown = over_time(np.std, np.hstack([r.outputs for r in records]))
    seen = np.abs(direct) * moved > 1e-9 * shown[:, None]
    return np.asarray(seen | any(record.hold != "zoh" for record in records))


def _lagged(record: Measurement, at_once: NDArray[np.bool_], powers: dict[int, int]) -> list[Array]:
    """Lagged powers of the inputs, for each output on its own: (N, k) each."""
    rows: list[list[Array]] = [[] for _ in range(record.n_outputs)]
    for j, row in enumerate(record.inputs):
        # powers of the normalized input at lags of 0, 1, 2, ... samples
        unit = (row - row.mean()) / (float(np.std(row)) or 1.0)
        for power, lags in powers.items():
            signal = unit**power
            signal = signal - signal.mean()
            for lag in range(lags):
                moved = np.concatenate([np.zeros(lag), signal])[: signal.size]  # a window may be shorter
                for i, own in enumerate(rows):
                    if lag or at_once[i, j]:
                        own.append(moved)
    return [np.reshape(own, (len(own), record.n_samples)).T for own in rows]


def overall(tests: Sequence[FTest]) -> float:
    """Smallest p-value, corrected for the number of tests.

    Parameters
    ----------
    tests : sequence of FTest
        Tests of one residual; those without a degree of freedom do not count.

    Returns
    -------
    float
        0 where nothing could be tested: what was not tested has not passed.
    """
    # Bonferroni
    valid = [t.p_value for t in tests if t.dof]
    return min(1.0, min(valid) * len(valid)) if valid else 0.0


def passes(tests: Sequence[FTest], excess: float, significance: float, levels: Levels) -> bool:
    """Return whether a residual is noise.

    No test is significant, and the residual is no larger than the declared noise.

    Parameters
    ----------
    tests : sequence of FTest
        Tests of the residual.
    excess : float
        Residual over the declared noise, 0 where none was declared.
    significance : float
        Level of the tests together.
    levels : Levels
        Of the excess.

    Returns
    -------
    bool
    """
    return overall(tests) >= significance and excess <= levels.noise_excess


_SHORT_LAGS = 21
_NEIGHBORS = 3


def response_tests(tested: TestedResidual) -> list[FTest]:
    """Test the residual of frequency responses for any other pattern.

    Each test has its own p-value.

    Parameters
    ----------
    tested : TestedResidual
        Residual under test.

    Returns
    -------
    list of FTest
        ``smooth error`` (a factor of any smooth form on each response), ``short response`` (anything
        that dies out within a few samples), ``neighbors`` (points beside each other that err alike).
    """
    tests = [tested.test("smooth error", _smooth(tested)), tested.test("short response", _short(tested))]
    return [*tests, _neighbors(tested)]


def over_frequency(record: ResponseRecord) -> Array:
    """Return piecewise linear functions of the logarithm of frequency.

    They have the shape (n_omega, k), and neighboring values are similar.
    """
    # hat functions over log frequency, with the prior covariance of a smooth curve
    along = np.log(record.omega)
    curve = Curve.along("", along, np.zeros(along.size))
    return np.asarray(curve.columns(along, np.zeros(along.size)) @ curve.root)


def in_rows(record: ResponseRecord, points: Array) -> Array:
    """Convert complex columns to real columns in the rows of a record.

    The shape changes from (n_y, n_w, n_omega, k) to (n_y, N, k).
    """
    return np.stack([coded(column) / record.noise for column in np.moveaxis(points, -1, 0)], axis=-1)


def _responses(tested: TestedResidual) -> list[tuple[ResponseEngine, ResponseRecord]]:
    engines = tested.fitted.problem.engines
    return [(engine, engine.data) for engine in engines if isinstance(engine, ResponseEngine)]


def _path_by_path(tested: TestedResidual, record: ResponseRecord, values: Array) -> Array:
    """Return weighted columns with the values of one path each.

    The values have the shape (n_y, n_w, n_omega, k).
    """
    columns = []
    for path in np.ndindex(values.shape[:2]):
        one = np.zeros(values.shape, complex)
        one[path] = values[path]
        columns.append(one)
    weights = tested.fitted.problem.weights[:, None, None]
    return weights * in_rows(record, np.concatenate(columns, axis=-1))


def _smooth(tested: TestedResidual) -> list[Array]:
    """Smooth complex factors on the response from each input to each output."""
    blocks = []
    for engine, record in _responses(tested):
        # relative error that varies smoothly, complex, for each path
        model, shapes = engine.response(tested.fitted.theta, derivatives=False)[0], over_frequency(record)
        most = max(record.omega.size // _VALUES_PER_COLUMN, 1)
        factors = model[..., None] * (shapes @ np.linalg.svd(shapes, full_matrices=False)[2].T[:, :most])
        both = np.concatenate([factors, 1j * factors], axis=-1)
        blocks.append(_path_by_path(tested, record, both))
    return blocks


def _short(tested: TestedResidual) -> list[Array]:
    """Responses of a few samples from each input to each output."""
    blocks = []
    for _, record in _responses(tested):
        # finite impulse response: exp(-j w T k) for a few lags
        lags = np.arange(min(_SHORT_LAGS, max(record.omega.size // _VALUES_PER_COLUMN, 1)))
        turns = np.exp(-1j * record.omega[:, None] * record.dt * lags)
        every = np.broadcast_to(turns, (record.n_outputs, record.n_inputs, *turns.shape))
        blocks.append(_path_by_path(tested, record, every))
    return blocks


def _neighbors(tested: TestedResidual) -> FTest:
    """Test whether errors at neighboring frequencies are correlated.

    The statistic is the sum of the products of neighbors, relative to their size. The test is one-sided,
    because a missing effect makes neighboring errors similar.
    """
    products = []
    first = 0
    # products of residuals at neighboring frequencies; independent, they sum to about zero
    for _, record in _responses(tested):
        rows = tested.left[first : first + record.noise.size].reshape(-1, record.omega.size)
        first += record.noise.size
        products += [(rows[:, lag:] * rows[:, :-lag]).ravel() for lag in range(1, _NEIGHBORS + 1)]
    all_ = np.concatenate(products)
    size = float(np.sqrt(all_ @ all_))
    statistic = float(all_.sum()) / size if size > 0 else 0.0
    p_value = float(stats.norm.sf(statistic))
    return FTest("neighbors", statistic, 1, p_value, max(statistic, 0.0) ** 2, p_value)


_MOST_PLACES = 8  # up to so many places all are kept: fits cost less than a wrong choice
_KEPT = 3  # places kept for each residual; twice as many for effects with a motion of their own


def in_race(fitted: FittedModel, library: Sequence[Effect], ratios: Sequence[float]) -> list[Effect]:
    """Return the candidates at the places where a free force explains most.

    Parameters
    ----------
    fitted : FittedModel
        Model at its minimum.
    library : sequence of Effect
        Candidate effects.
    ratios : sequence of float
        Observer ratios of the tested residuals, 0 for the free run. The free run suits weak effects, the
        estimated motion strong ones.

    Returns
    -------
    list of Effect
        Candidates in the order of the library; all of them for few places or for frequency responses.
        Effects at inputs, outputs and entries of A are always kept. Effects with a motion of their own are
        kept at more places, since a force along the motion only approximates them.
    """
    # keep all places where there are few, otherwise those with the largest free force
    ports = {port.name for port in fitted.structure.model.ports}
    places = {effect.place for effect in library if effect.place in ports}
    if len(places) <= _MOST_PLACES or not fitted.problem.in_time:
        return list(library)
    orders = [likely_places(TestedResidual(fitted, ratio), places) for ratio in ratios]
    near, far = ({place for order in orders for place in order[:count]} for count in (_KEPT, 2 * _KEPT))
    return [
        effect
        for effect in library
        if effect.place not in ports or effect.place in (far if effect.spec.secant else near)
    ]


def likely_places(tested: TestedResidual, places: set[str]) -> list[str]:
    """Return places, first the one where a free force explains most."""
    names, blocks = tested.generic
    tests = []
    for place in dict.fromkeys(names):
        if place in places:
            mine = np.array([name == place for name in names])
            tests.append(tested.test(place, [block[:, :, mine] for block in blocks]))
    return [t.name for t in sorted(tests, key=lambda t: (t.p_value, -t.statistic))]
